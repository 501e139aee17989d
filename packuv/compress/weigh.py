"""How much of a picture each Gaussian of a segment makes up at most, and who is therefore left out."""

from __future__ import annotations

from itertools import islice

import numpy as np

from packuv.camera import PinholeCamera
from packuv.compress.views import Views
from packuv.gaussians.codes import OPACITY, Quantizer
from packuv.gaussians.segment import Segment
from packuv.progress import Ticks
from packuv.raster import Arena, RasterOptions, render

FRAMES, VIEWS = 8, 8
"""Of a segment, at most, spread evenly; and in each of them, or as many as it takes to look from each camera once"""
WORTH = 4e5
"""Of a picture, in noise a Gaussian: what stays must make up so much of one. Measured, docs/compression.md"""


def weigh(
    segment: Segment, quantizer: Quantizer, views: Views, *, near: float, rng: np.random.Generator, ticks: Ticks
) -> np.ndarray:
    """Largest share of a picture that each row makes up, float32 [N]: its blending weights over the pixels.

    Infinite where a row is in none of the frames that were drawn, or where nobody filmed the scene beside all
    pictures: nothing is known of it.
    """
    most, known = np.zeros(len(segment.key), np.float32), np.zeros(len(segment.key), bool)
    options, arena, frames = RasterOptions(near=near), Arena(), _spread(len(segment))
    count = _views(len(frames), len(views))
    cameras = views.sweep(count * len(frames), rng)
    for index in frames:
        codes = segment.frame(index)
        gaussians = quantizer.decode(codes)
        there = codes.attributes[:, OPACITY] > 0
        for camera in islice(cameras, count):
            drawn = render(gaussians, camera, options=options, weights=True, arena=arena)
            most = np.maximum(most, drawn.weights / (camera.width * camera.height))
            known |= there if views.filmed else there & _before(camera, gaussians.means, near)
            ticks.advance()
    return np.where(known, most, np.float32(np.inf))


def _before(camera: PinholeCamera, means: np.ndarray, near: float) -> np.ndarray:
    """Which of points [N, 3] lie within the picture of a camera, bool [N]."""
    pixels, depth = camera.project(means.astype(np.float64))
    inside = (pixels >= 0) & (pixels <= (camera.width, camera.height))
    return np.logical_and(inside.all(axis=1), depth > near)


def pictures_of(frames: int, cameras: int) -> int:
    """How many pictures `weigh` draws of a segment with so many frames, and so many cameras to see them."""
    drawn = len(_spread(frames))
    return drawn * _views(drawn, cameras)


def _views(frames: int, cameras: int) -> int:
    """In each of so many frames."""
    return max(VIEWS, -(-cameras // frames))


def _spread(frames: int) -> list[int]:
    """The first frame, the last, and some between."""
    return sorted({int(index) for index in np.linspace(0, frames - 1, FRAMES).round()})


def worth(weights: np.ndarray, noise: float) -> np.ndarray:
    """Rows that stay where kinds of codes add so much noise for each row, bool [N]; at least one.

    Noise adds up over the rows, and so does what is left out: a row is worth its bits by its share of the noise.
    """
    return np.asarray((weights >= WORTH * noise) | (weights == weights.max()))
