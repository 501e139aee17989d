"""Frames of a scene on their way to another program: which Gaussians go, in which light, and in which rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction

import numpy as np

from packuv.colour import OFFSET, light_factors, linear_from_srgb, srgb_from_linear
from packuv.gaussians.floats import SH_C0, Gaussians, drawn, lit_gaussians, opacity, rows_of
from packuv.interchange.conventions import is_drawn
from packuv.progress import Progress, no_progress
from packuv.scene import Scene, Sound
from packuv.scene.sound import RATE

ANTIALIASED = "antialiased"
"""Field of a header's `extra`: trained with the opacities of Mip-Splatting"""


class Part(StrEnum):
    """Which Gaussians of a frame go."""

    BACKDROP = "backdrop"
    """Those that stand still for the whole of their segment"""
    PEOPLE = "people"
    """Those that may move in it"""
    BOTH = "both"


@dataclass(frozen=True)
class ClipOptions:
    """How frames go out."""

    part: Part = Part.BOTH
    bake_light: bool = True
    """Whether each frame goes out as seen in its own light; otherwise in steady light. No format knows light"""
    keep_rows: bool = False
    """Whether a row is the same Gaussian in all frames of a segment, absent ones with alpha 0; otherwise only what is
    drawn goes"""


@dataclass(frozen=True)
class Baking:
    """What it costs to bake light into SH, which are sRGB, while gains are of linear light; colours in 0..1."""

    rms: float = 0.0
    """Over the Gaussians of a frame, each counted by its alpha"""
    largest: float = 0.0

    def worse(self, other: Baking) -> Baking:
        return Baking(max(self.rms, other.rms), max(self.largest, other.largest))


def baking_error(gaussians: Gaussians, light: np.ndarray) -> Baking:
    """How far colours of band 0, baked as `lit_gaussians` does, are from the same colours under linear gains.

    `light` holds natural logarithms of the gains, [3]. Both are cut to 0..1, as a display does.
    """
    if not np.any(light) or not len(gaussians):
        return Baking()
    colours = np.clip(0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64), 0, 1)
    baked = np.clip(light_factors(light) * (colours + OFFSET) - OFFSET, 0, 1)
    errors = np.abs(baked - srgb_from_linear(linear_from_srgb(colours) * np.exp(light)))
    return Baking(float(np.sqrt(np.average((errors**2).mean(axis=1), weights=opacity(gaussians)))), float(errors.max()))


class Clip:
    """Frames of a scene, read in order; memory does not grow with their number."""

    def __init__(self, scene: Scene, frames: range, options: ClipOptions, *, progress: Progress = no_progress) -> None:
        self._scene, self.frames, self.options, self._progress = scene, frames, options, progress
        self.baking = Baking()
        """The worst of the frames read so far"""
        self.drawn = 0
        """Gaussians that are drawn, of all frames read so far"""

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Gaussians]:
        for done, number in enumerate(self.frames, start=1):
            yield self.frame(number)
            self._progress(done, len(self))

    @property
    def rate(self) -> Fraction:
        return self._scene.header.rate

    @property
    def seconds(self) -> np.ndarray:
        """When each frame was filmed, float64 [T], from the first one on."""
        times = self._scene.header.times_ns[self.frames.start : self.frames.stop]
        return np.asarray((times - times[:1]) / 1e9, np.float64)

    @property
    def heard(self) -> str:
        """Name of the camera that heard the sound of the scene; empty where it has none."""
        return self._scene.index.heard

    def sound(self) -> Sound | None:
        """What was heard from the first of the frames to the end of the last; None where that is nothing."""
        whole = self._scene.sound()
        if whole is None:
            return None
        start, seconds = self._scene.header.seconds_to(self.frames.start), float(self.seconds[-1] + 1 / self.rate)
        samples = whole.samples(round(start * RATE), round(seconds * RATE))
        return Sound.of(whole.camera, samples) if samples.size else None

    @property
    def gains(self) -> np.ndarray:
        """Light of each frame, float64 [T, 3]: factors on linear light, r g b; 1 is steady."""
        gains: np.ndarray = np.exp(self._scene.header.light[self.frames.start : self.frames.stop])
        return gains

    @property
    def segments(self) -> list[int]:
        """Number of the segment of each frame; rows are numbered anew in each."""
        return [self._scene.segment_at(frame) for frame in self.frames]

    @property
    def antialiased(self) -> bool:
        return self._scene.header.extra.get(ANTIALIASED) is True

    def frame(self, number: int) -> Gaussians:
        """All rows of a frame, of the part that goes, absent ones included."""
        gaussians, light = self._scene.gaussians(number), self._scene.light(number)
        moving = self._scene.index.segments[self._scene.segment_at(number)].dynamic
        if self.options.part != Part.BOTH:
            moves = self.options.part == Part.PEOPLE
            gaussians = rows_of(gaussians, slice(moving) if moves else slice(moving, None))
        self.drawn += int(is_drawn(gaussians).sum())
        if not self.options.bake_light:
            return gaussians
        self.baking = self.baking.worse(baking_error(drawn(gaussians), light))
        return lit_gaussians(gaussians, light)
