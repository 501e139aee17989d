"""Track: what moves in every picture, what changes for good, and the keyframes that follow from both."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import save_json
from packuv.fit.patch import in_one_place
from packuv.footage import Views
from packuv.motion import (
    MotionCache,
    MotionOptions,
    Patches,
    PatchOptions,
    Raft,
    RaftOptions,
    find_patches,
    measure_motion,
)
from packuv.motion.keyframes import KeyframeOptions, choose_keyframes, motion_curve, segments
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.footage import Footage, Take

MOTION, KEYFRAMES, PATCHES = "motion", "keyframes.json", "patches.npz"
RAFT = "raft"
"""Name of its weights among the files that a stage reads"""
REPEATS = "repeats"
"""Key in the notes of cameras that repeat pictures; missing where none does"""
FEWEST_REPEATS, LEAST_REPEATED = 3, 0.1
"""Pictures that a camera must repeat to be named, and their share of all that follow another one"""
COMPARED = 4
"""Pairs of pictures in which nothing moves that are compared, evenly spread"""
MOST_UNLIKE = 0.05
"""Share of a picture's pixels by which a repeated one may differ: codecs mend it a little (0.7 to 3 % measured), while
noise of pictures that are filmed anew changes far more"""


@dataclass(frozen=True, kw_only=True)
class FindMotion(Stage):
    """Measure optical flow and motion masks of the fitted cameras."""

    name, version = "motion", 3
    take: Take
    options: MotionOptions

    def build(self, work: Work) -> Notes:
        folder = work.scratch / MOTION
        views = Footage(self.take, work.site).open_views()
        raft, threads = self.raft_model(), work.site.threads
        cache = measure_motion(views, folder, self.options, raft=raft, workers=threads, progress=work.progress)
        folder.rename(work.out / MOTION)
        measured = cache.previous >= 0  # nothing where there is a single instant
        share = float(np.nanmean(_shares(cache))) if measured.any() else 0.0
        repeats = find_repeats(cache, views)
        return {"pictures": int(measured.sum()), "moving_share": share, **({REPEATS: repeats} if repeats else {})}

    def raft_model(self) -> Raft | None:
        """What estimates optical flow instead of DIS."""
        return None


def find_repeats(cache: MotionCache, views: Views) -> dict[str, list[int]]:
    """Cameras that give one picture several times while most others see something move: how many of their pictures
    are still then, and how many follow another one. A sample of the still ones must be the same but for what codecs do:
    what cameras film anew has noise."""
    there = cache.previous >= 0
    moves = there & (cache.steps["share"] > 0)
    found = {}
    for column, name in enumerate(cache.names):
        own, others = moves[:, column], np.delete(np.arange(len(cache.names)), column)
        alive = 2 * moves[:, others].sum(axis=1) > there[:, others].sum(axis=1)
        still, steps = np.flatnonzero(there[:, column] & ~own & alive), int(there[:, column].sum())
        if len(still) >= max(FEWEST_REPEATS, LEAST_REPEATED * steps):
            some = still[np.linspace(0, len(still) - 1, COMPARED).round().astype(int)]
            if all(_unlike(views, column, cache.previous[t, column], t) <= MOST_UNLIKE for t in some):
                found[name] = [len(still), steps]
    return found


def _unlike(views: Views, camera: int, *instants: int) -> float:
    """Share of the pixels that differ between two instants."""
    before, after = (views.pixels(camera, instant, remember=False) for instant in instants)
    return 1.0 if before is None or after is None else float((before != after).any(axis=2).mean())


def repeats_told(notes: Notes) -> Iterator[str]:
    """Of the notes of FindMotion, for people."""
    for name, (still, steps) in notes.get(REPEATS, {}).items():
        why = "is its lens covered, or did it hang?" if still == steps else "did it hang, or was its rate converted?"
        yield (
            f"{name}: {still} of {steps} pictures repeat the one before, where most cameras see something move: {why} "
            "Repeated pictures count as filmed at their times; list the camera under 'ignore' in capture.toml if they "
            "are wrong"
        )


@dataclass(frozen=True, kw_only=True)
class FindMotionByRaft(FindMotion):
    """Measure the same with optical flow by RAFT."""

    network: Files
    """Digest of the file at `weights`, under RAFT"""
    raft: RaftOptions
    """Without the name of that file"""
    weights: str = field(default="", compare=False)
    """Path of the weights"""

    def raft_model(self) -> Raft:
        model = Raft(Path(self.weights), updates=self.raft.updates, device=self.raft.device)
        if model.facts["sha256"] != self.network.sha256[RAFT]:
            raise ValueError(f"{self.weights} changed since it was first read; run the command again")
        return model


@dataclass(frozen=True, kw_only=True)
class DatePatches(Stage):
    """Find what changes for good in the fitted cameras, and when: patches.npz."""

    name, version = "patches", 1
    take: Take
    options: PatchOptions

    def build(self, work: Work) -> Notes:
        views = Footage(self.take, work.site).open_views()
        all_found = find_patches(views, self.options, workers=work.site.threads, progress=work.progress)
        placed = {patch.date: in_one_place(patch.masks, views.cameras) for patch in all_found.found}
        real = tuple(patch for patch in all_found.found if placed[patch.date])
        replace(all_found, found=real).save(work.out / PATCHES)
        return {
            "patches": [{"instant": p.date, "cameras": [views.names[c] for c in sorted(p.masks)]} for p in real],
            "scattered": [date for date, together in placed.items() if not together],
            "cuts": list(all_found.cuts),
        }

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        for date in notes["scattered"]:
            yield f"patch at {date}", "what changes in these cameras is no one place; it stays foreground"
        for date in notes["cuts"]:
            why = f"more than {self.options.most_area:.0%} of the pictures change at once: is the scene cut there?"
            yield f"patch at {date}", f"{why} If so, process the parts apart with --frames"
        if not any(notes.values()):
            yield "patches", "no lasting change found"


@dataclass(frozen=True, kw_only=True)
class ChooseKeyframes(Stage):
    """Choose keyframes from the motion curve; segments in which nothing moves are named, since nobody fits them."""

    name, version = "keyframes", 2
    small = True
    motion: Key
    options: KeyframeOptions

    def build(self, work: Work) -> Notes:
        cache = MotionCache.load(work.path(self.motion) / MOTION)
        curve = motion_curve(cache.magnitude, cache.names, self.options)
        keyframes = choose_keyframes(curve, self.options, self.dates(work))
        spans = segments(keyframes, len(curve))
        moving = np.nan_to_num(_shares(cache)).max(axis=1) > 0  # [T]
        facts = {
            "keyframes": [{"instant": item.instant, "reason": str(item.reason)} for item in keyframes],
            "spans": [[span.start, span.stop] for span in spans],
            "still": [not bool(moving[span.start + 1 : span.stop].any()) for span in spans],
            "curve_px": curve.tolist(),
        }
        save_json(work.out / KEYFRAMES, facts)
        return {"keyframes": len(keyframes), "instants": len(curve)}

    def dates(self, work: Work) -> tuple[int, ...]:
        """Instants that are keyframes whatever moves there."""
        return ()

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        for still in read_still(folder):
            why = f"nothing moves in instants {still.start} to {still.stop - 1}; each repeats the keyframe"
            yield f"fit frames {still.start}-{still.stop - 1}", why


@dataclass(frozen=True, kw_only=True)
class ChooseDatedKeyframes(ChooseKeyframes):
    """Choose keyframes where something changes for good, and others as ever."""

    patches: Key

    def dates(self, work: Work) -> tuple[int, ...]:
        return read_patches(work.path(self.patches)).dates


def read_patches(folder: Path) -> Patches:
    """What changes for good."""
    return Patches.load(folder / PATCHES)


def read_spans(folder: Path) -> list[range]:
    """Instants of each segment."""
    return [range(*span) for span in _read(folder)["spans"]]


def read_still(folder: Path) -> list[range]:
    """Segments of more than one instant in which nothing moves."""
    data = _read(folder)
    spans = zip(data["spans"], data["still"], strict=True)
    return [range(*span) for span, still in spans if still and span[1] - span[0] > 1]


def read_keyframes(folder: Path) -> list[int]:
    """Instants of the keyframes."""
    return [item["instant"] for item in _read(folder)["keyframes"]]


def read_curve(folder: Path) -> list[float]:
    """M(t), pixels per instant."""
    curve: list[float] = _read(folder)["curve_px"]
    return curve


def _read(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / KEYFRAMES).read_text())
    return found


def _shares(cache: MotionCache) -> np.ndarray:
    """float32 [T, C]: share of the picture that moves, NaN without a step to the instant."""
    return cache.steps["share"]
