"""One gain per camera and channel, and its lens's shading, that bring the cameras of a rig to a common colour.

Both act on linear light: exposure and white balance are factors, and so is what a lens loses towards its corners.

    light of a point = gain x light filmed / shading

Richer models (an affine map per camera) agree better with each other and worse with the truth, because they flatten the
contrast; so these it is. Gains, one shading for all cameras, and one for each are kept, one after the other, only when
points that took no part in the fit agree better with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numba import njit

from calibration.multiview import medians
from calibration.rig import MOST_SHADING, Rig
from calibration.shading import shading_basis, turns_back
from calibration.triangulate import SparsePoints


class ColourModel(StrEnum):
    """What is fitted, each richer than the one before."""

    NONE = "as filmed"
    GAINS = "gains"
    COMMON = "gains and one shading"
    OWN = "gains and a shading each"


@dataclass(frozen=True)
class BalanceOptions:
    """How gains and shading are fitted and when they are believed."""

    min_observations: int = 30
    """A camera with fewer usable observations keeps a gain of 1 and has the rig's common shading"""
    huber: float = 0.05
    """Deviation, in natural logarithm of light, up to which errors count in full; highlights go beyond it"""
    dark: float = 0.01
    """Linear light at which an observation has half its weight: noise is a greater share of dark colours"""
    shading_spread: tuple[float, float] = (0.3, 0.02)
    """Standard deviations of the cameras' k1 and k2 about the rig's common ones, to which a camera that sees little is
    drawn. Few points lie in corners, where k2 counts: with 0.1 instead of 0.02 points left out agree no better (3.35 %
    and 3.31 %), and cameras left out get another light, by 2.4 % somewhere in the picture instead of 0.9 %"""
    common_spread: float = 1.0
    """Standard deviation of the rig's common k1 and k2 about 0"""
    held_out: int = 5
    """Parts into which the points are dealt; each judges the models by a fit to the others"""
    min_improvement: float = 0.02
    """Share by which a richer model must lower the held-out spread, or the simpler one stays"""
    min_correlation: float = 0.7
    """A camera that is not fitted sees a point where the patch there is correlated so with that of a fitted camera;
    otherwise something stands in front of it"""
    max_angle_deg: float = 25.0
    """Greatest angle between the rays of these two cameras to the point"""

    def __post_init__(self) -> None:
        if (
            self.min_observations < 1
            or self.held_out < 2
            or min(self.huber, self.dark, *self.shading_spread, self.common_spread) <= 0
            or self.min_improvement < 0
            or not -1 <= self.min_correlation < 1
            or not 0 < self.max_angle_deg <= 180
        ):
            raise ValueError(f"unusable options for the colour balance: {self}")


@dataclass(frozen=True)
class HeldOutColour:
    """How well the gains and shading of a camera that took no part in the fit agree with the fitted ones' points."""

    observations: int
    """Points that it sees for certain, by the patch about them"""
    spread_before: float | None
    """Median deviation of its judging observations from the points' colours, as a share of the light, as filmed"""
    spread_after: float | None
    """The same with gains and shading fitted without these observations"""
    kept: bool
    """False when they are none, because they did not help or the camera sees too little"""


