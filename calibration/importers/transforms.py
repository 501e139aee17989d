"""transforms.json of nerfstudio and instant-ngp: camera-to-world poses with OpenGL axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.importers.texts import number, read_json, whole
from calibration.importers.views import OPENCV_FROM_OPENGL, Reading, Videos, View, lens, picture_names, pose_at
from calibration.rig import Camera

KIND = "transforms.json"
BESIDE = ("transforms*.json", "*.ply")
_STRAIGHT = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_FISHEYE = "OPENCV_FISHEYE"


def claims(file: Path) -> bool:
    return file.name == "transforms.json"


def read(file: Path, videos: Videos) -> Reading:
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError("it must list its pictures under frames, each with what belongs to it")
    return Reading([_view(data, frame) for frame in frames])


def _view(shared: Mapping[str, Any], frame: Mapping[str, Any]) -> View:
    picture, values = str(frame["file_path"]), {**shared, **frame}
    model = values.get("camera_model", "OPENCV")
    fisheye = model == _FISHEYE or bool(values.get("is_fisheye"))
    if model not in (*_STRAIGHT, _FISHEYE) or (values.get("k4") and not fisheye):
        raise ValueError(
            f"{picture}: the lens model {f'{model} with k4' if values.get('k4') else model} is not supported; "
            f"undistort the pictures, or use one of {', '.join((*_STRAIGHT, _FISHEYE))}"
        )
    fx, fy, cx, cy, width, height = _intrinsics(values, picture)
    matrix = np.asarray(values["transform_matrix"], dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{picture}: transform_matrix must be [4, 4] or [3, 4], not {matrix.shape}")
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    terms = tuple(number(values.get(key) or 0.0, f"{picture}: {key}") for key in keys)
    placed = pose_at(OPENCV_FROM_OPENGL @ matrix[:3, :3].T, matrix[:3, 3], picture)
    shown = terms if fisheye else lens(terms)
    return View(picture_names(picture), Camera("", width, height, fx, fy, cx, cy, placed, shown, fisheye=fisheye))


def _intrinsics(values: Mapping[str, Any], picture: str) -> tuple[float, float, float, float, int, int]:
    if "w" not in values or "h" not in values or not ("fl_x" in values or "camera_angle_x" in values):
        raise ValueError(
            f"{picture}: transforms.json must give w, h and fl_x (or camera_angle_x), at the top or in the frame"
        )

    def of(key: str, otherwise: float) -> float:
        return number(values[key], f"{picture}: {key}") if values.get(key) is not None else otherwise

    width, height = whole(values["w"], f"{picture}: w"), whole(values["h"], f"{picture}: h")
    half = math.tan(of("camera_angle_x", 0.0) / 2)
    fx = of("fl_x", 0.0) or (width / 2 / half if half else 0.0)
    if fx <= 0:
        raise ValueError(f"{picture}: fl_x must be above 0, or camera_angle_x between 0 and pi")
    fy = of("fl_y", 0.0) or fx
    return fx, fy, of("cx", width / 2), of("cy", height / 2), width, height
