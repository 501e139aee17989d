"""Which cameras three-camera evidence confirms: what the others locate tells each one's principal point and place.

Along its epipolar lines a camera may be wrong and every match of a pair stays explained. So each camera is asked where
it shows the points that others locate without it. Matches found along the given lines are many and mostly chance, but
chance agrees on nothing: a right camera has a cluster of them where the calibration says, a wrong one elsewhere. A
camera is confirmed when its cluster would have told a fault of the size of `ConfirmOptions` from none; otherwise that
is said, with what could be wrong unseen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.multiview import Foreseen, Sightings, foreseen
from calibration.repair import POINT
from calibration.rig import Camera, Rig

PLACE = "place"


@dataclass(frozen=True)
class ConfirmOptions:
    """What counts as confirmed, and what as wrong."""

    point: float = 0.05
    """Of the picture's width: a principal point that is so far off must not go unseen ..."""
    place: float = 0.03
    """... nor a camera that stands so far elsewhere, as a share of the rig's radius, in whatever direction"""
    deviations: float = 4.0
    """Standard deviations by which such a fault must differ from none"""
    fitting: float = 4.2
    """Standard deviations within which a sighting fits; farther off it is chance"""
    least: float = 4.0
    """Sightings that fit exactly, or more that fit less, which confirm a camera ..."""
    chance: float = 0.04
    """... beside this share of all of its sightings: so many fit by chance"""
    accusing: float = 6.0
    """Fits that another principal point or place has beyond the given one's, to be believed ..."""
    over: float = 1.7
    """... times as many as the given one has ..."""
    share: float = 0.15
    """... and as a share of all its sightings"""
    hinting: tuple[float, float] = (4.0, 1.25)
    """With so many more, and times as many, a camera is not confirmed"""
    smallest: tuple[float, float] = (0.25, 0.4)
    """Of the faults that must not go unseen, the share from which on a camera is accused, or is not confirmed"""
    farthest: float = 0.15
    """Widths and radii; clusters farther off are chance"""
    least_angle_deg: float = 1.5
    """Between two of the rays that locate a point"""
    enough: int = 150
    """Points of each camera after which no more are taken; time grows with them"""
    rivals: int = 4
    """Accused cameras of which it is tried without which one the others fit best"""


@dataclass(frozen=True)
class Cluster:
    """How well a camera's sightings fit another principal point or place."""

    off: float
    """How far from the given one, widths or radii"""
    fits: float
    unseen: float
    """How far off it may be by `ConfirmOptions.deviations`, in the worst direction; infinite where nothing tells"""


@dataclass(frozen=True)
class Witness:
    """What the points that others locate say of a camera."""

    sightings: int
    fitting: int
    """Of them, near to where the calibration says"""
    fits: float
    """Likewise, exact ones counting 1, those at the limit 0"""
    clusters: Mapping[str, Cluster]
    """By POINT and PLACE, the best one"""

    @property
    def best(self) -> tuple[str, Cluster]:
        return max(self.clusters.items(), key=lambda one: one[1].fits)


def confirm(
    rig: Rig, sightings: Sightings, *, noise_px: float, options: ConfirmOptions = ConfirmOptions()
) -> tuple[dict[str, str], dict[str, str]]:
    """Cameras that show elsewhere what others locate, and cameras that are not confirmed: camera -> why, for people.

    `sightings` are chains of matches, each camera at most once (`refine.tracks`), known to `noise_px`. A wrong camera
    misplaces points for its neighbours: of those accused, the one without which the others fit best is set aside, and
    the others are asked again. Half of the cameras at most.
    """
    sightings = _thinned(sightings, len(rig.cameras), options.enough)
    wrong: dict[str, str] = {}
    said = witnesses(rig, sightings, noise_px=noise_px, options=options)
    while 2 * (len(wrong) + 1) <= len(rig.cameras):
        gains = {name: one.best[1].fits - one.fits for name, one in said.items() if _accused(one, options)}
        rivals = sorted(gains, key=lambda name: -gains[name])[: options.rivals]
        rivals = [name for name in rivals if 2 * gains[name] >= gains[rivals[0]]]
        if not rivals:
            break
        without = {name: sightings.only(sightings.camera != rig.names.index(name)) for name in rivals}
        heard = {name: witnesses(rig, left, noise_px=noise_px, options=options) for name, left in without.items()}
        worst = max(rivals, key=lambda name: sum(one.fits for one in heard[name].values()))
        wrong[worst] = _elsewhere(said[worst])
        sightings = without[worst]
        said = {name: one for name, one in heard[worst].items() if name not in wrong}
    unsure = {name: why for name, one in said.items() if (why := _unconfirmed(one, options))}
    return wrong, unsure


