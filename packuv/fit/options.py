"""How long and how large a fit is, by what needs it.

A run is given one table, `FitOptions`. Each piece of work declares the part that it reads, so that no other setting
can change its result, nor the name of its artefact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TypeVar

from packuv.fit.density import DensityOptions
from packuv.fit.labels import LabelOptions
from packuv.fit.lift import LiftOptions
from packuv.fit.losses import PhotometricOptions
from packuv.fit.model import Rates
from packuv.fit.start.first import StartOptions
from packuv.fit.start.shell import ShellOptions
from packuv.gaussians.uvsize import UvOptions
from packuv.motion import BackgroundOptions

Part = TypeVar("Part", bound="SolverOptions")


@dataclass(frozen=True)
class LossOptions:
    """What the terms of the loss weigh, see `packuv.fit.terms`."""

    photometric: PhotometricOptions = field(default_factory=PhotometricOptions)
    depth_weight: float = 0.05
    """Of the mean error of depth, in scene radii, where the background's shell is sure (paper, objective)"""
    opacity_weight: float = 0.0
    """Of mean alpha (1 - alpha), which makes Gaussians decide (paper, objective)"""
    scale_weight: float = 0.0
    """Of the squared excess of the longest standard deviation over `scale_limit`, in radii (paper, objective)"""
    scale_limit: float = 0.1
    """In scene radii"""


@dataclass(frozen=True)
class SolverOptions(LossOptions):
    """How one iteration goes, whatever is fitted."""

    low_precision: bool = True
    """Render what the codes decode to; without it everything is fitted in floats and rounded afterwards (ablation)"""
    near_jitter: float = 0.5
    """Share of the iterations that draw the near plane at random up to `near_reach`: what only hides close before one
    camera cannot explain its picture then"""
    near_reach: float = 0.7
    """In scene radii"""
    random_background: bool = True
    """Draw backdrop and keyframes before a colour at random in each iteration, but where a picture is black: what it
    shows must then be covered, and no camera can be explained by leaving a place half transparent"""
    seed: int = 0
    device: str = field(default="cpu", metadata={"in every recipe": "cpu"})
    """Who renders, compares, steps and labels: "cpu", or "cuda", where iterations stay from the first to the last (see
    `packuv.fit.device` and `packuv.fit.resident`). No artefact is named after it: a fit goes on where another device
    ended"""
    density: DensityOptions = field(default_factory=DensityOptions)
    rates: Rates = field(default_factory=Rates)
    uv: UvOptions = field(default_factory=UvOptions)


@dataclass(frozen=True)
class KeyframeOptions(SolverOptions):
    """What the backdrop and all keyframes read."""

    start: StartOptions = field(default_factory=StartOptions)


@dataclass(frozen=True)
class FirstOptions(KeyframeOptions):
    """What the backdrop reads, or the first keyframe without one; called the first fit below."""

    iterations: int = 1500
    """Of the first fit, one camera each"""
    coarse_share: float = 0.1
    """Share of the first fit's iterations on pictures of half the size"""
    float_share: float = 0.7
    """Share of the first fit's iterations before the quantizer is fixed"""
    sh_degree: int = 0
    """View dependence at most: 0 none, 1 to 3 as in 3D Gaussian Splatting; bands that gain nothing on cameras left out
    are dropped, see `packuv.fit.bands`"""
    sh_gain: float = 0.03
    """Share of the loss that the bands above a degree must gain to be carried. A matte simulated room gains 1.5 % by
    them, 0.07 dB: they are texture then, not shine"""
    near_share: float = 0.2
    """Near plane, in scene radii; cameras may sit in the wall they film"""
    backdrop_share: float = 0.88
    """Of the cap on Gaussians, at most, for what stands still. On "basketball" 8,500 for what stands before it are as
    good as 18,000, within 0.04 dB, at half the file"""
    shell: ShellOptions = field(default_factory=ShellOptions)

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"the first fit needs an iteration at least, but iterations is {self.iterations}")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"the SH degree must be 0 to 3, but is {self.sh_degree}")
        if not 0 < self.backdrop_share < 1:
            raise ValueError(
                "backdrop_share must lie between 0 and 1, so that there is room for what moves, "
                f"but is {self.backdrop_share}"
            )


@dataclass(frozen=True)
class ChangeOptions(SolverOptions):
    """What a fit of a part of the Gaussians reads."""

    labels: LabelOptions = field(default_factory=LabelOptions)


@dataclass(frozen=True)
class NextOptions(KeyframeOptions, ChangeOptions):
    """What a keyframe reads that starts from the backdrop or from another one."""

    key_births: int = 5_000
    """Gaussians born inside the hull of what differs from where the keyframe starts"""
    key_iterations: int = 500
    """Of each keyframe"""
    key_rate_scale: float = 16.0
    """Factor on the means' rate in keyframes that start from the backdrop: what is born in a hull has far to go. On
    "basketball" 800 iterations leave moving areas of unseen cameras with 24.1 dB with 1, 25.1 with 4, 26.2 with 16"""

    def __post_init__(self) -> None:
        if self.key_iterations < 1:
            raise ValueError(f"a keyframe needs an iteration at least, but key_iterations is {self.key_iterations}")


@dataclass(frozen=True)
class FrameOptions(ChangeOptions):
    """What the frames of a segment read."""

    frame_iterations: int = 240
    """Of each frame inside a segment, at most"""
    frame_rate_scale: float = 2.0
    """Factor on the means' rate inside segments: the lifted motion is only nearly right. Over 19 frames of "basketball"
    moving areas of unseen cameras have 26.5 dB with 4, 26.8 with 2"""
    spare: int = 1500
    """Rows per segment that are empty at its keyframe, for what comes into view"""
    births_share: float = 0.05
    """Of the moving rows, how many empty ones may come alive in one pass"""
    settle: float = 0.02
    """A frame stops when its last two rounds lowered the loss by less than this share, on average, ..."""
    near_key: float = 1.3
    """... and when its loss is at most this many times its keyframe's: slow gains far from there are a hard frame"""
    lift: LiftOptions = field(default_factory=LiftOptions)

    def __post_init__(self) -> None:
        if self.frame_iterations < 1:
            raise ValueError(f"a frame needs an iteration at least, but frame_iterations is {self.frame_iterations}")


@dataclass(frozen=True)
class FitOptions(FirstOptions, NextOptions, FrameOptions):
    """All settings of a fit; presets live in `pipelines.options`."""

    background: BackgroundOptions = field(default_factory=BackgroundOptions)

    def __post_init__(self) -> None:
        for part in (FirstOptions, NextOptions, FrameOptions):
            self.part(part)  # which checks itself

    def part(self, kind: type[Part]) -> Part:
        """What one piece of work reads, and no more."""
        return kind(**{item.name: getattr(self, item.name) for item in fields(kind)})
