""".smc of DNA-Rendering: HDF5 with Camera_Parameter/<camera>/K, D and RT, the pose from camera to world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.importers.texts import number
from calibration.importers.views import (
    PIXEL_CENTRE,
    Reading,
    Videos,
    View,
    intrinsics,
    lens,
    matrix3,
    numbered_names,
    pose_at,
)
from calibration.rig import Camera

KIND = "DNA-Rendering's .smc"
BESIDE = ("*.smc",)
_GROUP = "Camera_Parameter"
_FIVE_MEGAPIXELS, _TWELVE_MEGAPIXELS, _FIRST_TWELVE = (2448, 2048), (4096, 3000), 48


def claims(file: Path) -> bool:
    return file.suffix.lower() == ".smc"


def read(file: Path, videos: Videos) -> Reading:
    try:
        import h5py
    except ModuleNotFoundError:
        raise ValueError("an .smc file is HDF5, for which h5py is needed: pip install 'packuv[smc]'") from None
    try:
        with h5py.File(file, "r") as data:
            if _GROUP not in data:
                raise ValueError(
                    f"it must hold {_GROUP}, but has {sorted(data)[:8]}; the calibration lies in the _annots.smc"
                )
            return Reading([_view(name, camera) for name, camera in data[_GROUP].items()])
    except (OSError, RuntimeError) as problem:
        raise ValueError(f"it is no whole HDF5 file ({problem})") from None


def _view(name: str, camera: Any) -> View:
    what = f"camera {name}"
    fx, fy, cx, cy = intrinsics(matrix3(camera["K"][()], f"{what}: K"), what)
    world_from_camera = np.asarray(camera["RT"][()], dtype=np.float64)
    if world_from_camera.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{what}: RT must be [4, 4], but is {world_from_camera.shape}")
    placed = pose_at(world_from_camera[:3, :3].T, world_from_camera[:3, 3], what)
    terms = lens(number(value, f"{what}: D") for value in np.ravel(camera["D"][()]).tolist())
    numbered = numbered_names(int(name)) if name.isdecimal() else ()
    width, height = _TWELVE_MEGAPIXELS if name.isdecimal() and int(name) >= _FIRST_TWELVE else _FIVE_MEGAPIXELS
    shown = Camera("", width, height, fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE, placed, terms)
    return View((name, *numbered), shown)
