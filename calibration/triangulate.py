"""Points of the scene from synchronized pictures and known poses.

Each picture gives SIFT features; neighbouring cameras match them along epipolar lines; matches chain into tracks, one
feature per camera; each track becomes a point that every camera of the track sees within a few pixels and with
parallax, or is dropped. The rig does not move, so points of several instants may simply be put together.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from calibration.accept import CheckOptions, MatchesReport, MatchOptions, PairMatches, check_rig, matches_report
from calibration.features import Band, FeatureOptions, Features, detect, match, side_by_side
from calibration.multiview import Sightings, essential, locate, medians
from calibration.rig import Camera, Rig
from calibration.srgb import LINEAR, srgb_from_linear
from calibration.tracks import Link, chain

_COARSE = CheckOptions(samples=21)
"""Pairs need the scene's centre, not the exact extent of what the cameras share"""


@dataclass(frozen=True)
class TriangulateOptions:
    """Which matches become points."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    neighbours: int = 8
    """Cameras that each camera is matched with; time grows with it"""
    ratio: float = 0.8
    """Lowe's ratio among the candidates near the epipolar line, and for matches that judge the poses"""
    epipolar_px: float = 2.0
    """Greatest distance from the epipolar line, pixels"""
    max_error_px: float = 2.0
    """Greatest reprojection error of an observation; the worst one of a track is dropped while it exceeds this"""
    min_views: int = 3
    """Cameras that must see a point; two features on one epipolar line always make a point, right or wrong"""
    min_angle_deg: float = 1.5
    """Greatest angle between two rays of a point must reach this, or its depth is a guess"""
    patch_px: int = 9
    """Side of the square whose mean is an observation's colour, by which cameras are balanced. With 5, cameras of a
    dome disagree by 4.7 % after balancing, with 9 by 4.0 %; larger ones mix in what lies behind"""
    judge: MatchOptions = field(default_factory=MatchOptions)

    def __post_init__(self) -> None:
        if self.neighbours < 1 or not 0 < self.ratio <= 1 or min(self.epipolar_px, self.max_error_px) <= 0:
            raise ValueError(f"neighbours, ratio and pixel limits must be positive, and ratio at most 1: {self}")
        if self.min_views < 2 or not 0 <= self.min_angle_deg < 180 or self.patch_px < 1:
            raise ValueError(f"a point needs at least two views, an angle below 180 degrees and a patch: {self}")


