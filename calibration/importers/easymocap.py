"""intri.yml and extri.yml of EasyMocap and EasyVolcap: OpenCV's matrices, world-to-camera poses."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from calibration.importers.texts import about, read_text
from calibration.importers.views import PIXEL_CENTRE, Reading, Videos, View, intrinsics, lens, pose
from calibration.rig import Camera

KIND = "intri.yml and extri.yml"
BESIDE = ("intri.yml", "extri.yml", "intri.yaml", "extri.yaml", "t_offsets.json")
_MOST_DEPTH = 64
_DEEP_LINE = re.compile(r"^(?:[ \t]*-[ \t]){64}|^[ \t]{256}", re.MULTILINE)
"""More lists in one another than belong on a line, or as much white space as deep nesting needs"""


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


def _listed(lenses: cv2.FileStorage) -> list[str]:
    node = lenses.getNode("names")
    items = [node.at(index) for index in range(node.size())] if node.isSeq() else []
    names = [item.string() if item.isString() else f"{item.real():g}" for item in items]
    if not names:
        raise ValueError("intri.yml must list its cameras under names")
    return names


def _storage(path: Path) -> cv2.FileStorage:
    text = read_text(path)
    _check_nesting(path, text)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError):  # OpenCV's bindings wrap the parser's error in a SystemError that says nothing
        storage = None
    if storage is None or not storage.isOpened():
        raise ValueError(f"{path.name} is no YAML file of OpenCV")
    return storage


def _check_nesting(path: Path, text: str) -> None:
    """OpenCV's parser goes as deep as a file does, until the stack ends and with it the program."""
    depth = 0
    for mark in re.finditer(r"[][{}]", text):
        depth += 1 if mark[0] in "[{" else -1
        if depth > _MOST_DEPTH:
            raise ValueError(f"{path.name} may be nested {_MOST_DEPTH} deep at most, but goes deeper")
    if _DEEP_LINE.search(text):
        raise ValueError(f"{path.name} may be nested {_MOST_DEPTH} deep at most, but goes deeper")


def _pose(name: str, poses: cv2.FileStorage) -> np.ndarray:
    found = poses.getNode(f"Rot_{name}").mat()
    if found is None:
        found = cv2.Rodrigues(_matrix(poses, f"R_{name}", (3, 1)))[0]
    return pose(np.asarray(found, dtype=np.float64), _matrix(poses, f"T_{name}", (3, 1)), f"camera {name!r}")


def _view(name: str, lenses: cv2.FileStorage, placed: np.ndarray, videos: Videos) -> View | None:
    """None for a camera without a video, whose picture size nobody knows."""
    what = f"camera {name!r}"
    fx, fy, cx, cy = intrinsics(_matrix(lenses, f"K_{name}", (3, 3)), what)
    terms = next((mat for key in ("D", "dist") if (mat := lenses.getNode(f"{key}_{name}").mat()) is not None), ())
    width, height = (round(lenses.getNode(f"{axis}_{name}").real()) for axis in "WH")
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
    return View((name,), Camera("", width, height, fx, fy, cx, cy, placed, lens(np.ravel(terms))))


def _matrix(storage: cv2.FileStorage, key: str, shape: tuple[int, int]) -> np.ndarray:
    """float64 of this shape; a row stands for a column too."""
    found = storage.getNode(key).mat()
    if found is None or found.size != shape[0] * shape[1]:
        raise ValueError(f"{key} must be a matrix of {shape[0]} x {shape[1]} numbers")
    return np.asarray(found, dtype=np.float64).reshape(shape)
