"""One gain per camera and channel that brings the cameras of a rig to a common colour.

Gains act on linear light, where exposure and white balance are factors. Richer models (an affine map per camera) agree
better with each other and worse with the truth, because they flatten the contrast; so gains it is. They are kept only
when points that took no part in the fit agree better with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numba import njit

from calibration.multiview import medians
from calibration.rig import Rig
from calibration.triangulate import SparsePoints


@dataclass(frozen=True)
class BalanceOptions:
    """How gains are fitted and when they are believed."""

    min_observations: int = 30
    """A camera with fewer usable observations keeps a gain of 1"""
    huber: float = 0.05
    """Deviation, in natural logarithm of light, up to which errors count in full; highlights go beyond it"""
    dark: float = 0.01
    """Linear light at which an observation has half its weight: noise is a greater share of dark colours"""
    held_out: int = 5
    """Every `held_out`-th point judges the gains and takes no part in their trial fit"""
    min_improvement: float = 0.02
    """Share by which the held-out spread must fall, or the gains stay 1"""

    def __post_init__(self) -> None:
        if (
            self.min_observations < 1
            or self.held_out < 2
            or min(self.huber, self.dark) <= 0
            or self.min_improvement < 0
        ):
            raise ValueError(f"unusable options for the colour balance: {self}")


@dataclass(frozen=True)
class ColourReport:
    """Gains and how far the cameras agree without and with them."""

    gains: Mapping[str, tuple[float, float, float]]
    """Camera -> linear-light factors r g b; per channel their geometric mean over the fitted cameras is 1"""
    kept: bool
    """False when the gains are all 1 because fitting them did not help"""
    reason: str
    spread_before: float | None
    """Median deviation of a held-out observation from its point's median over the cameras, as a share of the light"""
    spread_after: float | None
    """The same with gains fitted without the held-out points"""
    points: int
    """Points that at least two cameras show unclipped"""
    observations: Mapping[str, int]
    """Camera -> usable observations"""
    weak_cameras: tuple[str, ...]
    """Cameras with too few observations, whose gain is 1"""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def balance(points: SparsePoints, *, options: BalanceOptions = BalanceOptions()) -> ColourReport:
    """Fit gains to the colours of triangulated points, and keep them if held-out points agree better with them."""
    data = _Light.of(points)
    cameras = len(points.cameras)
    counts = np.bincount(data.camera, minlength=cameras)
    strong = counts >= options.min_observations
    held_out = data.point % options.held_out == 0
    used = strong[data.camera]
    trial = _log_gains(data.only(used & ~held_out), cameras, options)
    judges = data.only(used & held_out)
    before, after = _spread(judges, np.zeros((cameras, 3))), _spread(judges, trial)
    kept, reason = _verdict(int(strong.sum()), before, after, options)
    log_gains = _log_gains(data.only(used), cameras, options) if kept else np.zeros((cameras, 3))
    names = points.cameras
    return ColourReport(
        gains={name: _triple(np.exp(row)) for name, row in zip(names, log_gains, strict=True)},
        kept=kept,
        reason=reason,
        spread_before=before,
        spread_after=after,
        points=len(np.unique(data.point)),
        observations=dict(zip(names, counts.tolist(), strict=True)),
        weak_cameras=tuple(name for name, enough in zip(names, strong, strict=True) if not enough),
    )


def with_gains(rig: Rig, report: ColourReport) -> Rig:
    """The rig with the report's gains; cameras that it does not know keep theirs."""
    cameras = (replace(camera, gains=report.gains.get(camera.name, camera.gains)) for camera in rig.cameras)
    return Rig(tuple(cameras), rig.source, rig.metric)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    r, g, b = (float(value) for value in values)
    return r, g, b


