"""Gaussians on a sphere: the multi-scale UV map that bounds their number, and its atlas picture.

A map has `rows` texels of azimuth and `columns` of polar angle; deeper layers are coarser, halved in turn
along columns and rows (paper, Preliminaries and section 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.gaussians.uvsize import UvOptions
from packuv.kernels.compile import kernel

TRIM = 0.1
"""Share of points at either end of an axis that the trimmed mean leaves out: stray background points."""


@dataclass(frozen=True)
class Slots:
    """Where each of N Gaussians lies in the map."""

    layer: np.ndarray
    """int8 [N]; -1: no layer takes it, it is pruned"""
    row: np.ndarray
    """int32 [N], azimuth texel at that layer's resolution; -1 where pruned"""
    column: np.ndarray
    """int32 [N], polar texel; -1 where pruned"""

    @property
    def kept(self) -> np.ndarray:
        """bool [N]"""
        return self.layer >= 0


def sphere_texels(points: np.ndarray, centre: np.ndarray, *, options: UvOptions) -> np.ndarray:
    """Texel of layer 0 that each world point [N, 3] falls in, seen from `centre` [3]: int32 [N, 2], row and column.

    theta = atan2(y, x) runs along the rows and wraps, phi = acos(z / rho) along the columns and is clamped, so no
    point leaves the map; the centre itself counts as the pole. Raises ValueError for points that are not finite.
    Source: paper, Preliminaries.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"points must be finite and [N, 3], but are {points.shape}; drop broken Gaussians first")
    offset = points.astype(np.float64) - centre
    rho = np.sqrt((offset * offset).sum(axis=1))
    theta = np.arctan2(offset[:, 1], offset[:, 0])
    phi = np.arccos(np.clip(np.divide(offset[:, 2], rho, out=np.ones_like(rho), where=rho > 0), -1, 1))
    row = np.floor((np.pi + theta) / (2 * np.pi) * options.rows).astype(np.int32) % options.rows
    column = np.minimum(np.floor(phi / np.pi * options.columns).astype(np.int32), options.columns - 1)
    return np.stack([row, column], axis=1)


def assign_slots(
    points: np.ndarray,  # [N, 3], world
    opacity: np.ndarray,  # [N], any increasing measure of opacity: alpha, logit or code
    centre: np.ndarray,  # [3], world
    *,
    options: UvOptions,
) -> Slots:
    """Give each Gaussian the first layer whose texel it wins by opacity; a tie goes to the lower index.

    What no layer takes is pruned (the paper's max-K pruning). O(N K).
    """
    if opacity.shape != (len(points),):
        raise ValueError(f"{len(points)} points need as many opacities, but {opacity.shape=}")
    texels = sphere_texels(points, centre, options=options)
    sizes = np.array(options.sizes, dtype=np.int64)
    return Slots(*_cascade(texels, opacity.astype(np.float64), sizes))


@kernel()
def _cascade(texels, opacity, sizes):
    """Layer by layer: one pass finds the winner of each texel, a second one seats the winners."""
    n = len(texels)
    layer = np.full(n, -1, np.int8)
    seat = np.full((2, n), -1, np.int32)
    waiting = np.arange(n)
    for k in range(len(sizes)):
        row_step, column_step = sizes[0, 0] // sizes[k, 0], sizes[0, 1] // sizes[k, 1]
        winner = np.full((sizes[k, 0], sizes[k, 1]), -1, np.int64)
        for i in waiting:
            row, column = texels[i, 0] // row_step, texels[i, 1] // column_step
            if winner[row, column] < 0 or opacity[i] > opacity[winner[row, column]]:
                winner[row, column] = i
        left = 0
        for i in waiting:
            row, column = texels[i, 0] // row_step, texels[i, 1] // column_step
            if winner[row, column] == i:
                layer[i], seat[0, i], seat[1, i] = k, row, column
            else:
                waiting[left] = i
                left += 1
        waiting = waiting[:left]
    return layer, seat[0], seat[1]


def choose_centre(
    points: np.ndarray,  # [N, 3], world
    alpha: np.ndarray,  # [N], opacity in 0..1
    cameras: np.ndarray | None = None,  # [C, 3], camera centres, world
    *,
    options: UvOptions,
) -> np.ndarray:
    """The centre, float64 [3], from which the map keeps most opacity.

    Tried are the trimmed mean of the points, their mean, and the centroid of the cameras; the choice is worth up to
    33 points of kept opacity on real scenes, and no single rule wins on all.
    """
    if len(points) == 0:
        raise ValueError("a UV map of no points has no centre; fit or import Gaussians first")
    trimmed = np.sort(points.astype(np.float64), axis=0)
    cut = int(TRIM * len(points))
    candidates = [trimmed[cut : len(points) - cut].mean(axis=0), points.mean(axis=0, dtype=np.float64)]
    if cameras is not None and len(cameras):
        candidates.append(cameras.mean(axis=0, dtype=np.float64))
    kept = [alpha[assign_slots(points, alpha, centre, options=options).kept].sum() for centre in candidates]
    return np.asarray(candidates[int(np.argmax(kept))])


@dataclass(frozen=True)
class Placement:
    """Where a layer lies in the atlas picture, pixels."""

    top: int
    left: int
    rotated: bool
    """Turned by 90 degrees counter-clockwise"""


def atlas_size(options: UvOptions) -> tuple[int, int]:
    """Height and width of the atlas picture: layer 0, and beside it an area of the same size for all others."""
    if options.layers == 1:
        return options.rows, options.columns
    return options.rows, 2 * options.columns


def atlas_layout(options: UvOptions) -> tuple[Placement, ...]:
    """Recursive halving: layer 0 at the right, each next layer takes half of what is left of the left area.

    In a square map odd layers are rotated, as in the paper; other maps keep all layers upright. The paper's formula
    for the width wastes 29 % of the picture, this packing 0.4 % at 8 layers.
    """
    square = options.rows == options.columns
    places = [Placement(0, options.columns if options.layers > 1 else 0, rotated=False)]
    top = left = 0
    for k, (rows, columns) in enumerate(options.sizes[1:], start=1):
        places.append(Placement(top, left, rotated=square and k % 2 == 1))
        upper_half = (k % 2 == 1) == square  # otherwise the left half
        if upper_half:
            top += columns if square else rows
        else:
            left += columns
    return tuple(places)


def atlas_pixels(slots: Slots, *, options: UvOptions) -> np.ndarray:
    """Atlas pixel of each slot, int32 [N, 2], y and x; -1 where pruned."""
    places = atlas_layout(options)
    top, left, rotated = (np.array([getattr(p, key) for p in places]) for key in ("top", "left", "rotated"))
    columns = np.array([size[1] for size in options.sizes])
    layer, row, column = slots.layer, slots.row, slots.column
    y = top[layer] + np.where(rotated[layer], columns[layer] - 1 - column, row)
    x = left[layer] + np.where(rotated[layer], row, column)
    return np.where(slots.kept[:, None], np.stack([y, x], axis=1), -1).astype(np.int32)
