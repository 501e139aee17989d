"""How far each camera's pictures lie from the others', in instants, and how sure that is."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from sync.content.activity import Activity
from sync.content.agreement import BLOCKS, LEAST_OVERLAP, shifted
from sync.content.lines import Agreements, SharedLines

APART = 2 / 3
"""Offset in instants from which a camera is said to be off: a whole frame, less what is measured too little"""
SIGNIFICANCE = 3.0
"""Standard errors by which an offset must differ from what the times say: tens of cameras are looked at at once"""
DECIDED = 1 / SIGNIFICANCE
"""Standard error, in instants, up to which a camera's times are taken to be looked at: a whole frame would be named"""
SHORT_OF_A_FRAME = 2.0
"""Standard errors by which an offset must stay below a whole frame for the times to be confirmed"""
POOLED = 4
"""Of as many blocks the typical error of all cameras enters that of each, which few blocks tell roughly"""
MILDEST, MILDEST_MEAN = 0.8, 0.44
"""Share of the cameras, those nearest to 0, whose offsets tell how right their errors are, and the mean square that
these have in standard errors if they are"""
MOST_SCATTER = 2.0
"""Factor by which errors are enlarged at most: cameras that run freely scatter by parts of an instant"""
CLEAR = 1.75
"""Standard errors by which pictures must agree better at an offset than two instants beside, or it is chance"""
LEAST_ERROR = 0.02
LEAST_REACH = 3
"""Instants that must be tried to either side for an offset of one to have two beside it"""


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
        if self.windows < 1 or self.instants < 2 * BLOCKS or self.reach < LEAST_REACH:
            raise ValueError(
                f"a content check needs a window, of {2 * BLOCKS} instants or more, and a reach of {LEAST_REACH} or "
                f"more, since an offset is held against those two beside it; but content.windows is {self.windows}, "
                f"content.instants {self.instants}, content.reach {self.reach}"
            )


