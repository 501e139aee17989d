"""Fit: the chain of keyframes, and the frames between them segment by segment."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.triangulate import SparsePoints
from packuv.files import save_json
from packuv.fit import frames, keyframe
from packuv.fit.keyframe import KeyState
from packuv.fit.options import FitOptions
from packuv.fit.seam import seam, tail
from packuv.fit.start.points import Points
from packuv.footage import Views
from packuv.gaussians.rows import hold_absent
from packuv.gaussians.segment import Segment
from packuv.motion import (
    BackgroundOptions,
    MotionCache,
    MotionOptions,
    Still,
    changed_between,
    load_stills,
    save_stills,
)
from packuv.motion import find_background as measure_background
from packuv.progress import Progress
from sync.align import FrameGroups
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import POINTS
from tasks.stages.footage import Footage, PictureOptions, footage_of
from tasks.stages.plan import Plan
from tasks.stages.synchronize import selected
from tasks.stages.track import MOTION

VERSION = 1
SEGMENT, FIGURES, STILLS, SEAM = "segment.npz", "fit.json", "stills.npz", "seam.json"
SURE_VIEWS = 3
"""Cameras that must see a point for Gaussians to start there; two may agree by chance"""


def count_pictures(workshop: Workshop, plan: Plan, groups: Key, instants: Sequence[int]) -> list[int]:
    """How many of the fitted cameras filmed each of the plan's instants."""
    found = FrameGroups.load(workshop.path(groups))
    columns = [found.cameras.index(name) for name in plan.fitted]
    first = selected(found, plan.first, plan.stop).start
    return [int((found.frames[first + instant, columns] >= 0).sum()) for instant in instants]


def find_background(
    workshop: Workshop, plan: Plan, groups: Key, points: Key, pictures: PictureOptions, options: BackgroundOptions
) -> Key | None:
    """Find what stands still in each fitted camera: stills.npz. None where the options ask for no background."""
    if not options.iteration_share:
        workshop.listener.skipped("background", "fit.background.iteration_share is 0")
        return None
    options = replace(options, iteration_share=BackgroundOptions().iteration_share)  # how it is used changes nothing
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=plan.fitted, pictures=pictures),
        "options": options,
    }
    reads = {
        "background": options,
        "pictures": pictures,
        "cameras": plan.fitted,
        "first": plan.first,
        "stop": plan.stop,
    }
    inputs = {"groups": groups, "points": points}
    return workshop.make("background", VERSION, reads, inputs, "tasks.stages.fitting:build_background", arguments)


def fit_first(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    background: Key | None,
    instant: int,
    pictures: PictureOptions,
    motion: MotionOptions,
    options: FitOptions,
) -> Key:
    """Fit the keyframe that the chain starts with: state.npz and key.json, with the quantizer of all."""
    options = _without(options, "key_iterations", "frame_iterations", "frame_rate_scale", "settle", "lift", "labels")
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=plan.fitted, pictures=pictures),
        "points": workshop.path(points) / POINTS,
        "background": _stills_path(workshop, background),
        "instant": instant,
        "motion": motion,
        "options": options,
    }
    reads = {**_reads(plan, pictures, options), "instant": instant, "motion": motion}
    inputs = {"groups": groups, "points": points, **({"background": background} if background else {})}
    return workshop.make(
        "key", VERSION, reads, inputs, "tasks.stages.fitting:build_first", arguments, label=f"fit key {instant}"
    )


def fit_next(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    background: Key | None,
    previous: Key,
    end: Key | None,
    step: tuple[int, int],
    pictures: PictureOptions,
    motion: MotionOptions,
    options: FitOptions,
) -> Key:
    """Fit the keyframe at instant `step[1]` from the one at `step[0]`, or from the last frame of its segment `end`."""
    options = _without(
        options, "iterations", "frame_iterations", "frame_rate_scale", "settle", "lift", "shell", "background"
    )
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=plan.fitted, pictures=pictures),
        "previous": workshop.path(previous),
        "end": workshop.path(end) / SEGMENT if end else None,
        "background": _stills_path(workshop, background),
        "instant": step[1],
        "motion": motion,
        "options": options,
    }
    reads = {**_reads(plan, pictures, options), "motion": motion, "step": step}
    inputs = {"groups": groups, "points": points, "previous": previous}
    inputs |= {"background": background} if background else {}
    inputs |= {"end": end} if end else {}
    label = f"fit key {step[1]}{f' after {step[0]}' if end else ''}"
    return workshop.make("key", VERSION, reads, inputs, "tasks.stages.fitting:build_next", arguments, label=label)


def fit_segment(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    motion: Key,
    key: Key,
    span: range,
    pictures: PictureOptions,
    options: FitOptions,
) -> Key:
    """Fit the instants of a segment, which starts with its keyframe: segment.npz and fit.json."""
    options = _without(
        options, "iterations", "key_iterations", "coarse_share", "float_share", "start", "shell", "background"
    )
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=plan.fitted, pictures=pictures),
        "key": workshop.path(key),
        "motion": workshop.path(motion) / MOTION,
        "span": (span.start, span.stop),
        "options": options,
    }
    reads = {**_reads(plan, pictures, options), "span": (span.start, span.stop)}
    inputs = {"groups": groups, "points": points, "motion": motion, "key": key}
    label = f"fit {span.start}-{span.stop - 1}"
    return workshop.make(
        "segment", VERSION, reads, inputs, "tasks.stages.fitting:build_segment", arguments, label=label
    )


