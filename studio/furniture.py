"""What stands still: the room, its furniture and what lies on it.

The floor is z = 0; the room spans x in [-4.4, 4.4], y in [-4, 4], z in [0, 3]. Furniture stands either along the walls
or within 2 m of the middle, so that cameras find room in the ring between. A doorway in the wall at y = 4 leads to a
corridor. All lengths are metres.
"""

from __future__ import annotations

import numpy as np

from studio.geometry import Look, Parts, turn_about_z

HALF_X, HALF_Y, HEIGHT = 4.4, 4.0, 3.0
WALL = 0.2
DOOR_LEFT, DOOR_RIGHT, DOOR_TOP = 0.55, 1.55, 2.08
"""The doorway, x and z"""
CORRIDOR_LEFT, CORRIDOR_RIGHT, CORRIDOR_END = 0.1, 2.6, 6.0
LAMP = np.array([0.55, -0.35, 2.90])
"""Middle of the ceiling lamp's face"""
WHITE_ALBEDO = 0.69
"""Of the texture `white`, in linear light"""

Point = tuple[float, float, float]


def add_room(parts: Parts, owners: dict[str, int], *, shine: float) -> None:
    """Walls, floor, ceiling, corridor, door frame, skirting, ceiling lamp. The floor's gloss is `shine`."""
    room, lamp = owners["room"], owners["lamp"]
    _slab(parts, room, (-5, -4.6, -0.2), (5, 6.4, 0), Look("floor", (0.42, 0.42), gloss=shine, polished=shine > 0))
    _slab(parts, room, (-5, -4.6, HEIGHT), (5, 6.4, HEIGHT + 0.2), Look("ceiling", (0.42, 0.42)))
    _slab(parts, room, (-HALF_X - WALL, -4.2, 0), (-HALF_X, 4.2, HEIGHT), Look("plaster_warm", (0.45, 0.45)))
    _slab(parts, room, (HALF_X, -4.2, 0), (HALF_X + WALL, 4.2, HEIGHT), Look("plaster_blue", (0.45, 0.45)))
    _slab(parts, room, (-4.6, -HALF_Y - WALL, 0), (4.6, -HALF_Y, HEIGHT), Look("wallpaper", (0.6, 0.6)))
    _slab(parts, room, (-4.6, -HALF_Y - 0.01, 0), (4.6, -HALF_Y + 0.03, 0.95), Look("panels", (0.8, 1.03), (0, 0.5)))
    for left, right, bottom in ((-4.6, DOOR_LEFT, 0.0), (DOOR_RIGHT, 4.6, 0.0), (DOOR_LEFT, DOOR_RIGHT, DOOR_TOP)):
        # the three pieces continue one another's courses on the side that faces the room
        offset = (0.42 * (left + right) / 2, -0.42 * (bottom + HEIGHT) / 2)
        _slab(parts, room, (left, HALF_Y, bottom), (right, HALF_Y + WALL, HEIGHT), Look("brick", (0.42, 0.42), offset))
    _add_corridor(parts, room)
    _add_trim(parts, room)
    _slab(parts, lamp, (LAMP[0] - 0.36, LAMP[1] - 0.36, 2.91), (LAMP[0] + 0.36, LAMP[1] + 0.36, 3.0), Look("metal"))
    for x in (-0.17, 0.17):
        for y in (-0.17, 0.17):
            low, high = (LAMP[0] + x - 0.14, LAMP[1] + y - 0.14, 2.905), (LAMP[0] + x + 0.14, LAMP[1] + y + 0.14, 2.92)
            _slab(parts, lamp, low, high, Look("white", emission=1.1))


def add_wall_lamps(parts: Parts, lamp: int, radiance: float) -> None:
    """A panel of light on each wall, between the pictures and low enough for cameras across the room; it lights only
    itself."""
    look, half_wide, half_deep = Look("white", emission=radiance / WHITE_ALBEDO), 0.15, 0.04
    for x, y in ((-1.45, HALF_Y), (-2.42, -HALF_Y)):
        parts.box(lamp, np.array([x, y, 1.4]), np.array([half_wide, half_deep, 0.55]), look)
    for x, y in ((HALF_X, 1.22), (-HALF_X, 2.04)):
        parts.box(lamp, np.array([x, y, 1.4]), np.array([half_deep, half_wide, 0.55]), look)