def witnesses(
    rig: Rig, sightings: Sightings, *, noise_px: float, options: ConfirmOptions = ConfirmOptions()
) -> dict[str, Witness]:
    """Of each camera."""
    seen = foreseen(rig, sightings, max_error_px=max(5 * noise_px, 0.5), min_angle_deg=options.least_angle_deg)
    radius = float(np.median(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1)))
    return {
        camera.name: _witness(camera, seen.of(index), noise_px, radius, options)
        for index, camera in enumerate(rig.cameras)
    }


def _witness(camera: Camera, seen: Foreseen, noise_px: float, radius: float, options: ConfirmOptions) -> Witness:
    given = _squares(seen, seen.miss_px, noise_px)
    slopes = {POINT: _wide(camera, len(given)), PLACE: -radius * seen.slope}
    clusters = {}
    for kind, slope in slopes.items():
        off, fits = _densest(seen, slope, noise_px, options)
        clusters[kind] = Cluster(off, fits, _unseen(seen, slope, given, noise_px, options))
    fitting = int((given <= options.fitting**2).sum())
    return Witness(len(given), fitting, float(_fits(given, options)), clusters)


def _wide(camera: Camera, count: int) -> np.ndarray:
    return np.broadcast_to(camera.width * np.eye(2), (count, 2, 2))


def _squares(seen: Foreseen, miss_px: np.ndarray, noise_px: float) -> np.ndarray:
    """Squared distances [..., M] of ways [..., M, 2], in standard deviations."""
    weighed = (seen.weight @ miss_px[..., None])[..., 0]
    found: np.ndarray = (miss_px * weighed).sum(axis=-1) / noise_px**2
    return found


def _fits(squares: np.ndarray, options: ConfirmOptions) -> np.ndarray:
    """How many of the last axis fit, exact ones counting 1, those at the limit 0."""
    found: np.ndarray = np.maximum(0, 1 - squares / options.fitting**2).sum(axis=-1)
    return found


def _unseen(seen: Foreseen, slope: np.ndarray, given: np.ndarray, noise_px: float, options: ConfirmOptions) -> float:
    """How far off these numbers may be in the worst direction while what fits now still fits."""
    matrix, _ = _system(seen, slope, given, options)
    known = float(np.linalg.eigvalsh(matrix)[0]) / noise_px**2
    return options.deviations / known**0.5 if known > 1e-9 else float("inf")


