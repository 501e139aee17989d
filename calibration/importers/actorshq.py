"""calibration.csv of ActorsHQ: camera to world as a rotation vector and a place in metres.

Focal lengths and principal points are in widths and heights of the picture.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from calibration.importers.texts import first_line, number, read_text, whole
from calibration.importers.views import Reading, Videos, View, pose_at
from calibration.rig import Camera

KIND = "ActorsHQ's calibration.csv"
BESIDE = ("calibration.csv", "aabbs.csv", "light_annotations.csv", "scene.json")
_COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def claims(file: Path) -> bool:
    columns = {column.strip() for column in first_line(file).split(",")} if file.suffix.lower() == ".csv" else set()
    return {"rx", "tx", "px"} <= columns


def read(file: Path, videos: Videos) -> Reading:
    rows = csv.DictReader(read_text(file).splitlines(), skipinitialspace=True)
    columns = [column.strip() for column in rows.fieldnames or ()]
    if missing := [column for column in _COLUMNS if column not in columns]:
        raise ValueError(f"calibration.csv must have the columns {','.join(_COLUMNS)}, but lacks {','.join(missing)}")
    rows.fieldnames = columns
    return Reading([_view(row, f"line {rows.line_num}") for row in rows], metric=True)


def _view(row: Mapping[str, str | None], what: str) -> View:
    def of(*keys: str) -> list[float]:
        return [number(row[key], f"{what}: {key}") for key in keys]

    width, height = (whole(row[key], f"{what}: {key}") for key in ("w", "h"))
    world_from_camera = cv2.Rodrigues(np.array(of("rx", "ry", "rz")).reshape(3, 1))[0]
    fx, fy, cx, cy = np.array(of("fx", "fy", "px", "py")) * (width, height, width, height)
    placed = pose_at(world_from_camera.T, of("tx", "ty", "tz"), what)
    return View((str(row["name"]).strip(),), Camera("", width, height, fx, fy, cx, cy, placed))
