"""Refine a rig by all matches of several instants at once, where that helps matches that the fit did not see.

Matches found without the poses chain into tracks. Half of the tracks adjust the cameras, the other half judges them,
and the other way round. Poses alone are freed first, then focal lengths, principal points and distortion; what more
freedom does not gain on unseen tracks stays as it was given, and a rig that gains nothing stays to the byte.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from calibration.accept import PairMatches
from calibration.adjust import AdjustOptions, adjust
from calibration.multiview import Sightings, misses_px
from calibration.repair import FOCAL, LENS, POINT, POSE
from calibration.rig import Camera, Rig
from calibration.tracks import Link, chain

SOLVED = AdjustOptions(turn_deg=3.0, shift=0.1, focal=0.1, point=0.02, lens=0.1)
"""How far COLMAP may be off, which keeps principal points in the middle"""
PLACES = ((POSE,),)
"""Where lenses are known"""
LEVELS = ((POSE,), (POSE, FOCAL), (POSE, FOCAL, POINT), (POSE, FOCAL, POINT, LENS))


@dataclass(frozen=True)
class RefineOptions:
    """When a refined rig is taken, and what is said of it."""

    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    """How far the cameras are thought to be off"""
    most_tracks: int = 4000
    """Of more, evenly chosen; time grows with them"""
    least_tracks: int = 30
    """Of each camera in each half, at least; a rig one of whose cameras has fewer stays as it is"""
    gain: float = 0.03
    """Share by which unseen tracks must lie nearer, at least"""
    level_gain: float = 0.01
    """Likewise, for more kinds of numbers to be freed"""
    sure: float = 4.0
    """Standard errors by which the gain must differ from none, in each half"""
    far: float = 0.02
    """A camera of a given rig that moves by more than this share of the rig's radius is a finding ..."""
    far_deg: float = 1.0
    """... and one that turns by more than this"""
    unsure: float = 0.01
    """And one whose place the two halves tell differently by more than twice this share of the radius"""
    swaying: float = 0.004
    """And, of a rig that was solved without known lenses, one that goes by more than this share of the radius when
    lenses are freed (`sway`). The freed ones are off by 0.6 % themselves, so beyond this 1 % is not kept: in
    "basketball" all 13 cameras off by more than that go by 0.58 % or more"""

    def __post_init__(self) -> None:
        if self.least_tracks < 1 or not 0 <= self.level_gain <= self.gain < 1 or self.sure < 0:
            raise ValueError(f"tracks, gains and standard errors must be positive, and gains shares: {self}")


@dataclass(frozen=True)
class Change:
    """What became of a camera."""

    moved: float
    """Distance from where it was, share of the rig's radius"""
    turned_deg: float
    focal: float
    """New focal length by the given one"""
    point_px: float
    """Way of the principal point"""
    unsure: float
    """How far its place may be off by what the two halves of the tracks say, share of the rig's radius"""


@dataclass(frozen=True)
class Refinement:
    """The receipt of a refinement."""

    rig: Rig
    """The given one where nothing was freed"""
    reason: str
    """For people"""
    freed: tuple[str, ...]
    """Kinds of numbers that were adjusted, of all cameras; none: the rig stays as given"""
    tracks: int
    gains: Mapping[str, float]
    """By what was freed, share by which unseen tracks lie nearer than with the given rig; negative: farther"""
    medians_px: tuple[float | None, float | None]
    """Of unseen sightings, with the given rig and with `rig`"""
    cameras: Mapping[str, Change]

    def declined(self, given: Rig, why: str) -> Refinement:
        """The same attempt, of which nothing is used."""
        return replace(self, rig=given, reason=why, freed=(), cameras={})

    def told(self, options: RefineOptions) -> dict[str, str]:
        """What people must know of single cameras."""
        found = {}
        for name, change in self.cameras.items():
            said = []
            if change.moved > options.far or change.turned_deg > options.far_deg:
                said.append(
                    f"was moved by {change.moved:.1%} of the rig's radius and turned by {change.turned_deg:.2f} "
                    "degrees, since matches that this adjustment did not see then fit better (rig.refine)"
                )
            if change.unsure > options.unsure:
                said.append(
                    f"stands where it does only to {change.unsure:.1%} of the rig's radius: one half of the matches "
                    "places it elsewhere than the other"
                )
            if said:
                found[name] = "; it ".join(said)
        return found

    def to_json(self) -> dict[str, Any]:
        names = (one.name for one in fields(self) if one.name not in ("rig", "cameras"))
        cameras = {name: asdict(change) for name, change in self.cameras.items()}
        return {**{name: getattr(self, name) for name in names}, "cameras": cameras}


