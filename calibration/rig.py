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
    """OpenCV's k1 k2 p1 p2 [k3 ...]; empty for a pinhole camera"""
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear-light factors r g b that bring this camera's pictures to the rig's common colour"""
    shading: tuple[float, float] = (0.0, 0.0)
    """k1, k2: light falls off by exp(k1 r^2 + k2 r^4), of mean 1 over the picture; r is the distance from the principal
    point at depth 1, r = 1 in the corner"""

    def __post_init__(self) -> None:
        if not _is_rigid(self.camera_from_world):
            raise ValueError(f"camera {self.name!r}: the pose must be a rigid [4, 4] transform (no mirror, no scale)")
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

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] to pixels of the distorted picture [N, 2] and depth [N].

        Pixels mean nothing where depth <= 0, or far outside the picture, where a lens polynomial may fold back.
        """
        local = self._local(points)
        depth = local[:, 2]
        plane = local[:, :2] / np.where(np.abs(depth) < 1e-12, 1e-12, depth)[:, None]
        return distort(plane, self.distortion) * (self.fx, self.fy) + (self.cx, self.cy), depth

    def plane_from_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels of the distorted picture [N, 2] to undistorted coordinates on the plane z = 1, float64 [N, 2]."""
        plane = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion or not len(plane):
            return plane
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        lens = np.asarray(self.distortion, dtype=np.float64)
        return cv2.undistortPoints(plane[:, None], np.eye(3), lens, criteria=stop).reshape(-1, 2)

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

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names) or not names:
            raise ValueError(f"a rig needs cameras with names of their own, but has {names}")

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
        return Rig(tuple(self[name] for name in names), self.source, self.metric)

    def resized(self, sizes: Mapping[str, tuple[int, int]]) -> Rig:
        """The rig with pictures of these widths and heights, by camera."""
        return replace(self, cameras=tuple(camera.resized(*sizes[camera.name]) for camera in self.cameras))

    def save(self, path: Path) -> None:
        """Write JSON; docs/calibration.md names every field."""
        cameras = [_camera_to_json(camera) for camera in self.cameras]
        path.write_text(json.dumps({"source": self.source, "metric": self.metric, "cameras": cameras}, indent=1))

    @classmethod
    def load(cls, path: Path) -> Rig:
        """Inverse of `save`; raises ValueError that names the file and what it lacks."""
        try:
            data = json.loads(path.read_text())
            cameras = tuple(_camera_from_json(item) for item in data["cameras"])
            return cls(cameras, str(data["source"]), bool(data["metric"]))
        except KeyError as missing:
            raise ValueError(f"{path}: a rig file needs the field {missing}; docs/calibration.md lists them") from None
        except (TypeError, RecursionError, OverflowError, json.JSONDecodeError) as problem:
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


def _is_rigid(pose: np.ndarray) -> bool:
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)) or not np.array_equal(pose[3], (0, 0, 0, 1)):
        return False
    rotation = pose[:3, :3]
    return bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0)


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    numbers = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    lists = {"distortion": list(camera.distortion), "gains": list(camera.gains), "shading": list(camera.shading)}
    return {"name": camera.name, **numbers, **lists, "camera_from_world": camera.camera_from_world.tolist()}


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
    )
