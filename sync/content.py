"""Whether pictures that are paired show the same moment: how far each camera's lie from the others', by what moves.

A point and two cameras span a plane. Whatever moves in it is seen on one line of each picture, so over time the two
lines tell the same story of motion and rest: the motion barcodes of Ben-Artzi, Halperin, Werman and Peleg, "Epipolar
Geometry Based On Line Similarity" (2016). Shifted by the right number of frames the barcodes of two cameras agree best;
no point has to be found in both pictures, and cameras that face each other serve as well as neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

LINES = 64
"""Lines of a barcode, about"""
ANGLES = 720
"""Steps of the full turn in which the angles that two cameras share are found"""
MOVING_CELLS = 1.5
"""A line with more cells than this that change is in motion"""
BLOCKS = 8
"""Of instants that are left out in turn, which tells how sure an offset is"""
LEAST_SHARE = 1e-3
"""Of a picture: less motion than that is as good as none"""
WHILE = 21
"""Instants over which a mean is taken that slow changes of how much moves do not enter"""
NEIGHBOURS = 10
"""Each camera is compared with so many of the nearest ones"""
LEAST_OVERLAP = 0.5
"""Share of its instants that two cameras must have in common at an offset that is tried"""
DECIDED = 1 / 3
"""Standard error, in instants, up to which an offset is told: three of them make one frame"""
APART = 0.5
"""Offset in instants from which another frame would have been nearer"""
SIGNIFICANCE = 3.0
"""Standard errors by which an offset must differ from what the times say"""
LEAST_ERROR = 0.02


@dataclass(frozen=True)
class ContentOptions:
    """How pictures that are paired are compared."""

    enabled: bool = True
    windows: int = 3
    """Stretches of a long sequence that are looked at, where most moves"""
    instants: int = 200
    """Length of each; a sequence that is hardly longer than them is looked at as a whole"""
    reach: int = 12
    """Farthest offset that is tried, in instants"""

    def __post_init__(self) -> None:
        if min(self.windows, self.reach) < 1 or self.instants < 2 * BLOCKS:
            raise ValueError(
                f"a content check needs a window, of {2 * BLOCKS} instants or more, and a reach, each of 1 or more: "
                f"{self.windows=}, {self.instants=}, {self.reach=}"
            )


@dataclass(frozen=True, eq=False)
class Activity:
    """Where the pictures of one camera change from instant to instant, in the cells of a coarse grid."""

    moving: np.ndarray
    """float32 [T, P]: share of each cell that changed since the instant before"""
    there: np.ndarray
    """bool [T]: whether the camera has a picture at this instant and the one before"""
    centre: np.ndarray | None = None
    """float64 [3], world axes; None where nobody knows how the cameras stand"""
    rays: np.ndarray | None = None
    """float64 [P, 3]: through the middles of the cells, world axes, of any length; likewise"""

    @cached_property
    def changes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Instants and cells [n] where something moves, and the shares of these cells."""
        instants, cells = np.nonzero(self.moving)
        return instants, cells, self.moving[instants, cells]


@dataclass(frozen=True)
class Offset:
    """How far a camera's pictures lie from the others', in instants: by what they show, and by their times."""

    instants: float
    """At instant t the camera shows what the others show at t + `instants`: its times are too small by so much"""
    error: float
    """Standard error, from instants and from cameras left out in turn"""
    expected: float = 0.0
    """What its times say, by their residuals"""

    @property
    def decided(self) -> bool:
        """Whether a whole frame would have been noticed."""
        return self.error <= DECIDED

    @property
    def away(self) -> float:
        """By how many instants the times are too small."""
        return self.instants - self.expected

    @property
    def lies(self) -> bool:
        """Whether the pictures refute the times, by half a frame or more."""
        return self.decided and abs(self.away) > max(APART, SIGNIFICANCE * self.error)

    def to_json(self) -> dict[str, float]:
        return {"instants": round(self.instants, 4), "error": round(self.error, 4), "expected": round(self.expected, 4)}


@dataclass(frozen=True)
class Window:
    """What one stretch of a sequence tells."""

    first: int
    last: int
    """Instants of the sequence"""
    offsets: Mapping[str, Offset]


