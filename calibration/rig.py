"""Cameras and the rig they form.

Axes are OpenCV's: x right, y down, z forward. Poses map world to camera. The centre of the top-left pixel is
(0.5, 0.5), as in COLMAP. Lengths are in the units of the source; `Rig.metric` says whether these are metres.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


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

    def __post_init__(self) -> None:
        rotation = self.camera_from_world[:3, :3]
        if self.camera_from_world.shape != (4, 4) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise ValueError(f"camera {self.name!r}: the pose must be a rigid [4, 4] transform")
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"camera {self.name!r}: size and focal lengths must be positive, but are "
                f"{self.width}x{self.height} and {self.fx}, {self.fy}"
            )

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsic matrix K, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands, world, float64 [3]."""
        return -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]


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

    def save(self, path: Path) -> None:
        """Write JSON; the docs name every field."""
        cameras = [
            {
                "name": c.name, "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
                "distortion": list(c.distortion), "gains": list(c.gains), "camera_from_world": c.camera_from_world.tolist(),
            }
            for c in self.cameras
        ]  # fmt: skip
        path.write_text(json.dumps({"source": self.source, "metric": self.metric, "cameras": cameras}, indent=1))

    @classmethod
    def load(cls, path: Path) -> Rig:
        data = json.loads(path.read_text())
        return cls(tuple(_camera_from_json(item) for item in data["cameras"]), data["source"], data["metric"])


def _camera_from_json(item: Mapping[str, Any]) -> Camera:
    return Camera(
        item["name"], item["width"], item["height"], item["fx"], item["fy"], item["cx"], item["cy"],
        np.asarray(item["camera_from_world"], dtype=np.float64), tuple(item["distortion"]), tuple(item["gains"]),
    )  # fmt: skip