@dataclass(frozen=True)
class Offset:
    """How far a camera's pictures lie from the others', in instants: by what they show, and by their times."""

    instants: float
    """At instant t the camera shows what the others show at t + `instants`: its times are too small by so much"""
    error: float
    """Standard error, from instants and from cameras left out in turn, and how much the cameras scatter"""
    expected: float = 0.0
    """What its times say, by their residuals"""
    clear: float = np.inf
    """By how many standard errors pictures agree better there than two instants beside"""

    @property
    def by_chance(self) -> bool:
        """Whether pictures agree there no better than they do anywhere."""
        return self.clear < CLEAR

    @property
    def decided(self) -> bool:
        """Whether a whole frame would have been noticed, or more has been; what lies between is neither."""
        near = abs(self.away) + SHORT_OF_A_FRAME * self.error < 1
        return self.lies or (not self.by_chance and self.error <= DECIDED and near)

    @property
    def away(self) -> float:
        """By how many instants the times are too small."""
        return self.instants - self.expected

    @property
    def lies(self) -> bool:
        """Whether the pictures refute the times, by a frame or more."""
        return not self.by_chance and abs(self.away) > max(APART, SIGNIFICANCE * self.error)

    def to_json(self) -> dict[str, float]:
        return {key: round(value, 4) for key, value in asdict(self).items()}


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

    Most cameras are taken to be right: their median is 0. While any camera agrees better with the others elsewhere, the
    one that gains most is moved there, for who lies draws others along. Of cameras whose places nobody knows, how much
    moves in the whole picture is compared, which tells less.

    Args:
        seen: by camera, all of the same T instants.
        expected: offsets by the times, in instants; 0 where nothing is said.
        paired: whether the instants are paired by times that most cameras have right; else nothing is known of them.
    """
    names, cameras = tuple(seen), tuple(seen.values())
    instants = len(cameras[0].there) if cameras else 0
    farthest = int(instants * (1 - LEAST_OVERLAP))
    reach = min(reach, farthest)
    if reach < 1:
        return {}
    lines = SharedLines(cameras, farthest)
    pairs = lines.sharpest(np.zeros(len(names), np.int64))
    if not pairs:
        return {}
    start = np.zeros(len(names), np.int64) if paired else _grown(pairs, len(names), reach)
    places = _settle(pairs, start, reach, CLEAR if paired else 0.0)
    found = _measure(lines, places, reach, range(len(names)))
    usual = _usual([own.instants + places[camera] for camera, own in found.items()])
    said = [(expected or {}).get(name, 0.0) for name in names]
    told = _told(found, places - usual, said)
    told = _with_errors_of(told, _pooled([own.error for own in told.values()]))
    told = _with_errors_of(told, _scatter(told) * np.array([own.error for own in told.values()]))
    sure = [camera for camera, own in told.items() if own.decided]
    if len(sure) < len(told) and any(own.lies for own in told.values()):
        still = _told(_measure(lines, places, reach, sure), places - usual, said)
        still = {camera: replace(own, error=told[camera].error) for camera, own in still.items()}
        told |= {camera: _doubted(own) for camera, own in told.items() if own.lies and not _lies_in(still, camera)}
    return {names[camera]: own for camera, own in told.items()}


def _scatter(told: Mapping[int, Offset]) -> float:
    """By what factor cameras that do not lie scatter more than their errors say: few instants and partners that see
    the same things move tell too little of how sure an offset is. Two cameras do not tell it, so the most is taken."""
    if len(told) < 3:
        return MOST_SCATTER
    squares = sorted((own.away / own.error) ** 2 for own in told.values() if not own.lies)
    mildest = squares[: int(np.ceil(MILDEST * len(squares)))]
    return float(np.clip(np.sqrt(np.mean(mildest) / MILDEST_MEAN), 1.0, MOST_SCATTER)) if mildest else 1.0


def _pooled(errors: Sequence[float]) -> np.ndarray:
    """Errors [C] drawn towards the typical one: that of a camera comes from a few blocks of instants alone."""
    own, usual = np.array(errors), float(np.median(errors)) if errors else 0.0
    pooled: np.ndarray = np.sqrt(((BLOCKS - 1) * own**2 + POOLED * usual**2) / (BLOCKS - 1 + POOLED))
    return pooled


def _with_errors_of(told: Mapping[int, Offset], errors: np.ndarray) -> dict[int, Offset]:
    return {camera: replace(own, error=float(error)) for (camera, own), error in zip(told.items(), errors, strict=True)}


def _lies_in(found: Mapping[int, Offset], camera: int) -> bool:
    return camera in found and found[camera].lies


def _doubted(own: Offset) -> Offset:
    """Of a camera that lies only beside those of which nothing is told, one of which may lie in its stead."""
    return replace(own, clear=0.0)


def _usual(offsets: Sequence[float]) -> float:
    """By how much most cameras are off, that is, right: the median, of two in the middle the one nearer to 0."""
    ordered = sorted(offsets)
    return min(ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1], key=abs, default=0.0)


def _told(found: Mapping[int, Offset], moved: np.ndarray, said: Sequence[float]) -> dict[int, Offset]:
    """What is measured at places, by where the cameras were."""
    return {
        camera: replace(own, instants=float(own.instants + moved[camera]), expected=said[camera])
        for camera, own in found.items()
    }


def _measure(lines: SharedLines, places: np.ndarray, reach: int, among: Collection[int]) -> dict[int, Offset]:
    """Offsets of some cameras against each other that are left once each is moved to its place; those that no motion
    tells are missing."""
    shared = [
        {pair: levels for pair, levels in agreements.items() if set(pair) <= set(among)}
        for agreements in lines.agreements(places)
    ]
    still, found = np.zeros(len(places), np.int64), {}
    for camera in among:
        kinds = [against_others(agreements, camera, still) for agreements in shared]
        told = [(parts.sum(axis=0), _locate(_within(parts, reach), reach)) for parts in kinds if len(parts)]
        if told:
            found[camera] = _combined(told, reach)
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
        levels = {camera: _within(against_others(among, camera, places), reach).sum(axis=(0, 2)) for camera in waiting}
        best = max(waiting, key=lambda camera: float(levels[camera].max(initial=-1.0)))
        places[best] = int(levels[best].argmax()) - reach
        placed.add(best)
    return places


def _settle(agreements: Agreements, start: np.ndarray, reach: int, least: float) -> np.ndarray:
    """Whole offsets int64 [count] at which the cameras agree best: from a start, the one that gains most moves, until
    none gains by moving, by more than `least` standard errors."""
    places, count = start.copy(), len(start)
    for _ in range(4 * count):
        gains, goals = np.zeros(count), places.copy()
        for camera in range(count):
            levels = _within(against_others(agreements, camera, places).sum(axis=0), reach)
            if levels.any():
                goals[camera] = int(levels.sum(axis=1).argmax()) - reach
                gain = levels[goals[camera] + reach] - levels[places[camera] + reach]
                gains[camera] = gain.sum() if _sigmas(gain[None]) > least else 0.0
        if gains.max() <= 0:
            break
        places[gains.argmax()] = goals[gains.argmax()]
    return places


def _sigmas(parts: np.ndarray) -> float:
    """By how many standard errors the least of sums of [n, BLOCKS] differs from 0."""
    return float((parts.sum(axis=1) / np.maximum(np.sqrt(BLOCKS) * parts.std(axis=1, ddof=1), 1e-12)).min())


def against_others(agreements: Agreements, camera: int, places: np.ndarray) -> np.ndarray:
    """Agreement of a camera with each of the others where these are, by its own offset: [n, 2 farthest + 1, BLOCKS]."""
    found, offsets = [], max(map(len, agreements.values()), default=1)
    for (first, second), levels in agreements.items():
        if camera in (first, second) and levels.any():
            own, other = (levels, second) if camera == first else (levels[::-1], first)
            found.append(shifted(own, int(places[other])))
    return np.array(found).reshape(-1, offsets, BLOCKS)


def _within(levels: np.ndarray, reach: int) -> np.ndarray:
    """Of levels [..., 2 farthest + 1, BLOCKS] those up to an offset."""
    middle = levels.shape[-2] // 2
    return levels[..., middle - reach : middle + reach + 1, :]


def _locate(own: np.ndarray, reach: int) -> Offset:
    """The peak of [n, 2 reach + 1, BLOCKS], to parts of an instant, and its error by jackknife."""
    whole = own.sum(axis=(0, 2))
    blocks, partners = own.sum(axis=0), own.sum(axis=2)
    by_time = [_peak(whole - blocks[:, block]) for block in range(BLOCKS)]
    by_partner = [_peak(whole - partner) for partner in partners] if len(own) > 1 else []
    error = max(LEAST_ERROR, _jackknife(by_time), _jackknife(by_partner))
    return Offset(_peak(whole) - reach, error)


def _combined(told: Sequence[tuple[np.ndarray, Offset]], reach: int) -> Offset:
    """Mean of what kinds of signals tell, levels [2 farthest + 1, BLOCKS] and offset each, by their errors; less sure
    the more they disagree."""
    weights = np.array([own.error**-2 for _, own in told])
    offsets = np.array([own.instants for _, own in told])
    mean = float(weights @ offsets / weights.sum())
    apart = float(weights @ (offsets - mean) ** 2) / max(1, len(told) - 1)
    error = float(np.sqrt(max(1.0, apart) / weights.sum()))
    tops = [float(_within(levels, reach).sum(axis=1).max()) for levels, _ in told]
    heights = [top if top > 0 else np.inf for top in tops]  # what agrees nowhere tells nothing
    whole = sum(weight / height * levels for weight, height, (levels, _) in zip(weights, heights, told, strict=True))
    return Offset(mean, error, clear=_clearness(whole, round(mean)) if abs(round(mean)) <= reach - 2 else 0.0)


def _clearness(levels: np.ndarray, offset: int) -> float:
    """By how many standard errors [2 farthest + 1, BLOCKS] is larger at an offset than at two more and two less; 0 if
    it is largest anywhere else, maybe beyond what is looked for: of a few offsets one agrees best by chance, too."""
    top = offset + len(levels) // 2
    if abs(int(levels.sum(axis=1).argmax()) - top) > 1:
        return 0.0
    return _sigmas(levels[top] - levels[[top - 2, top + 2]])


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