@dataclass(frozen=True)
class Content:
    """How far the cameras' pictures lie from one another, as far as they tell."""

    cameras: tuple[str, ...]
    windows: tuple[Window, ...]

    @property
    def undecided(self) -> tuple[str, ...]:
        """Cameras of which no stretch tells whether they are a frame off."""
        told = {name for window in self.windows for name, offset in window.offsets.items() if offset.decided}
        return tuple(name for name in self.cameras if name not in told)

    def worst(self, camera: str) -> tuple[Window, Offset] | None:
        """The stretch whose pictures say most against a camera's times, or for them; None where none tells."""
        told = [(window, own) for window in self.windows if (own := window.offsets.get(camera)) and own.decided]
        return max(told, key=lambda item: (item[1].lies, abs(item[1].away))) if told else None


def find_offsets(
    seen: Mapping[str, Activity],
    reach: int,
    expected: Mapping[str, float] | None = None,
    *,
    paired: bool = True,
) -> dict[str, Offset]:
    """Offset of each camera against the others, up to `reach` instants either way; cameras that share no motion with
    another are missing.

    Most cameras are taken to be right: the offset that most have is 0. Of cameras whose places nobody knows, how much
    moves in the whole picture is compared, which tells less.

    Args:
        seen: by camera, all of the same T instants.
        expected: offsets by the times, in instants; 0 where nothing is said.
        paired: whether the instants are paired by times that most cameras have right; else nothing is known of them.
    """
    names = tuple(seen)
    instants = len(next(iter(seen.values())).there) if seen else 0
    reach = min(reach, int(instants * (1 - LEAST_OVERLAP)))
    if reach < 1:
        return {}
    agreements = _agreements(tuple(seen.values()), reach)
    if not agreements:
        return {}
    start = np.zeros(len(names), np.int64) if paired else _grown(agreements, len(names), reach)
    places = _settle(agreements, start, reach)
    found = {}
    for camera, name in enumerate(names):
        own = _against_others(agreements, camera, places, reach)
        if len(own):
            found[name] = _locate(own, reach, (expected or {}).get(name, 0.0))
    return found


Agreements = dict[tuple[int, int], np.ndarray]
"""By pair of cameras, float64 [2 reach + 1, BLOCKS]: how well the second one's barcodes agree with the first one's if
it shows them so many instants later, from -reach on, by blocks of instants"""


def _agreements(seen: Sequence[Activity], reach: int) -> Agreements:
    found: Agreements = {}
    for first, second in _pairs([one.centre for one in seen]):
        barcodes = _barcodes(seen[first], seen[second])
        if barcodes is not None:
            found[first, second] = _agreement(*barcodes, seen[first].there, seen[second].there, reach)
    return found


def _pairs(places: Sequence[np.ndarray | None]) -> Iterator[tuple[int, int]]:
    """Of cameras that are among each other's nearest; all where one's place is unknown."""
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


def _agreement(
    first: np.ndarray, second: np.ndarray, there_first: np.ndarray, there_second: np.ndarray, reach: int
) -> np.ndarray:
    """Normalized correlation at each offset, in parts that add up, [2 reach + 1, BLOCKS]; 0 without any change."""
    a, b = _centred(first, there_first), _centred(second, there_second)
    scale = np.sqrt((a * a).sum() * (b * b).sum())
    products, count = a @ b.T, len(a)
    found = np.zeros((2 * reach + 1, BLOCKS))
    if not scale:
        return found
    both = there_first.sum() * there_second.sum() / count
    for offset in range(-reach, reach + 1):
        start = max(0, -offset)
        along = products.diagonal(offset)
        blocks = np.arange(start, start + len(along)) * BLOCKS // count
        overlap = int((there_first[start : start + len(along)] & there_second[start + offset :][: len(along)]).sum())
        if overlap >= LEAST_OVERLAP * both:
            found[offset + reach] = np.bincount(blocks, along, minlength=BLOCKS) * (both / (scale * overlap))
    return found


