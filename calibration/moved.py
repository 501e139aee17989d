"""Which cameras have been moved since the rig was solved.

The other cameras locate points; where a camera shows these points tells where it stands. A camera that was bumped shows
them elsewhere than the rig says, all of them as one other pose would. Chance matches agree on no pose, so a camera of
which the pictures say little is not taken for a moved one. Two cameras alone cannot tell: a turn along the epipolar
lines leaves every match of a pair explained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.accept import PairMatches
from calibration.multiview import Sightings, locate
from calibration.rig import Camera, Rig

Place = tuple[str, float, float]
"""A feature: camera and pixel"""
Partners = Mapping[Place, set[Place]]
"""The features that match one"""


@dataclass(frozen=True)
class MovedOptions:
    """When a camera counts as moved. Lengths in pixels of the undistorted picture."""

    max_error_px: float = 3.0
    """Distance up to which a point fits"""
    located_px: float = 2.0
    """Greatest error of the points that the other cameras locate"""
    min_angle_deg: float = 1.5
    """Least angle between the rays to such a point"""
    min_points: int = 15
    """Points that must agree on another pose; six chance matches may"""
    max_points: int = 300
    """Of more, evenly chosen, a camera's place is no better known, and time grows with them"""
    agreeing: float = 0.6
    """Share of a camera's points that must agree on it; of right cameras 0.79 to 0.99 do"""
    max_turn_deg: float = 20.0
    """Of a camera that was moved. Patterns that repeat make poses farther off, as of a camera before another wall"""
    max_shift: float = 0.25
    """Likewise, as a share of the rig's radius"""
    offset_px: float = 2.0
    """Median offset of these points from where the rig says, from which on a camera has been moved"""
    over_others: float = 3.0
    """And at least this many times the median of all cameras, for a calibration that is not exact to the pixel"""
    sure_px: float = 0.7
    """Offset of a camera whose shift is sure: pictures of 320 pixels show 3 % of the radius by 0.8 to 1.4, and right
    cameras lie 0.1 to 0.5 off"""
    sure_points: int = 60
    """It is by so many points, ..."""
    sure_shift: float = 0.015
    """this way at least, as a share of the rig's radius, ..."""
    sure_left: float = 0.4
    """and where the other pose leaves at most this share of the offset: 0.15 to 0.3 of a moved camera, nearly all of
    its neighbours, whose points it misplaces"""

    def __post_init__(self) -> None:
        limits = (self.max_error_px, self.located_px, self.offset_px, self.over_others)
        if min(limits) <= 0 or not 6 <= self.min_points <= self.max_points or not 0 < self.agreeing <= 1:
            raise ValueError(f"unusable options for finding moved cameras: {self}")


@dataclass(frozen=True)
class Standing:
    """Where a camera stands by the points that the other cameras locate."""

    points: int
    fitting: float
    """Share of them within `max_error_px` of where the rig says"""
    agreeing: float
    """Share of them that one pose explains, be it the rig's or another"""
    offset_px: float
    """Median distance of these from where the rig says"""
    left_px: float
    """Likewise from where that one pose says"""
    turned_deg: float
    """Between the rig's pose and that one"""
    shifted: float
    """Likewise, as a share of the rig's radius"""


def find_moved(
    rig: Rig, matches: Sequence[PairMatches], *, options: MovedOptions = MovedOptions()
) -> tuple[dict[str, Standing], tuple[str, ...]]:
    """Where each camera stands by verified matches (`triangulate.verified_matches`), and the moved ones.

    A moved camera misplaces points of its neighbours, which then seem moved, too. So of those that seem so, the one
    without which the others fit best is set aside, and the others are asked again. Cameras with too few points are
    missing. Half of the cameras at most are called moved: beyond that, it is the rig that is wrong.
    """
    partners, found, moved = _partners(matches), dict[str, Standing](), list[str]()
    while True:
        left = [name for name in rig.names if name not in moved]
        known = _standings(rig, left, partners, options)
        elsewhere = [name for name in known if _has_moved(known[name], known, options)]
        if not elsewhere or 2 * (len(moved) + 1) > len(rig.cameras):
            break
        without = {name: [other for other in left if other != name] for name in elsewhere}
        fit = {name: _fitting(_standings(rig, others, partners, options)) for name, others in without.items()}
        moved.append(max(elsewhere, key=lambda name: fit[name]))
        found[moved[-1]] = known[moved[-1]]
    # Those set aside first were judged beside others that had moved, too.
    again = {name: _standing(rig, name, left, partners, options) for name in moved}
    found |= known | {name: standing for name, standing in again.items() if standing is not None}
    return found, tuple(name for name in moved if _has_moved(found[name], known, options))


def place_by_others(
    rig: Rig, camera: Camera, matches: Sequence[PairMatches], *, options: MovedOptions = MovedOptions()
) -> Camera | None:
    """The camera, which need not be in the rig, where most of the points that the rig's other cameras locate put it.

    Its lens stays, its pose does not count. None without enough points that agree on one pose.
    """
    others = [name for name in rig.names if name != camera.name]
    xyz, pixels = _located(rig, camera.name, others, _partners(matches), options)
    flat = camera.undistorted_pixels(pixels)
    best = _resected(camera, xyz, flat, options) if len(xyz) >= options.min_points else None
    if best is None:
        return None
    agreeing = int((_errors_px(best, xyz, flat) <= options.max_error_px).sum())
    return best if agreeing >= max(options.min_points, options.agreeing * len(xyz)) else None


