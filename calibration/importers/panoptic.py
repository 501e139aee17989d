"""Panoptic Studio: calibration_*.json of the toolbox, and train_meta.json, test_meta.json of Dynamic 3D Gaussians."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from calibration.importers.texts import about, number, read_json, whole
from calibration.importers.views import (
    PIXEL_CENTRE,
    Reading,
    Videos,
    View,
    intrinsics,
    lens,
    matrix3,
    numbered_names,
    picture_names,
    pose,
)
from calibration.rig import Camera

KIND = "a calibration of the Panoptic Studio"
BESIDE = ("*_meta.json", "calibration_*.json", "*.npz")


def claims(file: Path) -> bool:
    return file.name.endswith("_meta.json") or (file.name.startswith("calibration_") and file.suffix == ".json")


def read(file: Path, videos: Videos) -> Reading:
    if file.name.endswith("_meta.json"):
        views = []
        for path in sorted(file.parent.glob("*_meta.json")):  # training and test cameras
            with about(path):
                views += list(_instants(read_json(path)))
        return Reading(views)
    cameras = read_json(file)["cameras"]
    found = (_toolbox_view(camera, videos) for camera in cameras)
    return Reading([view for view in found if view is not None])


def _instants(data: Any) -> Iterator[View]:
    """Cameras that stand still are listed at every instant."""
    if not {"w", "h", "k", "w2c", "cam_id"} <= set(data):
        raise ValueError(f"it must hold w, h, k, w2c and cam_id, but has {sorted(data)[:8]}")
    width, height = whole(data["w"], "w"), whole(data["h"], "h")
    lengths = {key: len(data[key]) for key in ("k", "w2c", "cam_id")}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"k, w2c and cam_id must list the same instants, but list {lengths}")
    known: set[tuple[Any, ...]] = set()
    for instant, row in enumerate(zip(data["k"], data["w2c"], data["cam_id"], strict=True)):
        if len({len(part) for part in row}) != 1:
            raise ValueError(f"k, w2c and cam_id must list the same cameras at instant {instant}")
        files = data.get("fn", [[]] * len(data["k"]))[instant]
        for column, (matrix, place, camera) in enumerate(zip(*row, strict=True)):
            same = (camera, str(matrix), str(place))
            if same not in known:
                known.add(same)
                picture = str(files[column]) if column < len(files) else ""
                yield _view(matrix, place, camera, picture, (width, height))


def _view(matrix: Any, place: Any, camera: Any, picture: str, size: tuple[int, int]) -> View:
    what = f"camera {camera}"
    placed = np.asarray(place, dtype=np.float64)
    if placed.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{what}: w2c must be a matrix of 4 x 4 numbers, but is {placed.shape}")
    numbered = numbered_names(camera) if isinstance(camera, int) else (str(camera),)
    folder = picture_names(picture)[1] or numbered[0]
    fx, fy, cx, cy = intrinsics(matrix3(matrix, f"{what}: k"), what)
    pinhole = Camera("", *size, fx, fy, cx, cy, pose(placed[:3, :3], placed[:3, 3], what))
    return View((numbered[0], folder, *numbered[1:]), pinhole)


def _toolbox_view(camera: Any, videos: Videos) -> View | None:
    """Centimetres; OpenCV's lens, and pixels counted from the centre of the first."""
    name = str(camera["name"])
    what = f"camera {name!r}"
    if camera.get("type", "hd") not in ("hd", "vga", "kinect-color"):
        return None
    fx, fy, cx, cy = intrinsics(matrix3(camera["K"], f"{what}: K"), what)
    width, height = (whole(side, f"{what}: resolution") for side in camera["resolution"])
    shift = [number(value, f"{what}: t") for value in np.ravel(np.asarray(camera["t"], dtype=object)).tolist()]
    if len(shift) != 3:
        raise ValueError(f"{what}: t must be 3 numbers, not {len(shift)}")
    placed = pose(matrix3(camera["R"], f"{what}: R"), shift, what)
    terms = [number(value, f"{what}: distCoef") for value in camera.get("distCoef", ())]
    shown = Camera("", width, height, fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE, placed, lens(terms))
    return View((name, f"{camera.get('type', 'hd')}_{name}"), shown)