def _centred(barcode: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Less the mean of each line over a while, 0 at instants without a picture."""
    known = np.where(there[:, None], barcode, 0.0)
    sums = np.concatenate([np.zeros((1, barcode.shape[1] + 1)), np.cumsum(np.column_stack([known, there]), axis=0)])
    middle = np.arange(len(there))
    first, stop = np.maximum(middle - WHILE // 2, 0), np.minimum(middle + WHILE // 2 + 1, len(there))
    around = sums[stop] - sums[first]
    return np.where(there[:, None], known - around[:, :-1] / np.maximum(around[:, -1:], 1), 0.0)


def _grown(agreements: Agreements, count: int, reach: int) -> np.ndarray:
    """Whole offsets int64 [count]: from the two cameras that agree best on, the one that agrees best with those that
    are placed is placed next."""
    places, placed = (
        np.zeros(count, np.int64),
        {max(agreements, key=lambda pair: agreements[pair].sum(axis=1).max())[0]},
    )
    while len(placed) < count:
        among = {pair: levels for pair, levels in agreements.items() if len(placed & set(pair)) == 1}
        waiting = sorted({camera for pair in among for camera in pair} - placed)
        if not waiting:
            break  # the rest shares nothing with them
        levels = {camera: _against_others(among, camera, places, reach).sum(axis=(0, 2)) for camera in waiting}
        best = max(waiting, key=lambda camera: float(levels[camera].max(initial=-1.0)))
        places[best] = int(levels[best].argmax()) - reach
        placed.add(best)
    return places


def _settle(agreements: Agreements, start: np.ndarray, reach: int) -> np.ndarray:
    """Whole offsets int64 [count] at which the cameras agree best: from a start, the one that gains most moves, until
    none gains by moving. The offset that most of them have is 0."""
    places, count = start.copy(), len(start)
    for _ in range(4 * count):
        gains, goals = np.zeros(count), places.copy()
        for camera in range(count):
            levels = _against_others(agreements, camera, places, reach).sum(axis=(0, 2))
            if levels.any():
                goals[camera] = int(levels.argmax()) - reach
                gains[camera] = levels.max() - levels[places[camera] + reach]
        if gains.max() <= 0:
            break
        places[gains.argmax()] = goals[gains.argmax()]
    values, counts = np.unique(places, return_counts=True)
    usual = min(values[counts == counts.max()], key=abs)
    settled: np.ndarray = np.clip(places - usual, -reach, reach)
    return settled


def _against_others(agreements: Agreements, camera: int, places: np.ndarray, reach: int) -> np.ndarray:
    """Agreement of a camera with each of the others where these are, by its own offset: [n, 2 reach + 1, BLOCKS]."""
    found = []
    for (first, second), levels in agreements.items():
        if camera in (first, second) and levels.any():
            own, other = (levels, second) if camera == first else (levels[::-1], first)
            found.append(_shifted(own, int(places[other])))
    return np.array(found).reshape(-1, 2 * reach + 1, BLOCKS)


def _shifted(levels: np.ndarray, by: int) -> np.ndarray:
    """Rows moved down by so many; 0 comes in."""
    moved = np.zeros_like(levels)
    if by >= 0:
        moved[by:] = levels[: len(levels) - by]
    else:
        moved[:by] = levels[-by:]
    return moved


def _locate(own: np.ndarray, reach: int, expected: float) -> Offset:
    """The peak of [n, 2 reach + 1, BLOCKS], to parts of an instant, and its error by jackknife."""
    whole = own.sum(axis=(0, 2))
    blocks, partners = own.sum(axis=0), own.sum(axis=2)
    by_time = [_peak(whole - blocks[:, block]) for block in range(BLOCKS)]
    by_partner = [_peak(whole - partner) for partner in partners] if len(own) > 1 else []
    error = max(LEAST_ERROR, _jackknife(by_time), _jackknife(by_partner))
    return Offset(_peak(whole) - reach, error, expected)


def _peak(levels: np.ndarray) -> float:
    """Where the largest of [n] levels lies, by a parabola through it and its neighbours."""
    top = int(levels.argmax())
    if top in (0, len(levels) - 1):
        return float(top)
    before, at, after = levels[top - 1 : top + 2]
    bend = before - 2 * at + after
    return float(top + 0.5 * (before - after) / bend) if bend < 0 else float(top)


def _jackknife(estimates: Sequence[float]) -> float:
    """Standard error of what was estimated with one part left out in turn; 0 for a single one."""
    count = len(estimates)
    return float(np.sqrt((count - 1) * np.var(estimates))) if count > 1 else 0.0
