"""The report as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tasks.artefacts.recipe import plain
from tasks.report.facts import (
    LEVELS,
    MAX_PSNR_DB,
    FrameScore,
    ReportInput,
    SceneFigures,
    by_camera,
    mean_of,
    still_trend,
)
from tasks.report.findings import LIMITS, Limits, findings

SCHEMA = 1
"""Version of report.json"""
MOST_FRAMES = 5000
"""By which a list by frame goes whole into report.json"""


def report_json(report: ReportInput, limits: Limits = LIMITS) -> dict[str, Any]:
    """The numbers of the report, without its pictures; docs/viewer.md names the fields. Of a long scene, lists by frame
    hold every so manieth frame."""
    every = -(-_frames(report) // MOST_FRAMES) or 1
    return {
        "schema": SCHEMA,
        "name": report.name,
        "run": {
            "command": report.command,
            "options": None if report.options is None else plain(report.options),
            "versions": dict(report.versions),
            "host": report.host,
            "finished": report.finished,
            "seconds": report.seconds,
            "choice": report.choice and plain(report.choice),
            "forecast": [plain(row) for row in report.forecast],
        },
        "every": every,
        "summary": summary(report),
        "findings": [plain(finding) for finding in findings(report, limits)],
        "sync": report.sync and report.sync.to_json(),
        "content": report.content and plain(report.content),
        "cameras": _cameras_json(report),
        "check": report.check and report.check.to_json(),
        "light": report.light
        and {
            "factors": np.exp(report.light.light[::every]).round(5).tolist(),
            "exposures": {name: np.exp(own[::every]).round(5).tolist() for name, own in report.light.exposures.items()},
            "reason": report.light.reason,
        },
        "motion": report.motion
        and {
            "magnitude_px": [float(v) if math.isfinite(v) else None for v in report.motion.magnitude_px[::every]],
            "keyframes": list(report.motion.keyframes),
            "changes": [plain(change) for change in report.motion.changes],
            "cuts": list(report.motion.cuts),
        },
        "scores": [_score_json(score) for score in report.scores if score.frame % every == 0],
        "scene": report.scene and _scene_json(report.scene, every),
        "pictures": [{"camera": c.camera, "frame": c.frame, "choice": c.choice} for c in report.pictures],
        "stages": [plain(stage) for stage in report.stages],
    }


def _frames(report: ReportInput) -> int:
    """Of the longest list by frame."""
    motion, light, scene = report.motion, report.light, report.scene
    return max(
        len(motion.magnitude_px) if motion else 0, len(light.light) if light else 0, scene.frames if scene else 0
    )


def _scene_json(scene: SceneFigures, every: int) -> dict[str, Any]:
    by_frame = {name: getattr(scene, name)[::every] for name in ("frame_bytes", "gaussians", "dynamic")}
    return {**plain(replace(scene, **by_frame)), "mb_per_30_frames": scene.mb_per_30_frames}


def _score_json(score: FrameScore) -> dict[str, Any]:
    levels = {name: min(value, MAX_PSNR_DB) for name in LEVELS if (value := getattr(score, name)) is not None}
    return {**vars(score), **levels}


def summary(report: ReportInput) -> dict[str, Any]:
    """The figures that one quotes; None where there is none. Means run over cameras first, then over frames."""
    cameras = by_camera(report.scores)
    scene, rig = report.scene, report.rig
    work = sum(stage.seconds for stage in report.stages) if report.stages else None
    return {
        "psnr_db": _mean([np.mean([score.level_db for score in own]) for own in cameras.values()]),
        "ssim": _mean([np.mean([score.ssim for score in own]) for own in cameras.values()]),
        **{f"psnr_{name}": _over_cameras(cameras, name) for name in LEVELS if name != "psnr_db"},
        "still_trend_db": still_trend(report.scores),
        **{name: _over_cameras(cameras, name) for name in ("tof_px", "flicker", "lpips")},
        "scored_cameras": sorted(cameras),
        "mb_per_30_frames": scene.mb_per_30_frames if scene else None,
        "seconds": report.seconds if report.seconds is not None else work,
        "peak_memory_bytes": max((s.peak_memory_bytes or 0 for s in report.stages), default=0) or None,
        "frames": scene.frames if scene else None,
        "cameras": len(rig.cameras) if rig else len(report.sync.cameras) if report.sync else None,
        "held_out": list(report.held_out),
        "verified": scene.verified if scene else None,
    }


def _over_cameras(cameras: Mapping[str, Sequence[FrameScore]], name: str) -> float | None:
    return _mean([value for own in cameras.values() if (value := mean_of(own, name)) is not None])


def _mean(values: Sequence[Any]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _cameras_json(report: ReportInput) -> list[dict[str, Any]]:
    return [
        {
            "name": camera.name,
            "size": [camera.width, camera.height],
            "focal_px": [camera.fx, camera.fy],
            "centre": camera.centre.tolist(),
            "forward": camera.camera_from_world[2, :3].tolist(),
            "gains": list(camera.gains),
            "shading": list(camera.shading),
            "held_out": camera.name in report.held_out,
        }
        for camera in (report.rig.cameras if report.rig else ())
    ]