def refine(
    rig: Rig,
    evidence: Sequence[PairMatches],
    *,
    levels: Sequence[tuple[str, ...]] = LEVELS,
    options: RefineOptions = RefineOptions(),
) -> Refinement:
    """Adjust the rig to verified matches of one instant or several (`triangulate.verified_matches`).

    The world stays where the given cameras have it, in place, orientation and scale. Deterministic.
    """
    sightings = _thinned(tracks(rig, evidence), options.most_tracks)
    side = sightings.point % 2
    halves = [sightings.only(side == which) for which in (0, 1)]
    few = _few(rig, halves, options.least_tracks)
    if few:
        return Refinement(rig, f"too few matches show {', '.join(few)}", (), len(sightings.views), {}, (None, None), {})
    # What neither poses alone nor all numbers gain, those between do not either.
    trials = {kinds: _trial(rig, halves, kinds, options) for kinds in dict.fromkeys((levels[0], levels[-1]))}
    if _chosen(list(trials.values()), options) is not None:
        trials = {kinds: trials.get(kinds) or _trial(rig, halves, kinds, options) for kinds in levels}
    best = _chosen(list(trials.values()), options)
    gains = {" and ".join(kinds): trial.gain for kinds, trial in trials.items()}
    if best is None:
        first = trials[levels[0]]
        reason = f"matches that the fit does not see lie {first.before_px:.3f} px off, and {first.after_px:.3f} refined"
        return Refinement(rig, reason, (), len(sightings.views), gains, (first.before_px, first.before_px), {})
    refined = aligned(adjust(rig, sightings, best.kinds, options=options.adjust), rig)
    reason = f"matches that the fit does not see lie {best.after_px:.3f} px off, {best.before_px:.3f} as given"
    changes = _changes(rig, refined, best)
    pixels = (best.before_px, best.after_px)
    refined = replace(refined, source=f"{rig.source}; refined ({', '.join(best.kinds)}): {reason}")
    return Refinement(refined, reason, best.kinds, len(sightings.views), gains, pixels, changes)


def sway(rig: Rig, evidence: Sequence[PairMatches], *, options: RefineOptions = RefineOptions()) -> dict[str, float]:
    """How far each camera goes, as a share of the rig's radius, when all that is not known of its lens is freed.

    A mapper keeps principal points in the middle. Lenses that explain the matches as well may have others, and their
    cameras then stand elsewhere: no more is known of their places.
    """
    sightings = _thinned(tracks(rig, evidence), options.most_tracks)
    freed = aligned(adjust(rig, sightings, LEVELS[-1], options=options.adjust), rig)
    apart = np.linalg.norm(freed.centres - rig.centres, axis=1) / _radius(rig)
    return dict(zip(rig.names, apart.tolist(), strict=True))


@dataclass(frozen=True)
class _Trial:
    """What adjusting each half of the tracks does for the other one."""

    kinds: tuple[str, ...]
    fits: tuple[Rig, ...]
    before_px: float
    after_px: float
    errors_px: np.ndarray
    """Of unseen tracks with the fits"""
    sure: float
    """Standard errors by which the less sure half gains"""

    @property
    def gain(self) -> float:
        return 1 - self.after_px / max(self.before_px, 1e-9)


def _trial(rig: Rig, halves: Sequence[Sightings], kinds: tuple[str, ...], options: RefineOptions) -> _Trial:
    fits = tuple(aligned(adjust(rig, half, kinds, options=options.adjust), rig) for half in halves)
    before = [misses_px(rig, half) for half in halves[::-1]]
    after = [misses_px(fit, half) for fit, half in zip(fits, halves[::-1], strict=True)]
    one, two = (float(np.median(np.concatenate(errors))) for errors in (before, after))
    sure = min(_sure(a, b, max(min(one, two), 0.02)) for a, b in zip(before, after, strict=True))
    return _Trial(kinds, fits, one, two, np.concatenate(after), sure)


def _sure(before: np.ndarray, after: np.ndarray, scale_px: float) -> float:
    """Standard errors by which the mean robust cost falls, of the same tracks before and after."""
    fall = np.log1p((before / scale_px) ** 2) - np.log1p((after / scale_px) ** 2)
    return float(fall.mean() / max(fall.std() / np.sqrt(len(fall)), 1e-12))


def _chosen(trials: Sequence[_Trial], options: RefineOptions) -> _Trial | None:
    """The simplest that gains nearly as much as the best; None where none gains."""
    good = [trial for trial in trials if trial.gain >= options.gain and trial.sure >= options.sure]
    best = min((trial.after_px for trial in good), default=0.0)
    return next((trial for trial in good if trial.after_px * (1 - options.level_gain) <= best), None)


def _thinned(sightings: Sightings, most: int) -> Sightings:
    points = len(sightings.views)
    kept = (
        np.isin(sightings.point, np.arange(most) * points // most)
        if points > most
        else np.ones(len(sightings.point), bool)
    )
    return sightings.only(kept)


def _few(rig: Rig, halves: Sequence[Sightings], least: int) -> list[str]:
    counts = np.min([np.bincount(half.camera, minlength=len(rig.cameras)) for half in halves], axis=0)
    return [name for name, count in zip(rig.names, counts, strict=True) if count < least]


def _changes(rig: Rig, refined: Rig, trial: _Trial) -> dict[str, Change]:
    radius = _radius(rig)
    found = {}
    for given, now, one, two in zip(rig.cameras, refined.cameras, *(fit.cameras for fit in trial.fits), strict=True):
        found[given.name] = Change(
            moved=float(np.linalg.norm(now.centre - given.centre)) / radius,
            turned_deg=_turn_deg(given, now),
            focal=now.fx / given.fx,
            point_px=float(np.hypot(now.cx - given.cx, now.cy - given.cy)),
            unsure=float(np.linalg.norm(one.centre - two.centre)) / 2 / radius,
        )
    return found


def _radius(rig: Rig) -> float:
    return max(float(np.median(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1))), 1e-12)


