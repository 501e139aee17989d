"""RealityScan's and RealityCapture's "Internal/External camera parameters" (.csv): places and angles in the world.

Angles are degrees: heading about z, clockwise, then pitch about x, then roll about y, of a camera with OpenGL's axes.
f is in the units of a film 36 wide, px and py in units of the picture's longer side, from its middle.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calibration.importers.texts import first_lines, number, read_text
from calibration.importers.views import OPENCV_FROM_OPENGL, Reading, Videos, View, lens, picture_names, pose_at
from calibration.rig import Camera

KIND = "a RealityScan export"
BESIDE: tuple[str, ...] = ()
_FILM = 36.0
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")


def claims(file: Path) -> bool:
    wanted = {"heading", "pitch", "roll"}
    return file.suffix.lower() == ".csv" and any(wanted <= set(_columns(line)) for line in first_lines(file, 2))


def read(file: Path, videos: Videos) -> Reading:
    lines = [line for line in read_text(file).splitlines() if line.strip()]
    while lines and lines[0].startswith("#cameras"):
        del lines[0]
    columns = _columns(lines[0])
    if missing := [column for column in _NEEDED if column not in columns]:
        raise ValueError(f"it must have the columns {','.join(_NEEDED)}, but lacks {','.join(missing)}")
    if not videos.sizes:
        raise ValueError("it gives no picture size, which the videos tell; there are no videos to ask")
    rows = csv.DictReader(lines[1:], fieldnames=columns)
    found = (_view(row, f"row {rows.line_num}", videos) for row in rows)
    return Reading([view for view in found if view is not None])


def _columns(line: str) -> list[str]:
    return [column.strip().lstrip("#").lower() for column in line.split(",")]


def _view(row: Mapping[str, str | None], what: str, videos: Videos) -> View | None:
    names = picture_names(str(row["name"]).strip())
    what = f"{what}, {names[0]!r}"
    size = videos.size(names)
    if size is None:
        return None

    def of(*keys: str) -> list[float]:
        return [number(row.get(key, 0), f"{what}: {key}") for key in keys]

    width, height = size
    side, (focal, px, py) = max(size), of("f", "px", "py")
    k1, k2, k3, k4, t1, t2 = of("k1", "k2", "k3", "k4", "t1", "t2")
    if k4:
        raise ValueError(f"{what}: Brown's model with k4 has no counterpart in OpenCV's; export with Brown 3")
    placed = pose_at(
        OPENCV_FROM_OPENGL @ _world_from_camera(*of("heading", "pitch", "roll")).T, of("x", "y", "alt"), what
    )
    f, cx, cy = focal * side / _FILM, px * side + width / 2, py * side + height / 2
    return View(names, Camera("", width, height, f, f, cx, cy, placed, lens((k1, k2, t1, t2, k3))))


def _world_from_camera(heading_deg: float, pitch_deg: float, roll_deg: float) -> np.ndarray:
    """float64 [3, 3], of a camera with OpenGL's axes."""
    (ch, cp, cr), (sh, sp, sr) = (wave(np.radians([-heading_deg, pitch_deg, roll_deg])) for wave in (np.cos, np.sin))
    about_z = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    turn: np.ndarray = about_z @ about_x @ about_y
    return turn
