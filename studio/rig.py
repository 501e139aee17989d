"""Camera rigs that look inwards: where each camera stands and what its lens is.

Axes are OpenCV's: x right, y down, z forward. Poses map world to camera. World lengths are metres, z is up. The
centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from studio.film_set import VISITOR_FROM, VISITOR_TO, VISITOR_X
from studio.furniture import HEIGHT
from studio.raycast import View

TARGET = np.array([0.0, 0.0, 0.95])
"""What all cameras look at, world"""
NEAREST_M, FARTHEST_M = 2.5, 3.4
"""Closer, cameras would stand in the table; farther, cameras would stand in the furniture"""
LOWEST_M, HIGHEST_M = 0.4, HEIGHT - 0.25
HEAD_M, ARM_M = 2.05, 0.75
"""The visitor's way is free of cameras below this height, this far to each side"""
GOLDEN_RAD = np.pi * (3 - np.sqrt(5))


class RigKind(StrEnum):
    """How the cameras stand."""

    RING = "ring"
    """Evenly on a circle round the scene"""
    DOME = "dome"
    """All round, at heights from knee to ceiling"""
    FRONT = "front"
    """On an arc of 100 degrees before the scene, in two rows"""


@dataclass(frozen=True)
class PlacementOptions:
    """Where the cameras stand."""

    kind: RigKind = RigKind.RING
    radius_m: float = 3.1
    """Horizontal distance from the middle of the room (front, ring), or of the lowest cameras (dome)"""
    height_m: float | None = None
    """Height of the lenses; None: 2.15 (ring), 1.6 (front), all heights (dome takes none)"""
    focal: float = 0.75
    """Focal length as a share of the picture's width; 0.75 sees 67 degrees"""
    jitter_m: float = 0.04
    """How far, one standard deviation, a camera stands from its place; aim, roll and lens vary along with it"""

    def __post_init__(self) -> None:
        if not NEAREST_M <= self.radius_m <= FARTHEST_M:
            raise ValueError(
                f"the rig's radius must be {NEAREST_M} to {FARTHEST_M} m, so that cameras stand between the scene and "
                f"the furniture, but is {self.radius_m}"
            )
        if self.height_m is not None and self.kind is RigKind.DOME:
            raise ValueError(
                "a dome has cameras at all heights; leave height_m out, or choose the ring or the front rig"
            )
        if self.height_m is not None and not LOWEST_M <= self.height_m <= HIGHEST_M:
            raise ValueError(f"the rig's height must be {LOWEST_M} to {HIGHEST_M} m, but is {self.height_m}")
        if not 0.3 <= self.focal <= 3:
            raise ValueError(f"the focal length must be 0.3 to 3 picture widths, but is {self.focal}")
        if not 0 <= self.jitter_m <= 0.15:
            raise ValueError(f"the rig's jitter must be 0 to 0.15 m, but is {self.jitter_m}")


@dataclass(frozen=True, eq=False)
class StudioCamera:
    """A pinhole camera of the rig."""

    name: str
    width: int
    height: int
    fx: float
    """Focal lengths and principal point, pixels"""
    fy: float
    cx: float
    cy: float
    camera_from_world: np.ndarray
    """Rigid transform, float64 [4, 4]"""

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands, world, float64 [3]."""
        centre: np.ndarray = -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]
        return centre

    @property
    def view(self) -> View:
        """The camera as the ray caster reads it."""
        rotation = np.ascontiguousarray(self.camera_from_world[:3, :3])
        return View(self.width, self.height, np.array([self.fx, self.fy, self.cx, self.cy]), rotation, self.centre)


def place_cameras(
    names: Sequence[str], width: int, height: int, seed: int, options: PlacementOptions
) -> tuple[StudioCamera, ...]:
    """Cameras by name, in order; the same seed gives the same rig."""
    rng = np.random.default_rng([seed, 3])
    places = PLACES[options.kind](len(names), options)
    return tuple(_camera(name, width, height, place, rng, options) for name, place in zip(names, places, strict=True))


def _ring(count: int, options: PlacementOptions) -> np.ndarray:
    # half a step off, so that the doorway lies between two cameras of the usual rigs
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    return _round(options.radius_m, angle, np.full(count, options.height_m or 2.15))


def _dome(count: int, options: PlacementOptions) -> np.ndarray:
    """A golden spiral on a flattened dome, from low and wide to high and close."""
    share = (np.arange(count) + 0.5) / count
    radius = np.maximum(options.radius_m * np.cos(0.25 * np.pi * share), NEAREST_M)
    angle = (GOLDEN_RAD * np.arange(count) + 0.3) % (2 * np.pi)
    # in the order of the angles, so that neighbours by name see much the same
    return _round(radius, angle, 0.7 + (HIGHEST_M - 0.7) * share)[np.argsort(angle)]


def _front(count: int, options: PlacementOptions) -> np.ndarray:
    share = (np.arange(count) + 0.5) / count
    height = (options.height_m or 1.6) + 0.22 * np.where(np.arange(count) % 2, 1, -1)
    return _round(options.radius_m, -np.pi / 2 + np.radians(100) * (share - 0.5), height)


PLACES: dict[RigKind, Callable[[int, PlacementOptions], np.ndarray]] = {
    RigKind.RING: _ring,
    RigKind.DOME: _dome,
    RigKind.FRONT: _front,
}
"""Where the cameras of each kind stand, float64 [C, 3], before jitter"""


def _round(radius: float | np.ndarray, angle: np.ndarray, height: np.ndarray) -> np.ndarray:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _camera(
    name: str, width: int, height: int, place: np.ndarray, rng: np.random.Generator, options: PlacementOptions
) -> StudioCamera:
    shift, aim, lens = rng.normal(size=3), rng.normal(size=4), rng.normal(size=4)
    centre = _out_of_the_way(place + options.jitter_m * np.clip(shift, -2, 2))
    target = TARGET + 1.5 * options.jitter_m * aim[:3]
    rotation = _look(centre, target, roll_rad=0.4 * options.jitter_m * aim[3])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    focal = options.focal * width * (1 + 0.25 * options.jitter_m * np.clip(lens[0], -3, 3))
    return StudioCamera(
        name,
        width,
        height,
        fx=focal,
        fy=focal * (1 + 0.05 * options.jitter_m * lens[1]),
        cx=width * (0.5 + 0.12 * options.jitter_m * lens[2]),
        cy=height * (0.5 + 0.12 * options.jitter_m * lens[3]),
        camera_from_world=pose,
    )


def _out_of_the_way(place: np.ndarray) -> np.ndarray:
    """Lift a camera above the head of the visitor if it would stand in the way from the door."""
    x, y, z = place
    if abs(x - VISITOR_X) < ARM_M and VISITOR_TO - ARM_M < y < VISITOR_FROM and z < HEAD_M:
        return np.array([x, y, HEAD_M + 0.05])
    return place


def _look(centre: np.ndarray, target: np.ndarray, *, roll_rad: float) -> np.ndarray:
    """Rotation camera from world that looks at a point, upright but for the roll, float64 [3, 3]."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    return np.stack([c * right + s * down, c * down - s * right, forward])
