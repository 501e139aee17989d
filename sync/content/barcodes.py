"""What moves on lines that two cameras share.

A point and two cameras span a plane. Whatever moves in it is seen on one line of each picture, so over time the two
lines tell the same story of motion and rest: Ben-Artzi, Halperin, Werman and Peleg, "Epipolar Geometry Based On Line
Similarity" (2016). A plane that follows a point turns about the axis through both cameras, and each sees by how much:
the lines tell the same story of speeds, too, with signs, which is sharper in time than where something moves at all. No
point has to be found in both pictures, and cameras that face each other serve as well as neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from sync.content.activity import Activity
from sync.content.agreement import agreement

LINES = 64
"""Lines of a barcode, about"""
ANGLES = 720
"""Steps of the full turn in which the angles that two cameras share are found"""
MOVING_CELLS = 1.5
"""A line with more cells than this that change is in motion"""
LEAST_SHARE = 1e-3
"""Of a picture: less motion than that is as good as none"""
NEIGHBOURS = 10
"""Each camera is compared with so many of the nearest ones"""

Agreements = dict[tuple[int, int], np.ndarray]
"""By pair of cameras what `agreement` says of them"""
Signals = tuple[np.ndarray, np.ndarray]
"""Of two cameras over time, float64 [T, n] each"""


def compare_pairs(seen: Sequence[Activity], reach: int) -> list[Agreements]:
    """Of cameras that are among each other's nearest by what moves on common lines, and by how fast it crosses them.

    Of all by how much moves in their pictures, where it is not known how one stands.
    """
    posed = all(one.posed for one in seen)
    kinds: list[Agreements] = [{}, {}] if posed else [{}]
    for first, second in _pairs(seen):
        a, b = seen[first], seen[second]
        for kind, signals in zip(kinds, _on_lines(a, b) if posed else [(_course(a), _course(b))], strict=False):
            kind[first, second] = agreement(*signals, a.there, b.there, reach)
    return kinds


def _pairs(seen: Sequence[Activity]) -> Iterator[tuple[int, int]]:
    if not all(one.posed for one in seen):
        yield from combinations(range(len(seen)), 2)
        return
    centres = np.array([one.centre for one in seen])
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    ranks = np.argsort(np.argsort(distances, axis=1, kind="stable"), axis=1, kind="stable")
    for first, second in combinations(range(len(centres)), 2):
        if min(ranks[first, second], ranks[second, first]) <= NEIGHBOURS and distances[first, second] > 0:
            yield first, second


def _on_lines(first: Activity, second: Activity) -> list[Signals]:
    """Whether anything moves on common lines, 0 or 1, and the roots of the rates at which it turns about the axis
    through both cameras; nothing where they share too few lines."""
    assert first.centre is not None
    assert second.centre is not None
    assert first.rays is not None
    assert second.rays is not None
    axis = (second.centre - first.centre) / np.linalg.norm(second.centre - first.centre)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    planes = np.stack([across, np.cross(axis, across)], axis=1)
    angles = [np.arctan2(*(one.rays @ planes).T) for one in (first, second)]
    steps = [((angle / (2 * np.pi) + 0.5) * ANGLES).astype(np.int64) % ANGLES for angle in angles]
    shared = np.logical_and(*(np.bincount(step, minlength=ANGLES) > 0 for step in steps))
    if shared.sum() < 4:
        return []
    width = -(-int(shared.sum()) // LINES)
    line = np.where(shared, (np.cumsum(shared) - 1) // width, -1)
    count = int(line.max()) + 1
    told = [_told_by(one, line[step], count, planes) for one, step in zip((first, second), steps, strict=True)]
    return list(zip(*told, strict=True))


def _course(seen: Activity) -> np.ndarray:
    """By what factor the share of the picture that moves changes, as a logarithm: float64 [T, 1]."""
    moved = np.bincount(seen.instants, seen.shares, minlength=len(seen.there)) / seen.count
    level = np.log(moved[:, None] + LEAST_SHARE)
    return np.diff(level, axis=0, prepend=level[:1])


def _told_by(seen: Activity, line: np.ndarray, count: int, planes: np.ndarray) -> Signals:
    """Whether anything moves on each line, and the root, with its sign, of the mean rate of it, so that one throw does
    not drown all else. Cells near the axis, which turn by much for a small error, count little."""
    assert seen.rays is not None
    lines = line[seen.cells]
    known = lines >= 0
    places, shares = seen.instants[known] * count + lines[known], seen.shares[known]
    steps = np.stack([seen.rays[1], seen.rays[seen.width]]) - seen.rays[0]  # to the next cell across and down
    rays, motion = seen.rays[seen.cells[known]] @ planes, seen.flow[known] @ steps @ planes
    turned = rays[:, 1] * motion[:, 0] - rays[:, 0] * motion[:, 1]
    moved, turning, inertia = (
        np.bincount(places, weights, minlength=len(seen.there) * count).reshape(-1, count)
        for weights in (shares, shares * turned, shares * np.square(rays).sum(axis=1))
    )
    rates = turning / np.where(inertia > 0, inertia, 1)
    known_by = np.minimum(1, moved / MOVING_CELLS)
    return (moved > MOVING_CELLS).astype(np.float64), np.sign(rates) * np.sqrt(np.abs(rates)) * known_by
