"""What a camera makes of the rig's colours: light of the instant, its own exposure, gain and lens shading, clipping.

    filmed = clip(light x exposure x shading / gain x colour, 0, 1)        in linear light

sRGB is (light ^ (1 / 2.4) * 1.055) - 0.055 but for the darkest tones, so a factor k on light is k ^ (1 / 2.4) on
sRGB + 0.055. That is how factors are applied here and wherever a scene is drawn, dark tones included: it keeps the
response linear, so that pictures and colours of Gaussians can carry it alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange

from packuv import colour
from packuv.camera import PinholeCamera
from packuv.footage.lens import LensCamera
from packuv.kernels.compile import kernel, prefer_tbb

GAMMA, OFFSET = colour.GAMMA, colour.OFFSET
_f32 = np.float32


@dataclass(frozen=True)
class Response:
    """A camera's response at an instant, for pictures of one size."""

    factors: tuple[float, float, float]
    """On sRGB + 0.055, r g b, on the circle where the shading is 1"""
    falloff: tuple[float, float]
    """a, b: further factor exp(a r^2 + b r^4), r = 1 in the corner of the filmed picture"""
    grid: tuple[float, float, float, float]
    """Column and row of r = 0, pixels, and r per pixel along x and y"""

    @classmethod
    def of(cls, lens: LensCamera, camera: PinholeCamera, light: np.ndarray | None = None) -> Response:
        """Of a camera whose undistorted pictures are those of `camera`.

        `light`, float [3], is the natural logarithm of light of the instant times the camera's own exposure.
        """
        (k1, k2), (m2, m4) = lens.shading, shading_means(lens.pinhole)
        level = -np.log(lens.gains) + (0 if light is None else light) - k1 * m2 - k2 * m4
        red, green, blue = (float(factor) for factor in colour.light_factors(level))
        corner = corner_radius(lens.pinhole)
        grid = camera.cx, camera.cy, 1 / (camera.fx * corner), 1 / (camera.fy * corner)
        return cls((red, green, blue), (k1 / GAMMA, k2 / GAMMA), grid)

    def scaled(self, x: float, y: float) -> Response:
        """For pictures x times as wide and y times as high."""
        column, row, across, down = self.grid
        return Response(self.factors, self.falloff, (column * x, row * y, across / x, down / y))

    def shown(self, picture: np.ndarray) -> np.ndarray:
        """What the camera films where the rig's colours are `picture`: float32 [3, H, W], sRGB, clipped to [0, 1]."""
        return self._applied(_show, picture)

    def undone(self, filmed: np.ndarray) -> np.ndarray:
        """The rig's colours of what was filmed, float32 [3, H, W] both; what was clipped is taken for its limit."""
        return self._applied(_undo, filmed)

    def carried(self, gradient: np.ndarray) -> np.ndarray:
        """Derivative by the rig's colours, from that by what is shown, float32 [3, H, W] both.

        It passes through the limits: where both pictures are clipped there is none, and a colour beyond a limit that
        the camera did not reach must come back.
        """
        return self._applied(_carry, gradient)

    def _applied(self, how, picture: np.ndarray) -> np.ndarray:
        prefer_tbb()
        out = np.empty_like(picture)
        how(picture, *self.arrays, out)
        return out

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """What kernels take: factors, float32 [3], and the lens, float32 [6]."""
        return np.array(self.factors, _f32), np.array((*self.falloff, *self.grid), _f32)


PLAIN = Response((1.0, 1.0, 1.0), (0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
"""Of a camera that films the rig's colours"""


def corner_radius(pinhole: PinholeCamera) -> float:
    """Length at depth 1 from the middle of a picture to its corner."""
    return math.hypot(pinhole.width / (2 * pinhole.fx), pinhole.height / (2 * pinhole.fy))


def shading_means(pinhole: PinholeCamera) -> tuple[float, float]:
    """Means m2, m4 of r^2 and r^4 over the picture; k1 (r^2 - m2) + k2 (r^4 - m4), the shading's log, has mean 0."""
    x, y = (pinhole.width / (2 * pinhole.fx)) ** 2, (pinhole.height / (2 * pinhole.fy)) ** 2
    return 1 / 3, (x * x / 5 + y * y / 5 + 2 * x * y / 9) / (x + y) ** 2


# Kernels take the lens as float32 [6]: falloff a, b, then the grid.


@kernel(inline=True)
def shading(lens, x, y):
    """exp(a r^2 + b r^4) in a pixel, by its series: exact to 3e-5 within a factor of e, and without a library call."""
    across, down = (_f32(x) + _f32(0.5) - lens[2]) * lens[4], (_f32(y) + _f32(0.5) - lens[3]) * lens[5]
    r2 = across * across + down * down
    e = r2 * (lens[0] + lens[1] * r2)
    total = _f32(1) + e * _f32(1 / 7)
    for n in range(6, 0, -1):
        total = _f32(1) + e * total * _f32(1 / n)
    return total


@kernel(parallel=True)
def _show(picture, factors, lens, out):
    for y in prange(picture.shape[1]):
        for x in range(picture.shape[2]):
            local = shading(lens, x, y)
            for c in range(3):
                value = factors[c] * local * (picture[c, y, x] + _f32(OFFSET)) - _f32(OFFSET)
                out[c, y, x] = min(max(value, _f32(0)), _f32(1))


@kernel(parallel=True)
def _undo(filmed, factors, lens, out):
    for y in prange(filmed.shape[1]):
        for x in range(filmed.shape[2]):
            local = shading(lens, x, y)
            for c in range(3):
                out[c, y, x] = (filmed[c, y, x] + _f32(OFFSET)) / (factors[c] * local) - _f32(OFFSET)


@kernel(parallel=True)
def _carry(gradient, factors, lens, out):
    for y in prange(gradient.shape[1]):
        for x in range(gradient.shape[2]):
            local = shading(lens, x, y)
            for c in range(3):
                out[c, y, x] = factors[c] * local * gradient[c, y, x]
