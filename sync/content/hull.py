"""The moving hull: what the other cameras say that a camera should see move.

Where something moves, it moves in every picture that shows it. The places that most other cameras see move at an
instant, as a camera would see them, are compared with what moves in its own picture: a silhouette against its carving,
whole pictures instead of lines, which tells more the more cameras there are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sync.content.activity import Activity
from sync.content.agreement import BLOCKS, agreement

SIDE = 40
"""Places along each side of the cube in which things move"""
CUBE = 0.8
"""Half of its side, in typical distances of a camera from its middle"""
COARSE = 4
"""Cells along a side of those that are compared: about as large as a place looks"""
MOVING_SHARE = 0.5
"""Of a coarse cell that must change for it to be in motion"""
AGREED = 0.8
"""Share of the other cameras that show a place which must see it move, at least two"""


def compare_with_hull(seen: Sequence[Activity], reach: int) -> list[np.ndarray]:
    """For each camera what `agreement` says of its own pictures and of what the others see move; all are posed."""
    if len(seen) < 3 or not all(one.posed for one in seen):
        return [np.zeros((2 * reach + 1, BLOCKS)) for _ in seen]
    places = _places(seen)
    coarse, cells = zip(*(_coarse(one, places) for one in seen), strict=True)
    moves, shown = list(_votes(seen, coarse, cells))
    ever = (moves >= _needed(shown - 1)).any(axis=0)
    found = []
    for one, own, cell in zip(seen, coarse, cells, strict=True):
        used = ever & (cell >= 0)
        mine = one.there[:, None]
        others_move = moves[:, used] - (own[:, cell[used]] > MOVING_SHARE) * mine
        others_show = shown[:, used] - mine
        hull = others_move >= _needed(others_show)
        expected = np.zeros(own.shape)
        instants, columns = np.nonzero(hull)
        expected[instants, cell[used][columns]] = 1.0
        there = others_show.max(axis=1, initial=0) >= 2
        found.append(agreement(own, expected, one.there, there, reach))
    return found


def _needed(shown: np.ndarray) -> np.ndarray:
    """How many cameras must see a place move of those that show it."""
    return np.maximum(2, np.ceil(AGREED * shown))


def _places(seen: Sequence[Activity]) -> np.ndarray:
    """A cube of points about where the cameras look, float64 [n, 3]."""
    centres = np.array([one.centre for one in seen])
    axes = np.array([one.rays.mean(axis=0) for one in seen if one.rays is not None])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [C, 3, 3]
    mean = centres.mean(axis=0)
    aside = (across @ (centres - mean)[:, :, None]).sum(axis=(0, 2))
    middle = mean + np.linalg.pinv(across.sum(axis=0), rcond=1e-3) @ aside  # nearest to all axes
    half = CUBE * float(np.median(np.linalg.norm(centres - middle, axis=1)))
    steps = np.linspace(-half, half, SIDE)
    places: np.ndarray = middle + np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return places


def _coarse(seen: Activity, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motion in coarse cells, float64 [T, p], and the cell that shows each place, int64 [n], -1 where none does."""
    assert seen.rays is not None
    assert seen.centre is not None
    width, height = seen.width, seen.moving.shape[1] // seen.width
    columns, rows = width // COARSE, height // COARSE
    whole = seen.moving.reshape(-1, height, width)[:, : rows * COARSE, : columns * COARSE]
    moving = whole.reshape(-1, rows, COARSE, columns, COARSE).mean(axis=(2, 4), dtype=np.float64)
    first, right, below = seen.rays[0], seen.rays[1] - seen.rays[0], seen.rays[width] - seen.rays[0]
    x, y, z = np.linalg.solve(np.stack([right, below, first], axis=1), (places - seen.centre).T)
    depth = np.where(z > 0, z, np.inf)
    column = np.floor((x / depth + 0.5) / COARSE).astype(np.int64)
    row = np.floor((y / depth + 0.5) / COARSE).astype(np.int64)
    inside = (z > 0) & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return moving.reshape(len(moving), -1), np.where(inside, row * columns + column, -1)


def _votes(seen: Sequence[Activity], coarse: Sequence[np.ndarray], cells: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    """How many cameras see each place move at each instant, and how many show it, int16 [T, n] each."""
    moves = np.zeros((len(coarse[0]), len(cells[0])), np.int16)
    shown = np.zeros_like(moves)
    for one, own, cell in zip(seen, coarse, cells, strict=True):
        used = np.flatnonzero(cell >= 0)
        mine = one.there[:, None]
        moves[:, used] += (own[:, cell[used]] > MOVING_SHARE) & mine
        shown[:, used] += mine
    yield moves
    yield shown
