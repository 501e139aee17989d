"""Encode: the scene file; verify: that it gives back every integer that was fitted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import write_json
from packuv.fit import KeyState
from packuv.frames import undistorted_camera
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.segment import Segment
from packuv.stream import in_storage_order
from sync.align import SyncReport
from tasks.footage import Footage, PictureOptions, footage_of, lens_camera
from tasks.jobs import Progress
from tasks.plan import Plan
from tasks.splat import SEGMENT
from tasks.store import Key
from tasks.workshop import Workshop

ENCODE_VERSION = 1
VERIFY_VERSION = 1
SCENE = "scene.mkv"


def encode(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    points: Key,
    first_key: Key,
    segments: Sequence[Key],
    pictures: PictureOptions,
) -> Key:
    """Write the scene file from the segments, in order."""
    arguments = {
        "footage": footage_of(workshop, plan, groups, points, cameras=tuple(plan.videos), pictures=pictures),
        "held_out": plan.held_out,
        "key": workshop.path(first_key),
        "segments": [workshop.path(key) / SEGMENT for key in segments],
    }
    reads = {
        "cameras": list(plan.videos),
        "held_out": plan.held_out,
        "first": plan.first,
        "stop": plan.stop,
        "pictures": pictures,
    }
    inputs = {"groups": groups, "points": points, "key": first_key, "segments": list(segments)}
    return workshop.make("encode", ENCODE_VERSION, reads, inputs, "tasks.encode:build_scene", arguments)


def verify(workshop: Workshop, scene: Key, segments: Sequence[Key]) -> Key:
    """Decode the scene file and compare every frame with the fitted segments; raises RuntimeError on a difference."""
    arguments = {
        "scene": workshop.path(scene) / SCENE,
        "segments": [workshop.path(key) / SEGMENT for key in segments],
    }
    inputs = {"scene": scene, "segments": list(segments)}
    return workshop.make("verify", VERIFY_VERSION, {}, inputs, "tasks.encode:build_verification", arguments)


def build_scene(
    footage: Footage,
    held_out: tuple[str, ...],
    key: Path,
    segments: list[Path],
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """The job behind `encode`."""
    header = scene_header(footage, held_out, KeyState.load(key))
    summary = write_scene(
        out / SCENE, segments, header, progress=lambda done, total: progress(done, total, "write and read back")
    )
    notes = {"frames": summary.frames, "bytes": summary.bytes, "track_bytes": dict(summary.track_bytes)}
    write_json(out / "encode.json", notes)
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
    frame = 0
    with open_scene(scene) as opened:
        for path in segments:
            stored = in_storage_order(Segment.load(path))
            for index in range(len(stored)):
                found, expected = opened.codes(frame), stored.frame(index)
                if not _same(found.xyz, expected.xyz) or not _same(found.attributes, expected.attributes):
                    raise RuntimeError(f"frame {frame} of {scene} does not decode to what was fitted ({path})")
                frame += 1
                progress(frame, len(opened), "")
        if frame != len(opened):
            raise RuntimeError(f"{scene} has {len(opened)} frames, but {frame} were fitted")
    write_json(out / "verify.json", {"frames": frame, "exact": True})
    return {"frames": frame}


def _same(found: np.ndarray, expected: np.ndarray) -> bool:
    return found.dtype == expected.dtype and np.array_equal(found, expected)


def _rate(groups: Path) -> Fraction:
    return Fraction(json.loads((groups / "videos.json").read_text())["rate"])