def add_furniture(parts: Parts, owners: dict[str, int], rng: np.random.Generator) -> None:
    """Everything that stands still inside the room; colours and the books differ by the random stream."""
    furniture, things, pictures = owners["furniture"], owners["things"], owners["pictures"]
    _slab(parts, owners["room"], (-1.75, -1.65, 0), (1.95, 1.35, 0.008), Look("rug", (1 / 3.7, 1 / 3.0), (0.5, 0.5)))
    _add_pictures(parts, pictures)
    _add_table(parts, furniture, things, owners["vase"])
    _add_bookshelf(parts, furniture, things, rng)
    _add_sofa(parts, furniture, things)
    _add_sideboard(parts, furniture, things, rng)
    _add_crates(parts, things)
    _add_plant(parts, things, (-3.75, 3.35), 1.0, rng)
    _add_plant(parts, things, (3.85, -3.45), 0.8, rng)
    _add_stool(parts, furniture, (1.62, 0.42))
    _add_floor_lamp(parts, furniture, (3.9, 3.45))
    parts.cylinder(furniture, np.array([-1.45, -1.2, 0.17]), 0.34, 0.34, Look("marble", (2.0, 0.6)))
    for x in (-0.76, 0.26):
        parts.cone(furniture, np.array([x, 1.66, 0.02]), np.array([x, 1.66, 1.46]), (0.020, 0.016), Look("metal"))
        _slab(parts, furniture, (x - 0.14, 1.54, 0), (x + 0.14, 1.78, 0.025), Look("wood_dark", (2, 2)))
    parts.cone(
        furniture, np.array([-0.80, 1.66, 1.42]), np.array([0.30, 1.66, 1.42]), (0.016, 0.015), Look("wood_light")
    )


def _slab(parts: Parts, owner: int, low: Point, high: Point, look: Look) -> None:
    """A box by two corners; its texture is anchored in its middle."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    parts.box(owner, (a + b) / 2, (b - a) / 2, look)


def _above(point: np.ndarray, height: float) -> np.ndarray:
    raised: np.ndarray = point + np.array([0.0, 0.0, height])
    return raised


def _board(parts: Parts, owner: int, texture: str, centre: Point, wide: float, high: float, wall: str) -> None:
    """A picture on a wall, 3 cm thick; the wall is named by its outward axis."""
    half = (0.015, wide / 2, high / 2) if wall in ("+x", "-x") else (wide / 2, 0.015, high / 2)
    parts.box_fit(owner, np.array(centre), np.array(half), Look(texture))


def _add_corridor(parts: Parts, room: int) -> None:
    left, right, end = CORRIDOR_LEFT, CORRIDOR_RIGHT, CORRIDOR_END
    _slab(parts, room, (left - WALL, 4.2, 0), (left, end, HEIGHT), Look("plaster_blue", (0.45, 0.45)))
    _slab(parts, room, (right, 4.2, 0), (right + WALL, end, HEIGHT), Look("plaster_warm", (0.45, 0.45)))
    _slab(parts, room, (left - WALL, end, 0), (right + WALL, end + WALL, HEIGHT), Look("wallpaper", (0.6, 0.6)))
    _board(parts, room, "poster_5", (1.05, end, 1.45), 0.9, 1.1, "+y")


def _add_trim(parts: Parts, room: int) -> None:
    """Skirting boards, the door's frame and the rail of the sliding door."""
    wood = Look("wood_dark", (0.7, 3.0))
    for side in (-1, 1):
        x = side * (HALF_X - 0.01)
        _slab(parts, room, (x - 0.01, -HALF_Y, 0), (x + 0.01, HALF_Y, 0.11), wood)
    for left, right in ((-HALF_X, DOOR_LEFT - 0.08), (DOOR_RIGHT + 0.08, HALF_X)):
        _slab(parts, room, (left, HALF_Y - 0.02, 0), (right, HALF_Y, 0.11), wood)
    for x in (DOOR_LEFT - 0.08, DOOR_RIGHT):
        _slab(parts, room, (x, HALF_Y - 0.02, 0), (x + 0.08, HALF_Y + WALL, DOOR_TOP), wood)
    _slab(
        parts,
        room,
        (DOOR_LEFT - 0.08, HALF_Y - 0.02, DOOR_TOP),
        (DOOR_RIGHT + 0.08, HALF_Y + WALL, DOOR_TOP + 0.08),
        wood,
    )
    _slab(parts, room, (0.35, HALF_Y - 0.09, 2.20), (2.85, HALF_Y - 0.02, 2.25), Look("metal", (1.0, 4.0)))


