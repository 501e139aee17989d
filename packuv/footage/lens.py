"""What a camera's lens and sensor do to a picture, and how that is undone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from packuv.bounds import MOST_CAMERAS, field, fields, finite, items, numbers, words
from packuv.camera import PinholeCamera

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
"""Coefficient counts that OpenCV's lens model knows, see `LensCamera.distortion`."""
MOST_SHADING = 2.0
"""Of a coefficient of lens shading: corners at a seventh of the light, or seven times it"""


@dataclass(frozen=True)
class LensCamera:
    """A camera as it films: its pinhole, the lens in front of it, and its colours."""

    pinhole: PinholeCamera
    """Intrinsics and pose in the video's own pixels; the name is the key of its video"""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1..s4 [tx ty]]]]; empty for a pinhole camera"""
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear-light factors r g b that bring this camera to the rig's common colour"""
    shading: tuple[float, float] = (0.0, 0.0)
    """k1, k2: light falls off by exp(k1 r^2 + k2 r^4), of mean 1 over the picture; r is the distance from the principal
    point at depth 1, r = 1 in the corner"""
    fisheye: bool = False
    """Whether `distortion` is k1 k2 k3 k4 of OpenCV's fisheye model"""

    def __post_init__(self) -> None:
        if self.fisheye and len(self.distortion) != 4:
            raise ValueError(
                f"camera {self.pinhole.name!r}: a fisheye lens has 4 coefficients, not {len(self.distortion)}"
            )
        if len(self.distortion) not in DISTORTION_LENGTHS:
            raise ValueError(
                f"camera {self.pinhole.name!r}: a lens has one of {DISTORTION_LENGTHS} coefficients, "
                f"not {len(self.distortion)}"
            )
        if len(self.gains) != 3 or not all(np.isfinite(gain) and gain > 0 for gain in self.gains):
            raise ValueError(f"camera {self.pinhole.name!r}: gains must be three positive numbers, not {self.gains}")
        if len(self.shading) != 2 or not all(abs(k) <= MOST_SHADING for k in self.shading):
            raise ValueError(
                f"camera {self.pinhole.name!r}: shading must be two numbers within {MOST_SHADING}, not {self.shading}"
            )

    def to_json(self) -> dict[str, Any]:
        # All floats, so that a round trip through JSON gives the same text: caches compare by it.
        floats = {key: float(getattr(self.pinhole, key)) for key in ("fx", "fy", "cx", "cy")}
        lens = {"distortion": [float(k) for k in self.distortion], "gains": [float(gain) for gain in self.gains]}
        lens["shading"] = [float(k) for k in self.shading]
        return {**self.pinhole.to_json(), **floats, **lens, **({"fisheye": True} if self.fisheye else {})}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> LensCamera:
        pinhole = PinholeCamera.from_json(data)
        what = f"camera {pinhole.name!r}"
        red, green, blue = numbers(field(data, "gains", what), f"{what}: gains", (3,)).tolist()
        lens = items(field(data, "distortion", what), f"{what}: distortion", most=max(DISTORTION_LENGTHS))
        k1, k2 = numbers(data.get("shading", (0.0, 0.0)), f"{what}: shading", (2,)).tolist()
        fisheye = data.get("fisheye", False) is True
        shown = tuple(finite(k, f"{what}: distortion") for k in lens)
        return cls(pinhole, shown, (red, green, blue), (k1, k2), fisheye)

    @property
    def straight(self) -> bool:
        """Whether the lens shows what a pinhole would."""
        return not self.fisheye and not any(self.distortion)


def abridged(lenses: Iterable[LensCamera], cameras: Sequence[PinholeCamera]) -> list[dict[str, Any]]:
    """JSON of lenses that stands beside that of `cameras`, among which each lens has one of its name.

    An entry holds this name, and what a lens that leaves that camera's pictures as they are would not say.
    """
    plain = _plain(cameras)
    pairs = ((lens.to_json(), plain[lens.pinhole.name]) for lens in lenses)
    return [{key: said for key, said in own.items() if key == "name" or said != like.get(key)} for own, like in pairs]


