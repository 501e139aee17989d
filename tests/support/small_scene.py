"""A scene of a few hundred Gaussians before three cameras, of which some move."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.codes import DC, OPACITY, OPACITY_RANGE, ROTATION, SCALE, Codes, Quantizer, attribute_count
from packuv.gaussians.floats import Gaussians, with_canonical_axes
from packuv.gaussians.segment import Segment
from packuv.scene import SceneHeader, Sound, write_scene

ROWS, MOVING, FRAMES = 500, 120, 6


def small_quantizer() -> Quantizer:
    low, high = np.empty(attribute_count(0)), np.empty(attribute_count(0))
    ranges = (SCALE, (-5.0, 0.0)), (ROTATION, (-1.0, 1.0)), (OPACITY, OPACITY_RANGE), (DC, (-2.0, 2.0))
    for column, (least, most) in ranges:
        low[column], high[column] = least, most
    return Quantizer(np.array([0, 0, 4.0]), 1.0, np.full(3, 6.0), low, high)


def small_segments() -> list[Segment]:
    """Two segments of equal keys."""
    rng, quantizer = np.random.default_rng(3), small_quantizer()
    means = rng.uniform([-2, -1.5, 3], [2, 1.5, 5], (ROWS, 3))
    values = [
        means,
        rng.uniform(-2.6, -1.6, (ROWS, 3)),
        rng.normal(size=(ROWS, 4)),
        rng.uniform(-2, 3, ROWS),
        rng.uniform(-1.2, 1.2, (ROWS, 1, 3)),
    ]
    key = quantizer.encode(with_canonical_axes(Gaussians(*(value.astype(np.float32) for value in values))))
    dynamic = np.arange(ROWS) < MOVING
    segments = []
    for first in (0, FRAMES // 2):
        walk = np.cumsum(rng.integers(-60, 61, (FRAMES // 2 - 1, MOVING, 3)), axis=0)
        shake = rng.integers(-2, 3, (FRAMES // 2 - 1, MOVING, key.attributes.shape[1]))
        xyz = (key.xyz[dynamic] + walk).astype(np.uint16)
        attributes = np.clip(key.attributes[dynamic] + shake, 1, 255).astype(np.uint8)
        attributes[:, :5, OPACITY] = 0
        segments.append(Segment(first, Codes(key.xyz, key.attributes), dynamic, xyz, attributes))
    return segments


def small_scene(path: Path, segments: list[Segment] | None = None, sound: Sound | None = None) -> Path:
    """Write it, lossless, or other segments of as many frames, with sound if any is given."""
    paths = [path.with_name(f"{number}.npz") for number in range(2)]
    for place, segment in zip(paths, segments or small_segments(), strict=True):
        segment.save(place)
    cameras = tuple(_camera(f"cam{number}", 0.5 * number) for number in range(3))
    times = np.arange(FRAMES, dtype=np.int64) * 40_000_000
    header = SceneHeader(small_quantizer(), times, Fraction(25), cameras, ("cam2",), {}, {"near": 0.1})
    write_scene(path, paths, header, sound=sound)
    return path


def _camera(name: str, right: float) -> PinholeCamera:
    pose = np.eye(4)
    pose[0, 3] = -right
    return PinholeCamera(name, 96, 64, 80.0, 80.0, 48.0, 32.0, pose)
