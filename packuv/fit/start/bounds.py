"""Where the scene is: its centre, its radius and the near plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera


@dataclass(frozen=True)
class Bounds:
    """The part of the world that a rig films."""

    centre: np.ndarray
    """World, float64 [3]: where the optical axes meet best"""
    radius: float
    """Median distance of the cameras from the centre, world"""
    near: float
    """Distance before which a camera draws nothing, world"""


def find_bounds(cameras: Sequence[PinholeCamera], *, near_share: float) -> Bounds:
    """Centre and size of what the cameras look at. `near_share` is the near plane's share of the radius.

    Parallel cameras never meet: a weak pull towards a point before them keeps the centre finite.
    """
    origins = np.stack([camera.centre for camera in cameras])
    forward = np.stack([camera.forward for camera in cameras])
    spread = np.linalg.norm(origins - origins.mean(axis=0), axis=1).mean()
    guess = (origins + forward * max(2 * spread, 1e-6)).mean(axis=0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # [C, 3, 3], projectors across each axis
    system = across.sum(axis=0) + 0.01 * len(cameras) * np.eye(3)
    centre = np.linalg.solve(system, (across @ origins[:, :, None]).sum(axis=0)[:, 0] + 0.01 * len(cameras) * guess)
    radius = float(np.median(np.linalg.norm(origins - centre, axis=1)))
    return Bounds(centre, radius, near_share * radius)
