"""How light falls off towards the corners of a camera's picture, the same in all channels.

    ln V = k1 (r^2 - m2) + k2 (r^4 - m4)

r is the distance from the principal point at depth 1, r = 1 in the corner; m2 and m4 are the means of r^2 and r^4 over
the picture, so that ln V has mean 0 and gains keep their meaning. `packuv.footage.response` draws by the same formula.
"""

from __future__ import annotations

import math

import numpy as np

from calibration.rig import Camera

MOST_TURN = 0.05
"""ln V may rise again by this much on its way to the corner, or fall; lenses do no more, noise does"""


def corner_radius(camera: Camera) -> float:
    """Length at depth 1 from the middle of a picture to its corner."""
    return math.hypot(camera.width / (2 * camera.fx), camera.height / (2 * camera.fy))


def shading_means(camera: Camera) -> tuple[float, float]:
    """m2 and m4."""
    x, y = (camera.width / (2 * camera.fx)) ** 2, (camera.height / (2 * camera.fy)) ** 2
    return 1 / 3, (x * x / 5 + y * y / 5 + 2 * x * y / 9) / (x + y) ** 2


def shading_basis(camera: Camera, plane: np.ndarray) -> np.ndarray:
    """r^2 - m2 and r^4 - m4, float64 [N, 2], of undistorted coordinates [N, 2] at depth 1."""
    r2 = (np.asarray(plane, np.float64) ** 2).sum(axis=1) / corner_radius(camera) ** 2
    return np.stack([r2, r2 * r2], axis=1) - shading_means(camera)


def turns_back(shading: np.ndarray) -> np.ndarray:
    """By which k1, k2 [..., 2] the light falls and rises again on the way to the corner, or rises and falls."""
    r2 = np.linspace(0, 1, 33)
    log = shading[..., :1] * r2 + shading[..., 1:] * r2**2  # [..., 33]
    back: np.ndarray = np.ptp(log, axis=-1) - np.abs(log[..., -1]) > MOST_TURN
    return back
