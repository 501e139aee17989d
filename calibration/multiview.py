"""Geometry of several views with known cameras: points from sightings, and what two views say about each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.rig import Camera, Rig


@dataclass(frozen=True)
class Sightings:
    """Where cameras see points, sorted by point; every point from 0 on has at least one."""

    point: np.ndarray
    """int32 [M]"""
    camera: np.ndarray
    """int32 [M], index into the rig's cameras"""
    pixels: np.ndarray
    """float64 [M, 2], distorted pictures"""

    def only(self, kept: np.ndarray) -> Sightings:
        """Those that a mask [M] keeps, points numbered anew without gaps."""
        point = np.unique(self.point[kept], return_inverse=True)[1].astype(np.int32)
        return Sightings(point, self.camera[kept], self.pixels[kept])

    @property
    def starts(self) -> np.ndarray:
        """Row of each point's first sighting, int64 [P]."""
        return np.flatnonzero(np.r_[True, self.point[1:] != self.point[:-1]]) if len(self.point) else np.zeros(0, int)

    @property
    def views(self) -> np.ndarray:
        """Sightings of each point, int32 [P]."""
        return np.bincount(self.point).astype(np.int32) if len(self.point) else np.zeros(0, np.int32)


def locate(
    rig: Rig, sightings: Sightings, *, max_error_px: float, min_views: int, min_angle_deg: float
) -> tuple[Sightings, np.ndarray, np.ndarray]:  # sightings kept, xyz float64 [P, 3], errors float64 [M] pixels
    """Triangulate, drop the worst sighting of each point that exceeds the error, and repeat until none does.

    A point goes when fewer than `min_views` sightings are left or when no two of its rays differ by `min_angle_deg`.
    """
    geometry = _Geometry(rig)
    while True:
        sightings = sightings.only(sightings.views[sightings.point] >= min_views)
        xyz = geometry.points(sightings)
        errors = geometry.errors_px(sightings, xyz)
        worst = np.maximum.reduceat(errors, sightings.starts) if len(errors) else errors
        drop = (errors > max_error_px) & (errors == worst[sightings.point])
        if not drop.any():
            break
        sightings = sightings.only(~drop)
    wide = geometry.angles_deg(sightings, xyz) >= min_angle_deg
    seen = wide[sightings.point]
    return sightings.only(seen), xyz[wide], errors[seen]


def misses_px(rig: Rig, sightings: Sightings, *, most_px: float = 50.0) -> np.ndarray:
    """How far each point's sightings lie from where they meet best, root mean square, up to `most_px`: float64 [P]."""
    geometry = _Geometry(rig)
    errors = np.minimum(geometry.errors_px(sightings, geometry.points(sightings)), most_px)
    found: np.ndarray = np.sqrt(_sums(errors**2, sightings) / sightings.views)
    return found


@dataclass(frozen=True)
class Foreseen:
    """Sightings beside where the other cameras that show their points expect them, in undistorted pictures."""

    camera: np.ndarray
    """int32 [M], index into the rig's cameras"""
    plane: np.ndarray
    """float64 [M, 2], where it is expected, at z = 1"""
    miss_px: np.ndarray
    """float64 [M, 2], from there to where it is seen"""
    weight: np.ndarray
    """float64 [M, 2, 2], inverse covariance of that way, if each coordinate of a sighting is known to 1 px"""
    slope: np.ndarray
    """float64 [M, 2, 3], pixels by which the expected place goes when the point goes by one unit of the world"""

    def of(self, camera: int) -> Foreseen:
        """Those of one camera."""
        return self._only(self.camera == camera)

    def _only(self, kept: np.ndarray) -> Foreseen:
        return Foreseen(self.camera[kept], self.plane[kept], self.miss_px[kept], self.weight[kept], self.slope[kept])


def foreseen(rig: Rig, sightings: Sightings, *, max_error_px: float, min_angle_deg: float) -> Foreseen:
    """What the others say of each sighting of a point that three cameras or more show.

    Each point is located anew without the camera that is asked, so a camera that is wrong does not bend what is
    expected of it. The worst of the others goes while it exceeds the error and two are left; where these two disagree,
    or no two rays differ by `min_angle_deg`, nothing is expected.
    """
    geometry = _Geometry(rig)
    asked, others = _without_each(sightings.only(sightings.views[sightings.point] >= 3))
    xyz, errors, left = np.zeros((len(asked.point), 3)), np.zeros(len(others.point)), np.ones(len(others.point), bool)
    rows = np.arange(len(left))
    while len(rows):
        now = others.only(np.isin(np.arange(len(left)), rows))
        located = geometry.points(now)
        xyz[others.point[rows[now.starts]]] = located
        errors[rows] = geometry.errors_px(now, located)
        worst = np.maximum.reduceat(errors[rows], now.starts)[now.point]
        drop = (errors[rows] > max_error_px) & (errors[rows] == worst) & (now.views[now.point] > 2)
        left[rows[drop]] = False
        rows = np.flatnonzero(left & np.isin(others.point, others.point[rows[drop]]))  # what is located again
    agree = np.bincount(others.point[left & (errors <= max_error_px)], minlength=len(xyz)) >= 2
    kept = others.only(left & agree[others.point])
    asked = asked.only(agree)
    return _expected(geometry, asked, kept, xyz[agree], min_angle_deg)


