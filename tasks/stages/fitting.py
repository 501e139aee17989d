"""Fit: the backdrop, keyframes, and the frames between them segment by segment."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.triangulate import SparsePoints
from packuv.budget import Budget
from packuv.files import save_json
from packuv.fit.bands import told
from packuv.fit.frames import fit_segment
from packuv.fit.gpu_memory import FitLoad, GpuMemory, fit_memory
from packuv.fit.keyframe import KeyState, enough_stands_still, fit_backdrop, fit_first, fit_next
from packuv.fit.options import FirstOptions, FrameOptions, NextOptions
from packuv.fit.patch import fit_patch, whole_places
from packuv.fit.seam import seam, tail
from packuv.fit.start.points import Points
from packuv.gaussians.rows import hold_absent
from packuv.gaussians.segment import Segment
from packuv.motion import (
    BackgroundOptions,
    MotionCache,
    MotionOptions,
    Plate,
    Still,
    compare_plate,
    epochs,
    find_background,
    load_stills,
    patched,
    save_stills,
)
from sync.align import FrameGroups
from sync.capture import find_capture, find_plate
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import POINTS
from tasks.stages.footage import Footage, Take
from tasks.stages.plan import Plan
from tasks.stages.synchronize import selected
from tasks.stages.track import MOTION, read_patches

SEGMENT, FIGURES, STILLS, SEAM = "segment.npz", "fit.json", "stills.npz", "seam.json"
PLATES, REFUSED = "plates.json", "refused"
SURE_VIEWS = 3
"""Cameras that must see a point for Gaussians to start there; two may agree by chance"""


@dataclass(frozen=True, kw_only=True)
class FindBackground(Stage):
    """Find what stands still in each fitted camera: stills.npz."""

    name, version = "background", 2
    take: Take
    options: BackgroundOptions

    def build(self, work: Work) -> Notes:
        footage, threads = Footage(self.take, work.site), work.site.threads
        stills = find_background(footage.open_views(), self.options, work.progress,
                                 silhouettes=footage.open_silhouettes(), workers=threads)  # fmt: skip
        save_stills(work.out / STILLS, stills)
        return {"cameras": len(stills), "known_share": float(np.mean([still.known.mean() for still in stills] or [0]))}


@dataclass(frozen=True, kw_only=True)
class UsePlate(Stage):
    """Take the background from videos of the empty stage, and for other cameras as ever: stills.npz, plates.json."""

    name, version = "background", 1
    take: Take
    plate: Files
    """Videos of the empty stage by camera"""
    options: BackgroundOptions

    def build(self, work: Work) -> Notes:
        footage, cameras = Footage(self.take, work.site), self.take.cameras
        found = find_background(footage.open_views(), self.options, work.progress,
                                silhouettes=footage.open_silhouettes())  # fmt: skip
        own = {cameras[still.camera]: still for still in found}
        videos = {name: video for name, video in find_plate(find_capture(work.site.capture)).items() if name in cameras}
        views = footage.open_plate(videos, self.options.instants)
        shown = {views.names[s.camera]: s for s in find_background(views, self.options, work.progress, least=1)}
        plates = {name: compare_plate(still, own.get(name), self.options) for name, still in shown.items()}
        good = {name: plate.still for name, plate in plates.items() if plate.fits}
        stills = [replace(still, camera=cameras.index(name)) for name, still in {**own, **good}.items()]
        stills.sort(key=lambda still: still.camera)
        save_stills(work.out / STILLS, stills)
        save_json(work.out / PLATES, {name: _plate_facts(plate) for name, plate in plates.items()})
        known = float(np.mean([still.known.mean() for still in stills] or [0]))
        without = [name for name in cameras if name not in plates]
        refused = {name: _refusal(plate) for name, plate in plates.items() if not plate.fits}
        relit = {name: plate.gains for name, plate in plates.items() if plate.fits and set(plate.gains) != {1.0}}
        counts = {"cameras": len(stills), "known_share": known, "plates": len(good)}
        return {**counts, "relit": relit, "without": without, REFUSED: refused}

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if notes["without"]:
            yield "clean plate", f"no video of {', '.join(notes['without'])}, which use what stands still in the take"
        for name, why in notes[REFUSED].items():
            yield f"clean plate of {name}", why


@dataclass(frozen=True, kw_only=True)
class FitBackdrop(Stage):
    """Fit what stands still, from which all keyframes start: state.npz and key.json, with the quantizer of all."""

    name, version = "backdrop", 6
    take: Take
    background: Key
    options: FirstOptions

    @property
    def label(self) -> str:
        return "fit backdrop"

    def gpu_memory(self, work: Work) -> GpuMemory:
        cap = round(self.options.backdrop_share * self.options.density.cap)
        return _first_memory(work, self.take, self.options, cap)

    def build(self, work: Work) -> Notes:
        views = Footage(self.take, work.site).open_views(spill=work.scratch)
        state = fit_backdrop(
            views,
            _stills(work, self.background, views.budget),
            points=_points(work, self.take),
            options=self.options,
            progress=work.progress,
        )
        state.save(work.out)
        return dict(state.figures)

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        yield from _spared_bands(notes)


@dataclass(frozen=True, kw_only=True)
class PatchBackground(Stage):
    """What stands still between two dates: that of the whole sequence, but where something changes for good the median
    of these instants: stills.npz."""

    name, version = "background", 1
    take: Take
    background: Key
    patches: Key
    epoch: int
    """Counted from 0, the time before the first date"""
    options: BackgroundOptions

    @property
    def label(self) -> str:
        return f"background of epoch {self.epoch + 1}"

    def build(self, work: Work) -> Notes:
        footage, found = Footage(self.take, work.site), read_patches(work.path(self.patches)).found
        views, silhouettes = footage.open_views(), footage.open_silhouettes()
        among = epochs([patch.date for patch in found], len(views))[self.epoch]
        own = {
            still.camera: still
            for still in find_background(
                views, self.options, work.progress, silhouettes=silhouettes, among=among, workers=work.site.threads
            )
        }
        stills = []
        for usual in _stills(work, self.background, views.budget):
            masks = [whole_places(p.masks[usual.camera], views.cameras[usual.camera])
                     for p in found if usual.camera in p.masks]  # fmt: skip
            seen = masks and usual.camera in own
            stills.append(patched(usual, own[usual.camera], np.any(masks, axis=0)) if seen else usual)
        save_stills(work.out / STILLS, stills)
        return {"cameras": len(stills), "known_share": float(np.mean([still.known.mean() for still in stills] or [0]))}


@dataclass(frozen=True, kw_only=True)
class PatchBackdrop(Stage):
    """Fit the backdrop of an epoch from that of one beside it: state.npz and key.json."""

    name, version = "backdrop", 4
    take: Take
    previous: Key
    before: Key
    """Background of `previous`"""
    after: Key
    options: NextOptions
    epoch: int = field(compare=False)

    @property
    def label(self) -> str:
        return f"patch backdrop for epoch {self.epoch + 1}"

    def gpu_memory(self, work: Work) -> GpuMemory:
        return _next_memory(work, self.take, KeyState.load(work.path(self.previous)), self.options.density.cap)

    def build(self, work: Work) -> Notes:
        views = Footage(self.take, work.site).open_views(spill=work.scratch)
        state = fit_patch(
            KeyState.load(work.path(self.previous)),
            views,
            _stills(work, self.before, views.budget),
            _stills(work, self.after, views.budget),
            options=self.options,
            progress=work.progress,
        )
        state.save(work.out)
        return dict(state.figures)


@dataclass(frozen=True, kw_only=True)
class FitFirst(Stage):
    """Fit the keyframe that a chain without backdrop starts with: state.npz and key.json, with the quantizer of all."""

    name, version = "key", 12
    take: Take
    instant: int
    options: FirstOptions

    @property
    def label(self) -> str:
        return f"fit keyframe {self.instant}"

    def gpu_memory(self, work: Work) -> GpuMemory:
        return _first_memory(work, self.take, self.options, self.options.density.cap)

    def build(self, work: Work) -> Notes:
        state = fit_first(
            Footage(self.take, work.site).open_views(spill=work.scratch),
            self.instant,
            points=_points(work, self.take),
            options=self.options,
            progress=work.progress,
        )
        state.save(work.out)
        return dict(state.figures)

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        yield from _spared_bands(notes)


@dataclass(frozen=True, kw_only=True)
class FitNext(Stage):
    """Fit a keyframe from the backdrop, another keyframe, or the last frame of that one's segment: state.npz and
    key.json."""

    name, version = "key", 9
    take: Take
    background: Key | None
    previous: Key
    end: Key | None
    """Segment of `previous` from whose last frame to go on"""
    instant: int
    motion: MotionOptions
    options: NextOptions

    @property
    def label(self) -> str:
        return f"fit keyframe {self.instant}{f' after {self.instant - 1}' if self.end else ''}"

    def gpu_memory(self, work: Work) -> GpuMemory:
        before = KeyState.load(work.path(self.previous))
        most = max(self.options.density.cap - before.backdrop, len(before.foreground))
        return _next_memory(work, self.take, before, most)

    def build(self, work: Work) -> Notes:
        before = KeyState.load(work.path(self.previous))
        if self.end:
            before = tail(before, Segment.load(work.path(self.end) / SEGMENT))
        footage = Footage(self.take, work.site)
        views = footage.open_views(spill=work.scratch)
        state = fit_next(
            before,
            views,
            self.instant,
            silhouettes=footage.open_silhouettes(),
            stills=_stills(work, self.background, views.budget),
            motion=self.motion,
            options=self.options,
            progress=work.progress,
        )
        state.save(work.out)
        return dict(state.figures)


@dataclass(frozen=True, kw_only=True)
class FitSegment(Stage):
    """Fit the instants of a segment, which starts with its keyframe: segment.npz and fit.json."""

    name, version = "segment", 7
    take: Take
    motion: Key
    key: Key
    span: tuple[int, int]
    """Instants, half-open"""
    options: FrameOptions
    number: int = field(compare=False)
    """Which one of the sequence, counted from 1"""

    @property
    def label(self) -> str:
        return f"fit segment {self.number} (frames {self.span[0]}-{self.span[1] - 1})"

    def gpu_memory(self, work: Work) -> GpuMemory:
        key = KeyState.load(work.path(self.key))
        return _next_memory(work, self.take, key, len(key.foreground) + self.options.spare, instants=2)

    def build(self, work: Work) -> Notes:
        segment, figures = fit_segment(
            KeyState.load(work.path(self.key)),
            Footage(self.take, work.site).open_views(spill=work.scratch),
            range(*self.span),
            motion=MotionCache.load(work.path(self.motion) / MOTION),
            options=self.options,
            scratch=work.scratch,
            workers=work.site.threads,
            progress=work.progress,
        )
        hold_absent(segment).save(work.out / SEGMENT)
        save_json(work.out / FIGURES, {"frames": figures})
        return {"frames": len(segment), "gaussians": len(segment.key), "dynamic": int(segment.dynamic.sum())}


@dataclass(frozen=True, kw_only=True)
class CutSegment(Stage):
    """The first frames of a segment, as a segment."""

    name, version = "segment", 7
    small = True
    segment: Key
    frames: int

    def build(self, work: Work) -> Notes:
        folder, frames = work.path(self.segment), self.frames
        whole = Segment.load(folder / SEGMENT)
        part = replace(whole, xyz=whole.xyz[: frames - 1], attributes=whole.attributes[: frames - 1])
        part.save(work.out / SEGMENT)
        figures = json.loads((folder / FIGURES).read_text())["frames"][: frames - 1]
        save_json(work.out / FIGURES, {"frames": figures})
        return {"frames": frames, "gaussians": len(part.key), "dynamic": int(part.dynamic.sum())}


@dataclass(frozen=True, kw_only=True)
class MeasureSeam(Stage):
    """Measure how much the border between a keyframe's segment and the keyframe `after` it shows: seam.json."""

    name, version = "seam", 2
    take: Take
    key: Key
    segment: Key
    after: Key

    def build(self, work: Work) -> Notes:
        before, after = (KeyState.load(work.path(key)) for key in (self.key, self.after))
        views = Footage(self.take, work.site).open_views()
        found = seam(before, Segment.load(work.path(self.segment) / SEGMENT), after, views)
        facts = {"ratio": found if math.isfinite(found) else None}
        save_json(work.out / SEAM, facts)
        return facts


