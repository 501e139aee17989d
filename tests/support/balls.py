"""Balls on smooth ways, seen by cameras all round: what moves in their pictures at times that are known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

WIDTH, HEIGHT = 96, 54
FOCAL = 80.0
"""Pixels"""
RADIUS = 0.25


def camera_pose(number: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of camera_from_world and centre of a camera on a ring of radius 4 that looks at the middle."""
    angle = 2 * np.pi * number / count + 0.1 * number % 0.7
    centre = 4 * np.array([np.cos(angle), 0.1 + 0.05 * number, np.sin(angle)])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]), centre


def pixels_of(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Middles of the pixels before a focal length of `FOCAL` for `WIDTH`, float64 [3, height * width]."""
    across, down = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    return np.stack([across.ravel(), down.ravel(), np.full(width * height, FOCAL * width / WIDTH)])


def covered(number: int, count: int, times: np.ndarray, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Where a camera sees a ball at each time, in instants: bool [T, height * width]."""
    return np.any([disc for disc, _ in discs(number, count, times, width, height)], axis=0)


def discs(
    number: int, count: int, times: np.ndarray, width: int = WIDTH, height: int = HEIGHT
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each ball where a camera sees it, bool [T, height * width], and its middle in pixels, float64 [T, 2]."""
    turn, centre = camera_pose(number, count)
    pixels = pixels_of(width, height)
    focal = pixels[2, 0]
    for way in _ways(times):
        x, y, z = turn @ (way - centre).T
        middle = focal * np.stack([x, y], axis=1) / z[:, None]
        away = np.hypot(*(pixels[axis] - middle[:, axis, None] for axis in (0, 1)))
        yield away < (focal * RADIUS / z)[:, None], middle


def _ways(times: np.ndarray) -> np.ndarray:
    """Places of three balls, [3, T, 3]."""
    rng = np.random.default_rng(3)
    speeds, phases = rng.uniform(0.04, 0.16, (3, 3, 3)), rng.uniform(0, 2 * np.pi, (3, 3, 3))
    ways: np.ndarray = np.sin(speeds[..., None] * times + phases[..., None]).mean(axis=2)  # [3, 3, T]
    return np.moveaxis(ways, 1, 2) + rng.uniform(-0.8, 0.8, (3, 1, 3)) * [1, 0.3, 1]
