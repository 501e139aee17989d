"""Calibrations made elsewhere, read into a `Rig`; `calibration.exporters` writes them.

One module for each format; what each says about axes, pixel centres and units is in docs/calibration.md. After loading
everything follows `calibration.rig`: OpenCV axes, world to camera, top-left pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from calibration.importers import (
    actorshq,
    board,
    brics,
    colmap,
    dna_rendering,
    easymocap,
    immersive,
    llff,
    metashape,
    mvhumannet,
    own,
    panoptic,
    qualisys,
    realityscan,
    technicolor,
    transforms,
)
from calibration.importers.names import cameras_by_name
from calibration.importers.texts import about, read_json
from calibration.importers.views import Reading, Videos
from calibration.rig import Rig


class Format(Protocol):
    """What a module of this package offers."""

    KIND: str
    """What such a calibration is called, for people"""
    BESIDE: tuple[str, ...]
    """Patterns of the names of files that belong to one, beside the file that is read"""

    def claims(self, file: Path) -> bool:
        """Whether a file is one, by its name or its first line."""

    def read(self, file: Path, videos: Videos) -> Reading:
        """Its posed pictures; raises ValueError, FileNotFoundError or what look-ups in a strange file raise."""


FORMATS = cast(
    tuple[Format, ...],
    (
        *(own, colmap, transforms, llff, easymocap, board),
        *(brics, panoptic, technicolor, immersive, actorshq, mvhumannet, dna_rendering),
        *(qualisys, metashape, realityscan),
    ),
)
"""Of several in a folder the first counts"""
_PLACES = (".", "sparse/0", "sparse", "0", "colmap", "colmap/sparse/0", "colmap/0")
"""Where in a folder a calibration may lie"""
_PEOPLES = ("readme*", "license*", "*.md", "*.pdf")
"""Files for people, which nobody takes for a calibration"""


@dataclass(frozen=True)
class Found:
    """A calibration that is there."""

    file: Path
    """From which to read; others may belong to it"""
    format: Format

    def files(self) -> list[Path]:
        """The file and those that belong to it."""
        beside = (path for path in sorted(self.file.parent.iterdir()) if path.is_file() and self._belongs(path))
        return [self.file, *(path for path in beside if path != self.file)]

    def strays(self, folder: Path) -> list[Path]:
        """Other files of a folder, of which nothing is read."""
        return [path for path in _visible(folder) if path != self.file and not self._belongs(path)]

    def _belongs(self, other: Path) -> bool:
        return other.parent == self.file.parent and any(fnmatch(other.name, name) for name in self.format.BESIDE)


def load_rig(path: Path, names: Sequence[str] | None = None, sizes: Mapping[str, tuple[int, int]] | None = None) -> Rig:
    """Read a calibration; `names` (of the videos) selects its cameras and sets their order.

    `path` is a file, or a folder that holds one of the formats of docs/calibration.md (there, or under sparse/0,
    sparse, 0 or colmap); the first of `FORMATS` counts. `sizes` are width and height of the videos, for formats that do
    not say at which size they hold. Cameras that no video needs are left out. Formats without names have their rows in
    the order of the videos' names, or, for fewer videos than rows, the row of the number at the end of a name.
    Raises FileNotFoundError when nothing is there, and ValueError for an unreadable calibration or for videos
    without a camera.
    """
    found = find_calibration(Path(path))
    videos = Videos(None if names is None else tuple(names), sizes or {})
    with about(found.file), np.errstate(all="ignore"):  # what is not finite is refused by the camera it belongs to
        reading = found.format.read(found.file, videos)
    if not reading.views:
        raise ValueError(f"{found.file} holds no posed pictures{' of these videos' if sizes else ''}")
    cameras = tuple(cameras_by_name(reading.views, names, found.file))
    return Rig(cameras, str(found.file), reading.metric, reading.up)


def holds_lenses_alone(path: Path) -> bool:
    """Whether a calibration is an intri.yml without an extri.yml: lenses that are known, of cameras to be placed."""
    return easymocap.stands_alone(find_calibration(path).file)


def load_lenses(path: Path, names: Sequence[str], sizes: Mapping[str, tuple[int, int]]) -> Rig:
    """The lenses of `holds_lenses_alone`, those of all named cameras, at the size of their videos; all stand at 0.

    Raises ValueError for an unreadable file and for videos without a lens.
    """
    found = find_calibration(path)
    with about(found.file), np.errstate(all="ignore"):
        reading = easymocap.read_lenses(found.file, Videos(tuple(names), sizes))
    return Rig(tuple(cameras_by_name(reading.views, names, found.file)), str(found.file)).resized(sizes)


def find_calibration(path: Path) -> Found:
    """The calibration in a folder, or that a file is.

    Raises FileNotFoundError when there is no such path, ValueError when nothing in it is a calibration.
    """
    if not path.exists():
        raise FileNotFoundError(f"no calibration at {path}")
    if not path.is_dir():
        kind = next((kind for kind in FORMATS if kind.claims(path)), None) or _by_content(path)
        if kind is None:
            raise ValueError(
                f"{path}: a calibration is a .json, .toml, .txt, .csv, .xml, .bin, .npy, .yml or .smc file of a kind "
                "that docs/calibration.md lists, or a folder with one"
            )
        return Found(path, kind)
    places = [path / place for place in _PLACES if (path / place).is_dir()]
    files = [file for place in places for file in sorted(place.iterdir()) if file.is_file()]
    for kind in FORMATS:
        for file in files:
            if kind.claims(file):
                return Found(file, kind)
    for file in files:
        if kind := _by_content(file):
            return Found(file, kind)
    raise ValueError(
        f"{path} holds no calibration that we read ({', '.join(kind.KIND for kind in FORMATS)}; see "
        f"docs/calibration.md), only {sorted(entry.name for entry in path.iterdir())[:12]}; correct it, or write "
        'calibration = "solve" into capture.toml to have the cameras solved'
    )


def _by_content(file: Path) -> Format | None:
    """The format of a file that its name does not tell."""
    suffixes = {".npy": llff, ".toml": board, ".smc": dna_rendering}
    if file.suffix.lower() == ".json":
        try:
            return _json_format(read_json(file))
        except ValueError:
            return None
    if file.stem in ("images", "extri"):
        return cast(Format, colmap if file.stem == "images" else easymocap)
    return cast(Format | None, suffixes.get(file.suffix.lower()))


def _json_format(data: Any) -> Format | None:
    found = None
    if isinstance(data, list) and data and isinstance(data[0], dict) and "orientation" in data[0]:
        found = immersive
    elif isinstance(data, dict) and "frames" in data:
        found = transforms
    elif isinstance(data, dict) and isinstance(data.get("cameras"), list):
        first = next((camera for camera in data["cameras"] if isinstance(camera, dict)), {})
        found = panoptic if "K" in first else own
    return cast(Format | None, found)


def _visible(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if path.is_file() and not hidden and not any(fnmatch(path.name.lower(), name) for name in _PEOPLES):
            yield path