@dataclass(frozen=True)
class SparsePoints:
    """Triangulated points and what they look like in each camera; observations are sorted by point, then camera."""

    cameras: tuple[str, ...]
    """Names, in the order of the rig"""
    xyz: np.ndarray
    """float64 [P, 3], world"""
    rgb: np.ndarray
    """uint8 [P, 3], sRGB, median over the cameras before any colour balance"""
    views: np.ndarray
    """int32 [P], number of cameras"""
    error_px: np.ndarray
    """float32 [P], root mean square reprojection error"""
    instant: np.ndarray
    """int32 [P], position of the point's instant in the input"""
    point: np.ndarray
    """int32 [M], row of xyz that an observation is of"""
    camera: np.ndarray
    """int32 [M], index into `cameras`"""
    xy: np.ndarray
    """float32 [M, 2], pixels of the undistorted picture with the rig's focal lengths and principal point"""
    colour: np.ndarray
    """float32 [M, 3], linear light in [0, 1], mean of a patch; NaN where a pixel of it is near black or white"""
    matches: MatchesReport
    """How well the poses explain matches found without them"""

    def save(self, path: Path) -> None:
        """Write one .npz; the same points give the same bytes."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        np.savez(path, cameras=np.array(self.cameras), matches=np.array(json.dumps(self.matches.to_json())), **arrays)

    @classmethod
    def load(cls, path: Path) -> SparsePoints:
        with np.load(path, allow_pickle=False) as data:
            report = MatchesReport.from_json(json.loads(str(data["matches"])))
            names = tuple(str(name) for name in data["cameras"])
            return cls(cameras=names, matches=report, **{name: data[name] for name in _ARRAYS})


_ARRAYS = ("xyz", "rgb", "views", "error_px", "instant", "point", "camera", "xy", "colour")


def triangulate(
    rig: Rig,
    instants: Iterable[Mapping[str, np.ndarray]],
    *,
    options: TriangulateOptions = TriangulateOptions(),
) -> SparsePoints:
    """Points from pictures camera -> uint8 [H, W, 3] RGB, as filmed (distorted), one mapping per synchronized instant.

    An instant may lack cameras. Deterministic. Raises ValueError for pictures that do not fit the rig, for a rig
    with fewer cameras than a point needs or without a common volume, and when no point is found.
    """
    if len(rig.cameras) < options.min_views:
        raise ValueError(
            f"a point must be seen by {options.min_views} cameras (min_views), but there are {len(rig.cameras)}; in "
            "pictures of two any features on one epipolar line would make a point, right or wrong"
        )
    pairs = choose_pairs(rig, neighbours=options.neighbours)
    parts, evidence = [], []
    for pictures in instants:
        features = detect_all(rig, pictures, options=options.features)
        near = [(first, second) for first, second in pairs if first in features and second in features]
        parts.append(_part(rig, pictures, features, near, options))
        evidence += verified_matches(rig, features, near, ratio=options.ratio)
    return _joined(rig, parts, evidence, options)


def choose_pairs(rig: Rig, *, neighbours: int) -> list[tuple[str, str]]:
    """For each camera the `neighbours` that share most of its view under an angle that SIFT bears; by rig order."""
    centre = np.array(check_rig(rig, options=_COARSE).scene_centre)
    shared = _shared_views(rig, centre)
    towards = rig.centres - centre
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    angle_deg = np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1)))
    # SIFT tolerates about 30 degrees; below 3 the depth of a match is a guess.
    score = shared * np.exp(-((angle_deg / 40) ** 2)) * np.minimum(angle_deg / 3, 1)
    np.fill_diagonal(score, -1)
    best = np.argsort(-score, axis=1, kind="stable")[:, :neighbours]
    chosen = {(min(a, b), max(a, b)) for a, row in enumerate(best) for b in row.tolist() if score[a, b] > 0}
    return [(rig.names[a], rig.names[b]) for a, b in sorted(chosen)]


def verified_matches(
    rig: Rig, features: Mapping[str, Features], pairs: Sequence[tuple[str, str]], *, ratio: float
) -> list[PairMatches]:
    """Matches that agree on some epipolar geometry, found without the poses: what judges them."""

    def verified(pair: tuple[str, str]) -> PairMatches | None:
        first, second = pair
        rows, _ = match(features[first], features[second], ratio=ratio)
        a, b = features[first].pixels[rows[:, 0]], features[second].pixels[rows[:, 1]]
        flat = [rig[name].undistorted_pixels(pixels) for name, pixels in ((first, a), (second, b))]
        kept = on_one_geometry(*flat)
        return None if kept is None else PairMatches(first, second, a[kept], b[kept])

    return [found for found in side_by_side(verified, pairs) if found]


def matches_along(
    rig: Rig, features: Mapping[str, Features], pairs: Sequence[tuple[str, str]], *, options: TriangulateOptions
) -> list[PairMatches]:
    """Matches near the epipolar lines that the rig gives: more than are found without it, and more of them by chance.

    They tell nothing of errors across these lines, and all of those along them.
    """

    def along(pair: tuple[str, str]) -> PairMatches:
        rows, _ = _near_lines(rig, *pair, features, options)
        a, b = (features[name].pixels[side] for name, side in zip(pair, rows.T, strict=True))
        return PairMatches(*pair, a, b)

    return side_by_side(along, pairs)


def on_one_geometry(first: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """Which matches, undistorted pixels float64 [N, 2] each, agree on some epipolar geometry, bool [N], or None.

    A feature with several orientations matches several times from one place: eight places are needed in each picture.
    """
    if min(len(np.unique(pixels, axis=0)) for pixels in (first, second)) < 8:
        return None
    try:
        _, mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, 2.0, 0.999, 10_000)
    except cv2.error as error:
        if error.func != "setModelParameters":  # what fails when refining leaves no model, as of a plane and outliers
            raise
        return None
    return None if mask is None else mask.ravel().astype(bool)


def detect_all(rig: Rig, pictures: Mapping[str, np.ndarray], *, options: FeatureOptions) -> dict[str, Features]:
    """Features of each camera's picture, in the order of the rig; raises ValueError for pictures that do not fit it."""
    _check_pictures(rig, pictures)
    names = [name for name in rig.names if name in pictures]
    found = side_by_side(lambda name: detect(pictures[name], options=options), names)
    return dict(zip(names, found, strict=True))