def _system(
    seen: Foreseen, slope: np.ndarray, squares: np.ndarray, options: ConfirmOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations [D, D] and [D] of numbers, of sightings as far as they fit."""
    heavy = ((squares <= options.fitting**2) / (1 + squares / 9))[:, None, None] * seen.weight
    flat, weighed = slope.reshape(-1, slope.shape[2]), (heavy @ slope).reshape(-1, slope.shape[2])
    return flat.T @ weighed, weighed.T @ seen.miss_px.ravel()


def _densest(seen: Foreseen, slope: np.ndarray, noise_px: float, options: ConfirmOptions) -> tuple[float, float]:
    """Where most sightings fit: how far from the given numbers, and how many fit there."""
    tried = _guesses(seen, slope)
    tried = tried[np.linalg.norm(tried, axis=1) <= options.farthest]
    tried = np.concatenate([np.zeros((1, slope.shape[2])), tried])
    best = tried[np.argmax(_fits(_squares(seen, _left(seen, slope, tried), noise_px), options))]
    for _ in range(5):
        matrix, push = _system(seen, slope, _squares(seen, _left(seen, slope, best), noise_px), options)
        best = np.linalg.solve(matrix + (1e-9 * np.trace(matrix) + 1e-12) * np.eye(len(matrix)), push)
    return float(np.linalg.norm(best)), float(_fits(_squares(seen, _left(seen, slope, best), noise_px), options))


def _left(seen: Foreseen, slope: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What is left of the ways with numbers [..., D]: [..., M, 2]."""
    left: np.ndarray = seen.miss_px - (slope @ values[..., None, :, None])[..., 0]
    return left


def _guesses(seen: Foreseen, slope: np.ndarray, *, most: int = 200) -> np.ndarray:
    """Numbers [G, D] that one sighting tells, or two where it takes as many."""
    count, size = len(seen.miss_px), slope.shape[2]
    if count < 2:
        return np.zeros((0, size))
    rng = np.random.default_rng(0)
    first = np.arange(count) if size == 2 else rng.integers(0, count, most)
    rows = first[:, None] if size == 2 else np.stack([first, (first + rng.integers(1, count, most)) % count], axis=1)
    tall = slope[rows].reshape(len(rows), -1, size)
    found: np.ndarray = np.einsum("gdr,gr->gd", np.linalg.pinv(tall, 1e-6), seen.miss_px[rows].reshape(len(rows), -1))
    return found


def _accused(one: Witness, options: ConfirmOptions) -> bool:
    _, best = one.best
    gain = best.fits - one.fits
    enough = gain >= options.accusing and best.fits >= max(options.over * one.fits, options.share * one.sightings)
    return enough and _size(one, options) >= options.smallest[0]


def _size(one: Witness, options: ConfirmOptions) -> float:
    """How far off the best clusters are, by what must not go unseen."""
    limits = {POINT: options.point, PLACE: options.place}
    return max(c.off / limits[kind] for kind, c in one.clusters.items() if c.fits >= 0.85 * one.best[1].fits)


def _elsewhere(one: Witness) -> str:
    kind, best = one.best
    what = f"its principal point were off by {best.off:.1%} of the width"
    if kind == PLACE:
        what = f"it stood {best.off:.1%} of the rig's radius elsewhere"
    return (
        f"shows elsewhere what other cameras locate: {best.fits:.0f} points fit as if {what}, {one.fits:.0f} as it is "
        "given"
    )


def _unconfirmed(one: Witness, options: ConfirmOptions) -> str:
    """Why; empty for a camera that is confirmed."""
    point, place = one.clusters[POINT].unseen, one.clusters[PLACE].unseen
    _, best = one.best
    hint = best.fits - one.fits >= options.hinting[0] and best.fits >= options.hinting[1] * one.fits
    if one.fits < options.least + options.chance * one.sightings:
        why = f"of {one.sightings} points that other cameras locate {one.fitting} lie where it should show them"
    elif hint and _size(one, options) >= options.smallest[1]:
        why = f"it {_elsewhere(one)}"
    elif point > options.point:
        why = f"its principal point could be off by {_share(point)} of the width unseen"
    elif place > options.place:
        why = f"it could stand {_share(place)} of the rig's radius elsewhere unseen"
    else:
        return ""
    return why


def _share(value: float) -> str:
    return f"up to {value:.0%}" if value < 1 else "any share"


def _thinned(sightings: Sightings, cameras: int, enough: int) -> Sightings:
    """Points that three cameras or more show, without those all of whose cameras show enough others."""
    starts, views = sightings.starts, sightings.views
    kept, shown = np.zeros(len(views), bool), np.zeros(cameras, int)
    for number in np.random.default_rng(0).permutation(np.flatnonzero(views >= 3)).tolist():
        whose = sightings.camera[starts[number] : starts[number] + views[number]]
        if shown[whose].min() < enough:
            kept[number] = True
            shown[whose] += 1
    return sightings.only(kept[sightings.point])
