"""camera_intrinsics.json, camera_extrinsics.json and camera_scale.pkl of MVHumanNet: world to camera, OpenCV's axes."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from calibration.importers.texts import about, number, read_json
from calibration.importers.views import PIXEL_CENTRE, Reading, Videos, View, intrinsics, lens, matrix3, pose
from calibration.rig import Camera

KIND = "MVHumanNet's camera_extrinsics.json"
BESIDE = ("camera_intrinsics.json", "camera_extrinsics.json", "camera_scale.pkl")
PUBLISHED_SIZES = ((2448, 2048), (4096, 3000))


def claims(file: Path) -> bool:
    return file.name == "camera_extrinsics.json"


def read(file: Path, videos: Videos) -> Reading:
    intri, scale = file.with_name("camera_intrinsics.json"), file.with_name("camera_scale.pkl")
    if not intri.is_file():
        raise FileNotFoundError(f"{file.name} needs camera_intrinsics.json beside it, but there is no {intri}")
    with about(intri):
        data = read_json(intri)
        fx, fy, cx, cy = intrinsics(matrix3(data["intrinsics"], "intrinsics"), "all cameras")
        terms = [number(value, "dist") for value in np.ravel(data.get("dist") or data.get("distCoeff") or ()).tolist()]
    with about(scale):
        factor = _scale(scale) if scale.is_file() else 1.0
    # The size is not said: a principal point lies near the middle.
    width, height = min(PUBLISHED_SIZES, key=lambda size: abs(2 * cx - size[0]))
    shared = (width, height, fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE)
    return Reading(
        [
            View((_name(key),), Camera("", *shared, _pose(entry, factor, key), lens(terms)))
            for key, entry in read_json(file).items()
        ]
    )


def _name(key: str) -> str:
    """Keys are 1_CC32871A005.png, folders CC32871A005."""
    return key.split(".")[0].rsplit("_", 1)[-1]


def _pose(entry: Any, factor: float, what: str) -> np.ndarray:
    shift = np.array([number(value, f"{what}: translation") for value in np.ravel(entry["translation"]).tolist()])
    if shift.shape != (3,):
        raise ValueError(f"{what}: translation must be 3 numbers, not {len(shift)}")
    return pose(matrix3(entry["rotation"], f"{what}: rotation"), shift * factor, what)


class _Numbers(pickle.Unpickler):
    """Pickles may run any code; this one makes numbers and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module.replace("_core", "core"), name) == ("numpy.core.multiarray", "scalar"):
            return np.float64(0).__reduce__()[0]
        if (module, name) == ("numpy", "dtype"):
            return np.dtype
        raise pickle.UnpicklingError(f"camera_scale.pkl must hold a number, but asks for {module}.{name}")


def _scale(path: Path) -> float:
    try:
        return number(_Numbers(io.BytesIO(path.read_bytes())).load(), "the scale")
    except pickle.UnpicklingError as problem:
        raise ValueError(str(problem)) from None
