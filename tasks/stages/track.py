"""Track: what moves in every picture, and the keyframes that follow from it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import save_json
from packuv.motion import MotionCache, MotionOptions, measure_motion
from packuv.motion.keyframes import KeyframeOptions, choose_keyframes, motion_curve, segments
from tasks.artefacts.stage import Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.footage import Footage, Take

MOTION, KEYFRAMES = "motion", "keyframes.json"


@dataclass(frozen=True, kw_only=True)
class FindMotion(Stage):
    """Measure optical flow and motion masks of the fitted cameras."""

    name, version = "motion", 3
    take: Take
    options: MotionOptions

    def build(self, work: Work) -> Notes:
        folder = work.scratch / MOTION
        views = Footage(self.take, work.site).open_views()
        cache = measure_motion(views, folder, self.options, workers=work.site.threads, progress=work.progress)
        folder.rename(work.out / MOTION)
        return {"pictures": int((cache.previous >= 0).sum()), "moving_share": float(np.nanmean(_shares(cache)))}


@dataclass(frozen=True, kw_only=True)
class ChooseKeyframes(Stage):
    """Choose keyframes from the motion curve; segments in which nothing moves are named, since nobody fits them."""

    name, version = "keyframes", 2
    motion: Key
    options: KeyframeOptions

    def build(self, work: Work) -> Notes:
        cache = MotionCache.load(work.path(self.motion) / MOTION)
        curve = motion_curve(cache.magnitude, cache.names, self.options)
        keyframes = choose_keyframes(curve, self.options)
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

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        for still in read_still(folder):
            why = f"nothing moves in instants {still.start} to {still.stop - 1}; each repeats the keyframe"
            yield f"fit frames {still.start}-{still.stop - 1}", why


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