def _turn_deg(first: Camera, second: Camera) -> float:
    turn = second.camera_from_world[:3, :3] @ first.camera_from_world[:3, :3].T
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2)))


def aligned(rig: Rig, onto: Rig) -> Rig:
    """The rig in the world of another one of the same cameras, by the similarity that most of them agree on.

    Directions count beside places, so that cameras on a line leave no turn open.
    """
    radius = _radius(onto)
    a, b = (_marks(one, size) for one, size in ((rig, _radius(rig)), (onto, radius)))  # [C, 4, 3]
    weights = np.ones(len(a))
    for _ in range(20):
        scale, turn, shift = _similarity(a, b, weights)
        apart = np.linalg.norm(scale * a @ turn.T + shift - b, axis=2).mean(axis=1)
        weights = 1 / (apart + 0.1 * np.median(apart) + 1e-9 * radius)
    return replace(rig, cameras=tuple(_carried(camera, scale, turn, shift) for camera in rig.cameras))


def _marks(rig: Rig, size: float) -> np.ndarray:
    """Each camera's place, and a point on each of its axes: float64 [C, 4, 3]."""
    axes = np.stack([camera.camera_from_world[:3, :3] for camera in rig.cameras])
    return np.concatenate([rig.centres[:, None], rig.centres[:, None] + size * axes], axis=1)


def _similarity(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation and shift that bring points [C, 4, 3] nearest to others (Umeyama, 1991)."""
    share = weights[:, None, None] / (weights.sum() * a.shape[1])
    middle_a, middle_b = (share * a).sum(axis=(0, 1)), (share * b).sum(axis=(0, 1))
    flat_a, flat_b = (a - middle_a).reshape(-1, 3), (b - middle_b).reshape(-1, 3)
    heavy = np.repeat(share[:, 0, 0], a.shape[1])[:, None]
    left, sizes, right = np.linalg.svd((heavy * flat_b).T @ flat_a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left @ sign @ right
    scale = float(np.trace(np.diag(sizes) @ sign) / (heavy * flat_a**2).sum())
    return scale, turn, middle_b - scale * turn @ middle_a


def _carried(camera: Camera, scale: float, turn: np.ndarray, shift: np.ndarray) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = camera.camera_from_world[:3, :3] @ turn.T
    pose[:3, 3] = -pose[:3, :3] @ (scale * turn @ camera.centre + shift)
    return replace(camera, camera_from_world=pose)


def tracks(rig: Rig, evidence: Sequence[PairMatches]) -> Sightings:
    """Chains of matches through two cameras or more; what stands still counts once, however many instants show it."""
    number = {name: index for index, name in enumerate(rig.names)}
    ends: dict[str, list[np.ndarray]] = {name: [np.zeros((0, 2))] for name in rig.names}
    for pair in evidence:
        ends[pair.first].append(pair.first_pixels)
        ends[pair.second].append(pair.second_pixels)
    spots = {name: _Spots(np.concatenate(found)) for name, found in ends.items()}
    links = []
    for (first, second), found in _by_pair(evidence).items():
        both = [
            np.stack([spots[first].places(p.first_pixels), spots[second].places(p.second_pixels)], axis=1)
            for p in found
        ]
        places, counts = np.unique(np.concatenate(both), axis=0, return_counts=True)
        links.append(Link(number[first], number[second], places.astype(np.int32), -counts.astype(np.float32)))
    sizes = {number[name]: len(own.pixels) for name, own in spots.items()}
    point, camera, place = chain(links, sizes, min_views=2)
    pixels = np.zeros((len(point), 2))
    for name, own in spots.items():
        mine = camera == number[name]
        pixels[mine] = own.pixels[place[mine]]
    return Sightings(point, camera, pixels)


class _Spots:
    """Pixels of one camera, those in one cell of a pixel taken for one place."""

    def __init__(self, pixels: np.ndarray) -> None:
        cells, inverse, counts = np.unique(np.floor(pixels), axis=0, return_inverse=True, return_counts=True)
        self._number = {cell: row for row, cell in enumerate(map(tuple, cells.tolist()))}
        sums = [np.bincount(inverse, weights=column, minlength=len(cells)) for column in pixels.T]
        self.pixels = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]  # [S, 2]

    def places(self, pixels: np.ndarray) -> np.ndarray:
        return np.array([self._number[cell] for cell in map(tuple, np.floor(pixels).tolist())], np.int64)


def _by_pair(evidence: Sequence[PairMatches]) -> dict[tuple[str, str], list[PairMatches]]:
    found: dict[tuple[str, str], list[PairMatches]] = {}
    for pair in evidence:
        found.setdefault((pair.first, pair.second), []).append(pair)
    return found
