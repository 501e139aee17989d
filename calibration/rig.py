"""Cameras and the rig they form.

Axes are OpenCV's: x right, y down, z forward. Poses map world to camera. The centre of the top-left pixel is
(0.5, 0.5), as in COLMAP. Lengths are in the units of the source; `Rig.metric` says whether these are metres.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

MOST_SIDE_PX, MOST_PIXELS, MOST_NUMBER = 2**15, 2**28, 1e30
"""Of a picture, and of lengths and lens parameters; packuv.bounds has the same"""

MOST_SHADING = 2.0
"""Of k1 and of k2; packuv.footage.lens has the same"""
WIDEST_RAD = np.radians(88.0)
"""Farthest from the axis that a ray of a fisheye is told apart: beyond, the plane z = 1 is 29 times the depth away"""


@dataclass(frozen=True)
class Camera:
    """One calibrated camera."""

    name: str
    width: int
    height: int
    fx: float
    """Focal lengths and principal point, pixels"""
    fy: float
    cx: float
    cy: float
    camera_from_world: np.ndarray
    """Rigid transform, float64 [4, 4]"""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1 k2 p1 p2 [k3 ...]; empty for a pinhole camera; k1 k2 k3 k4 of OpenCV's fisheye model if `fisheye`"""
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear-light factors r g b that bring this camera's pictures to the rig's common colour"""
    shading: tuple[float, float] = (0.0, 0.0)
    """k1, k2: light falls off by exp(k1 r^2 + k2 r^4), of mean 1 over the picture; r is the distance from the principal
    point at depth 1, r = 1 in the corner"""
    fisheye: bool = False
    """Whether the lens shows a ray at the angle t from the axis at t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)"""

    def __post_init__(self) -> None:
        if not _is_rigid(self.camera_from_world):
            raise ValueError(f"camera {self.name!r}: the pose must be a rigid [4, 4] transform (no mirror, no scale)")
        if self.fisheye and len(self.distortion) != 4:
            raise ValueError(
                f"camera {self.name!r}: OpenCV's fisheye model has 4 coefficients, not {len(self.distortion)}"
            )
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(
                f"camera {self.name!r}: OpenCV lens models have 4, 5 or 8 coefficients, not {len(self.distortion)}"
            )
        numbers = (
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            *self.distortion,
            *self.gains,
            *self.shading,
            self.width,
            self.height,
        )
        if not np.all(np.abs([*numbers, *self.camera_from_world[:3, 3]]) <= MOST_NUMBER):
            raise ValueError(
                f"camera {self.name!r}: intrinsics, lens, gains, size and place must be finite, up to {MOST_NUMBER:g}, "
                f"but are {numbers} and {self.camera_from_world[:3, 3].tolist()}"
            )
        if len(self.shading) != 2 or max(map(abs, self.shading)) > MOST_SHADING:
            raise ValueError(
                f"camera {self.name!r}: shading must be two numbers within {MOST_SHADING}, not {self.shading}"
            )
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"camera {self.name!r}: size and focal lengths must be positive, but are "
                f"{self.width}x{self.height} and {self.fx}, {self.fy}"
            )
        if max(self.width, self.height) > MOST_SIDE_PX or self.width * self.height > MOST_PIXELS:
            raise ValueError(
                f"camera {self.name!r}: a picture has sides up to {MOST_SIDE_PX} and at most {MOST_PIXELS} pixels, "
                f"but is {self.width}x{self.height}"
            )

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsic matrix K, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands, world, float64 [3]."""
        centre: np.ndarray = -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]
        return centre

    @property
    def forward(self) -> np.ndarray:
        """Unit viewing direction, world, float64 [3]."""
        return self.camera_from_world[2, :3].copy()

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with pictures scaled to another size; raises ValueError if that would stretch them."""
        if abs(self.height * width / self.width - height) >= 1 and abs(self.width * height / self.height - width) >= 1:
            raise ValueError(
                f"camera {self.name!r} must film in the shape it was calibrated in, {self.width}x{self.height}, "
                f"but its video is {width}x{height}; crop neither, or calibrate again"
            )
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def turned(self, quarters: int) -> Camera:
        """The same camera when its picture is turned clockwise by so many quarters."""
        camera = self
        for _ in range(quarters % 4):
            camera = camera._turned_once()
        return camera

    def _turned_once(self) -> Camera:
        """What was at (x, y) is at (height - y, x) then."""
        turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        lens = self.distortion
        if lens and not self.fisheye:  # tangential terms are a direction in the picture
            lens = (*lens[:2], lens[3], -lens[2], *lens[4:])
        return replace(
            self,
            width=self.height,
            height=self.width,
            fx=self.fy,
            fy=self.fx,
            cx=self.height - self.cy,
            cy=self.cx,
            camera_from_world=turn @ self.camera_from_world,
            distortion=lens,
        )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] to pixels of the distorted picture [N, 2] and depth [N].

        Pixels mean nothing where depth <= 0, or far outside the picture, where a lens polynomial may fold back.
        """
        local = self._local(points)
        depth = local[:, 2]
        plane = local[:, :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[:, None]
        return self.distorted(plane) * (self.fx, self.fy) + (self.cx, self.cy), depth

    def distorted(self, plane: np.ndarray) -> np.ndarray:
        """What the lens makes of coordinates on the plane z = 1: float64 [N, 2] to [N, 2]."""
        return distort_fisheye(plane, self.distortion) if self.fisheye else distort(plane, self.distortion)

    def plane_from_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels of the distorted picture [N, 2] to undistorted coordinates on the plane z = 1, float64 [N, 2].

        What a fisheye shows at `WIDEST_RAD` from its axis or farther comes out at that angle.
        """
        plane = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion or not len(plane):
            return plane
        if self.fisheye:
            return undistort_fisheye(plane, self.distortion)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        lens = np.asarray(self.distortion, dtype=np.float64)
        return cv2.undistortPoints(plane[:, None], np.eye(3), lens, criteria=stop).reshape(-1, 2)

    def undistorted_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels of the distorted picture [N, 2] to those of a pinhole of the same numbers, float64 [N, 2]."""
        flat: np.ndarray = self.plane_from_pixels(pixels) * (self.fx, self.fy) + (self.cx, self.cy)
        return flat

    def sees(self, points: np.ndarray) -> np.ndarray:
        """Which world points [N, 3] lie before the camera and inside its picture, bool [N]."""
        pixels, depth = self.project(points)
        inside: np.ndarray = np.all((pixels >= 0) & (pixels <= (self.width, self.height)), axis=1) & (depth > 0)
        if not self.distortion:
            return inside
        # A lens polynomial that folds back maps rays far outside the field of view into the picture.
        local = self._local(points)
        corners = self.plane_from_pixels(np.array([(x, y) for x in (0, self.width) for y in (0, self.height)]))
        reach = 1.05 * np.linalg.norm(corners, axis=1).max()
        inside &= np.linalg.norm(local[:, :2], axis=1) <= reach * np.maximum(depth, 0)
        return inside

    def _local(self, points: np.ndarray) -> np.ndarray:
        local: np.ndarray = points @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        return local  # [N, 3], camera axes


@dataclass(frozen=True)
class Rig:
    """All cameras of a capture, by name, in a common world."""

    cameras: tuple[Camera, ...]
    source: str
    """Where the calibration came from, for people: a path or 'COLMAP, instant 0'"""
    metric: bool = False
    """True if the source says that one unit is one metre"""
    up: tuple[float, float, float] | None = None
    """Unit vector, world; None where nothing tells it"""

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names) or not names:
            raise ValueError(f"a rig needs cameras with names of their own, but has {names}")
        if self.up is not None and not (len(self.up) == 3 and abs(float(np.linalg.norm(self.up)) - 1) < 1e-6):
            raise ValueError(f"up must be a unit vector of three numbers, but is {self.up}")

    def __getitem__(self, name: str) -> Camera:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise KeyError(f"no camera {name!r} in the rig; it has {[camera.name for camera in self.cameras]}")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    @property
    def centres(self) -> np.ndarray:
        """Where the cameras stand, world, float64 [C, 3]."""
        return np.stack([camera.centre for camera in self.cameras])

    def select(self, names: Iterable[str]) -> Rig:
        """The rig of the named cameras, in that order; raises KeyError for a name it lacks."""
        return replace(self, cameras=tuple(self[name] for name in names))

    def resized(self, sizes: Mapping[str, tuple[int, int]]) -> Rig:
        """The rig with pictures of these widths and heights, by camera."""
        return replace(self, cameras=tuple(camera.resized(*sizes[camera.name]) for camera in self.cameras))

    def save(self, path: Path) -> None:
        """Write JSON; docs/calibration.md names every field."""
        cameras = [_camera_to_json(camera) for camera in self.cameras]
        # Absent where nobody knows it, so that such rigs keep their bytes.
        up = {} if self.up is None else {"up": list(self.up)}
        data = {"source": self.source, "metric": self.metric, **up, "cameras": cameras}
        path.write_text(json.dumps(data, indent=1))

    @classmethod
    def load(cls, path: Path) -> Rig:
        """Inverse of `save`; raises ValueError that names the file and what it lacks."""
        try:
            return cls.from_json(json.loads(path.read_text()), path)
        except (RecursionError, json.JSONDecodeError) as problem:
            raise ValueError(f"{path}: not a rig file ({problem}); docs/calibration.md shows one") from None

    @classmethod
    def from_json(cls, data: Any, path: Path) -> Rig:
        """The rig of a file's content; raises ValueError that names the file and what it lacks."""
        try:
            cameras = tuple(_camera_from_json(item) for item in data["cameras"])
            return cls(cameras, str(data["source"]), bool(data["metric"]), _direction(data.get("up")))
        except KeyError as missing:
            raise ValueError(f"{path}: a rig file needs the field {missing}; docs/calibration.md lists them") from None
        except (TypeError, OverflowError) as problem:
            raise ValueError(f"{path}: not a rig file ({problem}); docs/calibration.md shows one") from None


