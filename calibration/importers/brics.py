"""params.txt of BRICS, DiVa360 and MANUS: a row for each camera, COLMAP's pose and OPENCV lens, columns by a header."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from calibration.importers.texts import first_line, number, read_text, whole
from calibration.importers.views import Reading, Videos, View, lens, pose, rotation
from calibration.rig import Camera

KIND = "BRICS parameters (params.txt)"
BESIDE = ("*params*.txt",)
_COLUMNS = (
    *("cam_id", "width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    *("cam_name", "qvecw", "qvecx", "qvecy", "qvecz", "tvecx", "tvecy", "tvecz"),
)
"""As DiVa360's src/colmap_calib.py writes them"""
_NEEDED = frozenset(_COLUMNS) - {"cam_id", "cam_name", "k1", "k2", "p1", "p2"}


def claims(file: Path) -> bool:
    return file.suffix.lower() == ".txt" and {"qvecw", "tvecx", "fx"} <= set(first_line(file).lstrip("# ").split())


def read(file: Path, videos: Videos) -> Reading:
    lines = [(count, line.strip()) for count, line in enumerate(read_text(file).splitlines(), 1) if line.strip()]
    header = lines[0][1].lstrip("#").split()
    if missing := sorted(_NEEDED - set(header)):
        raise ValueError(f"the first line must name the columns {', '.join(_COLUMNS)}, but lacks {', '.join(missing)}")
    views = []
    for count, line in lines[1:]:
        if line.startswith("#"):
            continue
        fields, what = line.split(), f"line {count}"
        if len(fields) != len(header):
            raise ValueError(f"{what} must have the {len(header)} columns that the first line names, not {len(fields)}")
        views.append(_view(dict(zip(header, fields, strict=True)), what))
    return Reading(views)


def _view(row: Mapping[str, str], what: str) -> View:
    def of(*columns: str) -> list[float]:
        return [number(row.get(column, 0), f"{what}: {column}") for column in columns]

    name = row.get("cam_name", row.get("cam_id", ""))
    placed = pose(
        rotation(of("qvecw", "qvecx", "qvecy", "qvecz"), f"{what}, camera {name!r}"),
        of("tvecx", "tvecy", "tvecz"),
        f"{what}, camera {name!r}",
    )
    width, height = (whole(row[side], f"{what}: {side}") for side in ("width", "height"))
    shown = lens(of("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    fx, fy, cx, cy = of("fx", "fy", "cx", "cy")
    return View((name,), Camera("", width, height, fx, fy, cx, cy, placed, shown))