def _add_pictures(parts: Parts, owner: int) -> None:
    for texture, centre, wide, high, wall in (
        ("poster_1", (-0.75, HALF_Y, 1.75), 1.05, 1.35, "+y"),
        ("landscape_1", (-2.25, HALF_Y, 1.65), 1.25, 0.95, "+y"),
        ("poster_2", (3.35, HALF_Y, 1.75), 0.95, 1.25, "+y"),
        ("chart", (HALF_X, -0.2, 1.85), 2.0, 1.35, "+x"),
        ("poster_3", (HALF_X, 2.1, 1.75), 0.95, 1.25, "+x"),
        ("notices", (HALF_X, -2.35, 1.65), 1.3, 1.1, "+x"),
        ("landscape_2", (0.3, -HALF_Y, 1.90), 1.5, 1.1, "-y"),
        ("poster_4", (-1.6, -HALF_Y, 1.90), 0.9, 1.15, "-y"),
        ("poster_5", (2.2, -HALF_Y, 1.90), 0.95, 1.2, "-y"),
        ("chart", (-3.4, -HALF_Y, 1.90), 1.2, 0.95, "-y"),
        ("poster_4", (-HALF_X, 2.75, 1.70), 1.0, 1.3, "-x"),
        ("poster_2", (-HALF_X, -2.7, 1.70), 1.0, 1.3, "-x"),
    ):
        _board(parts, owner, texture, centre, wide, high, wall)


def _add_table(parts: Parts, furniture: int, things: int, vase: int) -> None:
    """A table near the middle, with a vase, books and a bowl of fruit."""
    turn, middle = turn_about_z(0.45), np.array([-1.35, 0.95, 0.0])

    def at(x: float, y: float, z: float) -> np.ndarray:
        place: np.ndarray = middle + turn @ np.array([x, y, z])
        return place

    parts.box(furniture, at(0, 0, 0.72), np.array([0.62, 0.38, 0.02]), Look("wood_light", (0.9, 0.9)), turn)
    parts.box(furniture, at(0, 0, 0.66), np.array([0.56, 0.32, 0.04]), Look("wood_dark", (0.9, 4.0)), turn)
    for x in (-0.54, 0.54):
        for y in (-0.30, 0.30):
            parts.box(furniture, at(x, y, 0.35), np.array([0.03, 0.03, 0.35]), Look("wood_dark", (4, 1)), turn)
    parts.sheet(vase, _lathe(at(-0.28, 0.08, 0.74)), Look("porcelain", (2.0, 1.0), gloss=0.10), closed=True)
    for layer, (wide, deep, thick, offset) in enumerate(
        ((0.15, 0.11, 0.022, 0.1), (0.13, 0.10, 0.016, 0.4), (0.11, 0.08, 0.02, 0.8))
    ):
        centre = at(0.12, -0.14, 0.74 + 0.042 * layer + thick)
        look = Look("spines", (1.6, 0.8), (offset, 0.3))
        parts.box(things, centre, np.array([wide, deep, thick]), look, turn_about_z(0.45 + 0.5 * layer))
    parts.cylinder(things, at(0.38, 0.14, 0.76), 0.16, 0.04, Look("porcelain", (3.0, 0.2)))
    for x, y, z, radius, tint in (
        (0.33, 0.12, 0.825, 0.050, (0.9, 0.25, 0.12)),
        (0.43, 0.10, 0.822, 0.046, (0.9, 0.70, 0.15)),
        (0.39, 0.21, 0.825, 0.050, (0.45, 0.75, 0.15)),
        (0.385, 0.14, 0.895, 0.047, (0.95, 0.45, 0.12)),
    ):
        parts.ellipsoid(things, at(x, y, z), np.full(3, radius), Look("skin", (2, 1), tint=tint), turn)


