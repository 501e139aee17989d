"""Views from outside: cameras on a circle about Gaussians that came without any, and how alike two sets look there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians
from packuv.metrics import psnr
from packuv.raster import Arena, RasterOptions, render

NEAR_SHARE = 0.02
"""Near plane as a share of the orbit's radius."""


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
    """How far above the scene's middle they stand; up is -y, as in the files of 3D Gaussian Splatting"""
    share: float = 0.9
    """Share of the opacity that fills the picture; stray background lies outside"""


def middle(gaussians: Gaussians, *, share: float) -> tuple[np.ndarray, float]:
    """Median position, float64 [3], weighted by alpha, and the radius about it that holds this share of all alpha."""
    alpha = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    means = gaussians.means.astype(np.float64)
    centre = np.array([_quantile(axis, alpha, 0.5) for axis in means.T])
    radius = _quantile(np.linalg.norm(means - centre, axis=1), alpha, share)
    return centre, max(radius, 1e-6)


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(reached, share * reached[-1])]])


def around(spheres: Sequence[tuple[np.ndarray, float]]) -> tuple[np.ndarray, float]:
    """Centre and radius of a sphere about others, those of the frames of a sequence."""
    centres = np.stack([centre for centre, _ in spheres])
    centre = (centres.min(axis=0) + centres.max(axis=0)) / 2
    return centre, max(float(np.linalg.norm(c - centre)) + radius for c, radius in spheres)


def orbit(centre: np.ndarray, radius: float, *, options: OrbitOptions) -> tuple[PinholeCamera, ...]:
    """Cameras `orbit00`, ... that look at a sphere from a circle around it."""
    width, height = options.size
    focal = width / 2 / math.tan(math.radians(options.field_deg) / 2)
    distance = 1.1 * radius / math.sin(math.radians(options.field_deg) / 2)
    cameras = []
    for index in range(options.cameras):
        azimuth, elevation = 2 * math.pi * index / options.cameras, math.radians(options.elevation_deg)
        ahead = -np.array(
            [math.cos(elevation) * math.sin(azimuth), -math.sin(elevation), -math.cos(elevation) * math.cos(azimuth)]
        )
        right = np.cross([0.0, 1.0, 0.0], ahead)  # down x ahead
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        pose[:3, 3] = -pose[:3, :3] @ (centre - distance * ahead)
        cameras.append(PinholeCamera(f"orbit{index:02d}", width, height, focal, focal, width / 2, height / 2, pose))
    return tuple(cameras)


def near_of(cameras: tuple[PinholeCamera, ...]) -> float:
    """Near plane that suits an orbit, world."""
    centres = np.stack([camera.centre for camera in cameras])
    return NEAR_SHARE * max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()), 1e-6)


def likeness(truth: Gaussians, other: Gaussians, cameras: tuple[PinholeCamera, ...], *, near: float) -> list[float]:
    """PSNR of renders of `other` against renders of `truth`, dB, one for each camera; black background."""
    options, arena = RasterOptions(near=near), Arena()
    found = []
    for camera in cameras:
        pictures = [render(g, camera, options=options, arena=arena).colour for g in (truth, other)]
        found.append(psnr(pictures[1], pictures[0]))
    return found
