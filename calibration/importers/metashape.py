"""cameras.xml of Agisoft Metashape: poses from camera to chunk, OpenCV's axes, principal points from the middle.

The chunk's own frame is the world; its place on the earth is left out, for coordinates of 6,000 km leave no digits.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from calibration.importers.texts import number, whole
from calibration.importers.trees import attribute, child, root, root_tag, text_number
from calibration.importers.views import Reading, Videos, View, lens, picture_names, pose_at
from calibration.rig import Camera

KIND = "a Metashape export"
BESIDE: tuple[str, ...] = ()
_MOST_SKEW_PX = 0.5


def claims(file: Path) -> bool:
    return file.suffix.lower() == ".xml" and root_tag(file) == "document"


def read(file: Path, videos: Videos) -> Reading:
    chunks = root(file).findall("chunk")
    if len(chunks) != 1:
        raise ValueError(f"it must hold one chunk, but holds {len(chunks)}; export one chunk's cameras")
    sensors = {sensor.attrib.get("id", ""): sensor for sensor in chunks[0].iter("sensor")}
    posed = [camera for camera in chunks[0].iter("camera") if camera.find("transform") is not None]
    pieces = {camera.attrib.get("component_id", "") for camera in posed}
    if len(pieces) > 1:
        raise ValueError(
            f"its cameras were aligned in {len(pieces)} pieces that do not know each other; align them to one"
        )
    return Reading([_view(camera, sensors) for camera in posed])


def _view(camera: Element, sensors: Mapping[str, Element]) -> View:
    label = camera.attrib.get("label", "")
    what, sensor = f"camera {label!r}", camera.attrib.get("sensor_id", "")
    if sensor not in sensors:
        raise ValueError(f"{what} must have one of the sensors {sorted(sensors)[:8]}, but names {sensor!r}")
    fields = (child(camera, "transform", what).text or "").split()
    if len(fields) != 16:
        raise ValueError(f"{what}: transform must have 16 numbers, but has {len(fields)}")
    chunk_from_camera = np.array([number(value, f"{what}: transform") for value in fields]).reshape(4, 4)
    turn = chunk_from_camera[:3, :3].T
    return View(picture_names(label), _camera(sensors[sensor], pose_at(turn, chunk_from_camera[:3, 3], what), what))


def _camera(sensor: Element, placed: np.ndarray, what: str) -> Camera:
    found = sensor.findall("calibration")
    adjusted = [one for one in found if one.attrib.get("class") == "adjusted"] or found
    if not adjusted:
        raise ValueError(f"{what}: its sensor must have a calibration; align and optimize the cameras first")
    inner = adjusted[-1]
    kind = sensor.attrib.get("type", inner.attrib.get("type", "frame"))
    resolution = child(sensor if sensor.find("resolution") is not None else inner, "resolution", what)
    width, height = (whole(attribute(resolution, side, what), f"{what}: {side}") for side in ("width", "height"))

    def of(key: str) -> float:
        return text_number(inner, key, what)

    f = of("f") or of("fx")
    k1, k2, k3, k4, p1, p2 = (of(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if of("p3") or of("p4"):
        raise ValueError(f"{what}: Metashape's p3 and p4 have no counterpart in OpenCV's model; optimize without them")
    if abs(of("b2")) * height / 2 / f > _MOST_SKEW_PX:
        raise ValueError(f"{what}: pixels must be upright, but b2 is {of('b2')}; optimize without b2")
    pinhole = (width, height, f + of("b1"), f, width / 2 + of("cx"), height / 2 + of("cy"), placed)
    if kind in ("fisheye", "equidistant_fisheye") and not (p1 or p2):
        return Camera("", *pinhole, (k1, k2, k3, k4), fisheye=True)
    if kind != "frame" or k4:
        raise ValueError(
            f"{what}: Metashape's {kind} lens{' with k4' if k4 else ''} has no counterpart; optimize as frame without "
            "k4, or as fisheye without p1 and p2"
        )
    return Camera("", *pinhole, lens((k1, k2, p2, p1, k3)))  # its p1 and p2 are OpenCV's p2 and p1
