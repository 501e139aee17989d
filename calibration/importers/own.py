"""This project's rig.json."""

from __future__ import annotations

from pathlib import Path

from calibration.importers.texts import read_json
from calibration.importers.views import Reading, Videos, View
from calibration.rig import Rig

KIND = "rig.json"
BESIDE = ("rig.json",)


def claims(file: Path) -> bool:
    return file.name == "rig.json"


def read(file: Path, videos: Videos) -> Reading:
    rig = Rig.from_json(read_json(file), file)
    return Reading([View((camera.name,), camera) for camera in rig.cameras], rig.metric, rig.up)