def measure_seam(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    key: Key,
    segment: Key,
    after: Key,
    pictures: PictureOptions,
) -> Key:
    """Measure how much the border between a keyframe's segment and the keyframe `after` it shows: seam.json."""
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=plan.fitted, pictures=pictures),
        "key": workshop.path(key),
        "segment": workshop.path(segment) / SEGMENT,
        "after": workshop.path(after),
    }
    reads = {"pictures": pictures, "cameras": plan.fitted, "first": plan.first}
    inputs = {"groups": groups, "points": points, "key": key, "segment": segment, "after": after}
    return workshop.make("seam", VERSION, reads, inputs, "tasks.stages.fitting:build_seam", arguments)


def read_seam(workshop: Workshop, key: Key) -> float | None:
    """Flicker across a border over that before it; None where nobody can tell."""
    return json.loads((workshop.path(key) / SEAM).read_text())["ratio"]


def read_losses(workshop: Workshop, segment: Key) -> list[float]:
    """Loss of each frame after a segment's keyframe, NaN where nothing moved."""
    frames = json.loads((workshop.path(segment) / FIGURES).read_text())["frames"]
    return [frame.get("loss", math.nan) for frame in frames]


def cut_segment(workshop: Workshop, segment: Key, frames: int) -> Key:
    """The first frames of a segment, as a segment."""
    arguments = {"segment": workshop.path(segment), "frames": frames}
    inputs = {"segment": segment}
    return workshop.make("segment", VERSION, {"frames": frames}, inputs, "tasks.stages.fitting:build_cut", arguments)


def build_background(footage: Footage, options: BackgroundOptions, out: Path, progress: Progress) -> dict[str, Any]:
    """The job behind `find_background`."""
    stills = measure_background(footage.open_views(), options, progress)
    save_stills(out / STILLS, stills)
    return {"cameras": len(stills), "known_share": float(np.mean([still.known.mean() for still in stills] or [0]))}


def build_first(
    footage: Footage,
    points: Path,
    background: Path | None,
    instant: int,
    motion: MotionOptions,
    options: FitOptions,
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """The job behind `fit_first`."""
    known = _sure_points(SparsePoints.load(points)) if points.exists() else None
    state = keyframe.fit_first(
        footage.open_views(),
        instant,
        points=known,
        stills=_stills(background),
        motion=motion,
        options=options,
        progress=progress,
    )
    state.save(out)
    return dict(state.figures)


def build_next(
    footage: Footage,
    previous: Path,
    end: Path | None,
    background: Path | None,
    instant: int,
    motion: MotionOptions,
    options: FitOptions,
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """The job behind `fit_next`."""
    views, before = footage.open_views(), KeyState.load(previous)
    if end:
        before = tail(before, Segment.load(end))
    masks = _changes(views, before.instant, instant, motion)
    state = keyframe.fit_next(
        before,
        views,
        instant,
        masks=masks,
        stills=_stills(background),
        motion=motion,
        options=options,
        progress=progress,
    )
    state.save(out)
    return dict(state.figures)


def build_segment(
    footage: Footage,
    key: Path,
    motion: Path,
    span: tuple[int, int],
    options: FitOptions,
    out: Path,
    scratch: Path,
    progress: Progress,
) -> dict[str, Any]:
    """The job behind `fit_segment`."""
    segment, figures = frames.fit_segment(
        KeyState.load(key),
        footage.open_views(),
        range(*span),
        motion=MotionCache.load(motion),
        options=options,
        scratch=scratch,
        progress=progress,
    )
    hold_absent(segment).save(out / SEGMENT)
    save_json(out / FIGURES, {"frames": figures})
    return {"frames": len(segment), "gaussians": len(segment.key), "dynamic": int(segment.dynamic.sum())}


def build_seam(footage: Footage, key: Path, segment: Path, after: Path, out: Path) -> dict[str, Any]:
    """The job behind `measure_seam`."""
    found = seam(KeyState.load(key), Segment.load(segment), KeyState.load(after), footage.open_views())
    facts = {"ratio": found if math.isfinite(found) else None}
    save_json(out / SEAM, facts)
    return facts


def build_cut(segment: Path, frames: int, out: Path) -> dict[str, Any]:
    """The job behind `cut_segment`."""
    whole = Segment.load(segment / SEGMENT)
    part = replace(whole, xyz=whole.xyz[: frames - 1], attributes=whole.attributes[: frames - 1])
    part.save(out / SEGMENT)
    figures = json.loads((segment / FIGURES).read_text())["frames"][: frames - 1]
    save_json(out / FIGURES, {"frames": figures})
    return {"frames": frames, "gaussians": len(part.key), "dynamic": int(part.dynamic.sum())}


def _stills_path(workshop: Workshop, background: Key | None) -> Path | None:
    return workshop.path(background) / STILLS if background else None


def _stills(path: Path | None) -> list[Still]:
    return load_stills(path) if path else []


def _sure_points(sparse: SparsePoints) -> Points:
    """Where surfaces surely are; of what moved on since, a fit prunes the few points that it starts with."""
    sure = sparse.views >= SURE_VIEWS
    return Points(sparse.xyz[sure], sparse.rgb[sure] / 255)


def _changes(views: Views, first: int, last: int, options: MotionOptions) -> list[np.ndarray | None]:
    return [changed_between(views, camera, first, last, options) for camera in range(len(views.cameras))]


def _reads(plan: Plan, pictures: PictureOptions, options: FitOptions) -> dict[str, Any]:
    """Instants count from the plan's first one."""
    return {
        "fit": options,
        "fit_version": keyframe.VERSION,
        "pictures": pictures,
        "cameras": plan.fitted,
        "first": plan.first,
    }


def _without(options: FitOptions, *unread: str) -> FitOptions:
    """Options with those fields at their defaults that a stage does not read, so that they cannot change its key."""
    defaults = FitOptions()
    return replace(options, **{name: getattr(defaults, name) for name in unread})