def _without_each(sightings: Sightings) -> tuple[Sightings, Sightings]:
    """Each sighting as a point of its own, and the others of its point under the same number."""
    asked, others = [np.zeros(0, int)], [np.zeros((2, 0), int)]
    for views in np.unique(sightings.views).tolist():
        rows = sightings.starts[sightings.views == views][:, None] + np.arange(views)  # [P, views]
        for place in range(views):
            asked.append(rows[:, place])
            rest = np.delete(rows, place, axis=1)
            others.append(np.stack([np.repeat(rows[:, place], views - 1), rest.ravel()]))
    one, (whose, many) = np.sort(np.concatenate(asked)), np.concatenate(others, axis=1)
    order = np.argsort(whose, kind="stable")
    whose, many = whose[order], many[order]
    number = np.searchsorted(one, whose).astype(np.int32)
    return (
        Sightings(np.arange(len(one), dtype=np.int32), sightings.camera[one], sightings.pixels[one]),
        Sightings(number, sightings.camera[many], sightings.pixels[many]),
    )


def _expected(
    geometry: _Geometry, asked: Sightings, others: Sightings, xyz: np.ndarray, min_angle_deg: float
) -> Foreseen:
    """Of sightings `asked`, one for each point that `others` locate at xyz [P, 3]."""
    _, slope, _ = geometry.residuals(others, xyz)
    known = _sums(slope.transpose(0, 2, 1) @ slope, others)  # [P, 3, 3], inverse covariance of the points
    miss, own, depth = geometry.residuals(asked, xyz)
    wide = (geometry.angles_deg(others, xyz) >= min_angle_deg) & (depth > 0)
    known = known + 1e-9 * np.trace(known, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    cover = np.eye(2) + own @ np.linalg.solve(known, own.transpose(0, 2, 1)) if len(xyz) else np.zeros((0, 2, 2))
    plane = geometry.planes(asked) + miss / geometry.focal[asked.camera]
    found = Foreseen(asked.camera, plane, -miss, np.linalg.inv(cover), own)
    return found._only(wide)


class _Geometry:
    """The rig as arrays, in a frame where its middle is 0 and its size 1, which keeps the linear start well posed."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._middle = rig.centres.mean(axis=0)
        self._size = max(float(np.linalg.norm(rig.centres - self._middle, axis=1).max()), 1e-12)
        self._rotation = np.stack([camera.camera_from_world[:3, :3] for camera in rig.cameras])  # [C, 3, 3]
        self._centre = (rig.centres - self._middle) / self._size  # [C, 3]
        self.focal = np.array([(camera.fx, camera.fy) for camera in rig.cameras])  # [C, 2]

    def points(self, sightings: Sightings, *, steps: int = 8) -> np.ndarray:  # [P, 3], world
        """Linear triangulation, then Gauss-Newton on Cauchy-weighted reprojection errors of 1 px scale."""
        plane = self.planes(sightings)
        unit = self._linear(sightings, plane)
        for _ in range(steps):
            residual, slope, _ = self._residuals(sightings, plane, unit)
            weight = 1 / (1 + (residual**2).sum(axis=1))
            normal = _sums(weight[:, None, None] * (slope.transpose(0, 2, 1) @ slope), sightings)
            push = _sums(weight[:, None] * np.einsum("mij,mi->mj", slope, residual), sightings)
            damping = 1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12
            unit = unit - np.linalg.solve(normal + damping[:, None, None] * np.eye(3), push[:, :, None])[:, :, 0]
        points: np.ndarray = unit * self._size + self._middle
        return points

    def errors_px(self, sightings: Sightings, xyz: np.ndarray) -> np.ndarray:
        """Distance in the undistorted picture, infinite behind the camera: float64 [M]."""
        residual, _, depth = self._residuals(sightings, self.planes(sightings), (xyz - self._middle) / self._size)
        return np.where(depth > 0, np.linalg.norm(residual, axis=1), np.inf)

    def residuals(
        self, sightings: Sightings, xyz: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # [M, 2] pixels, [M, 2, 3] slope by the point in the world, depth
        found, slope, depth = self._residuals(sightings, self.planes(sightings), (xyz - self._middle) / self._size)
        return found, slope / self._size, depth * self._size

    def angles_deg(self, sightings: Sightings, xyz: np.ndarray) -> np.ndarray:
        """Greatest angle between two rays of each point, float64 [P]."""
        rays = (xyz[sightings.point] - self._middle) / self._size - self._centre[sightings.camera]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        least = np.ones(len(xyz))
        for apart in range(1, int(sightings.views.max(initial=1))):
            same = sightings.point[apart:] == sightings.point[:-apart]
            cosine = (rays[apart:] * rays[:-apart]).sum(axis=1)[same]
            np.minimum.at(least, sightings.point[apart:][same], cosine)
        return np.degrees(np.arccos(np.clip(least, -1, 1)))

    def planes(self, sightings: Sightings) -> np.ndarray:
        plane = np.zeros((len(sightings.point), 2))
        for index, camera in enumerate(self._rig.cameras):
            mine = sightings.camera == index
            plane[mine] = camera.plane_from_pixels(sightings.pixels[mine])
        return plane

    def _linear(self, sightings: Sightings, plane: np.ndarray) -> np.ndarray:
        """Least squares on x z - X = 0 and y z - Y = 0 in camera axes, in pixels at depth 1: float64 [P, 3]."""
        rotation, centre = self._rotation[sightings.camera], self._centre[sightings.camera]
        rows = (plane[:, :, None] * rotation[:, 2:] - rotation[:, :2]) * self.focal[sightings.camera][:, :, None]
        right = np.einsum("mij,mj->mi", rows, centre)  # rows (X - centre) = 0
        normal = _sums(rows.transpose(0, 2, 1) @ rows, sightings)
        push = _sums(np.einsum("mij,mi->mj", rows, right), sightings)
        damping = 1e-12 * np.trace(normal, axis1=1, axis2=2) + 1e-12
        return np.linalg.solve(normal + damping[:, None, None] * np.eye(3), push[:, :, None])[:, :, 0]

    def _residuals(
        self, sightings: Sightings, plane: np.ndarray, unit: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # [M, 2] pixels, [M, 2, 3] slope by the point, [M] depth
        rotation, focal = self._rotation[sightings.camera], self.focal[sightings.camera]
        local = np.einsum("mij,mj->mi", rotation, unit[sightings.point] - self._centre[sightings.camera])
        depth = local[:, 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        seen = local[:, :2] / safe[:, None]
        slope = (rotation[:, :2] - seen[:, :, None] * rotation[:, 2:]) / safe[:, None, None]
        return (seen - plane) * focal, slope * focal[:, :, None], depth


def _sums(values: np.ndarray, sightings: Sightings) -> np.ndarray:
    """Sum over the sightings of each point, in their order: [M, ...] to [P, ...]."""
    return np.add.reduceat(values, sightings.starts) if len(values) else values[:0]


def medians(values: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Median of each point's rows, [M, K] to [P, K]; `point` int [M] is sorted and has no gaps."""
    starts, counts = np.unique(point, return_index=True, return_counts=True)[1:]
    low, high = starts + (counts - 1) // 2, starts + counts // 2
    columns = [column[np.lexsort((column, point))] for column in values.T]
    return np.stack([(column[low] + column[high]) / 2 for column in columns], axis=1)


# Two views


def essential(first: Camera, second: Camera) -> np.ndarray:
    """E with b^T E a = 0 for the two cameras' coordinates at z = 1, float64 [3, 3]."""
    second_from_first = second.camera_from_world @ np.linalg.inv(first.camera_from_world)
    x, y, z = second_from_first[:3, 3]
    matrix: np.ndarray = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ second_from_first[:3, :3]
    return matrix


def sampson_px(first: Camera, second: Camera, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """First-order distance to agreement with the poses, of matches at z = 1 [K, 2] each: float64 [K], pixels."""
    one = np.ones((len(a), 1))
    lines_b = np.hstack([a, one]) @ essential(first, second).T  # [K, 3]
    lines_a = np.hstack([b, one]) @ essential(first, second)
    residual = (np.hstack([b, one]) * lines_b).sum(axis=1)
    slope = (lines_a[:, :2] / (first.fx, first.fy)) ** 2 + (lines_b[:, :2] / (second.fx, second.fy)) ** 2
    distance: np.ndarray = np.abs(residual) / np.sqrt(np.maximum(slope.sum(axis=1), 1e-30))
    return distance


def in_front(first: Camera, second: Camera, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether the two rays come nearest to each other in front of both cameras, bool [K]."""
    one = np.ones((len(a), 1))
    u = np.hstack([a, one]) @ first.camera_from_world[:3, :3]  # [K, 3], world
    v = np.hstack([b, one]) @ second.camera_from_world[:3, :3]
    base = second.centre - first.centre
    uu, vv, uv = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    depth_a = vv * (u @ base) - uv * (v @ base)
    depth_b = uv * (u @ base) - uu * (v @ base)
    ahead: np.ndarray = (depth_a > 0) & (depth_b > 0)
    return ahead
