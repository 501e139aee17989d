"""A textured corner of a room with exact cameras, for the tests of `calibration`: every pixel's ray is cast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from calibration.rig import Camera, Rig


def look_at(centre: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """Camera from world, float64 [4, 4], for a camera that looks from one point to another, y down in the world."""
    centre_, forward = np.asarray(centre, float), np.asarray(target, float) - np.asarray(centre, float)
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre_
    return pose


def ring(count: int, *, radius: float = 3.0, height: float = -1.0, size: tuple[int, int] = (640, 360)) -> Rig:
    """Cameras on a circle that look at the origin."""
    width, tall = size
    angles = 2 * np.pi * np.arange(count) / count
    cameras = [
        Camera(
            f"cam{i:02d}", width, tall, 0.8 * width, 0.8 * width, width / 2, tall / 2,
            look_at((radius * np.sin(a), height, -radius * np.cos(a)), (0, 0, 0)),
        )
        for i, a in enumerate(angles)
    ]  # fmt: skip
    return Rig(tuple(cameras), "a ring")


def arc(count: int, *, span_deg: float = 50, size: tuple[int, int] = (320, 240), lens: tuple[float, ...] = ()) -> Rig:
    """Cameras at different heights that look into the corner of the room of `render`."""
    width, tall = size
    angles = np.radians(np.linspace(-span_deg / 2, span_deg / 2, count))
    cameras = [
        Camera(
            f"cam{i}", width, tall, 0.95 * width, 0.96 * width, width / 2 + 3, tall / 2 - 2,
            look_at((3 * np.sin(a), -0.6 + 0.25 * (i % 3), 3 - 3 * np.cos(a)), (0, 0.2, 3)), lens,
        )
        for i, a in enumerate(angles)
    ]  # fmt: skip
    return Rig(tuple(cameras), "an arc")


@dataclass(frozen=True)
class Plane:
    """Where normal . x = offset; u and v span it."""

    normal: np.ndarray
    offset: float
    u: np.ndarray
    v: np.ndarray


PLANES = (
    Plane(np.array([0.0, 0, 1]), 4.0, np.array([1.0, 0, 0]), np.array([0.0, 1, 0])),  # wall
    Plane(np.array([0.0, 1, 0]), 1.0, np.array([1.0, 0, 0]), np.array([0.0, 0, 1])),  # floor
    Plane(np.array([1.0, 0, 1]) / np.sqrt(2), 1.6, np.array([1.0, 0, -1]) / np.sqrt(2), np.array([0.0, 1, 0])),  # slant
)
SLANT_REACH = (0.7, 0.6)
"""Half the size of the slanted board along u and v about the point of it nearest to the scene"""
SLANT_MIDDLE = np.array([-0.45, 0.3, 1.6 * np.sqrt(2) + 0.45])


@cache
def texture(seed: int, size: int = 1024) -> np.ndarray:
    """Linear light, float32 [size, size, 3] in [0.05, 0.7], with detail at every scale."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cells in (8, 32, 64, 128, 256):
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32) + rng.normal(size=(cells, cells, 1))
        total += cv2.resize(noise.astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return (0.05 + 0.65 / (1 + np.exp(-0.8 * total))).astype(np.float32)


def render(camera: Camera, *, gains: Sequence[float] = (1, 1, 1), seed: int = 0, oversample: int = 2) -> np.ndarray:
    """uint8 [H, W, 3] sRGB picture of the room; the camera's sensor scales linear light by 1 / gains."""
    step = 1 / oversample
    x, y = np.meshgrid(np.arange(step / 2, camera.width, step), np.arange(step / 2, camera.height, step))
    plane = camera.plane_from_pixels(np.stack([x.ravel(), y.ravel()], axis=1))
    rays = np.hstack([plane, np.ones((len(plane), 1))]) @ camera.camera_from_world[:3, :3]
    light, nearest = np.full((len(rays), 3), 0.1, np.float32), np.full(len(rays), np.inf)
    for index, surface in enumerate(PLANES):
        depth = (surface.offset - surface.normal @ camera.centre) / (rays @ surface.normal)
        spot = camera.centre + depth[:, None] * rays
        hit = (depth > 0) & (depth < nearest)
        if index == 2:
            hit &= np.abs((spot - SLANT_MIDDLE) @ surface.u) < SLANT_REACH[0]
            hit &= np.abs((spot - SLANT_MIDDLE) @ surface.v) < SLANT_REACH[1]
        light[hit] = _sample(texture(10 * seed + index), spot[hit] @ surface.u, spot[hit] @ surface.v)
        nearest[hit] = depth[hit]
    fine = light.reshape(y.shape[0], y.shape[1], 3)
    picture = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return srgb(picture / np.asarray(gains, np.float32))


@cache
def filmed(count: int) -> tuple[Rig, np.ndarray, dict[str, np.ndarray]]:
    """An arc of cameras, the gains float64 [C, 3] that undo their colours, and their pictures."""
    rig = arc(count)
    gains = np.exp(np.random.default_rng(0).normal(0, 0.12, (count, 3)))
    gains /= np.exp(np.log(gains).mean(axis=0))
    return rig, gains, {c.name: render(c, gains=tuple(g)) for c, g in zip(rig.cameras, gains, strict=True)}


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray, metres: float = 6.0) -> np.ndarray:
    scale = image.shape[0] / metres
    grid = [((w + metres / 2) * scale).astype(np.float32).reshape(1, -1) for w in (u, v)]
    chunks = [slice(i, i + 30_000) for i in range(0, grid[0].shape[1], 30_000)]  # remap's width limit is 32,767
    parts = [
        cv2.remap(image, grid[0][:, c], grid[1][:, c], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[0] for c in chunks
    ]
    return np.concatenate([*parts, np.zeros((0, 3), np.float32)])


def srgb(light: np.ndarray) -> np.ndarray:
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(np.clip(curved, 0, 1) * 255).astype(np.uint8)


def off_surface(points: np.ndarray) -> np.ndarray:
    """Distance of points [P, 3] from the nearest of the room's planes, float64 [P]."""
    return np.min([np.abs(points @ plane.normal - plane.offset) for plane in PLANES], axis=0)
