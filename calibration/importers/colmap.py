"""COLMAP models, text and binary: world-to-camera poses, OpenCV axes, the top-left pixel's centre at (0.5, 0.5)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.importers.texts import about, number, read_text, whole
from calibration.importers.views import Reading, Videos, View, lens, picture_names, pose, rotation
from calibration.rig import Camera

KIND = "a COLMAP model"
BESIDE = ("cameras.*", "images.*", "points3D.*", "frames.*", "rigs.*", "project.ini", "*.db", "*.ply")
# COLMAP's model number: name and count of parameters (src/colmap/sensor/models.h).
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
_COUNTS = dict(_MODELS.values())
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE")
_STRAIGHT = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE")


def claims(file: Path) -> bool:
    return file.name in ("cameras.bin", "cameras.txt")


def read(file: Path, videos: Videos) -> Reading:
    """`file` is cameras or images, as text or binary; the other lies beside it."""
    suffix = file.suffix
    cameras, images = file.with_name(f"cameras{suffix}"), file.with_name(f"images{suffix}")
    for path in (cameras, images):
        if not path.is_file():
            raise FileNotFoundError(f"a COLMAP model needs cameras and images side by side, but there is no {path}")
    with about(cameras):
        lenses = _binary_lenses(cameras) if suffix == ".bin" else _text_lenses(cameras)
    with about(images):
        views = _binary_views(images, lenses) if suffix == ".bin" else _text_views(images, lenses)
        if not views:
            raise ValueError("it lists no images, so nothing has a pose; solve again")
        return Reading(views)


def _text_lenses(path: Path) -> dict[int, Camera]:
    lenses = {}
    for count, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        fields, what = line.split(), f"line {count}"
        if len(fields) < 5:
            raise ValueError(f"{what} must give CAMERA_ID, MODEL, WIDTH, HEIGHT and parameters, but is {line[:80]!r}")
        size = whole(fields[2], f"{what}: the width"), whole(fields[3], f"{what}: the height")
        parameters = [number(value, f"{what}: a parameter") for value in fields[4:]]
        lenses[whole(fields[0], f"{what}: a camera's number")] = _lens(fields[1], *size, parameters)
    return lenses


def _text_views(path: Path, lenses: Mapping[int, Camera]) -> list[View]:
    # Every image takes two lines, and the second one is empty when it has no points: blank lines count.
    lines = [(count, line) for count, line in enumerate(read_text(path).splitlines(), 1) if not line.startswith("#")]
    if any(len(line.split()) % 3 for _, line in lines[1::2]):
        raise ValueError("images.txt must give two lines for each image, the second with x y id of its points or empty")
    views = []
    for count, line in lines[0::2]:
        if not line.strip():
            continue
        fields, what = line.split(maxsplit=9), f"line {count}"
        if len(fields) < 10:
            raise ValueError(
                f"{what} must give IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID and NAME, but is {line[:80]!r}"
            )
        values = [number(value, f"{what}: a pose's number") for value in fields[1:8]]
        views.append(_view(values, _known(lenses, whole(fields[8], f"{what}: CAMERA_ID"), path), fields[9].strip()))
    return views


def _known(lenses: Mapping[int, Camera], camera: int, images: Path) -> Camera:
    if camera not in lenses:
        raise ValueError(
            f"images must have cameras of cameras{images.suffix}, which lists {sorted(lenses)[:8]}, not {camera}"
        )
    return lenses[camera]


def _binary_lenses(path: Path) -> dict[int, Camera]:
    data, lenses = _Bytes(path), {}
    for _ in range(data.take("<Q")[0]):
        camera, model, width, height = data.take("<iiQQ")
        if model not in _MODELS:
            raise ValueError(f"COLMAP has no lens model number {model}; solve again, or write the model as text")
        name, count = _MODELS[model]
        lenses[camera] = _lens(name, width, height, data.take(f"<{count}d"))
    return lenses


def _binary_views(path: Path, lenses: Mapping[int, Camera]) -> list[View]:
    data, views = _Bytes(path), []
    for _ in range(data.take("<Q")[0]):
        _, *values, camera = data.take("<i7di")
        views.append(_view(values, _known(lenses, camera, path), data.text()))
        data.skip(24 * data.take("<Q")[0])  # x, y, point of every feature
    return views


class _Bytes:
    """A little-endian file, read from front to back; a read past its end raises struct.error."""

    def __init__(self, path: Path) -> None:
        self._data, self._at = path.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from(layout, self._data, self._at)
        self._at += struct.calcsize(layout)
        return values

    def text(self) -> str:
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise struct.error("a name has no end")
        name, self._at = self._data[self._at : end].decode(), end + 1
        return name

    def skip(self, size_bytes: int) -> None:
        self._at += size_bytes
        if self._at > len(self._data):
            raise struct.error(f"{len(self._data)} bytes, but {self._at} are announced")


def _lens(model: str, width: int, height: int, parameters: Sequence[float]) -> Camera:
    if model in _COUNTS and len(parameters) != _COUNTS[model]:
        raise ValueError(f"COLMAP's model {model} does not have {len(parameters)} parameters, but {_COUNTS[model]}")
    if model not in (*_STRAIGHT, *_FISHEYE):
        raise ValueError(
            f"COLMAP's lens model {model} is not supported; undistort the pictures (colmap image_undistorter), "
            f"or solve with {', '.join((*_STRAIGHT, *_FISHEYE[:1]))}"
        )
    fx, fy, cx, cy, *terms = (parameters[0], *parameters) if model in _ONE_FOCAL else parameters
    fisheye = model in _FISHEYE
    shown: Callable[[Sequence[float]], tuple[float, ...]] = _four if fisheye else lens
    return Camera("", width, height, fx, fy, cx, cy, np.eye(4), shown(terms), fisheye=fisheye)


def _four(terms: Sequence[float]) -> tuple[float, ...]:
    return (*terms, 0.0, 0.0, 0.0, 0.0)[:4]


def _view(values: Sequence[float], shown: Camera, picture: str) -> View:
    what = f"image {picture!r}"
    matrix = pose(rotation(values[:4], what), values[4:], what)
    return View(picture_names(picture), replace(shown, camera_from_world=matrix))
