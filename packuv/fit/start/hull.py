"""The visual hull of motion masks: where things stand that the background lacks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.first import _ROUNDS, StartOptions
from packuv.fit.start.points import Points, look, pixels_of


def hull_points(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],  # float32 [3, H, W]
    masks: Sequence[np.ndarray],  # bool [H, W]
    *,
    bounds: Bounds,
    options: StartOptions,
    count: int,
    rng: np.random.Generator,
) -> Points:
    """At most `count` random points in the hull of the masks, drawn along the rays of masked pixels."""
    found = np.empty((0, 3))
    for _ in range(_ROUNDS):
        xyz = _masked_rays(cameras, masks, 8 * count, bounds, options, rng)
        found = np.concatenate([found, xyz[in_hull(xyz, cameras, masks, bounds=bounds, options=options)]])
        if len(found) >= count or not len(xyz):
            break
    return Points(found[:count], look(cameras, pictures, found[:count], bounds.near).rgb)


def in_hull(
    xyz: np.ndarray,  # [N, 3], world
    cameras: Sequence[PinholeCamera],
    masks: Sequence[np.ndarray],  # bool [H, W]
    *,
    bounds: Bounds,
    options: StartOptions,
) -> np.ndarray:
    """Which points fall into the mask of nearly every camera that sees them, and are seen by enough: bool [N].

    One camera in five may disagree: a mask can miss what has the colour of its background.
    """
    views, inside = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64)
    for camera, mask in zip(cameras, masks, strict=True):
        seen, rows, columns = pixels_of(camera, xyz, bounds.near)
        views += seen
        inside[seen] += mask[rows, columns]
    return np.asarray((views >= min(options.min_views, len(cameras))) & (inside >= 0.8 * views))


def _masked_rays(
    cameras: Sequence[PinholeCamera],
    masks: Sequence[np.ndarray],
    count: int,
    bounds: Bounds,
    options: StartOptions,
    rng: np.random.Generator,
) -> np.ndarray:
    """Points at random distances behind random masked pixels, inside the volume, float64 [n, 3]."""
    points = []
    for camera, mask in zip(cameras, masks, strict=True):
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        pick = rng.integers(0, len(rows), -(-count // len(cameras)))
        depth = rng.uniform(bounds.near, (1 + options.volume) * bounds.radius, len(pick))
        x, y = columns[pick] + rng.random(len(pick)), rows[pick] + rng.random(len(pick))
        local = np.stack([(x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth], axis=1)
        points.append((local - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3])
    xyz = np.concatenate(points) if points else np.empty((0, 3))
    inside = np.linalg.norm(xyz - bounds.centre, axis=1) <= options.volume * bounds.radius
    return rng.permutation(xyz[inside])