def _check_pictures(rig: Rig, pictures: Mapping[str, np.ndarray]) -> None:
    strangers = sorted(set(pictures) - set(rig.names))
    if strangers:
        raise ValueError(f"pictures must be of the rig's cameras {list(rig.names)}, but there are also {strangers}")
    for name, picture in pictures.items():
        expected = (rig[name].height, rig[name].width, 3)
        if picture.shape != expected or picture.dtype != np.uint8:
            raise ValueError(
                f"camera {name!r} needs uint8 pictures {expected}, but got {picture.dtype} {picture.shape}"
            )


def _shared_views(rig: Rig, centre: np.ndarray) -> np.ndarray:
    """Share of what camera a films, near the centre and behind it, that camera b films too; lesser of both ways."""
    grid = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2) + 0.5) / 8  # [64, 2]
    share = np.zeros((len(rig.cameras), len(rig.cameras)))
    for row, camera in enumerate(rig.cameras):
        plane = camera.plane_from_pixels(grid * (camera.width, camera.height))
        rays = np.hstack([plane, np.ones((len(plane), 1))]) @ camera.camera_from_world[:3, :3]
        distance = np.linalg.norm(camera.centre - centre)
        points = np.concatenate([camera.centre + distance * depth * rays for depth in (0.7, 1.0, 1.5, 2.0)])
        share[row] = [other.sees(points).mean() for other in rig.cameras]
    return np.minimum(share, share.T)


# Matches and tracks


def _link(rig: Rig, first: str, second: str, features: Mapping[str, Features], options: TriangulateOptions) -> Link:
    """Matches of two cameras near each other's epipolar lines."""
    a, b = features[first], features[second]
    rows, distances = _near_lines(rig, first, second, features, options)
    places = np.stack([a.places[rows[:, 0]], b.places[rows[:, 1]]], axis=1)
    return Link(rig.names.index(first), rig.names.index(second), places, distances)


def _near_lines(
    rig: Rig, first: str, second: str, features: Mapping[str, Features], options: TriangulateOptions
) -> tuple[np.ndarray, np.ndarray]:  # as `features.match` returns them
    a, b = features[first], features[second]
    return match(a, b, ratio=options.ratio, band=_epipolar_band(rig[first], rig[second], a, b, options.epipolar_px))


def _epipolar_band(first: Camera, second: Camera, a: Features, b: Features, limit_px: float) -> Band:
    rays_a, rays_b = _rays(first, a), _rays(second, b)
    matrix = essential(first, second)
    lines_b, lines_a = rays_a @ matrix.T, rays_b @ matrix  # [N, 3] in second, [M, 3] in first
    return Band(
        lines_b,
        rays_b,
        limit_px * np.linalg.norm(lines_b[:, :2] / (second.fx, second.fy), axis=1),
        limit_px * np.linalg.norm(lines_a[:, :2] / (first.fx, first.fy), axis=1),
    )


def _rays(camera: Camera, features: Features) -> np.ndarray:
    return np.hstack([camera.plane_from_pixels(features.pixels), np.ones((len(features.pixels), 1))])  # [N, 3]


def _sightings(
    rig: Rig, features: Mapping[str, Features], pairs: Sequence[tuple[str, str]], options: TriangulateOptions
) -> Sightings:
    links = side_by_side(lambda pair: _link(rig, pair[0], pair[1], features, options), pairs)
    number = {name: index for index, name in enumerate(rig.names)}
    counts = {number[name]: int(found.places.max(initial=-1)) + 1 for name, found in features.items()}
    point, camera, place = chain(links, counts, min_views=options.min_views)
    pixels = np.zeros((len(point), 2))
    for name, found in features.items():
        mine = camera == number[name]
        first_there = np.unique(found.places, return_index=True)[1]
        pixels[mine] = found.pixels[first_there[place[mine]]]
    return Sightings(point, camera, pixels)


# Colours and the result


@dataclass(frozen=True)
class _Part:
    """The points of one instant."""

    sightings: Sightings
    xyz: np.ndarray
    errors_px: np.ndarray
    light: np.ndarray
    """float32 [M, 3], mean of a patch, NaN where it is clipped"""
    tint: np.ndarray
    """float32 [M, 3], mean of the middle 3 x 3 pixels"""


