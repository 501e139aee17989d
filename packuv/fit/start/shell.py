"""The surface around a scene, one distance for each direction from its centre: sweep stereo over the UV sphere.

Spheres of many radii about the scene's centre are painted with every camera's picture. Where a sphere passes through a
surface, the cameras that see it agree on the pattern around a direction. Directions that several cameras agree on hold
points as exact as calibrated ones and by the ten thousand, where feature matching finds a few hundred; the rest of the
surface is drawn smoothly through them. A fit that starts there has walls where walls are, not haze before them. What
stands in the room is not on the shell: there the cameras disagree on its colour, and nothing starts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import prange

from packuv.camera import PinholeCamera
from packuv.each import Each
from packuv.fit.depth import SparseDepth
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.points import Points, drawn, look, pixels_of, softened, together
from packuv.kernels.compile import kernel, prefer_tbb
from packuv.raster import ewa
from packuv.raster.view import VIEW_CX, VIEW_CY, VIEW_FX, VIEW_FY, VIEW_HEIGHT, VIEW_NEAR, VIEW_WIDTH, view_constants

MOST_PIXELS = 8
"""Across a direction; pictures with more are halved before the sweep"""
SURE_SHARE, EVEN_SHARE = 0.07, 0.55
"""Of the places that a fit starts from: those that cameras agree on, and those that would cover the sphere evenly.
On "basketball" 1,500 iterations from more of them and denser detail reach 30.4 dB and SSIM 0.948 in nine cameras left
out, 29.8 and 0.942 from 22,000 even and sure places; from detail alone smooth floors turn to haze"""
AGREED = 0.05
"""Deviation between cameras, of colours 0 to 1, beyond which a place is hardly on a surface"""
STRONG, FAINT = 0.3, 0.01
"""Contrast beyond which there are no more places, and what smooth places count as, in brightness 0 to 1"""


@dataclass(frozen=True)
class ShellOptions:
    """How finely the sphere is swept, and what counts as agreement."""

    enabled: bool = True
    columns: int = 768
    """Directions around the z axis; half as many from pole to pole"""
    nearest: float = 0.5
    """Radius of the smallest sphere, in scene radii: the shell is what surrounds the scene, not what stands in it"""
    farthest: float = 8.0
    """Radius of the largest sphere, in scene radii"""
    steps: int = 72
    """Spheres, evenly spaced in 1 / radius"""
    window: int = 7
    """Side of the window that is compared, in directions; odd"""
    noise: float = 0.012
    """Contrast below which a window tells nothing, in brightness 0 to 1"""
    grazing: float = 0.35
    """Least cosine between the line of sight and the sphere's normal"""
    agreement: float = 0.7
    """Mean correlation of the best two thirds of the cameras where a surface is sure"""
    camera_agreement: float = 0.6
    """Correlation with these at which a camera counts as seeing the surface"""
    cameras: int = 3
    """That must see a surface"""
    outlier: float = 0.12
    """Step of 1 / distance (in 1 / scene radii) from the smooth surface beyond which a direction is something else"""

    def __post_init__(self) -> None:
        if self.window % 2 == 0 or self.columns % 64 or self.steps < 3 or not 0 < self.nearest < self.farthest:
            raise ValueError(
                "a shell needs an odd window, columns in multiples of 64, three steps or more and 0 < nearest < "
                f"farthest, but has {self.window}, {self.columns}, {self.steps}, {self.nearest} and {self.farthest}"
            )

    @property
    def places(self) -> int:
        """Depths that a camera may learn from it."""
        return self.columns * self.columns // 2 * self.enabled


