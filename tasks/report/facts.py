"""What a report tells: the figures of a run, what looks wrong in them, and all of it as JSON.

`ReportInput` is what the stages left, in their own types where they have them. Every part may be missing. Whatever
crosses a limit becomes a `Finding`: one sentence, shown first on the page and again beside its figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from calibration.accept import RigReport
from calibration.rig import Rig
from packuv.metrics import trend
from packuv.scene import Scene
from packuv.scene.stream import REPEAT
from sync.align import SyncReport
from sync.content import Content
from sync.natural import natural_key

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
class CameraEvidence:
    """What pictures say of a camera's pose and gain."""

    points: int | None = None
    """Triangulated points that it saw, or, held out, by which its gain was measured"""
    error_px: float | None = None
    """Median distance between where it saw them and where the rig puts them, pixels; None for a held-out camera"""
    gain: str = ""
    """Whether its gain was measured, and what by"""


@dataclass(frozen=True)
class LastingChange:
    """Something changes for good: from this frame on another backdrop stands behind what moves."""

    frame: int
    cameras: tuple[str, ...]
    """That saw it"""


@dataclass(frozen=True)
class MotionCurve:
    """How much moves at each instant."""

    magnitude_px: np.ndarray
    """float [T]: M(t), the smoothed mean of |flow|, pixels"""
    keyframes: tuple[int, ...]
    """Instants at which segments start"""
    changes: tuple[LastingChange, ...] = ()
    cuts: tuple[int, ...] = ()
    """Instants at which so much of the pictures changes that the scene may be cut there"""

    def __post_init__(self) -> None:
        count = len(self.magnitude_px)
        if any(not 0 <= keyframe < count for keyframe in self.keyframes):
            raise ValueError(f"keyframes must be instants 0 to {count - 1}, but are {self.keyframes}")


