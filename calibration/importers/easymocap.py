"""intri.yml and extri.yml of EasyMocap and EasyVolcap: OpenCV's matrices, world-to-camera poses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from calibration.importers.texts import about, read_text
from calibration.importers.views import PIXEL_CENTRE, Reading, Videos, View, intrinsics, lens, pose
from calibration.rig import Camera

KIND = "intri.yml and extri.yml"
BESIDE = ("intri.yml", "extri.yml", "intri.yaml", "extri.yaml", "t_offsets.json")
_DIRECTIVE = re.compile(r"\A\s*%YAML:[\d.]+[^\n]*")
"""OpenCV's first line, which a YAML parser takes for an unknown one"""

Storage = Mapping[str, Any]
"""What a file holds: texts, lists of them, and mappings; OpenCV's own parser is not asked, since damage aborts it"""


def claims(file: Path) -> bool:
    return file.name in ("intri.yml", "intri.yaml")


def read(file: Path, videos: Videos) -> Reading:
    intri, extri = (file.with_name(f"{name}{file.suffix}") for name in ("intri", "extri"))
    for path in (intri, extri):
        if not path.is_file():
            raise FileNotFoundError(f"an EasyMocap calibration is intri.yml and extri.yml side by side, but no {path}")
    with about(intri):
        lenses = _storage(intri)
        names = _listed(lenses)
    with about(extri):
        poses = _storage(extri)
        placed = {name: _pose(name, poses) for name in names}
    with about(intri):
        found = (_view(name, lenses, placed[name], videos) for name in names)
        return Reading([view for view in found if view is not None])


def read_lenses(file: Path, videos: Videos) -> Reading:
    """The lenses of an intri.yml that has no extri.yml beside it; the poses mean nothing."""
    with about(file):
        lenses = _storage(file)
        found = (_view(name, lenses, np.eye(4), videos) for name in _listed(lenses))
        return Reading([view for view in found if view is not None])


def stands_alone(file: Path) -> bool:
    """Whether nothing says where these cameras stand."""
    return claims(file) and not file.with_name(f"extri{file.suffix}").is_file()


def _listed(lenses: Storage) -> list[str]:
    """The names that are listed, or, where none are, those of the matrices."""
    listed = lenses.get("names")
    names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
    names = names or [key.removeprefix("K_") for key in lenses if key.startswith("K_")]
    if not names:
        raise ValueError("intri.yml must list its cameras under names")
    return names


def _storage(path: Path) -> Storage:
    """Every scalar stays text: 01 and 1e3 are names as well as numbers."""
    try:
        found = yaml.load(_DIRECTIVE.sub("", read_text(path)), yaml.BaseLoader)
    except RecursionError:
        raise ValueError(f"{path.name} is nested too deep to be a calibration") from None
    except yaml.YAMLError as error:
        raise ValueError(f"{path.name} is no YAML file of OpenCV: {_where(error)}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path.name} is no YAML file of OpenCV, which names matrices")
    return found


def _where(error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "it cannot be read"
    return str(problem) if mark is None else f"{problem}, line {mark.line + 1}"


def _pose(name: str, poses: Storage) -> np.ndarray:
    if f"Rot_{name}" in poses:
        found = _matrix(poses, f"Rot_{name}", (3, 3))
    else:
        found = cv2.Rodrigues(_matrix(poses, f"R_{name}", (3, 1)))[0]
    return pose(np.asarray(found, dtype=np.float64), _matrix(poses, f"T_{name}", (3, 1)), f"camera {name!r}")


def _view(name: str, lenses: Storage, placed: np.ndarray, videos: Videos) -> View | None:
    """None for a camera without a video, whose picture size nobody knows."""
    what = f"camera {name!r}"
    fx, fy, cx, cy = intrinsics(_matrix(lenses, f"K_{name}", (3, 3)), what)
    terms = next((_numbers(lenses, key) for key in (f"D_{name}", f"dist_{name}") if key in lenses), np.empty(0))
    width, height = (_length(lenses, f"{axis}_{name}") for axis in "WH")
    if not (height >= 1 and width >= 1):
        if not videos.sizes:
            raise ValueError(
                f"intri.yml must give camera {name!r} its picture size, as H_{name}: 1080 and W_{name}: 1920, "
                "where there is no video to tell it"
            )
        size = videos.size((name,), (cx, cy))
        if size is None:
            return None
        width, height = size
    cx, cy = cx + PIXEL_CENTRE, cy + PIXEL_CENTRE
    return View((name,), Camera("", width, height, fx, fy, cx, cy, placed, lens(terms)))


def _length(lenses: Storage, key: str) -> int:
    """0 where it is not given."""
    try:
        return round(float(lenses.get(key, 0)))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{key} must be a number of pixels, but is {lenses[key]!r}"[:200]) from None


def _matrix(storage: Storage, key: str, shape: tuple[int, int]) -> np.ndarray:
    """float64 of this shape; a row stands for a column too."""
    numbers = _numbers(storage, key) if key in storage else np.empty(0)
    if numbers.size != shape[0] * shape[1]:
        raise ValueError(f"{key} must be a matrix of {shape[0]} x {shape[1]} numbers")
    return numbers.reshape(shape)


def _numbers(storage: Storage, key: str) -> np.ndarray:
    """float64 (N,): an opencv-matrix's data, as many as its rows and columns ask for, or a plain list."""
    found = storage[key]
    try:
        data = found["data"] if isinstance(found, dict) else found
        numbers = np.array([float(number) for number in data], dtype=np.float64)
        asked = int(found["rows"]) * int(found["cols"]) if isinstance(found, dict) else numbers.size
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{key} must be a matrix of OpenCV: rows, cols and data") from None
    if numbers.size != asked:
        raise ValueError(f"{key} must hold rows times cols = {asked} numbers, but has {numbers.size}")
    return numbers