def distort(plane: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """OpenCV's lens model (0, 4, 5 or 8 coefficients) on coordinates at z = 1: [N, 2] to [N, 2]."""
    if not coefficients:
        return plane
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def distort_fisheye(plane: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """OpenCV's fisheye model (4 coefficients) on coordinates at z = 1: [N, 2] to [N, 2]."""
    radius = np.linalg.norm(plane, axis=1)
    angle = np.arctan(radius)
    factor = fisheye_radius(angle, coefficients) / np.where(radius < 1e-9, 1.0, radius)
    return plane * np.where(radius < 1e-9, 1.0, factor)[:, None]


def undistort_fisheye(plane: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Inverse of `distort_fisheye`, by bisection of the angle between 0 and `WIDEST_RAD`: [N, 2] to [N, 2]."""
    radius = np.linalg.norm(plane, axis=1)
    low, high = np.zeros(len(plane)), np.full(len(plane), min(WIDEST_RAD, fisheye_turn_rad(coefficients)))
    for _ in range(60):  # halves 1.5 rad down to less than float64 tells apart
        middle = (low + high) / 2
        short = fisheye_radius(middle, coefficients) < radius
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    factor = np.tan(high) / np.where(radius < 1e-9, 1.0, radius)
    return plane * np.where(radius < 1e-9, 1.0, factor)[:, None]


def fisheye_radius(angle: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Distance from the principal point, in focal lengths, of rays at these angles from the axis, radians."""
    k1, k2, k3, k4 = coefficients
    t2 = angle * angle
    radius: np.ndarray = angle * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return radius


def fisheye_turn_rad(coefficients: tuple[float, ...]) -> float:
    """Angle from the axis from which on the model folds back, radians; infinite where it never does before pi."""
    k1, k2, k3, k4 = coefficients
    angle = np.linspace(0, np.pi, 4097)
    t2 = angle * angle
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    folds = np.flatnonzero(slope <= 0)
    return float(angle[max(folds[0] - 1, 0)]) if len(folds) else float("inf")


def _is_rigid(pose: np.ndarray) -> bool:
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)) or not np.array_equal(pose[3], (0, 0, 0, 1)):
        return False
    rotation = pose[:3, :3]
    return bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0)


def _direction(numbers: Any) -> tuple[float, float, float] | None:
    if numbers is None:
        return None
    x, y, z = map(float, numbers)
    return x, y, z


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    numbers = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    lists = {"distortion": list(camera.distortion), "gains": list(camera.gains), "shading": list(camera.shading)}
    pose = {"camera_from_world": camera.camera_from_world.tolist()}
    return {"name": camera.name, **numbers, **lists, **({"fisheye": True} if camera.fisheye else {}), **pose}


def _camera_from_json(item: Mapping[str, Any]) -> Camera:
    unknown = sorted(set(item) - {field.name for field in fields(Camera)})
    if unknown:
        raise ValueError(f"camera {item.get('name')!r} has the unknown fields {unknown}")
    return Camera(
        name=item["name"],
        width=item["width"],
        height=item["height"],
        fx=item["fx"],
        fy=item["fy"],
        cx=item["cx"],
        cy=item["cy"],
        camera_from_world=np.asarray(item["camera_from_world"], dtype=np.float64),
        distortion=tuple(item["distortion"]),
        gains=tuple(item["gains"]),
        shading=tuple(item.get("shading", (0.0, 0.0))),
        fisheye=item.get("fisheye", False) is True,
    )
