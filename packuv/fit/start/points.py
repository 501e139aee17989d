"""Points with colours, from which Gaussians start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from packuv.camera import PinholeCamera

SOFT = 1.5
"""Pixels that pictures are blurred by before their colours are compared: places and calibrations are not exact"""


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


@dataclass(frozen=True)
class Sight:
    """What cameras see where points are."""

    rgb: np.ndarray
    """float64 [P, 3]: mean of the pixels that a point falls on, 0 without any"""
    deviation: np.ndarray
    """float64 [P]: standard deviation between cameras, over channels; infinite where fewer than two see the point"""
    views: np.ndarray
    """int64 [P]: cameras that see it"""


def look(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],
    xyz: np.ndarray,
    near: float,
    *,
    may: np.ndarray | None = None,
) -> Sight:
    """How points, float64 [P, 3], look in pictures, float32 [3, H, W], to the cameras that may see each, bool [P, C].

    O(cameras * P).
    """
    total, squares, views = np.zeros((len(xyz), 3)), np.zeros(len(xyz)), np.zeros(len(xyz), np.int64)
    for index, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        inside, rows, columns = pixels_of(camera, xyz, near)
        use = slice(None) if may is None else may[inside, index]
        seen, colours = np.flatnonzero(inside)[use], picture[:, rows[use], columns[use]].T.astype(np.float64)
        total[seen] += colours
        squares[seen] += np.square(colours).sum(axis=1)
        views[seen] += 1
    mean = total / np.maximum(views, 1)[:, None]
    spread = np.maximum(squares - views * np.square(mean).sum(axis=1), 0) / 3 / np.maximum(views - 1, 1)
    return Sight(mean, np.where(views >= 2, np.sqrt(spread), np.inf), views)


def softened(picture: np.ndarray) -> np.ndarray:
    """The picture, float32 [3, H, W], blurred by `SOFT`."""
    return np.stack([cv2.GaussianBlur(channel, (0, 0), SOFT) for channel in picture])


def pixels_of(camera: PinholeCamera, xyz: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which points the camera sees, bool [N], and the pixels of those, rows [n] and columns [n]."""
    pixels, depth = camera.project(xyz)
    x, y = pixels.T
    inside = (depth > near) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return inside, y[inside].astype(np.int64), x[inside].astype(np.int64)