@dataclass(frozen=True)
class Shell:
    """Distances from the centre for V x U directions: V polar angles and U azimuths."""

    xyz: np.ndarray
    """float64 [V, U, 3], world"""
    rgb: np.ndarray
    """float64 [V, U, 3], in [0, 1]"""
    sure: np.ndarray
    """bool [V, U]: several cameras agree on the place; elsewhere it is interpolated"""
    likely: np.ndarray
    """bool [V, U]: seen by some camera, or next to a direction that is, and cameras agree on its colour, or on that of
    its surroundings where no two of them see it"""
    explained: float
    """Share of the directions seen by two cameras or more in which they agree on the colour, by solid angle"""
    seers: np.ndarray
    """bool [V, U, C]: cameras that agree on a sure place"""

    def depths(self, camera: PinholeCamera, index: int, near: float) -> SparseDepth:
        """Depths of the sure places that a camera, by its place among those swept, agrees on."""
        xyz = self.xyz[self.sure & self.seers[:, :, index]]
        inside, rows, columns = pixels_of(camera, xyz, near)
        return SparseDepth(rows * camera.width + columns, camera.project(xyz[inside])[1].astype(np.float32))

    def places(self, count: int, rng: np.random.Generator) -> Points:
        """About `count` places of the surface: some that cameras agree on, some evenly over the rest of what is likely,
        which cover smooth walls, and most of the others where the surface has detail."""
        sure, even = self._sure_points(round(SURE_SHARE * count), rng), self._cover(round(EVEN_SHARE * count))
        return together(sure, even, self._detailed(count - len(sure.xyz) - len(even.xyz), rng))

    def _sure_points(self, count: int, rng: np.random.Generator) -> Points:
        """At most `count` of the places that cameras agree on, evenly over the sphere."""
        weight = solid_angles(*self.sure.shape)[self.sure]
        return drawn(Points(self.xyz[self.sure], self.rgb[self.sure]), count, rng, weight=weight)

    def _cover(self, count: int) -> Points:
        """Places evenly over what is likely and not sure; `count` would cover the whole sphere."""
        rows, columns = self.sure.shape
        turn = np.arange(count) + 0.5
        polar, azimuth = np.arccos(1 - 2 * turn / max(count, 1)), np.pi * (1 + math.sqrt(5)) * turn  # Fibonacci
        v = np.minimum((polar / np.pi * rows).astype(np.int64), rows - 1)
        u = (azimuth / (2 * np.pi) * columns).astype(np.int64) % columns
        open_places = self.likely & ~_grown(self.sure, 2)
        chosen = open_places[v, u]
        return Points(self.xyz[v, u][chosen], self.rgb[v, u][chosen])

    def _detailed(self, count: int, rng: np.random.Generator) -> Points:
        """At most `count` likely places, the denser the more their surroundings differ in brightness."""
        weight = (np.minimum(contrast(self.rgb.mean(axis=2)), STRONG) + FAINT) * solid_angles(*self.sure.shape)
        return drawn(Points(self.xyz[self.likely], self.rgb[self.likely]), count, rng, weight=weight[self.likely])


def solid_angles(rows: int, columns: int) -> np.ndarray:
    """Of the cells of a UV sphere, up to a factor, float64 [V, U]."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    return np.broadcast_to(np.sin(polar)[:, None], (rows, columns))


def contrast(brightness: np.ndarray) -> np.ndarray:
    """Gradient of brightness over the sphere, float32 [V, U], Sobel's sum by the cell, smoothed; azimuth wraps."""
    wide = cv2.copyMakeBorder(brightness.astype(np.float32), 0, 0, 4, 4, cv2.BORDER_WRAP)
    steep = np.hypot(cv2.Sobel(wide, cv2.CV_32F, 1, 0), cv2.Sobel(wide, cv2.CV_32F, 0, 1))
    return cv2.GaussianBlur(steep, (0, 0), 1.0)[:, 4:-4]