def _partners(matches: Sequence[PairMatches]) -> Partners:
    partners: dict[Place, set[Place]] = {}
    for pair in matches:
        for a, b in zip(pair.first_pixels.tolist(), pair.second_pixels.tolist(), strict=True):
            first, second = (pair.first, *a), (pair.second, *b)
            partners.setdefault(first, set()).add(second)
            partners.setdefault(second, set()).add(first)
    return partners


def _standings(rig: Rig, names: Sequence[str], partners: Partners, options: MovedOptions) -> dict[str, Standing]:
    """Of each camera, as the others of these see it."""
    asked = {name: _standing(rig, name, [n for n in names if n != name], partners, options) for name in names}
    return {name: standing for name, standing in asked.items() if standing is not None}


def _fitting(standings: Mapping[str, Standing]) -> float:
    """Share of all points that fit."""
    points = sum(standing.points for standing in standings.values())
    return sum(standing.fitting * standing.points for standing in standings.values()) / max(1, points)


def _has_moved(standing: Standing, standings: Mapping[str, Standing], options: MovedOptions) -> bool:
    usual = float(np.median([other.offset_px for other in standings.values()])) if standings else 0.0
    sure = (
        standing.points >= options.sure_points
        and standing.shifted >= options.sure_shift
        and standing.left_px <= options.sure_left * standing.offset_px
    )
    limit = options.sure_px if sure else max(options.offset_px, options.over_others * usual)
    return standing.offset_px > limit


def _standing(rig: Rig, name: str, others: Sequence[str], partners: Partners, options: MovedOptions) -> Standing | None:
    """None without enough points that one pose explains."""
    camera = rig[name]
    xyz, pixels = _located(rig, name, others, partners, options)
    flat = camera.undistorted_pixels(pixels)
    while len(xyz) >= options.min_points and (best := _resected(camera, xyz, flat, options)) is not None:
        errors, left = _errors_px(camera, xyz, flat), _errors_px(best, xyz, flat)
        agrees = left <= options.max_error_px
        turned_deg, shifted = _apart(camera, best, rig)
        if turned_deg <= options.max_turn_deg and shifted <= options.max_shift:
            if agrees.sum() < max(options.min_points, options.agreeing * len(xyz)):
                return None
            fitting = float((errors <= options.max_error_px).mean())
            offset_px = float(np.median(errors[agrees]))
            left_px = float(np.median(left[agrees]))
            return Standing(len(xyz), fitting, float(agrees.mean()), offset_px, left_px, turned_deg, shifted)
        xyz, flat = xyz[~agrees], flat[~agrees]  # a wall whose pattern repeats elsewhere
    return None


def _apart(first: Camera, second: Camera, rig: Rig) -> tuple[float, float]:
    """Angle between two poses of a camera, and the way between them as a share of the rig's radius."""
    turn = second.camera_from_world[:3, :3] @ first.camera_from_world[:3, :3].T
    radius = float(np.median(np.linalg.norm(rig.centres - np.median(rig.centres, axis=0), axis=1)))
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(turn)) - 1) / 2)))
    return math.degrees(angle), float(np.linalg.norm(second.centre - first.centre)) / radius


def _located(
    rig: Rig, name: str, others: Sequence[str], partners: Partners, options: MovedOptions
) -> tuple[np.ndarray, np.ndarray]:  # [P, 3] world; [P, 2] pixels of the camera, distorted
    """Points that other cameras locate which also match each other there, and where this one shows them."""
    mine = {place: theirs for place, theirs in partners.items() if place[0] == name}
    seen = [
        (place, [p for p in sorted(theirs) if p[0] in others and partners[p] & theirs])
        for place, theirs in mine.items()
    ]
    seen = [(place, theirs) for place, theirs in seen if theirs]
    seen = seen[:: -(-len(seen) // options.max_points) or 1]
    rows = [(number, place, there) for number, (place, theirs) in enumerate(seen) for there in theirs]
    if not rows:
        return np.zeros((0, 3)), np.zeros((0, 2))
    index = {camera: number for number, camera in enumerate(rig.names)}
    sightings = Sightings(
        np.array([number for number, _, _ in rows], np.int32),
        np.array([index[camera] for _, _, (camera, _, _) in rows], np.int32),
        np.array([(x, y) for _, _, (_, x, y) in rows]),
    )
    whose = {(index[camera], x, y): place for _, place, (camera, x, y) in rows}
    kept, xyz, _ = locate(
        rig, sightings, max_error_px=options.located_px, min_views=2, min_angle_deg=options.min_angle_deg
    )
    pixels = [whose[int(kept.camera[row]), *kept.pixels[row].tolist()][1:] for row in kept.starts]
    return xyz, np.array(pixels).reshape(-1, 2)


def _resected(camera: Camera, xyz: np.ndarray, flat: np.ndarray, options: MovedOptions) -> Camera | None:
    """The camera where most of the points say that it stands; `flat` is in the undistorted picture."""
    done, turn, shift, inliers = cv2.solvePnPRansac(
        xyz, flat, camera.matrix, None, iterationsCount=2000, reprojectionError=options.max_error_px, confidence=0.9999
    )
    if not done or inliers is None or len(inliers) < 6:
        return None
    rows = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(xyz[rows], flat[rows], camera.matrix, None, turn, shift)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return replace(camera, camera_from_world=pose)


def _errors_px(camera: Camera, xyz: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Distance of points in the undistorted picture, infinite behind the camera: float64 [P]."""
    pixels, depth = replace(camera, distortion=(), fisheye=False).project(xyz)
    errors: np.ndarray = np.where(depth > 0, np.linalg.norm(pixels - flat, axis=1), np.inf)
    return errors
