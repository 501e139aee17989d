"""Where the scene is, and the Gaussians a fit begins with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange

from packuv.camera import PinholeCamera
from packuv.quantize import OPACITY_RANGE, Gaussians

SH_BASE = 0.28209479177387814
"""Value of the constant spherical harmonic"""

_ROUNDS = 8
"""Draws of random places before fewer than asked for will do"""


@dataclass(frozen=True)
class Bounds:
    """The part of the world that a rig films."""

    centre: np.ndarray
    """World, float64 [3]: where the optical axes meet best"""
    radius: float
    """Median distance of the cameras from the centre, world"""
    near: float
    """Distance before which a camera draws nothing, world"""


@dataclass(frozen=True)
class StartOptions:
    count: int = 22_000
    """Gaussians at the start"""
    volume: float = 1.25
    """Random Gaussians fill a ball of this many radii about the centre"""
    min_views: int = 3
    """Cameras that must see a random Gaussian; all of them in smaller rigs"""
    surface_share: float = 0.45
    """At most this share starts on places that cameras agree on: triangulated points and sure places of the shell"""
    shell_share: float = 0.3
    """This share covers the rest of the shell evenly; what is left fills the volume"""
    opacity: float = 0.1
    """Opacity of every Gaussian at the start"""


@dataclass(frozen=True)
class Points:
    """Points on surfaces, with colours."""

    xyz: np.ndarray
    """float64 [P, 3], world"""
    rgb: np.ndarray
    """float64 [P, 3], in [0, 1]"""


def find_bounds(cameras: Sequence[PinholeCamera], *, near_share: float) -> Bounds:
    """Centre and size of what the cameras look at. `near_share` is the near plane's share of the radius.

    Parallel cameras never meet: a weak pull towards a point before them keeps the centre finite.
    """
    origins = np.stack([camera.centre for camera in cameras])
    forward = np.stack([camera.forward for camera in cameras])
    spread = np.linalg.norm(origins - origins.mean(axis=0), axis=1).mean()
    guess = (origins + forward * max(2 * spread, 1e-6)).mean(axis=0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # [C, 3, 3], projectors across each axis
    system = across.sum(axis=0) + 0.01 * len(cameras) * np.eye(3)
    centre = np.linalg.solve(system, (across @ origins[:, :, None]).sum(axis=0)[:, 0] + 0.01 * len(cameras) * guess)
    radius = float(np.median(np.linalg.norm(origins - centre, axis=1)))
    return Bounds(centre, radius, near_share * radius)


def first_gaussians(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],  # float32 [3, H, W] in [0, 1]
    *,
    bounds: Bounds,
    surface: Points | None,
    options: StartOptions,
    sh_degree: int,
    seed: int,
) -> Gaussians:
    """Gaussians on the points of the surface and at random in the volume that several cameras see, `options.count`
    together, coloured by the pictures.

    Raises ValueError if no place is seen by enough cameras.
    """
    rng = np.random.default_rng(seed)
    surface = no_points() if surface is None else surface
    volume = _random_points(cameras, pictures, bounds, options, max(0, options.count - len(surface.xyz)), rng)
    xyz, rgb = (np.concatenate([getattr(surface, name), getattr(volume, name)]) for name in ("xyz", "rgb"))
    spacing = neighbour_distance(xyz.astype(np.float32))
    scale = np.clip(spacing, 1e-4 * bounds.radius, 2 * np.median(spacing))
    return round_gaussians(xyz, rgb, scale, opacity=options.opacity, sh_degree=sh_degree)


def no_points() -> Points:
    return Points(np.empty((0, 3)), np.empty((0, 3)))


def drawn(points: Points, count: int, rng: np.random.Generator, *, weight: np.ndarray | None = None) -> Points:
    """At most `count` of the points, at random, in proportion to `weight` [P] if given."""
    if len(points.xyz) <= count:
        return points
    share = None if weight is None else weight / weight.sum()
    rows = np.sort(rng.choice(len(points.xyz), count, replace=False, p=share))
    return Points(points.xyz[rows], points.rgb[rows])


def round_gaussians(
    xyz: np.ndarray, rgb: np.ndarray, scale: np.ndarray, *, opacity: float, sh_degree: int
) -> Gaussians:
    """Spheres at `xyz` [N, 3] with colours [N, 3] in [0, 1] and standard deviations [N], world."""
    count = len(xyz)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (rgb - 0.5) / SH_BASE
    return Gaussians(
        means=xyz.astype(np.float32),
        log_scales=np.repeat(np.log(scale)[:, None], 3, axis=1).astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        sh=sh,
    )


def empty_gaussians(count: int, bounds: Bounds, *, sh_degree: int) -> Gaussians:
    """Rows at the scene's centre that no renderer draws: place for what comes later."""
    centre, size = np.repeat(bounds.centre[None], count, axis=0), max(0.01 * bounds.radius, 1e-12)
    rows = round_gaussians(centre, np.full((count, 3), 0.5), np.full(count, size), opacity=0.5, sh_degree=sh_degree)
    return replace(rows, opacity_logits=np.full(count, OPACITY_RANGE[0], np.float32))


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


def _random_points(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],
    bounds: Bounds,
    options: StartOptions,
    count: int,
    rng: np.random.Generator,
) -> Points:
    needed = min(options.min_views, len(cameras))
    xyz, rgb = np.empty((0, 3)), np.empty((0, 3))
    for _ in range(_ROUNDS if count else 0):
        places = random_ball(rng, 4 * count) * options.volume * bounds.radius + bounds.centre
        colours, views = seen_colours(cameras, pictures, places, bounds.near)
        seen = views >= needed
        xyz, rgb = np.concatenate([xyz, places[seen]]), np.concatenate([rgb, colours[seen]])
        if len(xyz) >= count:
            break
    if count and not len(xyz):
        raise ValueError(
            f"no place within {options.volume} rig radii is seen by {needed} cameras; check the calibration: "
            "do the cameras look at a common volume?"
        )
    return Points(xyz[:count], rgb[:count])


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
    rgb, _ = seen_colours(cameras, pictures, found[:count], bounds.near)
    return Points(found[:count], rgb)


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


def random_ball(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points evenly spread in the unit ball, float64 [count, 3]."""
    direction = rng.standard_normal((count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * np.cbrt(rng.random((count, 1)))


@njit(cache=True, error_model="numpy", parallel=True)
def neighbour_distance(points):
    """Mean distance to the three nearest other points, float32 [N]; every pair is looked at, O(N^2)."""
    count = len(points)
    out = np.empty(count, np.float32)
    for row in prange(count):
        i = np.int64(row)
        a = b = c = np.float32(np.inf)
        for j in range(count):
            x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            d = x * x + y * y + z * z
            if j == i or d >= c:
                continue
            if d < a:
                a, b, c = d, a, b
            elif d < b:
                b, c = d, b
            else:
                c = d
        out[i] = (np.sqrt(a) + np.sqrt(b) + np.sqrt(c)) / np.float32(3) if c < np.inf else np.float32(1e-3)
    return out
