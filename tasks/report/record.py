"""The report as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tasks.artefacts.recipe import plain
from tasks.report.facts import LEVELS, MAX_PSNR_DB, FrameScore, ReportInput, by_camera, mean_of, still_trend
from tasks.report.findings import LIMITS, Limits, findings

SCHEMA = 1
"""Version of report.json"""


def report_json(report: ReportInput, limits: Limits = LIMITS) -> dict[str, Any]:
    """All numbers of the report, without its pictures; docs/viewer.md names the fields."""
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
        "summary": summary(report),
        "findings": [plain(finding) for finding in findings(report, limits)],
        "sync": report.sync and report.sync.to_json(),
        "cameras": _cameras_json(report),
        "check": report.check and report.check.to_json(),
        "light": report.light
        and {
            "factors": np.exp(report.light.light).round(5).tolist(),
            "exposures": {name: np.exp(own).round(5).tolist() for name, own in report.light.exposures.items()},
            "reason": report.light.reason,
        },
        "motion": report.motion
        and {
            "magnitude_px": [float(v) if math.isfinite(v) else None for v in report.motion.magnitude_px],
            "keyframes": list(report.motion.keyframes),
            "changes": [plain(change) for change in report.motion.changes],
            "cuts": list(report.motion.cuts),
        },
        "scores": [_score_json(score) for score in report.scores],
        "scene": report.scene and {**plain(report.scene), "mb_per_30_frames": report.scene.mb_per_30_frames},
        "pictures": [{"camera": c.camera, "frame": c.frame, "choice": c.choice} for c in report.pictures],
        "stages": [plain(stage) for stage in report.stages],
    }


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