@dataclass(frozen=True)
class ColourReport:
    """Gains and shading, and how far the cameras agree without and with them."""

    gains: Mapping[str, tuple[float, float, float]]
    """Camera -> linear-light factors r g b; per channel their geometric mean over the fitted cameras is 1"""
    shading: Mapping[str, tuple[float, float]]
    """Camera -> k1, k2 of its lens"""
    common_shading: tuple[float, float]
    """k1, k2 to which the cameras' are drawn"""
    model: ColourModel
    """What is kept"""
    reason: str
    shading_reason: str
    """Why shading is kept, or is not"""
    spreads: Mapping[str, float | None]
    """Model -> median deviation of an observation from its point's median over the cameras, as a share of the light, by
    a fit to other points"""
    points: int
    """Points that at least two cameras show unclipped"""
    observations: Mapping[str, int]
    """Camera -> usable observations"""
    weak_cameras: tuple[str, ...]
    """Cameras with too few observations, whose gain is 1"""
    held_out: Mapping[str, HeldOutColour] = field(default_factory=dict)
    """Cameras that took no part in the fit and were calibrated by its points"""

    @property
    def kept(self) -> bool:
        """False when the gains are all 1 because fitting them did not help."""
        return self.model is not ColourModel.NONE

    @property
    def shaded(self) -> bool:
        return self.model in (ColourModel.COMMON, ColourModel.OWN)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def balance(rig: Rig, points: SparsePoints, *, options: BalanceOptions = BalanceOptions()) -> ColourReport:
    """Fit gains and shading to the colours of triangulated points, and keep what held-out points agree better with.

    `rig` has the cameras of `points`.
    """
    data, cameras = _Light.of(rig, points), len(points.cameras)
    counts = np.bincount(data.camera, minlength=cameras)
    strong = counts >= options.min_observations
    used = strong[data.camera]
    spreads = {model: _held_out_spread(data.only(used), cameras, model, options) for model in ColourModel}
    model, reason, shading_reason = _verdict(int(strong.sum()), spreads, options)
    fit = _fit(data.only(used), cameras, model, options)
    names = points.cameras
    shading = np.where(strong[:, None], fit.shading, fit.common)
    return ColourReport(
        gains={name: triple(np.exp(row)) for name, row in zip(names, fit.log_gains, strict=True)},
        shading={name: pair(row) for name, row in zip(names, shading, strict=True)},
        common_shading=pair(fit.common),
        model=model,
        reason=reason,
        shading_reason=shading_reason,
        spreads={str(model): spread for model, spread in spreads.items()},
        points=len(np.unique(data.point)),
        observations=dict(zip(names, counts.tolist(), strict=True)),
        weak_cameras=tuple(name for name, enough in zip(names, strong, strict=True) if not enough),
    )


def with_colours(rig: Rig, report: ColourReport) -> Rig:
    """The rig with the report's gains and shading; cameras that it does not know keep theirs."""
    cameras = (
        replace(
            camera,
            gains=report.gains.get(camera.name, camera.gains),
            shading=report.shading.get(camera.name, camera.shading),
        )
        for camera in rig.cameras
    )
    return replace(rig, cameras=tuple(cameras))


def log_colours(rig: Rig, points: SparsePoints, report: ColourReport) -> np.ndarray:
    """Natural logarithm of the points' linear light by the report, float64 [P, 3]; NaN where too few cameras show it.

    The median over the cameras that have gains; `rig` has the cameras of `points`.
    """
    data = _Light.of(rig, points)
    strong = np.array([name not in report.weak_cameras for name in points.cameras])
    data = data.only(strong[data.camera])
    gains = np.log([report.gains[name] for name in points.cameras])
    shading = np.array([report.shading[name] for name in points.cameras])
    level = data.levels(_Fit(gains, shading, np.zeros(2)))
    colours = np.full((len(points.xyz), 3), np.nan)
    found, row = np.unique(data.point, return_inverse=True)
    if len(found):
        colours[found] = medians(level, row)
    return colours


def trust(log: np.ndarray, options: BalanceOptions) -> np.ndarray:
    """Weights of observations of this logarithm of light."""
    light = np.exp(log)
    weight: np.ndarray = (light / (light + options.dark)) ** 2
    return weight


def triple(values: np.ndarray) -> tuple[float, float, float]:
    r, g, b = (float(value) for value in values)
    return r, g, b


def pair(values: np.ndarray) -> tuple[float, float]:
    k1, k2 = (float(value) for value in values)
    return k1, k2


def _verdict(
    strong: int, spreads: Mapping[ColourModel, float | None], options: BalanceOptions
) -> tuple[ColourModel, str, str]:
    """The richest model that pays, why, and why with or without shading."""
    known = {model: spread for model, spread in spreads.items() if spread is not None}
    if strong < 2 or len(known) < len(spreads):
        few = f"only {strong} cameras have {options.min_observations} usable observations or more"
        return ColourModel.NONE, few, few
    best = ColourModel.NONE
    for model in ColourModel:
        if known[model] < (1 - options.min_improvement) * known[best]:
            best = model
    before, gains, after = known[ColourModel.NONE], known[ColourModel.GAINS], known[best]
    if best is ColourModel.NONE:
        reason = f"held-out points do not agree better with gains: {before:.2%} before, {gains:.2%} after"
    else:
        reason = f"held-out points deviate by {after:.2%} instead of {before:.2%}"
    tried = f"{known[ColourModel.COMMON]:.2%} with one for all cameras, {known[ColourModel.OWN]:.2%} with one each"
    pays = "shading pays" if best in (ColourModel.COMMON, ColourModel.OWN) else "shading does not pay"
    return best, reason, f"{pays}: held-out points deviate by {gains:.2%} without it, {tried}"