def background_of(workshop: Workshop, take: Take, options: BackgroundOptions) -> FindBackground | UsePlate:
    """The stage for a take."""
    videos = {name: video for name, video in find_plate(workshop.capture).items() if name in take.cameras}
    if not videos:
        return FindBackground(take=take, options=options)
    return UsePlate(take=take, plate=workshop.files(videos, "reading plate"), options=options)


def lacks_backdrop(workshop: Workshop, background: Key, pictures: int) -> str | None:
    """Why keyframes cannot build on a backdrop, where so many cameras film at once; None where they can."""
    notes = workshop.store.receipt(background).notes
    cameras, known = notes["cameras"], notes["known_share"]
    if enough_stands_still(cameras, known, pictures):
        return None
    return (
        f"{cameras} of {pictures} cameras show what stands still, and {known:.0%} of their pictures; each keyframe is "
        "fitted whole"
    )


def count_pictures(workshop: Workshop, plan: Plan, groups: Key, instants: Sequence[int]) -> list[int]:
    """How many of the fitted cameras filmed each of the plan's instants."""
    found = FrameGroups.load(workshop.path(groups))
    columns = [found.cameras.index(name) for name in plan.fitted]
    first = selected(found, plan.first, plan.stop).start
    return [int((found.frames[first + instant, columns] >= 0).sum()) for instant in instants]


