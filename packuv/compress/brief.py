"""The header of a compressed scene, in as few digits as its pictures need: much of a small file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from packuv.bounds import MOST_NUMBER
from packuv.camera import PinholeCamera
from packuv.footage.lens import LensCamera, abridged, unabridged
from packuv.scene import SceneHeader
from packuv.scene.header import COMPRESSION, LENSES

SHORT = ("near", "scene_radius", "up", COMPRESSION)
"""What else in `extra` is told as briefly; not the quantizer, which decodes codes"""
MOST_PX = 1e-3
"""By how much the scene may move in pictures; a tenth of it is usual, about what float32 leaves out of a place there"""


def brief(header: SceneHeader) -> SceneHeader:
    """The same in the shortest numbers that are equal as float32, nine digits at most, and lenses beside their cameras.

    Cameras and lenses keep all digits where the scene is so far from the world's origin that it would move in their
    pictures. Raises ValueError for lenses that contradict the cameras.
    """
    extra = {**header.extra, **{name: _short(header.extra[name]) for name in SHORT if name in header.extra}}
    cameras, lenses = list(header.cameras), _lenses(header)
    rounded = [PinholeCamera.from_json(_short(camera.to_json())) for camera in cameras]
    if all(_moves_px(*pair, header) <= MOST_PX for pair in zip(cameras, rounded, strict=True)):
        cameras, lenses = rounded, [LensCamera.from_json(_short(lens.to_json())) for lens in lenses]
    if LENSES in extra:
        extra[LENSES] = abridged(lenses, cameras)
    return replace(header, cameras=tuple(cameras), extra=extra)


def _lenses(header: SceneHeader) -> list[LensCamera]:
    if LENSES not in header.extra:
        return []
    return list(unabridged(header.extra[LENSES], header.cameras, f"extra: {LENSES}").values())


def _moves_px(camera: PinholeCamera, other: PinholeCamera, header: SceneHeader) -> float:
    """By how many pixels the scene's centre moves from one to the other, at most, seen from the scene's unit away."""
    change = other.camera_from_world - camera.camera_from_world
    moved = np.linalg.norm(change[:3, :3] @ header.quantizer.centre + change[:3, 3])
    return float(moved * max(camera.fx, camera.fy) / header.quantizer.unit)


def _short(value: Any) -> Any:
    """JSON whose floats are the shortest that are equal as float32."""
    if isinstance(value, Mapping):
        return {name: _short(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_short(item) for item in value]
    if isinstance(value, float) and 1 / MOST_NUMBER <= abs(value) <= MOST_NUMBER:  # others may be none as float32
        return float(str(np.float32(value)))
    return value