@dataclass(frozen=True)
class _Fit:
    """Gains and shading of all cameras."""

    log_gains: np.ndarray
    """float64 [C, 3]"""
    shading: np.ndarray
    """float64 [C, 2]"""
    common: np.ndarray
    """float64 [2]"""


@dataclass(frozen=True)
class _Light:
    """Usable observations, sorted by point."""

    point: np.ndarray
    """int32 [M], as numbered in the input"""
    camera: np.ndarray
    """int32 [M]"""
    log: np.ndarray
    """float64 [M, 3], natural logarithm of linear light"""
    basis: np.ndarray
    """float64 [M, 2], whose product with k1, k2 is the logarithm of the shading"""

    @classmethod
    def of(cls, rig: Rig, points: SparsePoints) -> _Light:
        """Unclipped colours of points that two or more cameras show so."""
        clean = np.all(np.isfinite(points.colour) & (points.colour > 0), axis=1)
        shared = np.bincount(points.point[clean], minlength=len(points.xyz)) >= 2
        usable = clean & shared[points.point]
        camera, log = points.camera[usable], np.log(points.colour[usable].astype(np.float64))
        basis = np.zeros((len(log), 2))
        for index, name in enumerate(points.cameras):
            mine, lens = camera == index, rig[name]
            plane = (points.xy[usable][mine] - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
            basis[mine] = shading_basis(lens, plane)
        return cls(points.point[usable], camera, log, basis)

    def only(self, kept: np.ndarray) -> _Light:
        return _Light(self.point[kept], self.camera[kept], self.log[kept], self.basis[kept])

    def levels(self, fit: _Fit) -> np.ndarray:
        """Logarithm of the points' light as the observations have it, float64 [M, 3]."""
        falloff = (fit.shading[self.camera] * self.basis).sum(axis=1)
        levels: np.ndarray = self.log + fit.log_gains[self.camera] - falloff[:, None]
        return levels


def _fit(data: _Light, cameras: int, model: ColourModel, options: BalanceOptions) -> _Fit:
    """Gains have mean 0 over each group of cameras that share points; what has no observations is 0, or the common."""
    fit, simple = _Fit(np.zeros((cameras, 3)), np.zeros((cameras, 2)), np.zeros(2)), np.zeros(cameras, bool)
    if model is ColourModel.NONE or not len(data.point):
        return fit
    while True:
        # A camera whose light turns back on the way to the corner goes without r^4.
        scale = np.stack([np.ones(cameras), ~simple], axis=1)
        fit = _solve(replace(data, basis=data.basis * scale[data.camera]), cameras, model, options)
        fit = replace(fit, shading=np.clip(fit.shading, -MOST_SHADING, MOST_SHADING) * scale)
        turning = turns_back(fit.shading)
        if not turning.any():
            break
        simple |= turning if model is ColourModel.OWN else True
    common = np.clip(fit.common, -MOST_SHADING, MOST_SHADING)
    return replace(fit, common=common * (1, 0) if turns_back(common) else common)


def _solve(data: _Light, cameras: int, model: ColourModel, options: BalanceOptions) -> _Fit:
    """Minimise, over gains, shading and a colour per point, Huber's loss of log light + gain - shading - colour.

    The unknowns are the gains [C, 3], the common shading [2], and the cameras' own [C, 2], if these differ.
    """
    row = np.unique(data.point, return_inverse=True)[1]
    columns, values = _design(data, cameras, model)  # [3, M, K], [M, K]
    prior = _prior(cameras, model, options)
    solution, trusted = np.zeros(len(prior)), trust(data.log, options)
    weight = trusted
    for _ in range(50):
        before, matrix, vector = solution, np.zeros_like(prior), np.zeros(len(prior))
        for channel in range(3):
            _add_normal_equations(
                row, columns[channel], values, data.log[:, channel], weight[:, channel], matrix, vector
            )
        # Without a fixed mean all gains could grow alike; this ridge picks mean 0 in each group that shares points.
        ridge = 1e-8 * max(float(weight.sum()), 1e-30)
        solution = np.linalg.solve(matrix + prior + ridge * np.eye(len(prior)), vector)
        if np.abs(solution - before).max() < 1e-4:  # a tenth of what 8 bits resolve
            break
        weight = trusted * huber_weight(_residuals(row, _unpacked(solution, cameras), data, weight), options)
    return _unpacked(solution, cameras)


def _design(data: _Light, cameras: int, model: ColourModel) -> tuple[np.ndarray, np.ndarray]:
    """Which unknowns an observation of each channel depends on, int64 [3, M, K], and how, float64 [M, K]."""
    camera = data.camera.astype(np.int64)
    own = 2 + 2 * camera if model is ColourModel.OWN else np.zeros_like(camera)
    terms = 1 if model is ColourModel.GAINS else 3
    first = 3 * cameras + own
    columns = [np.stack([3 * camera + channel, first, first + 1], axis=1)[:, :terms] for channel in range(3)]
    values = np.hstack([np.ones((len(camera), 1)), -data.basis])[:, :terms]
    return np.ascontiguousarray(columns), np.ascontiguousarray(values)


def _prior(cameras: int, model: ColourModel, options: BalanceOptions) -> np.ndarray:
    """Normal equations [U, U] that draw the common shading to 0 and each camera's to the common one."""
    shaded, own = model is not ColourModel.GAINS, model is ColourModel.OWN
    prior = np.zeros((3 * cameras + 2 * shaded + 2 * cameras * own,) * 2)
    for k in range(2 * shaded):
        common = 3 * cameras + k
        each = common + 2 + 2 * np.arange(cameras * own)
        pull = (options.huber / options.shading_spread[k]) ** 2
        prior[common, common] = (options.huber / options.common_spread) ** 2 + pull * len(each)
        prior[each, each] = pull
        prior[each, common] = prior[common, each] = -pull
    return prior


def _unpacked(solution: np.ndarray, cameras: int) -> _Fit:
    gains, common, own = np.split(solution, [3 * cameras, 3 * cameras + 2])
    common = common if len(common) else np.zeros(2)
    shading = own.reshape(cameras, 2) if len(own) else np.tile(common, (cameras, 1))
    return _Fit(gains.reshape(cameras, 3), shading, common)


def _residuals(row: np.ndarray, fit: _Fit, data: _Light, weight: np.ndarray) -> np.ndarray:
    """Deviation from the point's weighted mean, float64 [M, 3]."""
    levels = data.levels(fit)
    means = [np.bincount(row, w * level) / np.bincount(row, w) for w, level in zip(weight.T, levels.T, strict=True)]
    residuals: np.ndarray = levels - np.stack(means, axis=1)[row]
    return residuals


def huber_weight(residuals: np.ndarray, options: BalanceOptions) -> np.ndarray:
    weight: np.ndarray = np.minimum(1, options.huber / np.maximum(np.abs(residuals), 1e-12))
    return weight


@njit(cache=True, error_model="numpy")
def _add_normal_equations(
    row: np.ndarray,
    columns: np.ndarray,
    values: np.ndarray,
    log: np.ndarray,
    weight: np.ndarray,
    matrix: np.ndarray,
    vector: np.ndarray,
) -> None:
    """Add to [U, U] and [U] of the unknowns alone, the points' colours eliminated.

    `row` int64 [M] is sorted, without gaps; `columns` int64 [M, K] and `values` float64 [M, K] say what an observation
    depends on.
    """
    terms = columns.shape[1]
    start = 0
    while start < len(row):
        end, total, light = start, 0.0, 0.0
        while end < len(row) and row[end] == row[start]:
            total += weight[end]
            light += weight[end] * log[end]
            end += 1
        for i in range(start, end):
            for a in range(terms):
                p, slope = columns[i, a], weight[i] * values[i, a]
                vector[p] += slope * (light / total - log[i])
                for b in range(terms):
                    matrix[p, columns[i, b]] += slope * values[i, b]
                for j in range(start, end):
                    share = slope * weight[j] / total
                    for b in range(terms):
                        matrix[p, columns[j, b]] -= share * values[j, b]
        start = end


def _held_out_spread(data: _Light, cameras: int, model: ColourModel, options: BalanceOptions) -> float | None:
    """Median over observations and channels of the distance to the point's median, as a share of the light.

    Each part of the points is judged by a fit to the others; None without points.
    """
    if not len(data.point):
        return None
    levels = np.zeros_like(data.log)
    for part in range(options.held_out):
        judges = data.point % options.held_out == part
        levels[judges] = data.only(judges).levels(_fit(data.only(~judges), cameras, model, options))
    row = np.unique(data.point, return_inverse=True)[1]
    return float(np.expm1(np.median(np.abs(levels - medians(levels, row)[row]))))
