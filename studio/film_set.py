"""What is in the room and where it is at any time.

A person walks round in a circle about a bouncing ball; a crate turns on a plinth; a banner waves; an inflatable column
sways and breathes. Late in the capture a sliding door opens and a second person, whom no camera has seen until then,
walks in and waves. If asked for, a parcel stands on the floor from one instant on. Everything is a function of time
alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from studio.figure import STRIDE_M, Clothes, Pose, add_figure
from studio.furniture import (
    DOOR_LEFT,
    DOOR_RIGHT,
    DOOR_TOP,
    HALF_X,
    HALF_Y,
    HEIGHT,
    LAMP,
    add_furniture,
    add_room,
    add_wall_lamps,
)
from studio.geometry import Look, Parts, turn_about_z
from studio.raycast import Light, Paints, Shapes, paints
from studio.standing import VOXEL_M, clearance_of
from studio.textures import Textures, paint_textures

STANDING = ("room", "lamp", "furniture", "things", "pictures", "vase")
MOVING = ("walker", "visitor", "ball", "crate", "banner", "inflatable", "door", "parcel")
OBJECTS = STANDING + MOVING
"""Names by object id"""
GRAVITY = 9.81

WALK_CENTRE, WALK_RADIUS, WALK_SPEED = (0.15, -0.30), 0.85, 0.95
"""The walker's circle, metres and metres per second"""
CROWD, CROWD_RADII_M = (6, 9, 12), (1.3, 1.75, 2.15)
"""Persons of a crowd on circles about the same middle, and the circles' radii"""
DOOR_TRAVEL, DOOR_SECONDS = 1.06, 0.7
VISITOR_FROM, VISITOR_TO, VISITOR_SPEED = 4.62, 1.75, 1.05
"""y of the visitor's way in along x = VISITOR_X, and how fast"""
VISITOR_X = (DOOR_LEFT + DOOR_RIGHT) / 2
PARCEL, PARCEL_HALF = (0.85, 1.1), (0.28, 0.22, 0.25)
"""Where the parcel stands on the floor, and half its sides, metres"""


@dataclass(frozen=True, eq=False)
class Moment:
    """What moves, at one time."""

    movers: Shapes
    blockers: np.ndarray
    """float64 [B, 4]: balls x y z radius that stand for the movers in ambient light"""


@dataclass(frozen=True, eq=False)
class FilmSet:
    """The room through time. `build_set` makes it."""

    entrance_s: float
    """When the door begins to open"""
    standing: Shapes
    light: Light
    colours: Paints
    textures: Textures
    moving: tuple[str, ...] = MOVING
    """Those of MOVING that do; the others stand as at the start"""
    crowd: int = 0
    """Persons who walk round beside the walker, and whose shapes count as the walker's"""
    parcel_s: float | None = None
    """From when on the parcel stands there; None: never"""

    def at(self, seconds: float) -> Moment:
        """What moves, `seconds` after the start of the capture."""
        parts = Parts(self.textures)
        blockers = [
            add(parts, OBJECTS.index(name), self, seconds if name in self.moving else 0.0)
            for name, add in MOVERS.items()
        ]
        blockers += [_add_walker_of_crowd(parts, number, seconds) for number in range(self.crowd)]
        return Moment(parts.shapes(), np.concatenate(blockers))

    def clear_of(self, point: np.ndarray) -> float:
        """Distance from a point to what stands still, metres, as coarse as the voxels."""
        field, corner = self.light.clearance, self.light.corner
        x, y, z = np.clip(np.rint((point - corner[:3]) / corner[3]).astype(int), 0, np.array(field.shape)[::-1] - 1)
        return float(field[z, y, x])


@lru_cache(maxsize=2)
def build_set(
    seed: int,
    entrance_s: float,
    *,
    shine: float = 0.0,
    wall_lamps: float = 0.0,
    moving: tuple[str, ...] = MOVING,
    crowd: int = 0,
    parcel_s: float | None = None,
) -> FilmSet:
    """Paint and furnish the room; takes some seconds, and is remembered. `LightOptions` has shine and wall lamps."""
    textures = _textures(seed)
    parts = Parts(textures)
    owners = {name: OBJECTS.index(name) for name in STANDING}
    add_room(parts, owners, shine=shine)
    add_furniture(parts, owners, np.random.default_rng([seed, 2]))
    if wall_lamps > 0:
        add_wall_lamps(parts, owners["lamp"], wall_lamps)
    standing = parts.shapes()
    return FilmSet(entrance_s, standing, _light(standing), paints(textures), textures, moving, crowd, parcel_s)