def unabridged(entries: object, cameras: Sequence[PinholeCamera], what: str) -> dict[str, LensCamera]:
    """Lenses by name, the inverse of `abridged`; entries may also say all, as in older files.

    Raises ValueError that names `what` for a name that no camera has, or two entries; for others that make no sense.
    """
    plain, lenses = _plain(cameras), dict[str, LensCamera]()
    for entry in items(entries, what, most=MOST_CAMERAS):
        name = words(field(fields(entry, f"{what}: an entry"), "name", f"{what}: an entry"), f"{what}: a name")
        if name not in plain or name in lenses:
            raise ValueError(
                f"{what} must name cameras of the scene, each once, but names {name!r}, which "
                f"{'it named before' if name in lenses else 'is none of them'}"
            )
        lenses[name] = LensCamera.from_json({**plain[name], **entry})
    return lenses


def _plain(cameras: Sequence[PinholeCamera]) -> dict[str, dict[str, Any]]:
    """JSON of lenses that leave these cameras' pictures as they are, by name."""
    plain = {camera.name: LensCamera(camera).to_json() for camera in cameras}
    if len(plain) < len(cameras):
        raise ValueError(f"cameras must differ in name, but {len(cameras)} have {len(plain)} names")
    return plain


def undistorted_camera(lens: LensCamera) -> PinholeCamera:
    """The widest pinhole camera with this centre and picture size that shows only what the lens filmed.

    Of a fisheye at most what keeps half the resolution in the middle: a pinhole would spend most pixels on its border.
    Raises ValueError for coefficients that fold the picture over itself.
    """
    if lens.straight:
        return lens.pinhole
    zooms = np.geomspace(4, 1 / 2 if lens.fisheye else 1 / 4, 81)
    valid = [_covered(lens, zoom) for zoom in zooms]
    if not valid[0]:
        raise ValueError(
            f"camera {lens.pinhole.name!r}: lens coefficients {lens.distortion} do not map the picture one to one, "
            "not even at its centre; check the calibration"
        )
    good = zooms[valid.index(False) - 1] if False in valid else zooms[-1]
    low = good * zooms[1] / zooms[0]
    for _ in range(12):
        middle = (low * good) ** 0.5
        low, good = (low, middle) if _covered(lens, middle) else (middle, good)
    return _zoomed(lens.pinhole, good)


def _zoomed(camera: PinholeCamera, zoom: float) -> PinholeCamera:
    return replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)


def _covered(lens: LensCamera, zoom: float) -> bool:
    """Whether rays through the border of the zoomed picture land inside the filmed one, without a fold on the way."""
    camera = lens.pinhole
    across, down = np.linspace(0, camera.width, 33), np.linspace(0, camera.height, 33)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(across, y), axis=1) for y in (0, camera.height)]
        + [np.stack(np.broadcast_arrays(x, down), axis=1) for x in (0, camera.width)]
    )  # [132, 2], pixels
    rays = (border - [camera.cx, camera.cy]) / [camera.fx * zoom, camera.fy * zoom]
    # From the centre outwards; the short last step catches a fold right at the border.
    steps = np.append(np.linspace(0, 1, 33)[1:-1], [0.999, 1])[:, None, None] * rays  # [33, 132, 2]
    filmed = _filmed(lens, steps.reshape(-1, 2)).reshape(steps.shape)
    radius = np.linalg.norm(filmed - [camera.cx, camera.cy], axis=2)
    inside = (filmed >= 0) & (filmed <= [camera.width, camera.height])
    return bool(inside.all() and (np.diff(radius, axis=0) > 0).all())


def _filmed(lens: LensCamera, rays: np.ndarray) -> np.ndarray:
    """Pixels, float64 [n, 2], where a lens shows rays [n, 2], given at depth 1."""
    if lens.fisheye:
        own = np.array(lens.distortion)
        return cv2.fisheye.distortPoints(rays[None], lens.pinhole.matrix, own)[0]  # type: ignore[no-any-return]
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.pinhole.matrix, np.array(lens.distortion))
    return pixels.reshape(-1, 2)


def undistortion_maps(lens: LensCamera, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray] | None:
    """Fixed-point maps for cv2.remap from the filmed picture to the pinhole one; None for a pinhole lens."""
    if lens.straight:
        return None
    # OpenCV puts the centre of the first pixel at 0, we put it at 0.5.
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    size = (camera.width, camera.height)
    undistort = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    maps = undistort(
        lens.pinhole.matrix - shift, np.array(lens.distortion), np.eye(3), camera.matrix - shift, size, cv2.CV_16SC2
    )
    return maps[0], maps[1]