def read_seam(folder: Path) -> float | None:
    """Flicker across a border over that before it; None where nobody can tell."""
    ratio: float | None = json.loads((folder / SEAM).read_text())["ratio"]
    return ratio


def read_losses(folder: Path) -> list[float]:
    """Loss of each frame after a segment's keyframe, NaN where nothing moved."""
    frames = json.loads((folder / FIGURES).read_text())["frames"]
    return [frame.get("loss", math.nan) for frame in frames]


def _first_memory(work: Work, take: Take, options: FirstOptions, gaussians: int) -> GpuMemory:
    """Of a fit that starts from nothing."""
    load = FitLoad(_sides(work, take), gaussians, sh_degree=options.sh_degree, depths=options.shell.places)
    return fit_memory(load, budget_bytes=work.site.memory_bytes)


def _next_memory(work: Work, take: Take, before: KeyState, gaussians: int, *, instants: int = 1) -> GpuMemory:
    """Of a fit that starts from a keyframe or the backdrop, of which so many may change."""
    load = FitLoad(_sides(work, take), gaussians, before.backdrop, before.quantizer.sh_degree, instants=instants)
    return fit_memory(load, budget_bytes=work.site.memory_bytes)


def _sides(work: Work, take: Take) -> list[tuple[int, int]]:
    return [(camera.width, camera.height) for camera in Footage(take, work.site).open_views().cameras]