def directions(columns: int) -> np.ndarray:
    """Unit vectors of the cells of a UV sphere, float64 [columns / 2, columns, 3]; z points to row 0."""
    azimuth = (np.arange(columns) + 0.5) / columns * 2 * np.pi - np.pi
    polar = ((np.arange(columns // 2) + 0.5) / (columns // 2) * np.pi)[:, None]
    flat = np.sin(polar)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.repeat(np.cos(polar), columns, 1)], axis=-1)


def sweep_shell(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],  # float32 [3, H, W] in [0, 1]
    *,
    bounds: Bounds,
    options: ShellOptions,
) -> Shell | None:
    """Find the surface around the scene, or None where the pictures show too little of it.

    O(directions * steps * cameras * window^2).
    """
    rays = directions(options.columns)
    inverse, seers, sure = _agreed(rays, cameras, pictures, bounds, options)
    smooth = _without_outliers(inverse, sure, options)
    if smooth.sum() < rays.shape[1]:  # fewer points than the sphere is wide say nothing about the rest
        return None
    distance = bounds.radius / interpolate(inverse, smooth.astype(np.float64))
    distance[sure] = bounds.radius / inverse[sure]
    xyz = bounds.centre + distance[:, :, None] * rays
    may = np.where(sure[:, :, None], seers, True).reshape(-1, len(cameras))
    sight = look(cameras, pictures, xyz.reshape(-1, 3), bounds.near, may=may)
    rgb, views = sight.rgb.reshape(xyz.shape), sight.views.reshape(sure.shape)
    filled = np.stack([interpolate(rgb[:, :, k], (views > 0).astype(np.float64)) for k in range(3)], axis=-1)
    agreed, explained = _agreement_on_colour(xyz, cameras, pictures, bounds.near)
    return Shell(xyz, filled, sure, _grown(views > 0, options.columns // 72) & agreed, explained, seers)


def _agreement_on_colour(
    xyz: np.ndarray, cameras: Sequence[PinholeCamera], pictures: Sequence[np.ndarray], near: float
) -> tuple[np.ndarray, float]:
    """Where the cameras agree on the colour of places [V, U, 3], bool [V, U], and the share of where two see them."""
    soft = Each(lambda index: softened(pictures[index]), len(pictures))
    rows, columns = xyz.shape[:2]
    deviation = look(cameras, soft, xyz.reshape(-1, 3), near).deviation.reshape(rows, columns)
    agreed, weight = deviation < AGREED, solid_angles(rows, columns) * np.isfinite(deviation)
    around = interpolate(agreed.astype(np.float64), weight) > 0.5
    explained = float((weight * agreed).sum() / max(weight.sum(), 1e-12))
    return np.where(np.isfinite(deviation), agreed, around), explained


def _grown(mask: np.ndarray, cells: int) -> np.ndarray:
    """The mask and what is within so many cells of it."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)) > 0


def interpolate(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Smooth continuation over the sphere [V, U] of values known where `weight` is 1; 0 elsewhere.

    Means over ever larger blocks fill what the smaller ones lack. With weights below 1 it smooths what is known too.
    """
    sums, weights = [values * weight], [weight]
    while min(weights[-1].shape) % 2 == 0 and min(weights[-1].shape) > 2:
        sums.append(_quartered(sums[-1]))
        weights.append(_quartered(weights[-1]))
    total = max(weights[-1].sum(), 1e-12)
    mean: np.ndarray = np.full_like(sums[-1], sums[-1].sum() / total)
    for block_sum, block_weight in zip(reversed(sums), reversed(weights), strict=True):
        if mean.shape != block_sum.shape:
            mean = _doubled(mean)
        trust = np.minimum(block_weight, 1)
        mean = trust * block_sum / np.maximum(block_weight, 1e-12) + (1 - trust) * mean
    return mean


def _quartered(values: np.ndarray) -> np.ndarray:
    rows, columns = values.shape
    return np.asarray(values.reshape(rows // 2, 2, columns // 2, 2).sum(axis=(1, 3)))


def _doubled(values: np.ndarray) -> np.ndarray:
    """Twice the rows and columns, linear between; azimuth wraps."""
    wrapped = np.concatenate([values[:, -2:], values, values[:, :2]], axis=1)
    large = cv2.resize(wrapped, (2 * wrapped.shape[1], 2 * wrapped.shape[0]), interpolation=cv2.INTER_LINEAR)
    return large[:, 4:-4]


def _without_outliers(inverse: np.ndarray, sure: np.ndarray, options: ShellOptions) -> np.ndarray:
    """Sure directions that belong to the smooth surface, bool [V, U]; the others stand before it."""
    kept = sure.copy()
    for slack in (3, 2, 1):
        smooth = interpolate(inverse, 0.004 * kept)
        kept &= np.abs(inverse - smooth) < slack * options.outlier
    return kept


def _agreed(
    rays: np.ndarray,
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],
    bounds: Bounds,
    options: ShellOptions,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scene radius / distance where cameras agree best [V, U], who sees it [V, U, C], and where that is sure [V, U]."""
    prefer_tbb()
    seen_by = [coarse(camera, options.columns) for camera in cameras]
    grey, views = _grey(seen_by, pictures), np.stack([view_constants(camera, bounds.near, 0.0) for camera in seen_by])
    shape, count = rays.shape[:2], len(cameras)
    inverse = np.linspace(1 / options.nearest, 1 / options.farthest, options.steps)
    painted = np.empty((count, *shape), np.float32)
    score, last = np.full(shape, -1, np.float32), np.zeros(shape, np.float32)
    around, step = np.zeros((*shape, 2), np.float32), np.full(shape, -1, np.int16)
    seers = np.zeros((*shape, count), np.bool_)
    rule = np.array([options.noise, options.camera_agreement])
    for index, value in enumerate(inverse):
        _paint(rays, bounds.centre, bounds.radius / value, views, grey, options.grazing, painted)
        _compare(painted, options.window // 2, rule, index, score, last, around, step, seers)
    sure = (score >= options.agreement) & (seers.sum(axis=2) >= options.cameras)
    sure &= (step > 0) & (step < options.steps - 1)
    sure &= np.abs(step - cv2.medianBlur(step, 5)) <= 1
    before, after = around[:, :, 0], around[:, :, 1]
    bend = np.maximum(2 * score - before - after, 1e-6)
    place = step + np.clip((after - before) / (2 * bend), -0.5, 0.5)
    return inverse[0] + place * (inverse[1] - inverse[0]), seers, sure


def _grey(cameras: Sequence[PinholeCamera], pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Brightness of pictures at the cameras' sizes, float32 [C, H, W], zeros where one is smaller."""
    height, width = max(camera.height for camera in cameras), max(camera.width for camera in cameras)
    grey = np.zeros((len(pictures), height, width), np.float32)
    for index, picture in enumerate(pictures):
        camera, bright = cameras[index], picture.mean(axis=0)
        if bright.shape != (camera.height, camera.width):
            bright = cv2.resize(bright, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        grey[index, : camera.height, : camera.width] = bright
    return grey


def coarse(camera: PinholeCamera, columns: int) -> PinholeCamera:
    """The camera at the size that a sphere of so many columns can use: larger pictures take memory, and alias."""
    while camera.fx * 2 * math.pi / columns >= MOST_PIXELS:
        camera = camera.scaled(camera.width // 2, camera.height // 2)
    return camera


_in_camera = kernel(inline=True)(ewa.in_camera)


@kernel(parallel=True)
def _paint(rays, centre, distance, views, grey, grazing, painted):
    """Each camera's brightness in each direction on the sphere, NaN where the camera does not see it.

    `views` holds the rasterizer's constants of each camera.
    """
    for v in prange(rays.shape[0]):
        for u in range(rays.shape[1]):
            dx, dy, dz = rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
            px, py, pz = centre[0] + distance * dx, centre[1] + distance * dy, centre[2] + distance * dz
            for c in range(len(views)):
                w = views[c]
                painted[c, v, u] = np.nan
                x, y, z = _in_camera(w, px, py, pz)
                if z < w[VIEW_NEAR]:
                    continue
                column, row = w[VIEW_FX] * x / z + w[VIEW_CX] - 0.5, w[VIEW_FY] * y / z + w[VIEW_CY] - 0.5
                if not (column >= 0 and row >= 0 and column < w[VIEW_WIDTH] - 1 and row < w[VIEW_HEIGHT] - 1):
                    continue
                normal_x = w[0] * dx + w[1] * dy + w[2] * dz
                normal_y = w[3] * dx + w[4] * dy + w[5] * dz
                normal_z = w[6] * dx + w[7] * dy + w[8] * dz
                outward = x * normal_x + y * normal_y + z * normal_z
                if outward < grazing * math.sqrt(x * x + y * y + z * z):
                    continue
                i, j = int(row), int(column)
                a, b = np.float32(row - i), np.float32(column - j)
                top = grey[c, i, j] * (1 - b) + grey[c, i, j + 1] * b
                bottom = grey[c, i + 1, j] * (1 - b) + grey[c, i + 1, j + 1] * b
                painted[c, v, u] = top * (1 - a) + bottom * a


@kernel(parallel=True)
def _compare(painted, half, rule, index, score, last, around, step, seers):
    """Note where the cameras agree better on this sphere than on those before."""
    count, rows, columns = painted.shape
    size = (2 * half + 1) ** 2
    for v in prange(rows):
        patches = np.empty((count, size), np.float32)
        who, gain = np.empty(count, np.int64), np.empty(count, np.float32)
        mean = np.empty(size, np.float32)
        for u in range(columns):
            found = np.float32(0)
            cameras = 0
            if half <= v < rows - half:
                cameras = _patches(painted, v, u, half, np.float32(rule[0]), patches, who)
            if cameras >= 2:
                found, used = _agreement(patches, cameras, gain, mean)
                if found > score[v, u]:
                    score[v, u], step[v, u], around[v, u, 0], around[v, u, 1] = found, index, last[v, u], 0
                    seers[v, u, :] = False
                    for k in range(cameras):
                        others = used - (1 if gain[k] == np.inf else 0)
                        seers[v, u, who[k]] = _with_others(patches[k], mean, gain[k] == np.inf) > rule[1] * others
                elif step[v, u] == index - 1:
                    around[v, u, 1] = found
            elif step[v, u] == index - 1:
                around[v, u, 1] = 0
            last[v, u] = found


@kernel(inner=True)
def _patches(painted, v, u, half, noise, patches, who):
    """Windows of the cameras that see all of one, without their mean and in units of their contrast."""
    columns, size, cameras = painted.shape[2], patches.shape[1], 0
    for c in range(len(painted)):
        centre = painted[c, v, u]
        if np.isnan(centre):
            continue
        total, square, k = np.float32(0), np.float32(0), 0
        for a in range(-half, half + 1):
            for b in range(-half, half + 1):
                value = painted[c, v + a, (u + b) % columns] - centre
                patches[cameras, k] = value
                total += value
                square += value * value
                k += 1
        if np.isnan(square):
            continue
        mean = total / np.float32(size)
        variance = max(square / np.float32(size) - mean * mean, np.float32(0))
        scale = np.float32(1) / math.sqrt((variance + noise * noise) * np.float32(size))
        for k in range(size):
            patches[cameras, k] = (patches[cameras, k] - mean) * scale
        who[cameras] = c
        cameras += 1
    return cameras


@kernel(inner=True)
def _with_others(patch, mean, inside):
    """Sum of correlations with the patches whose sum is `mean`; without its own if it is one of them."""
    dot, own = np.float32(0), np.float32(0)
    for k in range(len(patch)):
        dot += patch[k] * mean[k]
        own += patch[k] * patch[k]
    return dot - own if inside else dot


@kernel(inner=True)
def _agreement(patches, cameras, gain, mean):
    """Mean correlation among the best two thirds of the patches, whose sum is left in `mean`, and their number.

    Something before the surface spoils the view of some cameras; the others need not suffer. `gain` of those used is
    infinite afterwards.
    """
    used = max(2, (2 * cameras + 2) // 3)
    mean[:] = 0
    for c in range(cameras):
        for k in range(len(mean)):
            mean[k] += patches[c, k]
    for c in range(cameras):
        gain[c] = _with_others(patches[c], mean, True)
    for _ in range(used):
        best = -1
        for c in range(cameras):
            if gain[c] < np.inf and (best < 0 or gain[c] > gain[best]):
                best = c
        gain[best] = np.inf
    mean[:] = 0
    own = np.float32(0)
    for c in range(cameras):
        if gain[c] == np.inf:
            for k in range(len(mean)):
                mean[k] += patches[c, k]
                own += patches[c, k] * patches[c, k]
    total = np.float32(0)
    for k in range(len(mean)):
        total += mean[k] * mean[k]
    return (total - own) / np.float32(used * (used - 1)), used
