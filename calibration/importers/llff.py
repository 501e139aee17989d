"""poses_bounds.npy of LLFF, N3DV and MeetRoom: camera-to-world poses, axes down, right, back; no names, no lenses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.importers.names import natural_key
from calibration.importers.views import Reading, Videos, View, pose_at
from calibration.rig import Camera

KIND = "poses_bounds.npy"
BESIDE = ("poses_bounds*.npy",)


def claims(file: Path) -> bool:
    return file.name == "poses_bounds.npy"


def read(file: Path, videos: Videos) -> Reading:
    rows = np.load(file, mmap_mode="r", allow_pickle=False)  # mapped: its shape is held against the file's size
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu" or not np.isfinite(rows).all():
        numbers = rows.dtype.kind in "fiu"
        raise ValueError(
            f"poses_bounds.npy must hold a row of 17 finite numbers for each camera, but is {rows.shape}, "
            f"{int((~np.isfinite(rows)).sum()) if numbers else 'all'} of them not finite; export it again, or give "
            "another calibration"
        )
    of_row = names_of_rows(len(rows), videos.names)
    return Reading([View((of_row[index],), _camera(row)) for index, row in enumerate(rows)])


def names_of_rows(count: int, names: Sequence[str] | None) -> list[str]:
    """The camera of each row: by order where numbers agree, else by the number at the end of the name."""
    if names is None:
        return [f"cam{row:02d}" for row in range(count)]
    if len(names) == count:
        return sorted(names, key=natural_key)
    numbers = {int(match[0]): name for name in names if (match := re.search(r"\d+$", name))}
    if len(numbers) != len(names) or max(numbers, default=0) >= count:
        raise ValueError(
            f"it has {count} rows, which belong to the videos in the order of their names, but there are "
            f"{len(names)} videos; add the missing ones, or number all from 0 to {count - 1}"
        )
    return [numbers.get(row, f"row {row}") for row in range(count)]


def _camera(row: np.ndarray) -> Camera:
    """Columns are the axes down, right, back, the centre, and height, width, focal length; near and far are left."""
    down, right, back, centre, (height, width, focal) = row[:15].astype(np.float64).reshape(3, 5).T
    if height != round(height) or width != round(width):
        raise ValueError(f"pictures are whole pixels in size, but a row says {width} x {height}")
    placed = pose_at(np.stack([right, down, -back]), centre, "poses_bounds.npy")
    return Camera("", int(width), int(height), float(focal), float(focal), width / 2, height / 2, placed)
