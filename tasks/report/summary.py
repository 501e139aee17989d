"""The figures of a run that one quotes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tasks.report.facts import FOREGROUND, LEVELS, FrameScore, ReportInput, by_camera, mean_of, still_trend


@dataclass(frozen=True)
class Level:
    """What some cameras score at some frames: means over frames first, then over cameras."""

    cameras: tuple[str, ...]
    frames: tuple[int, ...]
    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class Contrast:
    """Fitted cameras beside unseen ones, at the same frames."""

    fitted: Level
    unseen: Level

    @property
    def gap_db(self) -> float:
        """By how much the fit is better at what it saw."""
        return self.fitted.psnr_db - self.unseen.psnr_db


def contrast(report: ReportInput) -> Contrast | None:
    """None where fitted cameras were not scored beside unseen ones, or these have no picture at their frames."""
    frames = {score.frame for score in report.fitted}
    unseen = [score for score in report.scores if score.frame in frames]
    if not (report.held_out and report.fitted and unseen):
        return None
    return Contrast(_level(report.fitted), _level(unseen))


def _level(scores: Sequence[FrameScore]) -> Level:
    cameras = by_camera(scores)
    return Level(
        tuple(cameras),
        tuple(sorted({score.frame for score in scores})),
        float(np.mean([np.mean([score.level_db for score in own]) for own in cameras.values()])),
        float(np.mean([np.mean([score.ssim for score in own]) for own in cameras.values()])),
    )


def summary(report: ReportInput) -> dict[str, Any]:
    """The figures that one quotes; None where there is none. Means run over cameras first, then over frames."""
    cameras, beside = by_camera(report.scores), contrast(report)
    scene, rig = report.scene, report.rig
    ahead = {name: value for name in FOREGROUND if (value := _over_cameras(cameras, name)) is not None}
    work = sum(stage.seconds for stage in report.stages) if report.stages else None
    return {
        "psnr_db": _mean([np.mean([score.level_db for score in own]) for own in cameras.values()]),
        "ssim": _mean([np.mean([score.ssim for score in own]) for own in cameras.values()]),
        **{f"psnr_{name}": _over_cameras(cameras, name) for name in LEVELS if name != "psnr_db"},
        "still_trend_db": still_trend(report.scores),
        **{name: _over_cameras(cameras, name) for name in ("tof_px", "flicker", "lpips")},
        **ahead,
        "scored_cameras": sorted(cameras),
        "fitted_psnr_db": beside and beside.fitted.psnr_db,
        "fitted_gap_db": beside and beside.gap_db,
        "fitted_cameras": list(beside.fitted.cameras) if beside else [],
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