def _lathe(foot: np.ndarray) -> np.ndarray:
    """The outside of a vase, float64 [R, C, 3], last column equal to the first."""
    height = np.linspace(0, 1, 18)[::-1]
    radius = (
        0.050
        + 0.062 * np.sin(np.pi * np.clip(height * 1.15, 0, 1)) ** 1.3
        + 0.030 * np.clip(height - 0.86, 0, 1) / 0.14
    )
    angle = np.linspace(0, 2 * np.pi, 23)
    rim = np.stack([radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)], axis=2)
    rim[:, -1] = rim[:, 0]
    points: np.ndarray = foot + np.concatenate(
        [rim, np.broadcast_to(0.36 * height[:, None, None], (18, 23, 1))], axis=2
    )
    return points


def _add_bookshelf(parts: Parts, furniture: int, things: int, rng: np.random.Generator) -> None:
    """Shelves along the wall at -x, full of books of differing size."""
    back, front, wood = -HALF_X, -HALF_X + 0.32, Look("wood_dark", (0.8, 0.8))
    for y in (-1.8, -0.6, 0.6, 1.8):
        _slab(parts, furniture, (back, y - 0.02, 0), (front, y + 0.02, 2.1), wood)
    for z in (0.05, 0.45, 0.86, 1.27, 1.68, 2.1):
        _slab(parts, furniture, (back, -1.82, z - 0.015), (front, 1.82, z + 0.015), wood)
    for z in (0.065, 0.465, 0.875, 1.285, 1.695):
        for left in (-1.78, -0.58, 0.62):
            _add_books(parts, things, (left, left + 1.14), z, front, rng)


def _add_books(
    parts: Parts, owner: int, span: tuple[float, float], z: float, front: float, rng: np.random.Generator
) -> None:
    y, end = span[0] + 0.01, span[1] - float(rng.uniform(0.0, 0.35))
    while True:
        # a block of books with one height: each shows its own spine of the texture
        books = int(rng.integers(1, 5))
        wide, high, first = (
            books * float(rng.uniform(0.025, 0.05)),
            float(rng.uniform(0.2, 0.34)),
            int(rng.integers(16)),
        )
        if y + wide > end:
            return
        deep = front - float(rng.uniform(0.02, 0.08))
        scale = (books / 16 / wide, 1 / high)
        look = Look("spines", scale, ((first + books / 2) / 16, 0.5))
        _slab(parts, owner, (-HALF_X + 0.02, y, z), (deep, y + wide, z + high), look)
        y += wide + 0.004


def _add_sofa(parts: Parts, furniture: int, things: int) -> None:
    cloth, right = Look("sofa", (1.6, 1.6)), HALF_X - 0.05
    _slab(parts, furniture, (right - 0.85, -1.2, 0.10), (right, 0.9, 0.42), cloth)
    _slab(parts, furniture, (right - 0.25, -1.2, 0.42), (right, 0.9, 0.88), cloth)
    for y in (-1.36, 0.9):
        _slab(parts, furniture, (right - 0.85, y, 0.10), (right, y + 0.16, 0.62), cloth)
    for y, texture, lean in ((-0.85, "plaid", 0.25), (0.55, "banner", -0.2)):
        centre, radii = np.array([right - 0.36, y, 0.62]), np.array([0.12, 0.22, 0.21])
        parts.ellipsoid(things, centre, radii, Look(texture, (1.0, 1.0)), turn_about_z(np.pi + lean))


