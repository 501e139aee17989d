"""What a report tells: the figures of a run, what looks wrong in them, and all of it as JSON.

`ReportInput` is what the stages left, in their own types where they have them. Every part may be missing. Whatever
crosses a limit becomes a `Finding`: one sentence, shown first on the page and again beside its figure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from calibration.accept import RigReport
from calibration.rig import Rig
from packuv.scene import Scene
from packuv.stream import REPEAT
from sync.align import SyncReport
from tasks.recipe import plain

SCHEMA = 1
"""Version of report.json"""

MAX_PSNR_DB = 99.0
"""Equal pictures have an infinite ratio, which neither JSON nor a mean can hold; they count as this"""

SIZE_FRAMES = 30
"""Sizes are quoted for this many frames"""


class StageOutcome(StrEnum):
    """How a stage came to its end."""

    MADE = "made"
    REUSED = "reused"
    SKIPPED = "skipped"
    FAILED = "failed"


@dataclass(frozen=True)
class StageRecord:
    """One stage of the run."""

    label: str
    outcome: StageOutcome
    seconds: float
    """Run time in this run; what a reused artefact cost when it was made is not in it"""
    peak_memory_bytes: int | None = None
    reason: str = ""
    """Why it was skipped or failed"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "outcome", StageOutcome(self.outcome))  # records read from JSON bring text


@dataclass(frozen=True)
class MotionCurve:
    """How much moves at each instant."""

    magnitude_px: np.ndarray
    """float [T]: M(t), the smoothed mean of |flow|, pixels"""
    keyframes: tuple[int, ...]
    """Instants at which segments start"""

    def __post_init__(self) -> None:
        count = len(self.magnitude_px)
        if any(not 0 <= keyframe < count for keyframe in self.keyframes):
            raise ValueError(f"keyframes must be instants 0 to {count - 1}, but are {self.keyframes}")


@dataclass(frozen=True)
class FrameScore:
    """A render against a picture that was filmed."""

    camera: str
    frame: int
    """Frame of the scene, from 0"""
    psnr_db: float
    ssim: float

    @property
    def level_db(self) -> float:
        """The ratio as a finite number."""
        return min(self.psnr_db, MAX_PSNR_DB)


@dataclass(frozen=True)
class Comparison:
    """Two pictures of one view to lay side by side: files, or uint8 [H, W, 3] RGB."""

    camera: str
    frame: int
    truth: Path | np.ndarray
    render: Path | np.ndarray
    choice: str = ""
    """Why this frame was chosen: "first", "middle", "worst" """


@dataclass(frozen=True)
class SceneFigures:
    """What the scene file holds."""

    name: str
    bytes: int
    """Size of the file, its header included"""
    rate: Fraction
    frame_bytes: tuple[int, ...]
    """Of each frame's pictures; the file's header and index come on top"""
    gaussians: tuple[int, ...]
    """Rows of each frame"""
    dynamic: tuple[int, ...]
    """Those among them that may change within their segment"""
    verified: bool | None = None
    """Whether every frame decodes to what was fitted; None: nobody looked"""
    problem: str = ""
    """What verification found wrong"""

    def __post_init__(self) -> None:
        if not len(self.frame_bytes) == len(self.gaussians) == len(self.dynamic):
            raise ValueError(
                f"figures of one scene must have one length, but have {len(self.frame_bytes)} sizes, "
                f"{len(self.gaussians)} and {len(self.dynamic)} counts"
            )

    @property
    def frames(self) -> int:
        return len(self.frame_bytes)

    @property
    def mb_per_30_frames(self) -> float:
        """Megabytes (10^6) of the whole file per 30 frames; 0 without frames."""
        return self.bytes / 1e6 * SIZE_FRAMES / self.frames if self.frames else 0.0


@dataclass(frozen=True)
class ReportInput:
    """All that a report may show; leave out what there is not."""

    name: str
    """The sequence, for people"""
    command: str = ""
    """What was typed, exactly"""
    options: Any = None
    """Options of the run: a dataclass or mapping that `tasks.recipe.plain` takes"""
    versions: Mapping[str, str] = field(default_factory=dict)
    host: str = ""
    """Machine and device"""
    finished: str = ""
    """UTC, ISO 8601"""
    seconds: float | None = None
    """Time from start to end of the run; without it the sum of the stages is shown"""
    sync: SyncReport | None = None
    rig: Rig | None = None
    """All cameras, held-out ones too, with their gains"""
    held_out: tuple[str, ...] = ()
    """Cameras that were never fitted"""
    check: RigReport | None = None
    motion: MotionCurve | None = None
    scores: tuple[FrameScore, ...] = ()
    """Of held-out cameras; of fitted ones where none was held out"""
    scene: SceneFigures | None = None
    pictures: tuple[Comparison, ...] = ()
    stages: tuple[StageRecord, ...] = ()


