"""What every format is read into: posed pictures, and what is known of the videos that they belong to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from calibration.importers.names import same_name
from calibration.rig import Camera

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""Camera axes right, up, back to right, down, forward; its own inverse"""
PIXEL_CENTRE = 0.5
"""Where OpenCV has the centre of the top-left pixel at (0, 0), we have (0.5, 0.5)"""
SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".exr"}
    | {".mp4", ".mov", ".mkv", ".avi", ".webm", ".mxf", ".m4v", ".mts"}
)
"""Of pictures and videos"""


@dataclass(frozen=True)
class View:
    """One posed picture; its camera's name is one of `names`, the file's videos tell which."""

    names: tuple[str, ...]
    camera: Camera


@dataclass(frozen=True)
class Reading:
    """What a file holds."""

    views: Sequence[View]
    metric: bool = False
    """Whether its units are metres"""
    up: tuple[float, float, float] | None = None
    """Unit vector, world, where it says one"""


@dataclass(frozen=True)
class Videos:
    """What is known of the videos."""

    names: tuple[str, ...] | None = None
    """None: the file's own cameras are asked for"""
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Width and height, pixels"""

    def size(self, names: Iterable[str], centre: tuple[float, float] | None = None) -> tuple[int, int] | None:
        """Size of the video that one of these names means, or None.

        `centre` is a principal point that must lie in it; raises ValueError where it does not.
        """
        for name in names:
            for video, (width, height) in self.sizes.items():
                if same_name(name, video):
                    if centre and not (0 < centre[0] < width and 0 < centre[1] < height):
                        raise ValueError(
                            f"camera {name!r} has its principal point at ({centre[0]:.6g}, {centre[1]:.6g}), outside "
                            f"its video of {width}x{height}: the file must say at which size it was calibrated"
                        )
                    return width, height
        return None


def picture_names(path: str) -> tuple[str, str, str]:
    """Names that a picture's file may give its camera: its own, its folder's, its own without the frame's number."""
    picture = PurePosixPath(path.replace("\\", "/"))
    own = picture
    while own.suffix.lower() in SUFFIXES:
        own = own.with_suffix("")
    stem = own.name.rstrip("0123456789")
    for separator in ("_", "-", "."):  # cam01_000123, and ActorsHQ's Cam001_rgb000123
        if stem != own.name and separator in stem:
            return own.name, picture.parent.name, stem.rsplit(separator, 1)[0]
    return own.name, picture.parent.name, own.name


def numbered_names(number: int) -> tuple[str, ...]:
    """How a video of a camera that has only a number may be called."""
    return (
        *(str(number), f"cam_{number}", f"cam{number}", f"port_{number}"),
        *(f"{number:02d}", f"cam{number:02d}", f"cam_{number:02d}"),
        *(f"{number:03d}", f"{number:04d}", f"camera_{number:04d}", f"camera{number}"),
    )


def lens(coefficients: Iterable[float]) -> tuple[float, ...]:
    """The shortest of OpenCV's lens models (0, 4, 5, 8 coefficients) that holds these."""
    values = tuple(float(value) for value in coefficients)
    used = max((index + 1 for index, value in enumerate(values) if value), default=0)
    if used > 8:
        raise ValueError(
            f"thin prisms and tilted sensors are not supported, but the lens has {used} coefficients; "
            "calibrate with at most 8"
        )
    length = next(length for length in (0, 4, 5, 8) if length >= used)
    return (values + (0.0,) * 8)[:length]


def pose(rotation: np.ndarray, translation: Any, what: str) -> np.ndarray:
    """Rigid [4, 4] from a rotation that text has rounded; raises ValueError when it is none."""
    if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
        raise ValueError(f"{what}: the pose must hold a rotation of 3 x 3 finite numbers, but is {rotation.tolist()}")
    left, scales, right = np.linalg.svd(rotation)
    if not np.allclose(scales, 1, atol=1e-3) or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{what}: the pose must hold a rotation, but its axes have lengths {np.round(scales, 4)} "
            f"and determinant {np.linalg.det(rotation):.4f}"
        )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = left @ right, np.asarray(translation, dtype=np.float64).reshape(3)
    return matrix


def pose_at(camera_from_world: np.ndarray, centre: Any, what: str) -> np.ndarray:
    """Rigid [4, 4] of a camera turned by [3, 3] that stands at `centre`, world."""
    turned = pose(camera_from_world, (0.0, 0.0, 0.0), what)
    turned[:3, 3] = -turned[:3, :3] @ np.asarray(centre, dtype=np.float64).reshape(3)
    return turned


def rotation(quaternion: Any, what: str) -> np.ndarray:
    """float64 [3, 3] of w x y z, which rounding may have made longer or shorter than 1."""
    parts = np.asarray(quaternion, dtype=np.float64)
    with np.errstate(over="ignore"):
        length = float(np.linalg.norm(parts))
    if not (np.isfinite(length) and length > 1e-12):
        raise ValueError(f"{what}: a rotation's quaternion must have the length 1, but is {parts.tolist()}")
    w, x, y, z = parts / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix3(value: Any, what: str) -> np.ndarray:
    """float64 [3, 3] of nested lists or nine numbers in rows."""
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.size != 9:
        raise ValueError(f"{what} must be a matrix of 3 x 3 numbers")
    return found.reshape(3, 3)


def intrinsics(matrix: np.ndarray, what: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of K [3, 3] in its own pixels; raises ValueError for a skew that would show."""
    if abs(matrix[0, 1]) > 1e-3 * abs(matrix[0, 0]):
        raise ValueError(f"{what}: pixels must be upright, but the intrinsic matrix has the skew {matrix[0, 1]:g}")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
