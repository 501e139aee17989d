"""What an error of a code does to pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.codes import Codes, Quantizer
from packuv.gaussians.floats import Gaussians
from packuv.progress import Ticks
from packuv.raster import Gradients, RasterOptions, gradients, render
from packuv.scene import Scene

LEAST_W = 1e-3
"""Below it x, y, z of a quaternion hardly tell its w, and their derivative has no bound"""


def sensitivity(
    scene: Scene,
    cameras: Sequence[PinholeCamera],
    frames: Sequence[int],
    *,
    near: float,
    seed: int = 0,
    ticks: Ticks | None = None,
) -> np.ndarray:
    """Mean squared error of a picture for one step of error in the codes of each kind, float64 [3 + A].

    Kinds are x, y, z and the attributes; errors of different Gaussians and kinds are taken as independent, so that
    squares add up: these are sums of squared derivatives over Gaussians, means over pixels, channels, cameras and
    frames. For seeds z of +1 and -1 by pixel, one backward pass gives J^T z, whose squares have the sums over pixels
    of J's squares as their mean: one pass for each picture tells all.
    """
    kinds, samples = np.zeros(3 + len(scene.header.quantizer.low)), 0
    for squares, count in _squares(scene, cameras, frames, near, seed=seed, ticks=ticks):
        kinds += squares.sum(axis=0)
        samples += count
    return kinds / samples


def row_sensitivity(
    scene: Scene, cameras: Sequence[PinholeCamera], frames: Sequence[int], *, near: float, seed: int = 0
) -> np.ndarray:
    """The same of each row, float64 [N, 3 + A], from frames of one segment."""
    total, samples = np.zeros(0), 0
    for squares, count in _squares(scene, cameras, frames, near, seed=seed):
        total = total + squares if samples else squares
        samples += count
    return total / samples


def _squares(
    scene: Scene,
    cameras: Sequence[PinholeCamera],
    frames: Sequence[int],
    near: float,
    *,
    seed: int,
    ticks: Ticks | None = None,
) -> Iterator[tuple[np.ndarray, int]]:
    """By picture: squared derivatives by the codes of each row [N, 3 + A], and how many values it has."""
    rng, options = np.random.default_rng(seed), RasterOptions(near=near)
    for frame in frames:
        codes = scene.codes(frame)
        gaussians = scene.header.quantizer.decode(codes)
        for camera in cameras:
            drawn = render(gaussians, camera, options=options)
            seeds = rng.choice(np.array([-1, 1], np.float32), drawn.colour.shape)
            seeds[(drawn.colour < 0) | (drawn.colour > 1)] = 0  # what a display clips shows no error
            found = gradients(drawn, seeds)
            yield np.square(by_code(found, gaussians, codes, scene.header.quantizer)), drawn.colour.size
            if ticks:
                ticks.advance()


def by_code(found: Gradients, gaussians: Gaussians, codes: Codes, quantizer: Quantizer) -> np.ndarray:
    """Derivatives by codes, float64 [N, 3 + A], from those by what they stand for."""
    along = [np.gradient(table.astype(np.float64)) for table in quantizer.xyz_table]
    place = found.means * np.stack([slope[codes.xyz[:, axis]] for axis, slope in enumerate(along)], axis=1)
    vector, w = gaussians.quaternions[:, 1:], np.maximum(gaussians.quaternions[:, :1], LEAST_W)
    turn = found.quaternions[:, 1:] - found.quaternions[:, :1] * vector / w  # w is what x, y, z leave of length 1
    values = [found.log_scales, turn, found.opacity_logits[:, None], found.sh.reshape(len(codes), -1)]
    others = np.concatenate(values, axis=1) * (quantizer.high - quantizer.low) / 255
    return np.concatenate([place, others], axis=1).astype(np.float64)
