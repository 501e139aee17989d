"""Track: what moves in every picture, and the keyframes that follow from it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import save_json
from packuv.motion import MotionCache, MotionOptions, measure_motion
from packuv.motion.keyframes import KeyframeOptions, motion_curve, segments
from packuv.motion.keyframes import choose_keyframes as choose
from packuv.progress import Progress
from tasks.artefacts.recipe import digest
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.footage import Footage, PictureOptions, footage_of
from tasks.stages.plan import Plan

MOTION_VERSION = 1
KEYFRAMES_VERSION = 1
MOTION, KEYFRAMES = "motion", "keyframes.json"


def find_motion(
    workshop: Workshop, plan: Plan, groups: Key, rig: Key, pictures: PictureOptions, options: MotionOptions
) -> Key:
    """Measure flow and motion masks of the fitted cameras."""
    arguments = {
        "footage": footage_of(workshop, plan, groups, rig, cameras=plan.fitted, pictures=pictures),
        "options": options,
        "workers": workshop.jobs.threads,
    }
    reads = {
        "motion": options,
        "pictures": pictures,
        "cameras": plan.fitted,
        "first": plan.first,
        "stop": plan.stop,
    }
    inputs = {"groups": groups, "rig": rig}
    return workshop.make(
        "motion", MOTION_VERSION, reads, inputs, "tasks.stages.track:build_motion", arguments, label="flow"
    )


def choose_keyframes(workshop: Workshop, motion: Key, options: KeyframeOptions) -> Key:
    """Choose keyframes from the motion curve; segments in which nothing moves are named, since nobody fits them."""
    arguments = {"motion": workshop.path(motion) / MOTION, "options": options}
    inputs = {"motion": motion}
    key = workshop.make(
        "keyframes", KEYFRAMES_VERSION, options, inputs, "tasks.stages.track:build_keyframes", arguments
    )
    for still in read_still(workshop.path(key)):
        why = f"nothing moves in instants {still.start} to {still.stop - 1}; each repeats the keyframe"
        workshop.listener.skipped(f"fit {still.start}-{still.stop - 1}", why)
    return key


def build_motion(
    footage: Footage, options: MotionOptions, workers: int, out: Path, scratch: Path, progress: Progress
) -> dict[str, Any]:
    """The job behind `find_motion`."""
    # The measurement knows the videos by their paths, so a capture that was moved between two attempts starts afresh.
    folder = scratch / digest(str(footage.capture))[:16]
    views = footage.open_views()
    cache = measure_motion(views, folder, options, workers=workers, progress=progress)
    folder.rename(out / MOTION)
    return {"pictures": int((cache.previous >= 0).sum()), "moving_share": float(np.nanmean(_shares(cache)))}


def build_keyframes(motion: Path, options: KeyframeOptions, out: Path) -> dict[str, Any]:
    """The job behind `choose_keyframes`."""
    cache = MotionCache.load(motion)
    curve = motion_curve(cache.magnitude, cache.names, options)
    keyframes = choose(curve, options)
    spans = segments(keyframes, len(curve))
    moving = np.nan_to_num(_shares(cache)).max(axis=1) > 0  # [T]
    save_json(
        out / KEYFRAMES,
        {
            "keyframes": [{"instant": item.instant, "reason": str(item.reason)} for item in keyframes],
            "spans": [[span.start, span.stop] for span in spans],
            "still": [not bool(moving[span.start + 1 : span.stop].any()) for span in spans],
            "curve_px": curve.tolist(),
        },
    )
    return {"keyframes": len(keyframes), "instants": len(curve)}


def read_spans(workshop: Workshop, keyframes: Key) -> list[range]:
    """Instants of each segment."""
    return [range(*span) for span in _read(workshop.path(keyframes))["spans"]]


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
    return _read(folder)["curve_px"]


def _read(folder: Path) -> dict[str, Any]:
    return json.loads((folder / KEYFRAMES).read_text())


def _shares(cache: MotionCache) -> np.ndarray:
    """float32 [T, C]: share of the picture that moves, NaN without a step to the instant."""
    return cache.steps["share"]
