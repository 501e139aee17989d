"""Gains and shading of cameras that took no part in a fit, from the points that the fitted ones located.

The fit is not touched: the points have the colours that it gave them, and a camera is brought to these. A point is
taken for seen where the patch about it looks as in the fitted camera whose ray is closest: the rest is hidden or shiny.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.colour import (
    BalanceOptions,
    ColourModel,
    ColourReport,
    HeldOutColour,
    huber_weight,
    log_colours,
    pair,
    triple,
    trust,
)
from calibration.rig import MOST_SHADING, Camera, Rig
from calibration.shading import shading_basis, turns_back
from calibration.triangulate import SparsePoints, patch_light

MOST_DEVIATION = 0.5
"""In natural logarithm of light; what deviates more from a point's colour shows something else"""


def balance_held_out(
    rig: Rig,
    points: SparsePoints,
    report: ColourReport,
    instants: Sequence[Mapping[str, np.ndarray]],
    *,
    light: np.ndarray | None = None,
    patch_px: int,
    options: BalanceOptions,
) -> ColourReport:
    """The report with gains and shading of the cameras of `rig` that `points` lack.

    `instants` are pictures of all cameras as filmed, uint8 [H, W, 3] RGB, one mapping per instant of the points; an
    instant may lack cameras. `light`, float [instants, cameras, 3], is the natural logarithm of what the light of the
    instant and a camera's exposure make of light, which the points' colours lack; None where both are steady. A camera
    with fewer than `min_observations`, or one that agrees no better, keeps gain 1.
    """
    fitted = rig.select(points.cameras)
    colours = log_colours(fitted, points, report)
    usable = np.isfinite(colours).all(axis=1)
    views = [_Instant.of(fitted, points, index, pictures, usable) for index, pictures in enumerate(instants)]
    for number, camera in enumerate(rig.cameras):
        if camera.name not in points.cameras:
            parts = [view.seen_by(camera, patch_px, options) for view in views]
            if light is not None:
                parts = [part.lit(-change) for part, change in zip(parts, light[:, number], strict=True)]
            seen = _joined(parts)
            report = _with_camera(report, camera, seen, colours[seen.point], options)
    return report


@dataclass(frozen=True)
class _Seen:
    """A camera's observations of points."""

    point: np.ndarray
    """int64 [N]"""
    log: np.ndarray
    """float64 [N, 3], natural logarithm of linear light"""
    basis: np.ndarray
    """float64 [N, 2], of the shading"""

    def lit(self, change: np.ndarray) -> _Seen:
        """In light that differs by exp(`change`), float [3]."""
        return replace(self, log=self.log + change)

    def only(self, kept: np.ndarray) -> _Seen:
        return _Seen(self.point[kept], self.log[kept], self.basis[kept])


def _joined(parts: Sequence[_Seen]) -> _Seen:
    point, log, basis = zip(*((part.point, part.log, part.basis) for part in parts), strict=True)
    return _Seen(np.concatenate(point), np.concatenate(log), np.concatenate(basis))


