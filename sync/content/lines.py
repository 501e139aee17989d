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
from sync.content.agreement import agreement, shifted

LINES = 64
"""That two cameras share, about"""
ANGLES = 720
"""Steps of the full turn in which the angles that two cameras share are found"""
MOVING_CELLS = 1.5
"""A line with more cells than this that change is in motion"""
LEAST_SHARE = 1e-3
"""Of a picture: less motion than that is as good as none"""
NEIGHBOURS = 10
"""Each camera is compared with so many of the nearest ones"""

Pair = tuple[int, int]
Agreements = dict[Pair, np.ndarray]
"""By pair of cameras what `agreement` says of them"""
Signals = tuple[np.ndarray, np.ndarray]
"""Of two cameras over time, float [T, n] each"""


class SharedLines:
    """What pairs of cameras tell over time, and how well that agrees wherever the cameras are moved in time.

    Of cameras that are among each other's nearest, whether anything moves on common lines, and how fast it crosses
    them. Of all, how much moves in their pictures, where it is not known how one stands.
    """

    def __init__(self, seen: Sequence[Activity], reach: int) -> None:
        self._there, self._reach = [one.there for one in seen], reach
        posed = all(one.posed for one in seen)
        self._kinds: list[dict[Pair, Signals]] = [{}, {}] if posed else [{}]
        for first, second in _pairs(seen):
            a, b = seen[first], seen[second]
            for kind, (one, other) in zip(self._kinds, _on_lines(a, b) if posed else [_courses(a, b)], strict=False):
                kind[first, second] = one.astype(np.float32), other.astype(np.float32)
        self._known: dict[tuple[int, ...], np.ndarray] = {}

    def agreements(self, places: np.ndarray) -> list[Agreements]:
        """Of each kind of signal if the cameras' pictures were so many instants later, int [C]."""
        return [self._agreements(kind, places) for kind in range(len(self._kinds))]

    def sharpest(self, places: np.ndarray) -> Agreements:
        """The same of the signal that is sharpest in time."""
        return self._agreements(len(self._kinds) - 1, places)

    def _agreements(self, kind: int, places: np.ndarray) -> Agreements:
        return {pair: self._agreement(kind, pair, places) for pair in self._kinds[kind]}

    def _agreement(self, kind: int, pair: Pair, places: np.ndarray) -> np.ndarray:
        moved = [int(places[camera]) for camera in pair]
        at = (kind, *pair, *moved)
        if at not in self._known:
            a, b = (shifted(signal, by) for signal, by in zip(self._kinds[kind][pair], moved, strict=True))
            there_a, there_b = (shifted(self._there[camera], by) for camera, by in zip(pair, moved, strict=True))
            self._known[at] = agreement(a, b, there_a, there_b, self._reach)
        return self._known[at]


def _pairs(seen: Sequence[Activity]) -> Iterator[Pair]:
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


def _courses(first: Activity, second: Activity) -> Signals:
    return _course(first), _course(second)


def _course(seen: Activity) -> np.ndarray:
    """By what factor the share of the picture that moves changes, as a logarithm: float64 [T, 1]."""
    moved = np.bincount(seen.instants, seen.shares, minlength=len(seen.there)) / seen.count
    level = np.log(moved[:, None] + LEAST_SHARE)
    return np.diff(level, axis=0, prepend=level[:1])


def _told_by(seen: Activity, line: np.ndarray, count: int, planes: np.ndarray) -> Signals:
    """Whether anything moves on each line, and the root, with its sign, of the mean rate of it, so that one throw does
    not drown all else. Cells near the axis, which turn by much for a small error, count little."""
    assert seen.rays is not None
    across, down = ((seen.rays[cell] - seen.rays[0]) @ planes for cell in (1, seen.width))  # to the next cell
    rays = seen.rays @ planes
    turning = np.stack([rays[:, 1] * step[0] - rays[:, 0] * step[1] for step in (across, down)], axis=1)  # by its flow
    inertia = np.square(rays).sum(axis=1)
    places = seen.instants * (count + 1) + line[seen.cells] + 1  # 0 of an instant: on no line
    turned = np.einsum("nk,nk->n", turning.astype(np.float32)[seen.cells], seen.flow)
    moved, turned, weight = (
        np.bincount(places, seen.shares * values, minlength=len(seen.there) * (count + 1))
        .reshape(-1, count + 1)[:, 1:]
        .astype(np.float64)
        for values in (np.float32(1), turned, inertia.astype(np.float32)[seen.cells])
    )
    rates = turned / np.where(weight > 0, weight, 1)
    known_by = np.minimum(1, moved / MOVING_CELLS)
    return (moved > MOVING_CELLS).astype(np.float64), np.sign(rates) * np.sqrt(np.abs(rates)) * known_by
