"""Bundle adjustment: the cameras and points with which sightings agree best, held by priors.

pycolmap's adjuster knows priors of places only, not of rotations or lenses, and cannot live in a process with OpenCV;
this one has a Gaussian prior on every number of a camera and works for every lens that a `Camera` has. Points are
eliminated (Schur complement), so a step costs as much as it has sightings, and a solution of all cameras' numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse

from calibration.multiview import Sightings, locate
from calibration.repair import SIZES, changing
from calibration.rig import Rig

_STEP = 1e-6
"""Of differences that stand for derivatives: radians, shares of the radius or width, coefficients"""
_ROBUST = 2.4
"""Cauchy's scale in standard deviations of a sighting: 95 % as sharp as least squares where errors are normal"""


@dataclass(frozen=True)
class AdjustOptions:
    """How far the cameras are thought to be off (one standard deviation each), and which sightings count."""

    turn_deg: float = 1.0
    shift: float = 0.02
    """Share of the rig's radius"""
    focal: float = 0.02
    """Share of the focal length"""
    point: float = 0.005
    """Share of the picture's width"""
    lens: float = 0.05
    """k1 and k2"""
    rounds: tuple[float, ...] = (0.025, 0.003)
    """Shares of the picture's width within which sightings must lie, round by round; at last 1.9 px of 640"""
    min_angle_deg: float = 1.0
    """Between two rays of a point at least"""
    steps: int = 8
    """Of a round at most"""
    settled: float = 1e-3
    """A round ends when a step lowers the cost by no more than this share"""

    def __post_init__(self) -> None:
        numbers = (self.turn_deg, self.shift, self.focal, self.point, self.lens, *self.rounds, self.settled)
        if min(numbers) <= 0 or not self.rounds or self.steps < 1 or self.min_angle_deg < 0:
            raise ValueError(f"what is thought to be off, rounds, points and steps must be positive: {self}")

    def scales(self, kinds: Sequence[str]) -> np.ndarray:
        """One standard deviation of each number of these kinds (`repair.SIZES`), float64 [D]."""
        pose = [np.radians(self.turn_deg)] * 3 + [self.shift] * 3
        each = {"focal length": [self.focal], "principal point": [self.point] * 2, "distortion": [self.lens] * 2}
        return np.array([scale for kind in kinds for scale in {**each, "pose": pose}[kind]])


def adjust(rig: Rig, sightings: Sightings, kinds: Sequence[str], *, options: AdjustOptions = AdjustOptions()) -> Rig:
    """The rig with which the sightings agree best when these kinds of numbers of all cameras are free.

    `sightings` holds two cameras or more for each point, each at most once. What lies far off its point is left out,
    round by round. The world may drift as a whole (`aligned` brings it back). Deterministic.
    """
    width = float(np.median([camera.width for camera in rig.cameras]))
    values = np.zeros((len(rig.cameras), sum(SIZES[kind] for kind in kinds)))
    bundle = _Bundle(rig, kinds, options.scales(kinds))
    for share in options.rounds:
        least_deg = options.min_angle_deg
        kept, xyz, errors = locate(
            bundle.rig(values), sightings, max_error_px=share * width, min_views=2, min_angle_deg=least_deg
        )
        if not len(xyz):
            break
        noise_px = max(1.48 * float(np.median(errors)), 0.02)
        values = bundle.settle(values, kept, xyz, noise_px, options)
    return bundle.rig(values)


System = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class _Bundle:
    """A rig whose cameras may change in some kinds of numbers."""

    def __init__(self, rig: Rig, kinds: Sequence[str], scales: np.ndarray) -> None:
        self._rig, self._scales = rig, scales
        centre = rig.centres.mean(axis=0)
        self._radius = max(float(np.linalg.norm(rig.centres - centre, axis=1).max()), 1e-12)
        self._change = changing(kinds, self._radius)

    def rig(self, values: np.ndarray) -> Rig:
        """With these changes, float64 [C, D]."""
        pairs = zip(self._rig.cameras, values, strict=True)
        return replace(self._rig, cameras=tuple(self._change(camera, mine) for camera, mine in pairs))

    def settle(
        self, values: np.ndarray, sightings: Sightings, xyz: np.ndarray, noise_px: float, options: AdjustOptions
    ) -> np.ndarray:
        """Levenberg and Marquardt from changes [C, D] and points [P, 3]; the changes that cost least."""
        rows = [np.flatnonzero(sightings.camera == index) for index in range(len(values))]
        cost, damping = self._cost(values, sightings, xyz, rows, noise_px), 1e-4
        for _ in range(options.steps):
            system = self._system(values, sightings, xyz, rows, noise_px)
            for _ in range(6):
                by_camera, by_point = _solved(system, sightings, damping)
                tried, moved = values + by_camera, xyz + self._radius * by_point
                new = self._cost(tried, sightings, moved, rows, noise_px)
                if new < cost:
                    break
                damping *= 10
            else:
                return values
            values, xyz, damping = tried, moved, damping / 5
            before, cost = cost, new
            if before - cost < options.settled * before:
                break
        return values

    def _residuals(
        self, values: np.ndarray, sightings: Sightings, xyz: np.ndarray, rows: Sequence[np.ndarray]
    ) -> np.ndarray:  # [M, 2] pixels of the distorted picture, far off behind a camera
        found = np.zeros((len(sightings.point), 2))
        for camera, mine, own in zip(self._rig.cameras, values, rows, strict=True):
            pixels, depth = self._change(camera, mine).project(xyz[sightings.point[own]])
            found[own] = np.where(depth[:, None] > 0, pixels - sightings.pixels[own], camera.width)
        return found

    def _cost(
        self, values: np.ndarray, sightings: Sightings, xyz: np.ndarray, rows: Sequence[np.ndarray], noise_px: float
    ) -> float:
        squares = (self._residuals(values, sightings, xyz, rows) ** 2).sum(axis=1) / (noise_px * _ROBUST) ** 2
        return float(_ROBUST**2 * np.log1p(squares).sum() + ((values / self._scales) ** 2).sum())

    def _system(
        self, values: np.ndarray, sightings: Sightings, xyz: np.ndarray, rows: Sequence[np.ndarray], noise_px: float
    ) -> System:
        """Normal equations, points in radii of the rig: own blocks of cameras [C, D, D] and points [P, 3, 3], mixed
        ones of sightings [M, D, 3], gradients [C, D] and [P, 3]."""
        residual = self._residuals(values, sightings, xyz, rows) / noise_px
        weight = 1 / (1 + (residual**2).sum(axis=1) / _ROBUST**2)
        by_camera = self._slopes(values, sightings, xyz, rows, noise_px, range(values.shape[1]), of_points=False)
        by_point = self._slopes(values, sightings, xyz, rows, noise_px, range(3), of_points=True)
        heavy = weight[:, None, None] * by_camera
        own = np.stack([np.einsum("mid,mie->de", heavy[mine], by_camera[mine]) for mine in rows])
        push = np.stack([np.einsum("mid,mi->d", heavy[mine], residual[mine]) for mine in rows])
        prior = 1 / self._scales**2
        mixed = heavy.transpose(0, 2, 1) @ by_point
        weighed = weight[:, None, None] * by_point
        points = np.add.reduceat(weighed.transpose(0, 2, 1) @ by_point, sightings.starts)
        pull = np.add.reduceat(np.einsum("mij,mi->mj", weighed, residual), sightings.starts)
        return own + np.diag(prior), points, mixed, push + prior * values, pull

    def _slopes(
        self,
        values: np.ndarray,
        sightings: Sightings,
        xyz: np.ndarray,
        rows: Sequence[np.ndarray],
        noise_px: float,
        columns: range,
        *,
        of_points: bool,
    ) -> np.ndarray:  # [M, 2, columns]
        start, found = self._residuals(values, sightings, xyz, rows), []
        for column in columns:
            other, moved = values.copy(), xyz
            if of_points:
                moved = xyz + _STEP * self._radius * np.eye(3)[column]
            else:
                other[:, column] += _STEP
            found.append((self._residuals(other, sightings, moved, rows) - start) / (_STEP * noise_px))
        return np.stack(found, axis=2)


def _solved(
    system: System, sightings: Sightings, damping: float
) -> tuple[np.ndarray, np.ndarray]:  # steps of cameras [C, D] and of points [P, 3]
    own, points, mixed, push, pull = system
    count, size = push.shape
    inverse = np.linalg.inv(_damped(points, damping))  # [P, 3, 3]
    # half half^T is the inverse, so that eliminating the points is one symmetric product.
    half = np.linalg.cholesky((inverse + inverse.transpose(0, 2, 1)) / 2)
    halved = mixed @ half[sightings.point]  # [M, D, 3]
    row = np.broadcast_to(sightings.camera[:, None, None] * size + np.arange(size)[:, None], halved.shape)
    column = np.broadcast_to(sightings.point[:, None, None] * 3 + np.arange(3), halved.shape)
    shape = (count * size, 3 * len(points))
    tall = scipy.sparse.csr_array((halved.ravel(), (row.ravel(), column.ravel())), shape=shape)
    reduced = scipy.linalg.block_diag(*_damped(own, damping)) - (tall @ tall.T).toarray()
    halved_pull = np.einsum("pji,pj->pi", half, pull)
    right = push.ravel() - tall @ halved_pull.ravel()
    by_camera = -np.linalg.solve(reduced, right)
    back = halved_pull + (tall.T @ by_camera).reshape(-1, 3)
    return by_camera.reshape(count, size), -np.einsum("pij,pj->pi", half, back)


def _damped(blocks: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.einsum("bii->bi", blocks)
    heavier: np.ndarray = blocks + (damping * diagonal + 1e-12)[:, :, None] * np.eye(blocks.shape[1])
    return heavier
