"""How far each camera's pictures lie from the others', in instants, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sync.content.activity import Activity
from sync.content.agreement import BLOCKS, LEAST_OVERLAP
from sync.content.barcodes import Agreements, compare_pairs
from sync.content.hull import compare_with_hull

HULL_WEIGHT = 10.0
"""What the hull of all others counts against the barcodes of one other camera"""
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

    Most cameras are taken to be right: the offset that most have is 0. Whoever lies most surely is moved, until nobody
    does. Of cameras whose places nobody knows, how much moves in the whole picture is compared, which tells less.

    Args:
        seen: by camera, all of the same T instants.
        expected: offsets by the times, in instants; 0 where nothing is said.
        paired: whether the instants are paired by times that most cameras have right; else nothing is known of them.
    """
    names, cameras = tuple(seen), tuple(seen.values())
    instants = len(cameras[0].there) if cameras else 0
    reach = min(reach, int(instants * (1 - LEAST_OVERLAP)))
    if reach < 1:
        return {}
    places = np.zeros(len(names), np.int64)
    if not paired:
        pairs = compare_pairs(cameras, reach)
        if not pairs:
            return {}
        places = _settle(pairs, _grown(pairs, len(names), reach), reach)
    for _ in range(len(names)):
        found = _measure(cameras, places, reach)
        camera = max(found, key=lambda one: _sureness(found[one]), default=None)
        if camera is None or _sureness(found[camera]) <= 0:
            break
        places[camera] += round(found[camera].instants)
    else:
        found = _measure(cameras, places, reach)
    values, counts = np.unique(places, return_counts=True)
    usual = min(values[counts == counts.max()], key=abs)
    return {
        names[camera]: Offset(
            float(own.instants + places[camera] - usual), own.error, (expected or {}).get(names[camera], 0.0)
        )
        for camera, own in found.items()
    }


def _sureness(own: Offset) -> float:
    """By how many errors a camera lies; 0 where it does not."""
    return abs(own.away) / own.error if own.lies else 0.0


def _measure(cameras: Sequence[Activity], places: np.ndarray, reach: int) -> dict[int, Offset]:
    """Offsets that are left once each camera is moved to its place; those that no motion tells are missing."""
    moved = [one.later(int(place)) for one, place in zip(cameras, places, strict=True)]
    pairs, still = compare_pairs(moved, reach), np.zeros(len(cameras), np.int64)
    found = {}
    for camera, hull in enumerate(compare_with_hull(moved, reach)):
        parts = against_others(pairs, camera, still, reach)
        if hull.any():
            parts = np.concatenate([parts, HULL_WEIGHT * hull[None]])
        if len(parts):
            found[camera] = _locate(parts, reach)
    return found


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
        levels = {camera: against_others(among, camera, places, reach).sum(axis=(0, 2)) for camera in waiting}
        best = max(waiting, key=lambda camera: float(levels[camera].max(initial=-1.0)))
        places[best] = int(levels[best].argmax()) - reach
        placed.add(best)
    return places


def _settle(agreements: Agreements, start: np.ndarray, reach: int) -> np.ndarray:
    """Whole offsets int64 [count] at which the cameras agree best: from a start, the one that gains most moves, until
    none gains by moving."""
    places, count = start.copy(), len(start)
    for _ in range(4 * count):
        gains, goals = np.zeros(count), places.copy()
        for camera in range(count):
            levels = against_others(agreements, camera, places, reach).sum(axis=(0, 2))
            if levels.any():
                goals[camera] = int(levels.argmax()) - reach
                gains[camera] = levels.max() - levels[places[camera] + reach]
        if gains.max() <= 0:
            break
        places[gains.argmax()] = goals[gains.argmax()]
    return places


def against_others(agreements: Agreements, camera: int, places: np.ndarray, reach: int) -> np.ndarray:
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


def _locate(own: np.ndarray, reach: int) -> Offset:
    """The peak of [n, 2 reach + 1, BLOCKS], to parts of an instant, and its error by jackknife."""
    whole = own.sum(axis=(0, 2))
    blocks, partners = own.sum(axis=0), own.sum(axis=2)
    by_time = [_peak(whole - blocks[:, block]) for block in range(BLOCKS)]
    by_partner = [_peak(whole - partner) for partner in partners] if len(own) > 1 else []
    error = max(LEAST_ERROR, _jackknife(by_time), _jackknife(by_partner))
    return Offset(_peak(whole) - reach, error)


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
