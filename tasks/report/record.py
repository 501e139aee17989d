"""The report as JSON."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from tasks.artefacts.recipe import plain
from tasks.report.facts import (
    FOREGROUND,
    LEVELS,
    MAX_PSNR_DB,
    FrameScore,
    ReportInput,
    SceneFigures,
)
from tasks.report.findings import findings
from tasks.report.limits import LIMITS, Limits
from tasks.report.summary import summary
from tasks.report.verdict import verdict

SCHEMA = 1
"""Version of report.json"""
MOST_FRAMES = 5000
"""By which a list by frame goes whole into report.json"""


def report_json(report: ReportInput, limits: Limits = LIMITS) -> dict[str, Any]:
    """The numbers of the report, without its pictures; docs/viewer.md names the fields. Of a long scene, lists by frame
    hold every so manieth frame."""
    every, found = -(-_frames(report) // MOST_FRAMES) or 1, findings(report, limits)
    return {
        "schema": SCHEMA,
        "name": report.name,
        "run": {
            "command": report.command,
            "options": None if report.options is None else plain(report.options),
            "versions": dict(report.versions),
            "stage_versions": dict(report.stage_versions),
            "otherwise": plain(report.otherwise),
            "host": report.host,
            "finished": report.finished,
            "seconds": report.seconds,
            "choice": report.choice and plain(report.choice),
            "forecast": [plain(row) for row in report.forecast],
        },
        "every": every,
        "summary": summary(report),
        "verdict": plain(verdict(report, limits, found)),
        "limits": plain(limits),
        "findings": [plain(finding) for finding in found],
        "sync": report.sync and report.sync.to_json(),
        "content": report.content and plain(report.content),
        "cameras": _cameras_json(report),
        "evidence": {name: plain(own) for name, own in report.evidence.items()},
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
        "fitted": [_score_json(score) for score in report.fitted],
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
    known = {name: value for name, value in vars(score).items() if value is not None or name not in FOREGROUND}
    return {**known, **levels}


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