@dataclass(frozen=True)
class Limits:
    """When a figure is bad enough to say so."""

    matched_share: float = 0.90
    """A camera with frames at fewer instants than this share leaves holes in the fit"""
    drop_share: float = 0.02
    """Missing frames as a share of a camera's timecodes: a network or disk that does not keep up"""
    residual_share: float = 0.25
    """95th percentile of the residuals, in frame periods: beyond it, moving things sit visibly elsewhere"""
    gain: float = 1.25
    """A colour gain above this, or below its inverse, is exposure that differs or a camera that sees little"""
    camera_drop_db: float = 6.0
    """A camera this far below the median camera is calibrated, synchronized or balanced worse than the others"""
    frame_drop_db: float = 3.0
    """A frame whose mean is this far below the median frame: motion that the fit could not follow"""
    poor_db: float = 20.0
    """A mean held-out ratio below this shows at a glance"""
    dynamic_share: float = 0.5
    """More dynamic Gaussians than this: noise passes for motion, and every frame pays for it"""


LIMITS = Limits()


@dataclass(frozen=True)
class Finding:
    """Something that a person should look at."""

    section: str
    """Id of the section on the page"""
    text: str


def scene_figures(scene: Scene, *, verified: bool | None = None, problem: str = "") -> SceneFigures:
    """Figures of an open scene file, from its header alone."""
    index = scene.index
    sizes: list[int] = []
    for number, segment in enumerate(index.segments):
        packets = iter(index.tracks[-1].sizes[segment.first_packet :])
        sizes.append(index.tracks[0].sizes[number])
        sizes += [0 if prediction == REPEAT else next(packets) for prediction in segment.predictions]
    return SceneFigures(
        scene.path.name,
        scene.path.stat().st_size,
        scene.header.rate,
        tuple(sizes),
        tuple(segment.rows for segment in index.segments for _ in range(segment.frames)),
        tuple(segment.dynamic for segment in index.segments for _ in range(segment.frames)),
        verified,
        problem,
    )


