"""models.json of Google's Immersive Light Field Video: fisheyes, rotation vectors from the world, places in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.importers.texts import number, read_json, whole
from calibration.importers.views import Reading, Videos, View, lens, pose_at
from calibration.rig import Camera

KIND = "Google's models.json"
BESIDE = ("models.json",)


def claims(file: Path) -> bool:
    return file.name == "models.json"


def read(file: Path, videos: Videos) -> Reading:
    cameras = read_json(file)
    if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
        raise ValueError("models.json must be a list of cameras")
    return Reading([_view(camera) for camera in cameras])


def _view(camera: Mapping[str, Any]) -> View:
    name, what = str(camera["name"]), f"camera {camera['name']!r}"
    kind = camera.get("projection_type", "fisheye")
    if kind not in ("fisheye", "perspective"):
        raise ValueError(f"{what}: projection_type must be fisheye or perspective, but is {kind!r}")

    def of(key: str, count: int) -> list[float]:
        values = [number(value, f"{what}: {key}") for value in np.ravel(np.asarray(camera[key], dtype=object)).tolist()]
        if len(values) != count:
            raise ValueError(f"{what}: {key} must be {count} numbers, but is {camera[key]}")
        return values

    focal, ratio = of("focal_length", 1)[0], number(camera.get("pixel_aspect_ratio", 1.0), f"{what}: aspect")
    k1, k2, k3 = (*(number(k, f"{what}: radial_distortion") for k in camera.get("radial_distortion", ())), 0, 0, 0)[:3]
    turn = cv2.Rodrigues(np.array(of("orientation", 3)).reshape(3, 1))[0]
    cx, cy = of("principal_point", 2)
    fisheye = kind == "fisheye"
    shown = Camera(
        name="",
        width=whole(camera["width"], f"{what}: width"),
        height=whole(camera["height"], f"{what}: height"),
        fx=focal,
        fy=focal * ratio,
        cx=cx,
        cy=cy,
        camera_from_world=pose_at(turn, of("position", 3), what),
        distortion=(k1, k2, k3, 0.0) if fisheye else lens((k1, k2, 0, 0, k3)),
        fisheye=fisheye,
    )
    return View((name,), shown)