@dataclass(frozen=True)
class _Instant:
    """The points of an instant and the pictures of it."""

    rig: Rig
    """The fitted cameras"""
    pictures: Mapping[str, np.ndarray]
    grey: dict[str, np.ndarray]
    """float32 [H, W], filled as needed"""
    point: np.ndarray
    """int64 [Q], sorted, row of the points' xyz"""
    xyz: np.ndarray
    """float64 [Q, 3]"""
    row: np.ndarray
    """int64 [M], place in `point` that a fitted camera's observation is of"""
    camera: np.ndarray
    """int64 [M], index of this camera"""

    @classmethod
    def of(
        cls, rig: Rig, points: SparsePoints, index: int, pictures: Mapping[str, np.ndarray], usable: np.ndarray
    ) -> _Instant:
        point = np.flatnonzero(usable & (points.instant == index))
        mine = np.isin(points.point, point)
        row = np.searchsorted(point, points.point[mine])
        return cls(rig, pictures, {}, point, points.xyz[point], row, points.camera[mine].astype(np.int64))

    def seen_by(self, camera: Camera, patch_px: int, options: BalanceOptions) -> _Seen:
        """What the camera's picture shows of the points, where it shows them for certain and unclipped."""
        seen, pixels = np.zeros(len(self.point), bool), camera.project(self.xyz)[0]
        if camera.name not in self.pictures or not len(seen):
            return _Seen(self.point[seen], np.zeros((0, 3)), np.zeros((0, 2)))
        margin, size = patch_px / 2, (camera.width, camera.height)
        inside = camera.sees(self.xyz) & np.all((pixels > margin) & (pixels < np.array(size) - margin), axis=1)
        nearest = self._nearest(camera, options)
        for index in np.unique(nearest[inside & (nearest >= 0)]).tolist():
            rows = np.flatnonzero(inside & (nearest == index))
            seen[rows] = self._correlations(camera, self.rig.cameras[index], rows, patch_px) >= options.min_correlation
        pixels[~seen] = 0
        light, clean = patch_light(self.pictures[camera.name], pixels, side_px=patch_px)
        seen &= clean & (light > 0).all(axis=1)
        basis = shading_basis(camera, camera.plane_from_pixels(pixels[seen]))
        return _Seen(self.point[seen], np.log(light[seen].astype(np.float64)), basis)

    def _nearest(self, camera: Camera, options: BalanceOptions) -> np.ndarray:
        """Of the fitted cameras that show each point, the one whose ray is closest, int64 [Q]; -1 beyond the angle."""
        cosine = (_rays(camera, self.xyz[self.row]) * _unit(self.xyz[self.row] - self.rig.centres[self.camera])).sum(1)
        order = np.lexsort((self.camera, cosine))
        nearest, best = np.full(len(self.point), -1), np.full(len(self.point), -1.0)
        nearest[self.row[order]], best[self.row[order]] = self.camera[order], cosine[order]  # the last one stays
        return np.where(best >= math.cos(math.radians(options.max_angle_deg)), nearest, -1)

    def _correlations(self, camera: Camera, other: Camera, rows: np.ndarray, patch_px: int) -> np.ndarray:
        """Of squares in space that face both cameras, `patch_px` pixels of the other wide, float64 [len(rows)]."""
        xyz, offset = self.xyz[rows], np.arange(patch_px) - (patch_px - 1) / 2
        facing = _unit(_rays(camera, xyz) + _rays(other, xyz))
        right = _unit(np.cross(other.camera_from_world[1, :3], facing))
        pixel = ((xyz - other.centre) @ other.forward / other.fx)[:, None, None, None]
        across = offset[None, None, :, None] * right[:, None, None]
        down = offset[None, :, None, None] * np.cross(facing, right)[:, None, None]
        grid = (xyz[:, None, None] + pixel * (across + down)).reshape(len(rows), -1, 3)
        first, second = self._patches(camera, grid), self._patches(other, grid)
        product, squares = (first * second).sum(axis=1), (first**2).sum(axis=1) * (second**2).sum(axis=1)
        correlations: np.ndarray = product / np.sqrt(np.maximum(squares, 1e-6))
        return correlations

    def _patches(self, camera: Camera, grid: np.ndarray) -> np.ndarray:
        """Grey levels of a camera's picture about their mean, float32 [N, K], at places in space [N, K, 3]."""
        name = camera.name
        if name not in self.grey:
            self.grey[name] = cv2.cvtColor(self.pictures[name], cv2.COLOR_RGB2GRAY).astype(np.float32)
        # OpenCV puts the centre of the first pixel at 0, we put it at 0.5.
        pixels = (camera.project(grid.reshape(-1, 3))[0] - 0.5).astype(np.float32).reshape(*grid.shape[:2], 2)
        parts = [pixels[start : start + 30_000] for start in range(0, len(pixels), 30_000)]  # remap's limit is 32,767
        samples = [
            cv2.remap(self.grey[name], part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for part in parts
        ]
        patches: np.ndarray = np.concatenate(samples)
        centred: np.ndarray = patches - patches.mean(axis=1, keepdims=True)
        return centred


def _rays(camera: Camera, xyz: np.ndarray) -> np.ndarray:
    return _unit(xyz - camera.centre)


def _unit(vectors: np.ndarray) -> np.ndarray:
    unit: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return unit


def _with_camera(
    report: ColourReport, camera: Camera, seen: _Seen, colours: np.ndarray, options: BalanceOptions
) -> ColourReport:
    """The report with what a camera's observations [N] of points of these colours [N, 3] say."""
    count, name = len(seen.point), camera.name
    found = HeldOutColour(count, None, None, kept=False)
    gains, shading = np.zeros(3), np.zeros(2)
    if count < options.min_observations:
        shading = np.array(report.common_shading)
    else:
        before, after = _spread(seen.log, colours), _trial_spread(seen, colours, report, options)
        kept = report.kept or after < (1 - options.min_improvement) * before
        found = HeldOutColour(count, before, after, kept)
        gains, shading = _fit(seen, colours, report, options) if kept else (gains, shading)
    weak = () if count >= options.min_observations else (name,)
    return replace(
        report,
        gains={**report.gains, name: triple(np.exp(gains))},
        shading={**report.shading, name: pair(shading)},
        observations={**report.observations, name: count},
        weak_cameras=(*report.weak_cameras, *weak),
        held_out={**report.held_out, name: found},
    )


def _fit(
    seen: _Seen, colours: np.ndarray, report: ColourReport, options: BalanceOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of the gains [3], and k1, k2 [2], drawn to the rig's common ones as those of a fitted camera are."""
    gains, shading = _solve(seen, colours, report, options)
    if turns_back(shading):
        simple = replace(seen, basis=seen.basis * (1, 0))
        gains, shading = _solve(simple, colours, report, options)
        shading = shading * (1, 0)
    return gains, np.clip(shading, -MOST_SHADING, MOST_SHADING)


def _solve(
    seen: _Seen, colours: np.ndarray, report: ColourReport, options: BalanceOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise Huber's loss of log light + gain - shading - colour; far outliers do not count."""
    common = np.array(report.common_shading)
    asked, trusted = colours - seen.log + (seen.basis @ common)[:, None], trust(seen.log, options)  # [N, 3] both
    own = 2 if report.model is ColourModel.OWN else 0
    ridge = np.diag([0.0] * 3 + [(options.huber / spread) ** 2 for spread in options.shading_spread[:own]])
    solution = np.concatenate([np.median(asked, axis=0), np.zeros(own)])
    for _ in range(50):
        before, matrix, vector = solution, ridge + 1e-12 * np.eye(3 + own), np.zeros(3 + own)
        residuals = asked - solution[:3] + (seen.basis[:, :own] @ solution[3:])[:, None]
        near = np.abs(residuals).max(axis=1) < MOST_DEVIATION
        weight = trusted * huber_weight(residuals, options) * near[:, None]
        for channel in range(3):
            slope = np.hstack([np.tile(np.eye(3)[channel], (len(asked), 1)), -seen.basis[:, :own]])
            matrix = matrix + slope.T @ (weight[:, channel, None] * slope)
            vector = vector + slope.T @ (weight[:, channel] * asked[:, channel])
        solution = np.linalg.solve(matrix, vector)
        if np.abs(solution - before).max() < 1e-4:
            break
    return solution[:3], common + (solution[3:] if own else 0)


def _trial_spread(seen: _Seen, colours: np.ndarray, report: ColourReport, options: BalanceOptions) -> float:
    """The spread when each part of the points is judged by a fit to the others."""
    levels = np.zeros_like(seen.log)
    for part in range(options.held_out):
        judges = seen.point % options.held_out == part
        gains, shading = _fit(seen.only(~judges), colours[~judges], report, options)
        levels[judges] = seen.log[judges] + gains - (seen.basis[judges] @ shading)[:, None]
    return _spread(levels, colours)


def _spread(levels: np.ndarray, colours: np.ndarray) -> float:
    """Median over observations and channels of the distance to the point's colour [N, 3], as a share of the light."""
    return float(np.expm1(np.median(np.abs(levels - colours))))
