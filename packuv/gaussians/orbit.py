"""Views from outside: cameras on circles about Gaussians that came without any."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, opacity

NEAR_SHARE = 0.02
"""Near plane as a share of the orbit's radius."""
SIGMAS = 3.0
"""Of the median Gaussian that the picture holds at least, where there are few"""
UP = (0.0, -1.0, 0.0)
"""In the files of 3D Gaussian Splatting"""


@dataclass(frozen=True)
class OrbitOptions:
    """Where the cameras stand, and what they see."""

    cameras: int = 6
    """Cameras on the circle, evenly spaced"""
    size: tuple[int, int] = (480, 360)
    """Width and height, pixels"""
    field_deg: float = 50.0
    """Horizontal field of view"""
    elevation_deg: float = 15.0
    """How far above the scene's middle they stand"""
    azimuth_deg: float = 0.0
    """Of the first camera on the circle"""
    up: tuple[float, float, float] = UP
    """World, a unit vector"""
    share: float = 0.9
    """Share of the opacity that fills the picture; stray background lies outside"""


def middle(gaussians: Gaussians, *, share: float) -> tuple[np.ndarray, float]:
    """Median position, float64 [3], weighted by alpha, and the radius about it that holds this share of all alpha."""
    alpha, means = opacity(gaussians), gaussians.means.astype(np.float64)
    centre = np.array([_quantile(axis, alpha, 0.5) for axis in means.T])
    radius = _quantile(np.linalg.norm(means - centre, axis=1), alpha, share)
    size = math.exp(_quantile(gaussians.log_scales.max(axis=1).astype(np.float64), alpha, 0.5))
    return centre, max(radius, SIGMAS * size, 1e-6)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(reached, share * reached[-1])]])


def around(spheres: Sequence[tuple[np.ndarray, float]]) -> tuple[np.ndarray, float]:
    """Centre and radius of a sphere about others, those of the frames of a sequence."""
    centres = np.stack([centre for centre, _ in spheres])
    centre = (centres.min(axis=0) + centres.max(axis=0)) / 2
    return centre, max(float(np.linalg.norm(c - centre)) + radius for c, radius in spheres)


def orbit(
    centre: np.ndarray, radius: float, *, options: OrbitOptions, name: str = "orbit", first: int = 0
) -> tuple[PinholeCamera, ...]:
    """Cameras `orbit00`, ... that look at a sphere from a circle around it; with another name, counted from `first`."""
    width, height = options.size
    focal = width / 2 / math.tan(math.radians(options.field_deg) / 2)
    distance = 1.1 * radius / math.sin(math.radians(options.field_deg) / 2)
    cameras: list[PinholeCamera] = []
    down = np.subtract(0.0, options.up)
    down /= np.linalg.norm(down)
    side, back = _across(down)
    for index in range(options.cameras):
        azimuth = 2 * math.pi * index / options.cameras + math.radians(options.azimuth_deg)
        elevation = math.radians(options.elevation_deg)
        level = math.cos(elevation) * (math.sin(azimuth) * side - math.cos(azimuth) * back)
        ahead = -(level - math.sin(elevation) * down)
        right = np.cross(down, ahead)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        pose[:3, 3] = -pose[:3, :3] @ (centre - distance * ahead)
        label = f"{name}{first + index:02d}"
        cameras.append(PinholeCamera(label, width, height, focal, focal, width / 2, height / 2, pose))
    return tuple(cameras)


def _across(down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [3] that stand on it and on each other: x and z where down is y."""
    axis = np.eye(3)[2 if abs(down[2]) < 0.9 else 1]
    side = np.cross(down, axis)
    side /= np.linalg.norm(side)
    return side, np.cross(side, down)


def near_of(cameras: tuple[PinholeCamera, ...]) -> float:
    """Near plane that suits an orbit, world."""
    centres = np.stack([camera.centre for camera in cameras])
    return NEAR_SHARE * max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()), 1e-6)
