"""Whether a calibration can be believed: do the cameras look at one place, and do the pictures agree with the poses.

`check_rig` judges the cameras alone. `matches_report` judges them by what the pictures show; it catches the wrong
calibrations that register every camera with a small reprojection error (research: those explain less than half of the
matches).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from calibration.multiview import in_front, sampson_px
from calibration.rig import WIDEST_RAD, Camera, Rig, fisheye_radius, fisheye_turn_rad

_PARALLEL = 1e-3
"""Least eigenvalue of the mean of I - d d^T below which axes d count as parallel: they spread by about 2 degrees"""


@dataclass(frozen=True)
class CheckOptions:
    """What counts as a common volume."""

    support: int = 3
    """Cameras that must see a point for it to be common; fewer cameras than that must all see it"""
    covered: float = 0.9
    """Share of the common sphere that has this support"""
    reach: float = 1.5
    """Half the side of the sampled cube, in rig radii"""
    samples: int = 41
    """Samples along each side of the cube"""
    outlier: float = 5.0
    """A camera is far out from this many median distances to the scene centre"""

    def __post_init__(self) -> None:
        if self.support < 2 or not 0 < self.covered <= 1 or self.reach <= 0 or self.samples < 3 or self.outlier <= 1:
            raise ValueError(f"unusable options for the common volume: {self}")


@dataclass(frozen=True)
class RigReport:
    """Where the cameras look; lengths in the rig's units."""

    cameras: int
    scene_centre: tuple[float, float, float]
    """The point nearest to the optical axes, robustly; world"""
    rig_radius: float
    """Median distance from the cameras to the scene centre"""
    common_radius: float
    """Radius of the sphere about the scene centre of which `CheckOptions.covered` has support"""
    seen_share: float
    """Share of the cameras that see the scene centre"""
    parallel: bool
    """True when the axes hardly converge, so that they do not say how far the scene is"""
    spacing: tuple[float, float, float]
    """Distance from a camera to its nearest neighbour: least, median, greatest"""
    suspicious: Mapping[str, str]
    """Camera -> what is odd about it"""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def check_rig(rig: Rig, *, points: np.ndarray | None = None, options: CheckOptions = CheckOptions()) -> RigReport:
    """Find the volume that the cameras share; raises ValueError when there is none.

    Odd single cameras do not raise: they are listed in `suspicious`. Parallel axes meet nowhere; there the centre lies
    on the middle axis at the median depth of `points` [P, 3], or without points at three times the rig's width.
    """
    centre, parallel = _scene_centre(rig, points)
    distances = np.linalg.norm(rig.centres - centre, axis=1)
    radius = float(np.median(distances))
    sees = np.array([bool(camera.sees(centre[None])[0]) for camera in rig.cameras])
    suspicious = _suspicious(rig, centre, distances, sees, options.outlier)
    common = _common_radius(rig, centre, radius, options)
    if len(rig.cameras) < 2 or common <= 0:
        raise ValueError(
            f"the cameras must see a common volume, but of {len(rig.cameras)} only {int(sees.sum())} see the point "
            f"{np.round(centre, 3).tolist()} nearest to their axes; check the axes convention of {rig.source} "
            f"and these cameras: {suspicious or 'none stands out'}"
        )
    return RigReport(
        len(rig.cameras), _triple(centre), radius, common, float(sees.mean()), parallel, _spacing(rig), suspicious
    )


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _scene_centre(rig: Rig, points: np.ndarray | None) -> tuple[np.ndarray, bool]:
    """The point with the least sum of distances to the optical axes; for parallel axes, a point on the middle one."""
    centres, forwards = rig.centres, np.stack([camera.forward for camera in rig.cameras])
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # [C, 3, 3], drops what runs along an axis
    weights = np.ones(len(centres))
    for _ in range(50):
        matrix = (weights[:, None, None] * across).sum(axis=0) / weights.sum()
        if np.linalg.eigvalsh(matrix)[0] < _PARALLEL:
            return _centre_ahead(centres, forwards, points), True
        vector = (weights[:, None] * np.einsum("cij,cj->ci", across, centres)).sum(axis=0) / weights.sum()
        point = np.linalg.solve(matrix, vector)
        offsets = np.linalg.norm(np.einsum("cij,cj->ci", across, point - centres), axis=1)
        weights = 1 / np.maximum(offsets, 1e-9 + 0.1 * np.median(offsets))
    return point, False