@dataclass(frozen=True)
class LightCurve:
    """How light and the cameras' own exposures change over time: natural logarithms of factors on linear light."""

    light: np.ndarray
    """float [T, 3]: of each instant, r g b; all 0 where it is steady"""
    exposures: Mapping[str, np.ndarray] = field(default_factory=dict)
    """By camera float [T, 3], of those that have an exposure of their own"""
    reason: str = ""
    """Why the light is taken for steady"""

    def __post_init__(self) -> None:
        for name, own in {"light": self.light, **self.exposures}.items():
            if own.shape != (len(self.light), 3):
                raise ValueError(f"{name} must be {(len(self.light), 3)} as the light is, but is {own.shape}")

    def jump(self, camera: str) -> tuple[float, int]:
        """The largest change of a camera's exposure from four instants to the next four, as a factor, and where.

        Flicker, which comes back at once, is next to none.
        """
        level, length = self.exposures[camera].mean(axis=1), min(4, len(self.light) // 2)
        if not length:
            return 1.0, 0
        means = sliding_window_view(level, length).mean(axis=1)
        steps = means[length:] - means[:-length]
        worst = int(np.abs(steps).argmax())
        return float(np.exp(steps[worst])), worst + length


@dataclass(frozen=True)
class FrameScore:
    """A render against a picture that was filmed."""

    camera: str
    frame: int
    """Frame of the scene, from 0"""
    psnr_db: float
    """Of the render as the camera would film it, as are all but `raw_db` and `own_db`"""
    ssim: float
    raw_db: float | None = None
    """Of the render in the rig's colours, in the light of the instant"""
    own_db: float | None = None
    """With the one gain per channel that fits this picture best"""
    moving_db: float | None = None
    """Where the filmed picture moved; None where nothing did, as below"""
    still_db: float | None = None
    """Everywhere else"""
    never_moving_db: float | None = None
    """Where nothing moves in any frame"""
    tof_px: float | None = None
    """Difference of motion, pixels"""
    flicker: float | None = None
    lpips: float | None = None
    foreground_db: float | None = None
    """Where the camera's mask has foreground; None without a mask, as below"""
    foreground_ssim: float | None = None
    foreground_lpips: float | None = None

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
    sound: str = ""
    """Name of the camera that heard the sound in the file; empty where it has none"""

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
class Choice:
    """Which point of the curve of run time against error a run took, and why: what was forecast, and what came."""

    point: str
    """Of `pipelines.ladder.LADDER`"""
    forecast_minutes: float
    """Of the whole run, pilots included, had nothing been there"""
    max_minutes: float | None = None
    target_psnr: float | None = None
    pilots: Mapping[str, float] = field(default_factory=dict)
    """By point tried, PSNR of the first frames on unseen cameras, calibrated, dB"""
    minutes: float | None = None
    """That the run took, without what was there before"""
    psnr_db: float | None = None
    """Of all frames"""

    @property
    def missed(self) -> str:
        """By how much the target is missed; empty where it is reached, or none was set."""
        if self.target_psnr is None or (self.psnr_db is not None and self.psnr_db >= self.target_psnr):
            return ""
        if self.psnr_db is None:
            return f"The target of {self.target_psnr:g} dB is missed: no frame has a score."
        tried = ", ".join(f"{point} {level:.2f}" for point, level in self.pilots.items())
        return (
            f"The target of {self.target_psnr:g} dB is missed: {self.point} reaches {self.psnr_db:.2f} dB "
            f"(first frames, dB: {tried})."
        )

    @property
    def late(self) -> str:
        """By how much the run took longer than it was to."""
        if self.max_minutes is None or self.minutes is None or self.minutes <= self.max_minutes:
            return ""
        return (
            f"The run took {self.minutes:.1f} minutes, but was to take {self.max_minutes:g} at most; "
            f"{self.forecast_minutes:.1f} were forecast."
        )

    @property
    def told(self) -> str:
        """For people, in one line."""
        took = "" if self.minutes is None else f", took {self.minutes:.1f}"
        return f"{self.point}: {self.forecast_minutes:.1f} minutes forecast{took}"


@dataclass(frozen=True)
class Compared:
    """What was forecast before a run, and what came."""

    what: str
    unit: str
    forecast: float
    fact: float | None
    """None where the run did not come to it"""


@dataclass(frozen=True)
class ReportInput:
    """All that a report may show; leave out what there is not."""

    name: str
    """The sequence, for people"""
    command: str = ""
    """What was typed, exactly"""
    options: Any = None
    """Options of the run: a dataclass or mapping that `tasks.artefacts.recipe.plain` takes"""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Of software and of what it writes"""
    stage_versions: Mapping[str, int] = field(default_factory=dict)
    """By kind of artefact: of the stage that made it"""
    otherwise: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """What was there before and made otherwise: by "numpy 2.1.0, not 2.2.6", or processor, the kinds of artefacts"""
    host: str = ""
    """Machine and device"""
    finished: str = ""
    """UTC, ISO 8601"""
    seconds: float | None = None
    """Time from start to end of the run; without it the sum of the stages is shown"""
    sync: SyncReport | None = None
    rig: Rig | None = None
    """All cameras, held-out ones too, with their gains and shading"""
    held_out: tuple[str, ...] = ()
    """Cameras that were never fitted"""
    check: RigReport | None = None
    evidence: Mapping[str, CameraEvidence] = field(default_factory=dict)
    """By camera; empty where no points were triangulated"""
    content: Content | None = None
    masks: Mapping[str, str] = field(default_factory=dict)
    """Cameras whose foreground masks are not used, and why"""
    unread: tuple[str, ...] = ()
    """What of the capture seems to be masks, times or a calibration, and why it is not read"""
    footage: tuple[str, ...] = ()
    """What was read of the videos and what was not, where it is not plain, and which pictures are damaged"""
    colours: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By camera: how its video says that it codes colour, see `sync.probe.ColourTags`"""
    unlike: Mapping[str, str] = field(default_factory=dict)
    """Cameras that were not balanced although others were, and why"""
    log_like: tuple[str, ...] = ()
    """Cameras whose pictures look like log footage that nobody called so"""
    light: LightCurve | None = None
    motion: MotionCurve | None = None
    scores: tuple[FrameScore, ...] = ()
    """Of held-out cameras; of fitted ones where none was held out"""
    fitted: tuple[FrameScore, ...] = ()
    """Of some fitted cameras at some frames, beside held-out ones"""
    scene: SceneFigures | None = None
    pictures: tuple[Comparison, ...] = ()
    stages: tuple[StageRecord, ...] = ()
    choice: Choice | None = None
    """Where the user named a time or an error instead of a preset"""
    forecast: tuple[Compared, ...] = ()
    """Empty where nothing was forecast"""


def scene_figures(scene: Scene, *, verified: bool | None = None, problem: str = "") -> SceneFigures:
    """Figures of an open scene file, from its header alone."""
    index = scene.index
    sizes: list[int] = []
    for number, segment in enumerate(index.segments):
        packets = iter(index.tracks[-1].sizes[segment.first_packet : segment.first_packet + segment.frames])
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
        index.heard,
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
    """Scores of each camera, in order of frames; cameras in natural order."""
    cameras: dict[str, list[FrameScore]] = {}
    for score in sorted(scores, key=lambda item: (natural_key(item.camera), item.camera, item.frame)):
        cameras.setdefault(score.camera, []).append(score)
    return cameras


def mean_by_frame(scores: Sequence[FrameScore], name: str = "psnr_db") -> dict[int, float]:
    """Mean of a figure over the cameras at each frame that has it, in order of frames.

    A camera without a picture at a frame counts there as by its own mean and how the others do, so that a frame is not
    good or bad for who filmed it.
    """
    own = {camera: known for camera, items in by_camera(scores).items() if (known := mean_of(items, name)) is not None}
    usual = float(np.mean(list(own.values()))) if own else 0.0
    away: dict[int, list[float]] = {}
    for score in sorted(scores, key=lambda item: item.frame):
        if (level := mean_of([score], name)) is not None:
            away.setdefault(score.frame, []).append(level - own[score.camera])
    return {frame: usual + float(np.mean(levels)) for frame, levels in away.items()}


LEVELS = {
    "raw_db": "raw",
    "psnr_db": "calibrated",
    "own_db": "own gain",
    "moving_db": "moving",
    "still_db": "still",
    "never_moving_db": "never moving",
}
"""Ratios that a score holds, dB, and what people call them"""
FOREGROUND = {"foreground_db": "PSNR dB", "foreground_ssim": "SSIM", "foreground_lpips": "LPIPS"}
"""What a score holds of the foreground where there are masks, likewise"""


def mean_of(scores: Sequence[FrameScore], name: str) -> float | None:
    """Mean of a figure over the scores that have it; ratios of equal pictures count as `MAX_PSNR_DB`."""
    known = [value for score in scores if (value := getattr(score, name)) is not None]
    return float(np.mean(np.minimum(known, MAX_PSNR_DB) if name.endswith("_db") else known)) if known else None


def still_trend(scores: Sequence[FrameScore]) -> float | None:
    """Course of what is still, dB per 100 frames: the mean of the cameras' slopes; None for too few frames."""
    slopes = []
    for own in by_camera(scores).values():
        known = [(score.frame, score.still_db) for score in own if score.still_db is not None]
        slopes.append(trend([frame for frame, _ in known], [level for _, level in known]))
    found = [slope for slope in slopes if slope is not None]
    return float(np.mean(found)) if found else None
