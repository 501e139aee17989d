"""Light as real rigs have it: lamps that fade and flicker, lenses that darken towards the corners, one camera's own
exposure.

What camera c records at instant t in pixel p is

    clip(rig_light(p) * light[t] * exposure[c, t] * shading_c(p) * gains[c], 0, 1)

in linear light, per channel; then sRGB and 8 bits. `rig_light` is what the ray caster renders. Every factor but it has
a geometric mean of 1, over instants, frames, the picture and cameras in this order, so that none hides in another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studio.rig import StudioCamera

FLICKER_TICKS = 6.5
"""Period at which the mains beats with the trigger; not a whole number, so that frames of a period differ"""
FLICKER_SHARES = np.array([0.8, 1.0, 1.2])
"""Amplitude of the flicker by channel r g b: the phosphors of lamps decay at different speeds"""
SHADED_SHARE = 2 / 3
"""So many of the cameras have lens shading"""
WEAKEST_SHADING, OTHERS_SHADING = 0.7, 0.15
"""Of the largest: the least of those that have it, and the most of those that have near none"""
FOURTH_ORDER_SHARE = 0.2
"""Largest |k2| as a share of |k1|"""


@dataclass(frozen=True)
class LightOptions:
    """How light and exposure are less than ideal. All are 0, and change nothing, unless asked for."""

    fade: float = 0.0
    """Lamps lose this share of their light from the first instant to the last, linearly; negative: they gain it"""
    flicker: float = 0.0
    """Amplitude of the lamps' flicker as a share of their light, a sine with a period of 6.5 ticks"""
    shading: float = 0.0
    """Largest fall of ln light from a picture's middle to its corner; two thirds of the cameras have 0.7 to 1 of it"""
    exposure_jump: float = 0.0
    """Factor by which the second fitted camera's exposure jumps in the middle of the capture; 0: it does not"""
    shine: float = 0.0
    """Share of light that the floor mirrors at normal incidence: what stands in the room, and the lamp's highlight"""
    wall_lamps: float = 0.0
    """Radiance of four lamps on the walls, of which a camera clips what is above 1; 0: there are none"""

    def __post_init__(self) -> None:
        for name, least, most in (
            ("fade", -1, 0.95),
            ("flicker", 0, 0.8),
            ("shading", 0, 2),
            ("shine", 0, 1),
            ("wall_lamps", 0, 100),
        ):
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} must be {least} to {most}, but is {getattr(self, name)}")
        if self.exposure_jump != 0 and not 0.1 <= self.exposure_jump <= 10:
            raise ValueError(f"exposure_jump must be a factor of 0.1 to 10, or 0 for none, but is {self.exposure_jump}")


@dataclass(frozen=True)
class LensShading:
    """ln of a lens's factor on light is k1 (r^2 - m2) + k2 (r^4 - m4): 0 in the mean over a centred picture.

    r is the distance from the principal point on the undistorted plane at depth 1, in units of half the picture's
    diagonal there.
    """

    k1: float = 0.0
    k2: float = 0.0

    def factors(self, camera: StudioCamera) -> np.ndarray:
        """Factor on linear light at each pixel's centre, float64 [H, W]."""
        half_x, half_y = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
        corner2 = half_x**2 + half_y**2
        mean2 = 1 / 3
        mean4 = (half_x**4 / 5 + half_y**4 / 5 + 2 * half_x**2 * half_y**2 / 9) / corner2**2
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        r2 = (x**2 + y[:, None] ** 2) / corner2
        factors: np.ndarray = np.exp(self.k1 * (r2 - mean2) + self.k2 * (r2**2 - mean4))
        return factors


def light_over_time(ticks: int, options: LightOptions) -> np.ndarray:
    """Factors of the lamps' light by tick and channel, float64 [T, 3]; geometric mean 1 per channel."""
    tick = np.arange(ticks)[:, None]
    fade = 1 - options.fade * tick / (ticks - 1)
    flicker = 1 + options.flicker * FLICKER_SHARES * np.sin(2 * np.pi * tick / FLICKER_TICKS)
    return _mean_one(fade * flicker)


def exposure_over_time(
    ticks: np.ndarray,  # int64 [F], tick of each recorded frame
    middle: int,
    jump: float,
) -> np.ndarray:
    """A camera's own exposure by recorded frame, float64 [F]: `jump` times brighter from tick `middle` on.

    Its geometric mean is 1; so it is all along with a jump of 0.
    """
    return _mean_one(np.where(ticks >= middle, jump or 1.0, 1.0))


def draw_shading(cameras: int, seed: int, options: LightOptions) -> tuple[LensShading, ...]:
    """Lens shading by camera; the same seed gives the same lenses, whatever their strength."""
    rng = np.random.default_rng([seed, 7])
    shaded = rng.permutation(cameras) < round(SHADED_SHARE * cameras)
    strong, near_none = rng.uniform(WEAKEST_SHADING, 1, cameras), rng.uniform(-1, 1, cameras) * OTHERS_SHADING
    k1 = -options.shading * np.where(shaded, strong, near_none)
    k2 = k1 * rng.uniform(-1, 1, cameras) * FOURTH_ORDER_SHARE
    return tuple(LensShading(float(a), float(b)) for a, b in zip(k1, k2, strict=True))


def _mean_one(factors: np.ndarray) -> np.ndarray:
    """Divided by the geometric mean along the first axis."""
    divided: np.ndarray = factors / np.exp(np.log(factors).mean(axis=0))
    return divided
