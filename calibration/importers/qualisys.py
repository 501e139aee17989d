"""Qualisys Track Manager's calibration (.qca.txt, XML): 1/64 pixels, millimetres, places in the world, OpenGL's axes.

Rotations are camera from world, by rows r11 r12 r13, r21...; Pose2Sim reads them so. Lens coefficients have no unit.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from calibration.importers.trees import attribute, child, root, root_tag
from calibration.importers.views import OPENCV_FROM_OPENGL, PIXEL_CENTRE, Reading, Videos, View, lens, pose_at
from calibration.rig import Camera

KIND = "a Qualisys calibration"
BESIDE = ("*.qca", "*.qca.txt")
_SUBPIXELS = 64
_FULL_LINES = 1080
"""Sensor lines at which the file counts pixels; `video_resolution` says at how many was filmed"""


def claims(file: Path) -> bool:
    named = file.name.lower().endswith((".qca.txt", ".qca"))
    return named or (file.suffix.lower() in (".xml", ".txt") and root_tag(file) == "calibration")


def read(file: Path, videos: Videos) -> Reading:
    cameras = root(file).findall("cameras/camera")
    filmed = [camera for camera in cameras if camera.find("fov_video") is not None]
    if not filmed:
        raise ValueError(f"it must list video cameras with fov_video, but lists {len(cameras)} cameras without")
    return Reading([_view(camera) for camera in filmed])


def _view(camera: Element) -> View:
    name = camera.attrib.get("serial", "")
    what = f"camera {name!r}"
    seen, lens_of, place = (child(camera, path, what) for path in ("fov_video", "intrinsic", "transform"))
    lines = camera.attrib.get("video_resolution", "").rstrip("p")
    scale = int(lines) / _FULL_LINES if lines.isdecimal() else 1.0

    def inner(key: str) -> float:
        return attribute(lens_of, key, what)

    left, right, top, bottom = (attribute(seen, key, what) for key in ("left", "right", "top", "bottom"))
    size = (round((right - left + 1) * scale), round((bottom - top + 1) * scale))
    fx, fy = (inner(f"focalLength{axis}") / _SUBPIXELS * scale for axis in "UV")
    cx = (inner("centerPointU") / _SUBPIXELS - left) * scale + PIXEL_CENTRE
    cy = (inner("centerPointV") / _SUBPIXELS - top) * scale + PIXEL_CENTRE
    k1, k2 = inner("radialDistortion1"), inner("radialDistortion2")
    k3 = float(lens_of.attrib.get("radialDistortion3", 0))
    p1, p2 = inner("tangentalDistortion1"), inner("tangentalDistortion2")  # the format's spelling
    turn = np.array([[attribute(place, f"r{row}{column}", what) for column in (1, 2, 3)] for row in (1, 2, 3)])
    centre = [attribute(place, axis, what) for axis in "xyz"]
    placed = pose_at(OPENCV_FROM_OPENGL @ turn, centre, what)
    return View(
        (name, f"cam_{name}", f"cam{name}"), Camera("", *size, fx, fy, cx, cy, placed, lens((k1, k2, p1, p2, k3)))
    )
