"""Encode: the scene file; verify: that it gives back every integer that was fitted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import save_json
from packuv.fit.keyframe import KeyState
from packuv.footage.lens import undistorted_camera
from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.segment import Segment
from packuv.progress import Progress
from packuv.scene import EncodeOptions, SceneHeader, Tolerance, open_scene, write_scene
from packuv.scene.sharing import stored_segments
from sync.align import SyncReport
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.fitting import SEGMENT
from tasks.stages.footage import Footage, PictureOptions, footage_of, lens_camera
from tasks.stages.plan import Plan

ENCODE_VERSION = 2
VERIFY_VERSION = 2
SCENE = "scene.mkv"


def encode(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    first_key: Key,
    segments: Sequence[Key],
    pictures: PictureOptions,
    options: EncodeOptions | None = None,
) -> Key:
    """Write the scene file from the segments, in order; by default lossless."""
    options = options or EncodeOptions()
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=tuple(plan.videos), pictures=pictures),
        "held_out": plan.held_out,
        "key": workshop.path(first_key),
        "segments": [workshop.path(key) / SEGMENT for key in segments],
        "options": options,
    }
    reads = {
        "cameras": list(plan.videos),
        "held_out": plan.held_out,
        "first": plan.first,
        "stop": plan.stop,
        "pictures": pictures,
        "encode": options,
    }
    inputs = {"groups": groups, "points": points, "key": first_key, "segments": list(segments)}
    return workshop.make("encode", ENCODE_VERSION, reads, inputs, "tasks.stages.encode:build_scene", arguments)


def encode_finished(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    first_key: Key,
    segments: Sequence[Key],
    pictures: PictureOptions,
    options: EncodeOptions | None = None,
    *,
    path: Path,
) -> int:
    """Write the first segments of a sequence as a scene file that ends after them; returns its number of frames.

    For a run that stops early, or to watch one that goes on: `segments` are those that are fitted, without a gap from
    the first on. The file is whole or absent at any time, and takes the place of one that is there. Nothing goes to
    the store, for `encode` makes the same file of all segments.
    """
    footage = footage_of(workshop, plan, groups, points, cameras=tuple(plan.videos), pictures=pictures)
    paths = [workshop.path(key) / SEGMENT for key in segments]
    return write_finished(path, footage, plan.held_out, workshop.path(first_key), paths, options)


def write_finished(
    path: Path,
    footage: Footage,
    held_out: tuple[str, ...],
    key: Path,
    segments: Sequence[Path],
    options: EncodeOptions | None = None,
) -> int:
    """Write the first segments of a sequence, by their files; see `encode_finished`."""
    header = scene_header(footage, held_out, KeyState.load(key))
    frames = sum(len(Segment.load(part)) for part in segments)
    return write_scene(path, segments, header.first(frames), options=options).frames


def verify(workshop: Workshop, scene: Key, segments: Sequence[Key]) -> Key:
    """Decode the scene file and compare every frame with the fitted segments.

    Raises RuntimeError on a difference beyond the tolerance that the scene states.
    """
    arguments = {
        "scene": workshop.path(scene) / SCENE,
        "segments": [workshop.path(key) / SEGMENT for key in segments],
    }
    inputs = {"scene": scene, "segments": list(segments)}
    return workshop.make("verify", VERIFY_VERSION, {}, inputs, "tasks.stages.encode:build_verification", arguments)


def build_scene(
    footage: Footage,
    held_out: tuple[str, ...],
    key: Path,
    segments: list[Path],
    options: EncodeOptions,
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """The job behind `encode`."""
    header = scene_header(footage, held_out, KeyState.load(key))
    summary = write_scene(
        out / SCENE,
        segments,
        header,
        options=options,
        progress=progress,
    )
    notes = {"frames": summary.frames, "bytes": summary.bytes, "track_bytes": dict(summary.track_bytes)}
    save_json(out / "encode.json", notes)
    return notes


def scene_header(footage: Footage, held_out: tuple[str, ...], key: KeyState) -> SceneHeader:
    """What the scene says about its capture. No path and no clock time goes in: same input, same bytes."""
    rig, report = footage.load_rig(), SyncReport.load(footage.groups)
    return SceneHeader(
        quantizer=key.quantizer,
        times_ns=np.ascontiguousarray(footage.load_groups().times_ns),
        rate=_rate(footage.groups),
        cameras=tuple(undistorted_camera(lens_camera(camera)) for camera in rig.cameras),
        held_out=held_out,
        sync={
            "reference": report.reference,
            "period_ns": report.period_ns,
            "tolerance_ns": report.tolerance_ns,
            "clock": str(report.clock),
            "instants": report.instants,
            "complete": report.complete,
        },
        extra={
            "near": key.bounds.near,
            "scene_radius": key.bounds.radius,
            "metric": rig.metric,
            "max_width": footage.max_width,
            "lenses": [lens_camera(camera).to_json() for camera in rig.cameras],
        },
    )


def build_verification(scene: Path, segments: list[Path], out: Path, progress: Progress) -> dict[str, Any]:
    """The job behind `verify`."""
    frame, worst = 0, Tolerance()
    with open_scene(scene) as opened:
        fitted = (Segment.load(path) for path in segments)
        references = [entry.reference for entry in opened.index.segments]
        if len(references) != len(segments):
            raise RuntimeError(f"{scene} has {len(references)} segments, but {len(segments)} were fitted")
        for path, stored in zip(segments, stored_segments(fitted, references=references), strict=True):
            for index in range(len(stored)):
                allowed = opened.index.tolerance if index else Tolerance()
                worst = _worse(worst, opened.codes(frame), stored.frame(index), allowed, f"frame {frame} ({path})")
                frame += 1
                progress(frame, len(opened), "")
        if frame != len(opened):
            raise RuntimeError(f"{scene} has {len(opened)} frames, but {frame} were fitted")
    notes = {"frames": frame, "exact": worst.exact, "largest_error": vars(worst)}
    save_json(out / "verify.json", notes)
    return notes


def _worse(worst: Tolerance, found: Codes, fitted: Codes, allowed: Tolerance, what: str) -> Tolerance:
    """The largest errors so far; raises RuntimeError beyond what is allowed."""
    if found.xyz.shape != fitted.xyz.shape or found.attributes.shape != fitted.attributes.shape:
        raise RuntimeError(f"{what} does not decode to what was fitted: {len(found)} rows, not {len(fitted)}")
    position = _largest_error(found.xyz, fitted.xyz)
    attribute = _largest_error(found.attributes, fitted.attributes)
    same_rows = np.array_equal(found.attributes[:, OPACITY] > 0, fitted.attributes[:, OPACITY] > 0)
    if position > allowed.position or attribute > allowed.attribute or not same_rows:
        raise RuntimeError(
            f"{what} does not decode to what was fitted: codes differ by up to {position} and {attribute} steps, "
            f"but {allowed.position} and {allowed.attribute} are allowed"
        )
    return Tolerance(max(worst.position, position), max(worst.attribute, attribute))


def _largest_error(found: np.ndarray, fitted: np.ndarray) -> int:
    return int(np.abs(found.astype(np.int32) - fitted.astype(np.int32)).max(initial=0))


def _rate(groups: Path) -> Fraction:
    return Fraction(json.loads((groups / "videos.json").read_text())["rate"])
