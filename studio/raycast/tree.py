"""Bounds of shapes, and the tree over them with which a ray finds what it meets."""

from __future__ import annotations

import numba
import numpy as np

from studio.raycast.kernels import BOX, CONE, ELLIPSOID

LEAF = 2
"""Items that a leaf of the tree may hold"""
BINS = 8


def item_bounds(
    kind: np.ndarray,  # int32 [P]
    matrix: np.ndarray,  # float64 [P, 3, 4], world from canonical
    size: np.ndarray,  # float64 [P, 3]
    vertices: np.ndarray,  # float64 [V, 3], world
    triangles: np.ndarray,  # int32 [F, 3]
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of all items, solids then triangles, lower and upper, float64 [P + F, 3]."""
    x, y, z, centre = np.moveaxis(matrix, 2, 0)  # [P, 3] each
    form = kind[:, None]
    round_reach = np.where(form == ELLIPSOID, np.sqrt(x * x + y * y + z * z), np.sqrt(x * x + y * y) + np.abs(z))
    reach = np.where(form == BOX, np.abs(x) + np.abs(y) + np.abs(z), round_reach)
    # a cone is the hull of two spheres
    end, first, second = centre + z * size[:, 2:], size[:, :1], size[:, 1:2]
    lower = np.where(form == CONE, np.minimum(centre - first, end - second), centre - reach)
    upper = np.where(form == CONE, np.maximum(centre + first, end + second), centre + reach)
    corners = vertices[triangles]  # [F, 3, 3]
    return np.concatenate([lower, corners.min(axis=1)]), np.concatenate([upper, corners.max(axis=1)])


@numba.njit(cache=True, error_model="numpy")
def tree_over(
    lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """`lower`, `upper`, `first`, `fill` and `order` of `Shapes`, from the bounds of the items."""
    total = len(lower)
    order = np.arange(total).astype(np.int32)
    box_lower, box_upper = np.empty((2 * total, 3)), np.empty((2 * total, 3))
    first, count = np.zeros(2 * total, np.int32), np.zeros(2 * total, np.int32)
    bins, filled = np.empty((BINS, 6)), np.empty(BINS, np.int64)
    first[0], count[0] = 0, total
    nodes, node = 1, 0
    # children come after their parents, so one pass over the growing list visits every node
    while node < nodes:
        start, stop = first[node], first[node] + count[node]
        box_lower[node], box_upper[node] = np.inf, -np.inf
        for place in range(start, stop):
            for axis in range(3):
                box_lower[node, axis] = min(box_lower[node, axis], lower[order[place], axis])
                box_upper[node, axis] = max(box_upper[node, axis], upper[order[place], axis])
        if stop - start > LEAF:
            middle = _split(lower, upper, order, start, stop, bins, filled)
            first[nodes], count[nodes] = start, middle - start
            first[nodes + 1], count[nodes + 1] = middle, stop - middle
            first[node], count[node] = nodes, 0
            nodes += 2
        node += 1
    return box_lower[:nodes].copy(), box_upper[:nodes].copy(), first[:nodes].copy(), count[:nodes].copy(), order


@numba.njit(cache=True, error_model="numpy")
def _split(
    lower: np.ndarray, upper: np.ndarray, order: np.ndarray, start: int, stop: int, bins: np.ndarray, filled: np.ndarray
) -> int:
    """Sort a range of items into two by the cheapest of the binned planes; returns where the second begins."""
    best, best_axis, best_cut, best_low, best_scale = np.inf, -1, 0, 0.0, 0.0
    for axis in range(3):
        low, high = np.inf, -np.inf
        for place in range(start, stop):
            middle = lower[order[place], axis] + upper[order[place], axis]
            low, high = min(low, middle), max(high, middle)
        if high - low < 1e-9:
            continue
        scale = BINS * (1 - 1e-9) / (high - low)
        _fill_bins(lower, upper, order, start, stop, axis, low, scale, bins, filled)
        for cut in range(1, BINS):
            cost = _half_cost(bins, filled, 0, cut) + _half_cost(bins, filled, cut, BINS)
            if cost < best:
                best, best_axis, best_cut, best_low, best_scale = cost, axis, cut, low, scale
    if best_axis < 0:
        return (start + stop) // 2
    left, right = start, stop - 1
    while left <= right:
        item = order[left]
        if int((lower[item, best_axis] + upper[item, best_axis] - best_low) * best_scale) < best_cut:
            left += 1
        else:
            order[left], order[right] = order[right], item
            right -= 1
    return left


@numba.njit(cache=True, error_model="numpy")
def _fill_bins(
    lower: np.ndarray,
    upper: np.ndarray,
    order: np.ndarray,
    start: int,
    stop: int,
    axis: int,
    low: float,
    scale: float,
    bins: np.ndarray,
    filled: np.ndarray,
) -> None:
    bins[:, :3], bins[:, 3:], filled[:] = np.inf, -np.inf, 0
    for place in range(start, stop):
        item = order[place]
        cell = int((lower[item, axis] + upper[item, axis] - low) * scale)
        filled[cell] += 1
        for k in range(3):
            bins[cell, k] = min(bins[cell, k], lower[item, k])
            bins[cell, 3 + k] = max(bins[cell, 3 + k], upper[item, k])


@numba.njit(cache=True, error_model="numpy")
def _half_cost(bins: np.ndarray, filled: np.ndarray, start: int, stop: int) -> float:
    """Surface of the box about some bins times the number of items in them."""
    items = 0
    a, b, c, x, y, z = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for cell in range(start, stop):
        items += filled[cell]
        a, b, c = min(a, bins[cell, 0]), min(b, bins[cell, 1]), min(c, bins[cell, 2])
        x, y, z = max(x, bins[cell, 3]), max(y, bins[cell, 4]), max(z, bins[cell, 5])
    x, y, z = x - a, y - b, z - c
    return items * (x * y + y * z + z * x) if items > 0 else 0.0
