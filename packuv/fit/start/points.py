"""Points with colours, from which Gaussians start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera


@dataclass(frozen=True)
class Points:
    """Points on surfaces, with colours."""

    xyz: np.ndarray
    """float64 [P, 3], world"""
    rgb: np.ndarray
    """float64 [P, 3], in [0, 1]"""


def no_points() -> Points:
    return Points(np.empty((0, 3)), np.empty((0, 3)))


def together(*parts: Points) -> Points:
    """The points of all parts, in this order."""
    return Points(np.concatenate([part.xyz for part in parts]), np.concatenate([part.rgb for part in parts]))


def drawn(points: Points, count: int, rng: np.random.Generator, *, weight: np.ndarray | None = None) -> Points:
    """At most `count` of the points, at random, in proportion to `weight` [P] if given."""
    if len(points.xyz) <= count:
        return points
    share = None if weight is None else weight / weight.sum()
    rows = np.sort(rng.choice(len(points.xyz), count, replace=False, p=share))
    return Points(points.xyz[rows], points.rgb[rows])


def seen_colours(
    cameras: Sequence[PinholeCamera], pictures: Sequence[np.ndarray], xyz: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour [N, 3] of the pixels each point falls on, and the number of cameras that see it, int [N]."""
    total, views = np.zeros((len(xyz), 3)), np.zeros(len(xyz), np.int64)
    for camera, picture in zip(cameras, pictures, strict=True):
        inside, rows, columns = pixels_of(camera, xyz, near)
        total[inside] += picture[:, rows, columns].T
        views[inside] += 1
    return total / np.maximum(views, 1)[:, None], views


def pixels_of(camera: PinholeCamera, xyz: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which points the camera sees, bool [N], and the pixels of those, rows [n] and columns [n]."""
    pixels, depth = camera.project(xyz)
    x, y = pixels.T
    inside = (depth > near) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return inside, y[inside].astype(np.int64), x[inside].astype(np.int64)