def _light(standing: Shapes) -> Light:
    corner = np.array([-HALF_X - 0.1, -HALF_Y - 0.1, -0.1, VOXEL_M])
    shape = tuple(int(np.ceil(span / VOXEL_M)) for span in (HEIGHT + 0.2, 2 * HALF_Y + 2.3, 2 * HALF_X + 0.2))
    return Light(
        lamps=LAMP + np.array([(x, y, 0.0) for x in (-0.17, 0.17) for y in (-0.17, 0.17)]),
        power=np.array([4.6, 4.3, 3.8]),
        sky=np.array([0.52, 0.53, 0.55]),
        ground=np.array([0.40, 0.35, 0.29]),
        clearance=clearance_of(standing, corner, shape),
        corner=corner,
    )


@lru_cache(maxsize=2)
def _textures(seed: int) -> Textures:
    return paint_textures(seed)


# Each mover adds its shapes at a time and returns balls [B, 4] that stand for it where it darkens its surroundings.


def _add_walker(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    way = WALK_SPEED * seconds
    angle = 2.2 + way / WALK_RADIUS
    place = (WALK_CENTRE[0] + WALK_RADIUS * np.cos(angle), WALK_CENTRE[1] + WALK_RADIUS * np.sin(angle))
    clothes = Clothes("shirt", (1.0, 1.0, 1.0), (1.0, 0.96, 0.92), (1.0, 1.0, 1.0), (0.75, 0.12, 0.10))
    pose = Pose(place, angle + np.pi / 2, 2 * np.pi * way / STRIDE_M, 0.85, gaze_rad=0.35 * np.sin(0.9 * seconds))
    return add_figure(parts, owner, clothes, pose)


def _add_walker_of_crowd(parts: Parts, number: int, seconds: float) -> np.ndarray:
    """One of a crowd: on circles about the walker's, filled from the inner one on, all persons evenly apart."""
    ring = next(ring for ring in range(len(CROWD)) if number < sum(CROWD[: ring + 1]))
    place_in_ring, radius = number - sum(CROWD[:ring]), CROWD_RADII_M[ring]
    way = WALK_SPEED * seconds
    angle = 0.7 + 2 * np.pi * place_in_ring / CROWD[ring] + way / radius
    place = (WALK_CENTRE[0] + radius * np.cos(angle), WALK_CENTRE[1] + radius * np.sin(angle))
    tint = 0.4 + 0.6 * np.modf(0.618 * (number + 1) * np.arange(1, 4))[0]
    clothes = Clothes(("shirt", "plaid")[number % 2], tuple(tint), (1.0, 0.96, 0.92), (1.0, 1.0, 1.0), (0.3, 0.3, 0.3))
    phase = 2 * np.pi * (way / STRIDE_M + 0.37 * number)
    return add_figure(parts, OBJECTS.index("walker"), clothes, Pose(place, angle + np.pi / 2, phase, 0.85))


def _add_visitor(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    since = seconds - film_set.entrance_s - 0.15
    way, speed = _way_in(since)
    arrived = _ease((since - (VISITOR_FROM - VISITOR_TO) / VISITOR_SPEED + 0.8) / 0.9)
    clothes = Clothes(
        "plaid", (0.62, 0.50, 0.36), (0.62, 0.50, 0.42), (0.35, 0.32, 0.34), (0.16, 0.16, 0.2), height=1.03
    )
    pose = Pose(
        (VISITOR_X, VISITOR_FROM - way),
        -np.pi / 2,
        0.4 + 2 * np.pi * way / STRIDE_M,
        0.9 * speed,
        wave=arrived,
        wave_rad=0.45 * np.sin(6.5 * since),
        gaze_rad=0.3 * np.sin(0.7 * seconds + 1),
    )
    return add_figure(parts, owner, clothes, pose)


def _way_in(since_s: float) -> tuple[float, float]:
    """How far the visitor has come, metres, and the share of full speed; starts and stops softly."""
    length, ramp = VISITOR_FROM - VISITOR_TO, 0.5
    total = length / VISITOR_SPEED + ramp
    t = float(np.clip(since_s, 0, total))
    if t < ramp:
        return VISITOR_SPEED * t * t / (2 * ramp), t / ramp
    if t > total - ramp:
        left = total - t
        return length - VISITOR_SPEED * left * left / (2 * ramp), left / ramp
    return VISITOR_SPEED * (t - ramp / 2), 1.0


def _add_ball(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    """Free fall from 0.42 m between bounces, a little squash at the floor, drifting and spinning."""
    radius, apex = 0.13, 0.42
    period = 2 * np.sqrt(2 * apex / GRAVITY)
    t = (seconds + 0.11) % period - period / 2
    height = apex - GRAVITY * t * t / 2
    squash = 1 - 0.14 * np.exp(-((height / 0.05) ** 2))
    centre = np.array(
        [
            WALK_CENTRE[0] + 0.16 * np.cos(0.9 * seconds),
            WALK_CENTRE[1] + 0.16 * np.sin(0.7 * seconds),
            height + radius * squash,
        ]
    )
    radii = radius * np.array([squash**-0.5, squash**-0.5, squash])
    # the spin is inside the squash: the ball rolls within its flattened outline
    turn = np.diag(radii) @ turn_about_z(0.6 * seconds) @ _about_x(1.7 * seconds)
    parts.ellipsoid(owner, centre, np.ones(3), Look("ball", tint=(0.95, 0.95, 0.95)), turn)
    return np.array([[*centre, radius]])


def _add_crate(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    centre, half = np.array([-1.45, -1.2, 0.34 + 0.25]), 0.25
    look = Look("tiles", (1 / (2 * half), 1 / (2 * half)), (0.5, 0.5))
    parts.box(owner, centre, np.full(3, half), look, turn_about_z(1.1 * seconds + 0.4))
    return np.array([[*centre, half * 1.1]])


def _add_banner(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    """A sheet that hangs from a rod; waves run across it and grow towards the hem."""
    u, v = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 17))
    swing = v**1.3 * (
        0.085 * np.sin(2 * np.pi * (1.1 * u - 0.75 * seconds))
        + 0.055 * np.sin(2 * np.pi * (0.6 * u + 0.9 * v - 1.15 * seconds) + 1)
        + 0.06 * np.sin(2 * np.pi * 0.4 * seconds)
    )
    drawn = 0.03 * v * np.sin(2 * np.pi * 0.75 * seconds + 4 * u)
    points = np.stack([-0.72 + 0.94 * u + drawn, 1.66 - swing, 1.405 - 0.86 * v + 0.35 * swing**2], axis=2)
    parts.sheet(owner, points, Look("banner"))
    return np.zeros((0, 4))


def _add_inflatable(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    """A tube that bends more towards its top while swellings run up along it."""
    share = np.linspace(1, 0, 22)[:, None]
    angle = np.linspace(0, 2 * np.pi, 23)[None, :]
    outline = 0.17 * (1 - 0.30 * share) * np.sqrt(np.clip(1 - ((share - 0.86) / 0.14).clip(0) ** 2, 0, 1))
    radius = outline * (1 + 0.10 * np.sin(2 * np.pi * (1.2 * seconds - 1.4 * share)))
    bend_x = 0.26 * share**2 * np.sin(2 * np.pi * 0.55 * seconds - 1.2 * share)
    bend_y = 0.20 * share**2 * np.sin(2 * np.pi * 0.43 * seconds + 0.8 - 0.9 * share)
    rise = 1.35 * share - 0.25 * (bend_x**2 + bend_y**2)
    # the seam faces away from the middle of the room, the painted face towards it
    around = angle + 2.65 + np.pi
    points = np.stack(
        [
            1.62 + bend_x + radius * np.cos(around),
            -1.08 + bend_y + radius * np.sin(around),
            np.broadcast_to(rise, (22, 23)),
        ],
        axis=2,
    )
    points[:, -1] = points[:, 0]
    parts.sheet(owner, points, Look("inflatable"), closed=True)
    return np.array([[1.62, -1.08, 0.12, 0.17]])


def _add_door(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    """A door that slides along the wall and uncovers the corridor."""
    x = VISITOR_X + DOOR_TRAVEL * _ease((seconds - film_set.entrance_s) / DOOR_SECONDS)
    wide, high = DOOR_RIGHT - DOOR_LEFT + 0.08, DOOR_TOP + 0.06
    parts.box(
        owner,
        np.array([x, HALF_Y - 0.055, 0.02 + high / 2]),
        np.array([wide / 2, 0.022, high / 2]),
        Look("panels", (0.93, 0.9), (0.5, 0.5)),
    )
    parts.cone(
        owner,
        np.array([x - 0.42, HALF_Y - 0.11, 0.95]),
        np.array([x - 0.42, HALF_Y - 0.11, 1.2]),
        (0.013, 0.012),
        Look("metal"),
    )
    return np.zeros((0, 4))


def _add_parcel(parts: Parts, owner: int, film_set: FilmSet, seconds: float) -> np.ndarray:
    """A carton that nobody brings: it is there from one instant to the next."""
    if film_set.parcel_s is None or seconds < film_set.parcel_s:
        return np.zeros((0, 4))
    centre = np.array([*PARCEL, PARCEL_HALF[2]])
    parts.box(owner, centre, np.array(PARCEL_HALF), Look("carton", (1.5, 1.5), (0.5, 0.5)), turn_about_z(0.5))
    return np.array([[*centre, 1.1 * max(PARCEL_HALF)]])


def _ease(share: float) -> float:
    """0 up to 0, 1 from 1 on, with no jerk at either end."""
    t = float(np.clip(share, 0, 1))
    return t * t * t * (t * (6 * t - 15) + 10)


def _about_x(angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


MOVERS: dict[str, Callable[[Parts, int, FilmSet, float], np.ndarray]] = {
    "walker": _add_walker,
    "visitor": _add_visitor,
    "ball": _add_ball,
    "crate": _add_crate,
    "banner": _add_banner,
    "inflatable": _add_inflatable,
    "door": _add_door,
    "parcel": _add_parcel,
}
