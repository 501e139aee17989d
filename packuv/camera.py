"""The pinhole camera that every renderer, motion and fit of this package shares.

Axes are OpenCV's: x right, y down, z forward. The centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from packuv.bounds import check_picture, field, fields, finite, numbers, positive, words


@dataclass(frozen=True)
class PinholeCamera:
    """An undistorted camera with a pose."""

    name: str
    width: int
    height: int
    fx: float
    """Focal lengths and principal point, pixels."""
    fy: float
    cx: float
    cy: float
    camera_from_world: np.ndarray
    """Rigid transform, float64 [4, 4]; maps world points to camera axes."""

    def __post_init__(self) -> None:
        what = f"camera {self.name!r}"
        if self.camera_from_world.shape != (4, 4):
            raise ValueError(f"{what}: {self.camera_from_world.shape=}, but a pose is [4, 4]")
        if not np.isfinite(self.camera_from_world).all():
            raise ValueError(f"{what}: the pose must hold finite numbers, but is {self.camera_from_world.tolist()}")
        check_picture(self.width, self.height, what)
        for name in ("fx", "fy"):
            positive(float(getattr(self, name)), f"{what}: {name}")
        for name in ("cx", "cy"):
            finite(float(getattr(self, name)), f"{what}: {name}")

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands, world, float64 [3]."""
        return np.asarray(-self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3])

    @property
    def forward(self) -> np.ndarray:
        """Unit viewing direction, world, float64 [3]."""
        return self.camera_from_world[2, :3].copy()

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsic matrix K, float64 [3, 3], pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def scaled(self, width: int, height: int) -> PinholeCamera:
        """The same view at another picture size."""
        x, y = width / self.width, height / self.height
        return PinholeCamera(
            self.name, width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y, self.camera_from_world
        )

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points [N, 3] to pixels [N, 2] and depth [N]; pixels mean nothing where depth <= 0."""
        local = points @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        depth = local[:, 2]
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        pixels = np.stack([self.fx * local[:, 0] / safe + self.cx, self.fy * local[:, 1] / safe + self.cy], axis=1)
        return pixels, depth

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "width": self.width,
            "height": self.height,
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "camera_from_world": self.camera_from_world.tolist(),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> PinholeCamera:
        """Inverse of `to_json`; raises ValueError that names what is missing or no number."""
        name = words(field(fields(data, "a camera"), "name", "a camera"), "a camera's name")
        what = f"camera {name!r}"
        width, height, fx, fy, cx, cy = (
            finite(field(data, key, what), f"{what}: {key}") for key in ("width", "height", "fx", "fy", "cx", "cy")
        )
        check_picture(width, height, what)
        pose = numbers(field(data, "camera_from_world", what), f"{what}: camera_from_world", (4, 4))
        return cls(name, int(width), int(height), fx, fy, cx, cy, pose)
