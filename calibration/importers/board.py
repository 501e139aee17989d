"""TOML of programs that calibrate with a board: caliscope, aniposelib (Anipose, FreeMoCap), Pose2Sim.

A table for each camera with OpenCV's matrix, distortions, and the world-to-camera pose. caliscope numbers its cameras,
the others name them; Pose2Sim may name the tables, too, as it likes.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.importers.texts import FaultError, number, read_text, whole
from calibration.importers.views import (
    PIXEL_CENTRE,
    Reading,
    Videos,
    View,
    intrinsics,
    lens,
    matrix3,
    numbered_names,
    pose,
)
from calibration.rig import Camera

KIND = "a board's calibration (.toml)"
BESIDE: tuple[str, ...] = ()


def claims(file: Path) -> bool:
    return file.suffix.lower() == ".toml" and b"matrix" in file.read_bytes()


def read(file: Path, videos: Videos) -> Reading:
    try:
        data = tomllib.loads(read_text(file))
    except tomllib.TOMLDecodeError as problem:
        raise FaultError(f"{file} is no TOML: {problem}") from None
    inner = data.get("cameras")
    tables = inner if isinstance(inner, dict) and inner else data
    cameras = {key: table for key, table in tables.items() if isinstance(table, dict) and "matrix" in table}
    if not cameras:
        raise ValueError(
            "a calibration in TOML has a table for each camera with size, matrix, distortions, rotation and "
            f"translation, but this one has {sorted(map(str, data))[:8]}"
        )
    posed = {key: table for key, table in cameras.items() if "rotation" in table and not table.get("ignore")}
    if not posed:
        raise ValueError(f"none of the cameras {sorted(cameras)[:8]} has a rotation and a translation; calibrate again")
    return Reading([_view(key, table) for key, table in posed.items()], _metric(posed))


def _metric(tables: Mapping[str, Mapping[str, Any]]) -> bool:
    """caliscope's unit is a metre; what numbers its cameras is caliscope. The others' is the board's."""
    return all("cam_id" in table or "port" in table for table in tables.values())


def _view(section: str, table: Mapping[str, Any]) -> View:
    names = _names(section, table)
    what = f"camera {names[0]}"
    for key in ("size", "translation"):
        if key not in table:
            raise ValueError(f"{what} needs the key {key}, but has {sorted(table)}")
    width, height = (whole(side, f"{what}: a side of size") for side in _list(table["size"], 2, f"{what}: size"))
    fx, fy, cx, cy = intrinsics(matrix3(table["matrix"], f"{what}: matrix"), what)
    turn = np.asarray(table["rotation"], dtype=np.float64)
    rotation = turn if turn.shape == (3, 3) else cv2.Rodrigues(turn.reshape(3, 1))[0]
    shift = [number(value, f"{what}: translation") for value in _list(table["translation"], 3, f"{what}: translation")]
    terms = np.ravel(np.asarray(table.get("distortions", ()), dtype=np.float64))
    fisheye = bool(table.get("fisheye"))
    return View(
        names,
        Camera(
            name="",
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=cx + PIXEL_CENTRE,
            cy=cy + PIXEL_CENTRE,
            camera_from_world=pose(rotation, shift, what),
            distortion=tuple(float(term) for term in (*terms, 0, 0, 0, 0)[:4]) if fisheye else lens(terms),
            fisheye=fisheye,
        ),
    )


def _names(section: str, table: Mapping[str, Any]) -> tuple[str, ...]:
    """The camera's own name, its table's, or what a video of its number may be called."""
    count = table.get("cam_id", table.get("port"))
    own = table.get("name")
    if own is None and isinstance(count, int):
        return (f"cam_{count}", f"port_{count}", f"cam{count}", *numbered_names(count))
    first = section if own is None else str(own)
    digits = "".join(character for character in section if character.isdecimal())
    numbered = numbered_names(int(digits)) if 0 < len(digits) < 5 else ()
    return (first, section, *numbered)


def _list(value: Any, count: int, what: str) -> list[Any]:
    flat = np.ravel(value).tolist() if isinstance(value, list) else []
    if len(flat) != count:
        raise ValueError(f"{what} must be {count} numbers, but is {str(value)[:80]}")
    return flat