def _part(
    rig: Rig,
    pictures: Mapping[str, np.ndarray],
    features: Mapping[str, Features],
    pairs: Sequence[tuple[str, str]],
    options: TriangulateOptions,
) -> _Part:
    sightings, xyz, errors = locate(
        rig,
        _sightings(rig, features, pairs, options),
        max_error_px=options.max_error_px,
        min_views=options.min_views,
        min_angle_deg=options.min_angle_deg,
    )
    light, tint = np.zeros((2, len(errors), 3), np.float32)
    for index, name in enumerate(rig.names):
        mine = sightings.camera == index
        if mine.any():
            mean, clean = patch_light(pictures[name], sightings.pixels[mine], side_px=options.patch_px)
            light[mine] = np.where(clean[:, None], mean, np.float32(np.nan))
            tint[mine] = patch_light(pictures[name], sightings.pixels[mine], side_px=3)[0]
    return _Part(sightings, xyz, errors, light, tint)


def patch_light(picture: np.ndarray, pixels: np.ndarray, *, side_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean linear light of the square about each pixel [N, 2], float32 [N, 3], and whether none of it is clipped.

    `picture` is uint8 RGB. Values below 4 or above 250 count as clipped: what they hide would bend a gain.
    """
    size = (side_px, side_px)
    mean = cv2.blur(LINEAR[picture], size, borderType=cv2.BORDER_REPLICATE)
    clipped = ((picture < 4) | (picture > 250)).any(axis=2)
    spread = cv2.blur(np.asarray(clipped, dtype=np.float32), size, borderType=cv2.BORDER_REPLICATE)
    column = np.clip(pixels[:, 0].astype(int), 0, picture.shape[1] - 1)
    row = np.clip(pixels[:, 1].astype(int), 0, picture.shape[0] - 1)
    return mean[row, column], spread[row, column] < 0.5 / side_px**2


def _joined(
    rig: Rig, parts: Sequence[_Part], evidence: Sequence[PairMatches], options: TriangulateOptions
) -> SparsePoints:
    counts = [len(part.xyz) for part in parts]
    if not sum(counts):
        raise ValueError(
            f"pictures of {len(rig.cameras)} cameras must share points, but none was found in {len(parts)} instants; "
            f"check that the calibration belongs to these videos and that they are synchronized"
        )
    before = np.cumsum([0, *counts[:-1]])
    point = np.concatenate([part.sightings.point + start for part, start in zip(parts, before, strict=True)])
    camera = np.concatenate([part.sightings.camera for part in parts])
    pixels = np.concatenate([part.sightings.pixels for part in parts])
    errors = np.concatenate([part.errors_px for part in parts])
    tint = np.concatenate([part.tint for part in parts])
    whole = Sightings(point.astype(np.int32), camera, pixels)
    return SparsePoints(
        cameras=rig.names,
        xyz=np.concatenate([part.xyz for part in parts]),
        rgb=srgb_from_linear(medians(tint, whole.point)),
        views=whole.views,
        error_px=np.sqrt(np.add.reduceat(errors**2, whole.starts) / whole.views).astype(np.float32),
        instant=np.repeat(np.arange(len(parts)), counts).astype(np.int32),
        point=whole.point,
        camera=whole.camera,
        xy=_undistorted_all(rig, whole),
        colour=np.concatenate([part.light for part in parts]),
        matches=matches_report(rig, evidence, errors_px=errors, options=options.judge),
    )


def _undistorted_all(rig: Rig, sightings: Sightings) -> np.ndarray:
    flat = np.zeros_like(sightings.pixels)
    for index, camera in enumerate(rig.cameras):
        mine = sightings.camera == index
        flat[mine] = camera.undistorted_pixels(sightings.pixels[mine])
    return flat.astype(np.float32)


def reprojections_px(rig: Rig, points: SparsePoints) -> np.ndarray:
    """float64 [M]: distance between where each observation is and where the rig, of the cameras of the points, puts
    it, pixels of the undistorted picture."""
    poses = np.stack([camera.camera_from_world for camera in rig.cameras])[points.camera]  # [M, 4, 4]
    seen = np.einsum("mij,mj->mi", poses[:, :3, :3], points.xyz[points.point]) + poses[:, :3, 3]
    lenses = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in rig.cameras])[points.camera]  # [M, 4]
    placed = seen[:, :2] / seen[:, 2:] * lenses[:, :2] + lenses[:, 2:]
    errors: np.ndarray = np.linalg.norm(placed - points.xy, axis=1)
    return errors
