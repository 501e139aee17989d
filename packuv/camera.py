"""The pinhole camera that every renderer, motion and fit of this package shares.

Axes are OpenCV's: x right, y down, z forward. The centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


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
        if self.camera_from_world.shape != (4, 4):
            raise ValueError(f"camera {self.name!r}: {self.camera_from_world.shape=}, but a pose is [4, 4]")
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"camera {self.name!r}: size and focal lengths must be positive, "
                f"but are {self.width}x{self.height} and {self.fx}, {self.fy}"
            )

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
        """Inverse of `to_json`; raises ValueError that names a missing field."""
        try:
            return cls(
                str(data["name"]),
                int(data["width"]),
                int(data["height"]),
                float(data["fx"]),
                float(data["fy"]),
                float(data["cx"]),
                float(data["cy"]),
                np.asarray(data["camera_from_world"], dtype=np.float64),
            )
        except KeyError as missing:
            raise ValueError(f"a camera needs the field {missing}, but has {sorted(data)}") from None
