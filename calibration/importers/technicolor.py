"""cameras_parameters.txt of Technicolor: a header, then f cx cy . . qw qx qy qz tx ty tz, world to camera.

Rows belong to the cameras in the order of their names. No readers use the fourth and the fifth column.
"""

from __future__ import annotations

from pathlib import Path

from calibration.importers.llff import names_of_rows
from calibration.importers.texts import number, read_text
from calibration.importers.views import Reading, Videos, View, pose, rotation
from calibration.rig import Camera

KIND = "Technicolor's cameras_parameters.txt"
BESIDE = ("cameras_parameters.txt",)
PUBLISHED_SIZE = (2048, 1088)


def claims(file: Path) -> bool:
    return file.name == "cameras_parameters.txt"


def read(file: Path, videos: Videos) -> Reading:
    lines = [(count, line) for count, line in enumerate(read_text(file).splitlines(), 1) if line.strip()]
    rows = []
    for count, line in lines[1:]:
        fields = line.replace(",", " ").split()
        if len(fields) != 12:
            raise ValueError(f"line {count} must have f cx cy . . qw qx qy qz tx ty tz, but has {len(fields)} columns")
        rows.append([number(value, f"line {count}: column {at}") for at, value in enumerate(fields, 1)])
    names = names_of_rows(len(rows), videos.names)
    return Reading([_view(row, name, videos) for row, name in zip(rows, names, strict=True)])


def _view(row: list[float], name: str, videos: Videos) -> View:
    focal, cx, cy, _, _, *quaternion = row[:9]
    width, height = _size(name, cx, cy, videos)
    placed = pose(rotation(quaternion, f"camera {name!r}"), row[9:12], f"camera {name!r}")
    return View((name,), Camera("", width, height, focal, focal, cx, cy, placed))


def _size(name: str, cx: float, cy: float, videos: Videos) -> tuple[int, int]:
    """The video's, where the principal point lies in the middle half of it, or else the one that was published."""
    width, height = videos.size((name,)) or PUBLISHED_SIZE
    central = abs(cx / width - 0.5) < 0.25 and abs(cy / height - 0.5) < 0.25
    return (width, height) if central else PUBLISHED_SIZE
