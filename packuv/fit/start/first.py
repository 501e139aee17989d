"""Where the scene is, and the Gaussians a fit begins with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.points import Points, look, no_points, together
from packuv.gaussians.codes import OPACITY_RANGE
from packuv.gaussians.floats import Gaussians, logit

SH_BASE = 0.28209479177387814
"""Value of the constant spherical harmonic"""

AIR_OPACITY = 0.1
"""At the start of Gaussians in a volume, most of which is air"""

_ROUNDS = 8
"""Draws of random places before fewer than asked for will do"""

ROOM = 0.8
"""Share of the cap that a fit may start with; the rest is for where detail turns out to be"""

_CANDIDATES = 16
"""Neighbours among which float32 distances choose: more than the twelve that can be equally near on a lattice"""


@dataclass(frozen=True)
class StartOptions:
    count: int = 42_000
    """Gaussians at the start, or four in five of what the cap allows"""
    volume: float = 1.25
    """Random Gaussians fill a ball of this many radii about the centre"""
    min_views: int = 3
    """Cameras that must see a random Gaussian; all of them in smaller rigs"""
    surface_share: float = 0.8
    """Gaussians that start on surfaces, triangulated points and the shell, beside the share of the shell that cameras
    agree on; what is left fills the volume"""
    surface_opacity: float = 0.3
    """Opacity at the start of Gaussians on surfaces"""

    def within(self, cap: int) -> StartOptions:
        """The same for so many Gaussians at most in the end."""
        return replace(self, count=min(self.count, round(ROOM * cap)))


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
    points = together(surface, volume)
    spacing = neighbour_distance(points.xyz.astype(np.float32))
    scale = np.clip(spacing, 1e-4 * bounds.radius, 2 * np.median(spacing))
    opacity = np.repeat([options.surface_opacity, AIR_OPACITY], [len(surface.xyz), len(volume.xyz)])
    return round_gaussians(points.xyz, points.rgb, scale, opacity=opacity, sh_degree=sh_degree)


def round_gaussians(
    xyz: np.ndarray, rgb: np.ndarray, scale: np.ndarray, *, opacity: float | np.ndarray, sh_degree: int
) -> Gaussians:
    """Spheres at `xyz` [N, 3] with colours [N, 3] in [0, 1], standard deviations [N], world, and one opacity or [N]."""
    count = len(xyz)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (rgb - 0.5) / SH_BASE
    return Gaussians(
        means=xyz.astype(np.float32),
        log_scales=np.repeat(np.log(scale)[:, None], 3, axis=1).astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=np.full(count, logit(np.asarray(opacity)), np.float32),
        sh=sh,
    )


def empty_gaussians(count: int, bounds: Bounds, *, sh_degree: int) -> Gaussians:
    """Rows at the scene's centre that no renderer draws: place for what comes later."""
    centre, size = np.repeat(bounds.centre[None], count, axis=0), max(0.01 * bounds.radius, 1e-12)
    rows = round_gaussians(centre, np.full((count, 3), 0.5), np.full(count, size), opacity=0.5, sh_degree=sh_degree)
    return replace(rows, opacity_logits=np.full(count, OPACITY_RANGE[0], np.float32))


def _random_points(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],
    bounds: Bounds,
    options: StartOptions,
    count: int,
    rng: np.random.Generator,
) -> Points:
    needed = min(options.min_views, len(cameras))
    found = no_points()
    for _ in range(_ROUNDS if count else 0):
        xyz = random_ball(rng, 4 * count) * options.volume * bounds.radius + bounds.centre
        sight = look(cameras, pictures, xyz, bounds.near)
        seen = sight.views >= needed
        found = together(found, Points(xyz[seen], sight.rgb[seen]))
        if len(found.xyz) >= count:
            break
    if count and not len(found.xyz):
        raise ValueError(
            f"no place within {options.volume} rig radii is seen by {needed} cameras; check the calibration: "
            "do the cameras look at a common volume?"
        )
    return Points(found.xyz[:count], found.rgb[:count])


def random_ball(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points evenly spread in the unit ball, float64 [count, 3]."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * np.cbrt(rng.random((count, 1)))


def neighbour_distance(points: np.ndarray) -> np.ndarray:
    """Mean distance of points, float32 [N, 3], to the three nearest others, float32 [N]; 1e-3 where there are fewer.

    O(N log N).
    """
    from scipy.spatial import KDTree  # here, since loading it takes 0.17 s

    if len(points) < 4:
        return np.full(len(points), 1e-3, np.float32)
    _, near = KDTree(points).query(points, k=min(_CANDIDATES, len(points)))
    x, y, z = np.moveaxis(points[near] - points[:, None], 2, 0)  # [N, candidates] each
    # The nearest is the point itself, or one in the same place.
    a, b, c = np.sqrt(np.sort(x * x + y * y + z * z, axis=1)[:, 1:4]).T
    return np.where(c < np.inf, (a + b + c) / np.float32(3), np.float32(1e-3))