def _verdict(strong: int, before: float | None, after: float | None, options: BalanceOptions) -> tuple[bool, str]:
    if strong < 2 or before is None or after is None:
        return False, f"only {strong} cameras have {options.min_observations} usable observations or more"
    if after > (1 - options.min_improvement) * before:
        return False, f"held-out points do not agree better with gains: {before:.2%} before, {after:.2%} after"
    return True, f"held-out points deviate by {after:.2%} instead of {before:.2%}"


@dataclass(frozen=True)
class _Light:
    """Usable observations, sorted by point."""

    point: np.ndarray
    """int32 [M], as numbered in the input"""
    camera: np.ndarray
    """int32 [M]"""
    log: np.ndarray
    """float64 [M, 3], natural logarithm of linear light"""

    @classmethod
    def of(cls, points: SparsePoints) -> _Light:
        """Unclipped colours of points that two or more cameras show so."""
        clean = np.all(np.isfinite(points.colour) & (points.colour > 0), axis=1)
        shared = np.bincount(points.point[clean], minlength=len(points.xyz)) >= 2
        usable = clean & shared[points.point]
        return cls(points.point[usable], points.camera[usable], np.log(points.colour[usable].astype(np.float64)))

    def only(self, kept: np.ndarray) -> _Light:
        return _Light(self.point[kept], self.camera[kept], self.log[kept])


def _log_gains(data: _Light, cameras: int, options: BalanceOptions) -> np.ndarray:
    """Logarithms of the gains, float64 [C, 3], mean 0 over each group of cameras that share points; 0 without any."""
    return np.stack([_channel(data, data.log[:, channel], cameras, options) for channel in range(3)], axis=1)


def _channel(data: _Light, log: np.ndarray, cameras: int, options: BalanceOptions) -> np.ndarray:
    """Minimise, over a gain per camera and a colour per point, Huber's loss of log light + gain - colour."""
    gains, row = np.zeros(cameras), np.unique(data.point, return_inverse=True)[1]
    trust = (np.exp(log) / (np.exp(log) + options.dark)) ** 2
    weight = trust
    for _ in range(30):
        before, (matrix, vector) = gains, _normal_equations(row, data.camera, log, weight, cameras)
        # Without a fixed mean all gains could grow alike; the ridge picks mean 0 in each group that shares points.
        gains = np.linalg.solve(matrix + 1e-8 * max(float(np.trace(matrix)), 1e-30) * np.eye(cameras), vector)
        if np.abs(gains - before).max() < 1e-5:  # a hundredth of what 8 bits resolve
            break
        level = log + gains[data.camera]
        total = np.bincount(row, weight)
        residual = np.abs(level - (np.bincount(row, weight * level) / total)[row])
        weight = trust * np.minimum(1, options.huber / np.maximum(residual, 1e-12))
    return gains


@njit(cache=True, error_model="numpy")
def _normal_equations(
    row: np.ndarray, camera: np.ndarray, log: np.ndarray, weight: np.ndarray, cameras: int
) -> tuple[np.ndarray, np.ndarray]:
    """[C, C] and [C] of the gains alone, the points' colours eliminated; `row` int64 [M] is sorted, without gaps."""
    matrix, vector = np.zeros((cameras, cameras)), np.zeros(cameras)
    start = 0
    while start < len(row):
        end, total, light = start, 0.0, 0.0
        while end < len(row) and row[end] == row[start]:
            total += weight[end]
            light += weight[end] * log[end]
            end += 1
        for i in range(start, end):
            matrix[camera[i], camera[i]] += weight[i]
            vector[camera[i]] += weight[i] * (light / total - log[i])
            for j in range(start, end):
                matrix[camera[i], camera[j]] -= weight[i] * weight[j] / total
        start = end
    return matrix, vector


def _spread(data: _Light, log_gains: np.ndarray) -> float | None:
    """Median over observations and channels of the distance to the point's median, as a share of the light."""
    level = data.log + log_gains[data.camera]
    row = np.unique(data.point, return_inverse=True)[1]
    if not len(row):
        return None
    return float(np.expm1(np.median(np.abs(level - medians(level, row)[row]))))
