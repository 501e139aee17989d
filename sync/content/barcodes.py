"""Motion barcodes: what moves on lines that two cameras share.

A point and two cameras span a plane. Whatever moves in it is seen on one line of each picture, so over time the two
lines tell the same story of motion and rest: Ben-Artzi, Halperin, Werman and Peleg, "Epipolar Geometry Based On Line
Similarity" (2016). No point has to be found in both pictures, and cameras that face each other serve as well as
neighbours.
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


def compare_pairs(seen: Sequence[Activity], reach: int) -> Agreements:
    """Of cameras that are among each other's nearest; of all where it is not known how one stands."""
    found: Agreements = {}
    for first, second in _pairs([one.centre for one in seen]):
        barcodes = _barcodes(seen[first], seen[second])
        if barcodes is not None:
            found[first, second] = agreement(*barcodes, seen[first].there, seen[second].there, reach)
    return found


def _pairs(places: Sequence[np.ndarray | None]) -> Iterator[tuple[int, int]]:
    if any(place is None for place in places):
        yield from combinations(range(len(places)), 2)
        return
    centres = np.array(places)
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    ranks = np.argsort(np.argsort(distances, axis=1, kind="stable"), axis=1, kind="stable")
    for first, second in combinations(range(len(centres)), 2):
        if min(ranks[first, second], ranks[second, first]) <= NEIGHBOURS and distances[first, second] > 0:
            yield first, second


def _barcodes(first: Activity, second: Activity) -> tuple[np.ndarray, np.ndarray] | None:
    """Motion of common lines over time, float64 [T, lines] of 0 and 1; None where the cameras share too few lines.

    Without places one line each: the course of how much moves in the whole picture.
    """
    if first.rays is None or second.rays is None or first.centre is None or second.centre is None:
        return _course(first), _course(second)
    axis = (second.centre - first.centre) / np.linalg.norm(second.centre - first.centre)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    planes = np.stack([across, np.cross(axis, across)], axis=1)
    angles = [np.arctan2(*(one.rays @ planes).T) for one in (first, second)]
    steps = [((angle / (2 * np.pi) + 0.5) * ANGLES).astype(np.int64) % ANGLES for angle in angles]
    shared = np.logical_and(*(np.bincount(step, minlength=ANGLES) > 0 for step in steps))
    if shared.sum() < 4:
        return None
    width = -(-int(shared.sum()) // LINES)
    line = np.where(shared, (np.cumsum(shared) - 1) // width, -1)
    count = int(line.max()) + 1
    return tuple(_barcode(one, line[step], count) for one, step in zip((first, second), steps, strict=True))  # type: ignore[return-value]  # of two


def _course(seen: Activity) -> np.ndarray:
    """By what factor the share of the picture that moves changes, as a logarithm: float64 [T, 1]."""
    level = np.log(seen.moving.mean(axis=1, dtype=np.float64, keepdims=True) + LEAST_SHARE)
    return np.diff(level, axis=0, prepend=level[:1])


def _barcode(seen: Activity, line: np.ndarray, count: int) -> np.ndarray:
    instants, cells, shares = seen.changes
    lines = line[cells]
    known = lines >= 0
    places = instants[known] * count + lines[known]
    moved = np.bincount(places, shares[known], minlength=len(seen.moving) * count)
    barcode: np.ndarray = (moved > MOVING_CELLS).astype(np.float64).reshape(-1, count)
    return barcode