def _centre_ahead(centres: np.ndarray, forwards: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    middle, ahead = centres.mean(axis=0), forwards.mean(axis=0)
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    if points is not None and len(points):
        depth = float(np.median((points - middle) @ ahead))
    else:
        depth = 3 * float(np.linalg.norm(centres.max(axis=0) - centres.min(axis=0)))
    centre: np.ndarray = middle + depth * ahead
    return centre


def _common_radius(rig: Rig, centre: np.ndarray, radius: float, options: CheckOptions) -> float:
    """Greatest radius about the centre within which `covered` of a grid's samples have support; 0 for none."""
    steps = np.linspace(-options.reach, options.reach, options.samples)
    cube = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    length = np.linalg.norm(cube, axis=1)
    order = np.argsort(length, kind="stable")
    order = order[length[order] <= options.reach]
    seen = np.zeros(len(order), dtype=np.int64)
    for camera in rig.cameras:
        seen += camera.sees(centre + radius * cube[order])
    supported = seen >= min(options.support, len(rig.cameras))
    share = np.cumsum(supported) / np.arange(1, len(order) + 1)
    good = np.flatnonzero(share >= options.covered)
    return radius * float(length[order[good[-1]]]) if len(good) else 0.0


def _spacing(rig: Rig) -> tuple[float, float, float]:
    apart = np.linalg.norm(rig.centres[:, None] - rig.centres[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.min(axis=1)
    return float(nearest.min()), float(np.median(nearest)), float(nearest.max())


def _suspicious(
    rig: Rig, centre: np.ndarray, distances: np.ndarray, sees: np.ndarray, outlier: float
) -> dict[str, str]:
    median = float(np.median(distances))
    odd: dict[str, str] = {}
    for index, camera in enumerate(rig.cameras):
        twin = next((other.name for other in rig.cameras[:index] if _same_pose(camera, other, median)), None)
        if distances[index] > outlier * median:
            odd[camera.name] = f"stands {distances[index] / median:.1f} times as far from the scene centre as most"
        elif twin is not None:
            odd[camera.name] = f"has the same pose as {twin}"
        elif not sees[index]:
            odd[camera.name] = (
                f"does not see the scene centre, {_off_axis_deg(camera, centre):.0f} degrees off its axis"
            )
        elif _folds(camera):
            odd[camera.name] = f"has a lens model that folds back inside its picture: {camera.distortion}"
    return odd


def _same_pose(first: Camera, second: Camera, size: float) -> bool:
    apart = float(np.linalg.norm(first.centre - second.centre))
    return apart < 1e-4 * size and float(first.forward @ second.forward) > math.cos(math.radians(0.1))


def _off_axis_deg(camera: Camera, point: np.ndarray) -> float:
    towards = point - camera.centre
    cosine = float(camera.forward @ towards) / max(float(np.linalg.norm(towards)), 1e-12)
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def _folds(camera: Camera) -> bool:
    """Whether pixels at the border have no ray: the lens model cannot be inverted there."""
    x, y = np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9)
    border = np.array([(a, b) for a in x for b in (0, camera.height)] + [(a, b) for a in (0, camera.width) for b in y])
    if camera.fisheye:  # what lies beyond its widest angle has no ray, but folds nothing
        reach = np.linalg.norm((border - (camera.cx, camera.cy)) / (camera.fx, camera.fy), axis=1).max()
        turn = min(fisheye_turn_rad(camera.distortion), float(WIDEST_RAD))
        return turn < WIDEST_RAD and bool(fisheye_radius(np.array(turn), camera.distortion) < reach)
    plane = camera.plane_from_pixels(border)
    back = camera.distorted(plane) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return bool(np.abs(back - border).max() > 0.5) or not np.all(np.isfinite(back))


# What the pictures show


@dataclass(frozen=True)
class PairMatches:
    """Matches between two pictures of one instant, found without using the poses."""

    first: str
    second: str
    first_pixels: np.ndarray
    """float64 [K, 2], distorted pictures"""
    second_pixels: np.ndarray

    @property
    def key(self) -> str:
        return f"{self.first} {self.second}"


class Verdict(StrEnum):
    """What the matches say about a calibration."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class MatchOptions:
    """What a calibration must explain."""

    max_error_px: float = 3.0
    """Sampson distance up to which a match agrees with the poses; pixels of the undistorted picture"""
    min_matches: int = 20
    """Pairs with fewer verified matches say nothing"""
    bad_share: float = 0.5
    """A pair or a camera that explains less than this of its matches is bad"""
    min_explained: float = 0.8
    """Share of all matches that an acceptable calibration explains. Measured: right ones 0.86 to 1.0; wrong ones that
    placed every camera 0.2 to 0.75, and once 0.82, where chance matches had been let in"""

    def __post_init__(self) -> None:
        shares = 0 < self.bad_share < 1 and 0 < self.min_explained <= 1
        if self.max_error_px <= 0 or self.min_matches < 8 or not shares:
            raise ValueError(f"unusable options for judging matches: {self}")


@dataclass(frozen=True)
class MatchesReport:
    """How well the poses explain matches that were found without them."""

    pairs: int
    """Pairs of cameras with enough verified matches to say something"""
    matches: int
    explained_share: float | None
    """Share of the matches within `MatchOptions.max_error_px` and in front of both cameras; None without matches"""
    pair_median_px: float | None
    """Median over the pairs of the median Sampson distance; None without pairs"""
    bad_pairs: Mapping[str, float]
    """'a b' -> explained share"""
    bad_cameras: tuple[str, ...]
    """Cameras of whose matches less than `MatchOptions.bad_share` is explained, the worst set aside first"""
    reprojection_px: float | None
    """Median over the observations of triangulated points; None without points"""
    verdict: Verdict
    reason: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> MatchesReport:
        return cls(**{**data, "bad_cameras": tuple(data["bad_cameras"]), "verdict": Verdict(data["verdict"])})


def matches_report(
    rig: Rig,
    matches: Sequence[PairMatches],
    *,
    errors_px: np.ndarray | None = None,  # [M], reprojection errors of triangulated observations
    options: MatchOptions = MatchOptions(),
) -> MatchesReport:
    """Judge poses and lenses by verified matches (`triangulate.verified_matches`)."""
    telling = [pair for pair, _ in merged(matches) if len(pair.first_pixels) >= options.min_matches]
    errors = [pair_errors_px(rig, pair) for pair in telling]
    shares = [float((error <= options.max_error_px).mean()) for error in errors]
    bad = {pair.key: share for pair, share in zip(telling, shares, strict=True) if share < options.bad_share}
    every = np.concatenate([*errors, np.zeros(0)])
    explained = float((every <= options.max_error_px).mean()) if len(every) else None
    verdict, reason = _verdict(explained, len(telling), len(rig.cameras), options)
    return MatchesReport(
        pairs=len(telling),
        matches=len(every),
        explained_share=explained,
        pair_median_px=_median([float(np.median(error)) for error in errors]),
        bad_pairs=bad,
        bad_cameras=_bad_cameras(telling, shares, options.bad_share),
        reprojection_px=_median(errors_px),
        verdict=verdict,
        reason=reason,
    )


def merged(matches: Sequence[PairMatches]) -> list[tuple[PairMatches, int]]:
    """One entry for each pair of cameras: what several instants show of it, put together, and how many those are."""
    groups: dict[str, list[PairMatches]] = {}
    for pair in matches:
        groups.setdefault(pair.key, []).append(pair)
    return [
        (
            PairMatches(
                group[0].first,
                group[0].second,
                np.concatenate([pair.first_pixels for pair in group]),
                np.concatenate([pair.second_pixels for pair in group]),
            ),
            len(group),
        )
        for group in groups.values()
    ]


def _median(values: Sequence[float] | np.ndarray | None) -> float | None:
    return float(np.median(values)) if values is not None and len(values) else None


def _verdict(explained: float | None, pairs: int, cameras: int, options: MatchOptions) -> tuple[Verdict, str]:
    if explained is None or pairs < cameras / 2:
        reason = f"only {pairs} pairs of the {cameras} cameras have {options.min_matches} matches or more"
        return Verdict.UNDECIDED, reason
    if explained < options.min_explained:
        return Verdict.REJECTED, f"the poses explain {explained:.0%} of the matches; a right calibration, 90 % or more"
    return Verdict.ACCEPTED, f"the poses explain {explained:.0%} of the matches"


def _bad_cameras(pairs: Sequence[PairMatches], shares: Sequence[float], bad_share: float) -> tuple[str, ...]:
    """Peel off, one by one, the camera of whose matches the least share is explained, while that is a bad share.

    Matches count, not pairs: pictures that share nothing may match by chance, but with few matches.
    """
    left = list(zip(pairs, shares, strict=True))
    found: list[str] = []
    while left:
        names = sorted({name for pair, _ in left for name in (pair.first, pair.second)})
        explained = {name: _explained([e for e in left if name in (e[0].first, e[0].second)]) for name in names}
        worst = min(names, key=lambda name: explained[name])
        if explained[worst] >= bad_share:
            break
        found.append(worst)
        left = [entry for entry in left if worst not in (entry[0].first, entry[0].second)]
    return tuple(sorted(found))


def _explained(entries: Sequence[tuple[PairMatches, float]]) -> float:
    total = sum(len(pair.first_pixels) for pair, _ in entries)
    return sum(share * len(pair.first_pixels) for pair, share in entries) / total


def pair_errors_px(rig: Rig, pair: PairMatches) -> np.ndarray:
    """Sampson distance of each match, infinite where its point lies behind a camera: float64 [K]."""
    first, second = rig[pair.first], rig[pair.second]
    a, b = first.plane_from_pixels(pair.first_pixels), second.plane_from_pixels(pair.second_pixels)
    errors = sampson_px(first, second, a, b)
    return np.where(in_front(first, second, a, b), errors, np.inf)