def frames_to_picture(scores: Sequence[FrameScore]) -> tuple[tuple[str, int, str], ...]:
    """Which views deserve a picture: camera, frame and why, for the first, middle and worst frame of each camera."""
    chosen: list[tuple[str, int, str]] = []
    for camera, own in by_camera(scores).items():
        worst = min(own, key=lambda score: (score.level_db, score.frame))
        reasons: dict[int, list[str]] = {}
        for score, why in ((own[0], "first"), (own[len(own) // 2], "middle"), (worst, "worst")):
            reasons.setdefault(score.frame, []).append(why)
        chosen += [(camera, frame, ", ".join(whys)) for frame, whys in reasons.items()]
    return tuple(chosen)


def by_camera(scores: Sequence[FrameScore]) -> dict[str, list[FrameScore]]:
    """Scores of each camera, in order of frames; cameras by name."""
    cameras: dict[str, list[FrameScore]] = {}
    for score in sorted(scores, key=lambda item: (item.camera, item.frame)):
        cameras.setdefault(score.camera, []).append(score)
    return cameras


def mean_by_frame(scores: Sequence[FrameScore]) -> dict[int, float]:
    """Mean ratio of the cameras at each frame, dB, in order of frames."""
    frames: dict[int, list[float]] = {}
    for score in sorted(scores, key=lambda item: item.frame):
        frames.setdefault(score.frame, []).append(score.level_db)
    return {frame: float(np.mean(levels)) for frame, levels in frames.items()}


# What looks wrong


def findings(report: ReportInput, limits: Limits = LIMITS) -> tuple[Finding, ...]:
    """Everything in the report that crosses a limit, in the order of the page."""
    return (
        *_run_findings(report),
        *_sync_findings(report, limits),
        *_rig_findings(report, limits),
        *_score_findings(report, limits),
        *_scene_findings(report, limits),
    )


def _run_findings(report: ReportInput) -> Iterator[Finding]:
    for stage in report.stages:
        if stage.outcome is StageOutcome.FAILED:
            yield Finding("stages", f"The stage {stage.label!r} failed: {stage.reason or 'no reason was given'}.")


def _sync_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.sync is None:
        return
    for row in report.sync.cameras:
        if row.matched_share < limits.matched_share:
            yield Finding("sync", f"{row.camera} has a frame at only {row.matched_share:.0%} of the instants.")
        if row.drops > limits.drop_share * max(1, row.lines):
            yield Finding("sync", f"{row.camera} dropped {row.drops} of {row.lines + row.drops} frames.")
        if row.residual_p95_ns > limits.residual_share * report.sync.period_ns > 0:
            late = row.residual_p95_ns / report.sync.period_ns
            yield Finding("sync", f"{row.camera}: one frame in twenty is {late:.2f} frame periods or more off.")
    yield from (Finding("sync", f"{note}.") for note in report.sync.notes)


def _rig_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.check is not None:
        yield from (Finding("rig", f"{camera}: {what}.") for camera, what in report.check.suspicious.items())
    for camera in report.rig.cameras if report.rig else ():
        worst = max(camera.gains, key=lambda gain: abs(math.log(gain)))
        if not 1 / limits.gain <= worst <= limits.gain:
            yield Finding("colour", f"{camera.name} needs a colour gain of {worst:.2f}.")


def _score_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if not report.scores:
        return
    if not report.held_out:
        yield Finding(
            "quality", "No camera was held out, so the scores only tell how well the fit repeats what it saw."
        )
    cameras = {name: float(np.mean([s.level_db for s in own])) for name, own in by_camera(report.scores).items()}
    middle = float(np.median(list(cameras.values())))
    for name, level in cameras.items():
        if level < middle - limits.camera_drop_db:
            yield Finding("quality", f"{name} scores {level:.1f} dB, {middle - level:.1f} dB below the median camera.")
    frames = mean_by_frame(report.scores)
    usual = float(np.median(list(frames.values())))
    low = [frame for frame, level in frames.items() if level < usual - limits.frame_drop_db]
    if low:
        worst = min(low, key=lambda frame: frames[frame])
        text = f"{len(low)} of {len(frames)} frames score {limits.frame_drop_db:g} dB or more below the median frame"
        yield Finding("quality", f"{text}, the worst being frame {worst} with {frames[worst]:.1f} dB.")
    overall = float(np.mean(list(cameras.values())))
    if overall < limits.poor_db:
        yield Finding("quality", f"The mean of {overall:.1f} dB is poor: the difference shows at a glance.")


def _scene_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.scene is None:
        return
    if report.scene.verified is False:
        yield Finding(
            "size", f"The scene file does not decode to what was fitted: {report.scene.problem or 'unknown'}."
        )
    share = sum(report.scene.dynamic) / max(1, sum(report.scene.gaussians))
    if share > limits.dynamic_share:
        yield Finding("gaussians", f"{share:.0%} of the Gaussians are dynamic: noise may pass for motion.")


# report.json


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
        },
        "summary": summary(report),
        "findings": [plain(finding) for finding in findings(report, limits)],
        "sync": report.sync and report.sync.to_json(),
        "cameras": _cameras_json(report),
        "check": report.check and report.check.to_json(),
        "motion": report.motion and {
            "magnitude_px": [float(v) if math.isfinite(v) else None for v in report.motion.magnitude_px],
            "keyframes": list(report.motion.keyframes),
        },
        "scores": [
            {"camera": score.camera, "frame": score.frame, "psnr_db": score.level_db, "ssim": score.ssim}
            for score in report.scores
        ],
        "scene": report.scene and {**plain(report.scene), "mb_per_30_frames": report.scene.mb_per_30_frames},
        "pictures": [{"camera": c.camera, "frame": c.frame, "choice": c.choice} for c in report.pictures],
        "stages": [plain(stage) for stage in report.stages],
    }  # fmt: skip


def summary(report: ReportInput) -> dict[str, Any]:
    """The figures that one quotes; None where there is none. Means run over cameras first, then over frames."""
    cameras = by_camera(report.scores)
    scene, rig = report.scene, report.rig
    work = sum(stage.seconds for stage in report.stages) if report.stages else None
    return {
        "psnr_db": _mean([np.mean([score.level_db for score in own]) for own in cameras.values()]),
        "ssim": _mean([np.mean([score.ssim for score in own]) for own in cameras.values()]),
        "scored_cameras": sorted(cameras),
        "mb_per_30_frames": scene.mb_per_30_frames if scene else None,
        "seconds": report.seconds if report.seconds is not None else work,
        "peak_memory_bytes": max((s.peak_memory_bytes or 0 for s in report.stages), default=0) or None,
        "frames": scene.frames if scene else None,
        "cameras": len(rig.cameras) if rig else len(report.sync.cameras) if report.sync else None,
        "held_out": list(report.held_out),
        "verified": scene.verified if scene else None,
    }


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
            "held_out": camera.name in report.held_out,
        }
        for camera in (report.rig.cameras if report.rig else ())
    ]