def _add_sideboard(parts: Parts, furniture: int, things: int, rng: np.random.Generator) -> None:
    """A cupboard along the wall at -y, with boxes, a globe and a candlestick."""
    front = -HALF_Y + 0.42
    _slab(parts, furniture, (-1.3, -HALF_Y + 0.03, 0.08), (1.5, front, 0.82), Look("wood_light", (0.8, 0.8)))
    for x in (-0.83, 0.1, 1.03):
        _slab(parts, furniture, (x - 0.44, front, 0.14), (x + 0.44, front + 0.015, 0.76), Look("wood_dark", (0.8, 0.8)))
        parts.ellipsoid(furniture, np.array([x + 0.36, front + 0.03, 0.45]), np.full(3, 0.022), Look("metal"))
    globe = np.array([1.15, -HALF_Y + 0.22, 1.02])
    parts.ellipsoid(things, globe, np.full(3, 0.15), Look("chart", (2.0, 1.0)), turn_about_z(float(rng.uniform(0, 6))))
    parts.cylinder(things, np.array([1.15, -HALF_Y + 0.22, 0.84]), 0.09, 0.05, Look("wood_dark"))
    _slab(
        parts,
        things,
        (-1.15, -HALF_Y + 0.06, 0.82),
        (-0.75, -HALF_Y + 0.36, 1.12),
        Look("carton", (2.5, 3.3), (0.5, 0.5)),
    )
    _slab(parts, things, (-1.08, -HALF_Y + 0.08, 1.12), (-0.82, -HALF_Y + 0.32, 1.30), Look("tiles", (2.0, 2.8)))
    for x, high in ((0.2, 0.22), (0.36, 0.30), (0.52, 0.17)):
        foot = np.array([x, -HALF_Y + 0.22, 0.85])
        parts.cone(things, foot, _above(foot, high), (0.03, 0.022), Look("white", tint=(0.95, 0.86, 0.62)))


def _add_crates(parts: Parts, things: int) -> None:
    """A pile of cartons and crates in a corner."""
    for x, y, z, side, texture, angle in (
        (-3.75, -3.35, 0.0, 0.34, "carton", 0.15),
        (-3.05, -3.50, 0.0, 0.28, "tiles", -0.25),
        (-3.80, -3.38, 0.68, 0.24, "tiles", 0.5),
        (3.55, 2.75, 0.0, 0.30, "carton", 0.7),
        (3.50, 2.72, 0.60, 0.20, "carton", 0.2),
    ):
        look = Look(texture, (0.5 / side, 0.5 / side), (0.5, 0.5))
        parts.box(things, np.array([x, y, z + side]), np.full(3, side), look, turn_about_z(angle))


def _add_plant(parts: Parts, things: int, place: tuple[float, float], size: float, rng: np.random.Generator) -> None:
    foot = np.array([*place, 0.0])
    parts.cylinder(things, _above(foot, 0.18 * size), 0.19 * size, 0.36 * size, Look("porcelain", (3.0, 1.0)))
    for _ in range(16):
        angle, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.25, 0.95)
        lean = rng.uniform(0.15, 0.38) * size
        tip = foot + np.array([lean * np.cos(angle), lean * np.sin(angle), (0.45 + rise) * size])
        parts.cone(things, _above(foot, 0.3 * size), tip, (0.012 * size, 0.008 * size), Look("leaves", (1, 4)))
        radii = np.array([0.16, 0.06, 0.022]) * size
        parts.ellipsoid(
            things, tip, radii, Look("leaves", (1.5, 1.0)), turn_about_z(angle) @ _pitch(rng.uniform(-0.7, 0.4))
        )


def _pitch(angle_rad: float) -> np.ndarray:
    """Rotation about y: positive lowers the x axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _add_stool(parts: Parts, furniture: int, place: tuple[float, float]) -> None:
    middle = np.array([*place, 0.0])
    parts.cylinder(furniture, _above(middle, 0.45), 0.19, 0.05, Look("sofa", (2.0, 0.3)))
    for angle in (0.6, 2.7, 4.8):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        parts.cone(
            furniture,
            _above(middle + 0.19 * out, 0.02),
            _above(middle + 0.12 * out, 0.43),
            (0.018, 0.022),
            Look("wood_light"),
        )


def _add_floor_lamp(parts: Parts, furniture: int, place: tuple[float, float]) -> None:
    foot = np.array([*place, 0.0])
    parts.cylinder(furniture, _above(foot, 0.02), 0.17, 0.04, Look("metal"))
    parts.cone(furniture, _above(foot, 0.04), _above(foot, 1.5), (0.016, 0.014), Look("metal", (1, 4)))
    parts.cone(
        furniture, _above(foot, 1.52), _above(foot, 1.78), (0.19, 0.12), Look("plaid", (3.0, 1.0), emission=0.35)
    )