def _spared_bands(notes: Notes) -> Iterator[tuple[str, str]]:
    """View dependence that was asked for and is not carried, and on what evidence."""
    if notes.get("sh", {}).get("degree", 0) < notes.get("sh", {}).get("asked", 0):
        yield "view dependence", told(notes["sh"])


def _plate_facts(plate: Plate) -> dict[str, Any]:
    return {
        "used": plate.fits,
        "known_share": float(plate.still.known.mean()),
        "gains": plate.gains,
        "agreement": plate.agreement,
        "likeness": plate.likeness,
    }


def _refusal(plate: Plate) -> str:
    return (
        f"its clean plate shows another place (detail correlates by {plate.likeness:.2f}); has the camera been moved, "
        "or the stage rebuilt? What stands still in the take serves instead"
    )


def _stills(work: Work, background: Key | None, budget: Budget) -> Sequence[Still]:
    return load_stills(work.path(background) / STILLS, budget) if background else []


def _points(work: Work, take: Take) -> Points | None:
    """Where surfaces surely are; of what moved on since, a fit prunes the few points that it starts with."""
    assert take.rig is not None, "points lie beside the rig"
    path = work.path(take.rig) / POINTS
    if not path.exists():
        return None
    sparse = SparsePoints.load(path)
    sure = sparse.views >= SURE_VIEWS
    return Points(sparse.xyz[sure], sparse.rgb[sure] / 255)
