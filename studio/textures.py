"""Procedural surfaces: everything that a camera can see in the room is painted here.

A texture is a picture of paint, sRGB in [0, 1], float32 [H, W, 3] with sides that are powers of two. Row 0 is the
top. All tile, so that a wall shows no seam. Detail spans scales from metres to millimetres: features for matching at
any distance, and a picture whose PSNR means something.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from studio.srgb import LINEAR, srgb_from_linear

LEVELS = 12
"""Longest chain of halved copies that a texture may have: sides up to 2048"""

_GLYPHS = """
0E11111F111111 1E11111E11111E 0E11101010110E 1E11111111111E 1F10101E10101F 1F10101E101010 0E11101711110F
1111111F111111 0E04040404040E 0702020202120C 11121418141211 1010101010101F 111B1515111111 11111915131111
0E11111111110E 1E11111E101010 0E11111115120D 1E11111E141211 0F10100E01011E 1F040404040404 1111111111110E
11111111110A04 11111115151B11 11110A040A1111 11110A04040404 1F01020408101F 0E11131519110E 040C040404040E
0E11010204081F 1F02040201110E 02060A121F0202 1F101E0101110E 0608101E11110E 1F010204080808 0E11110E11110E
0E11110F01020C
"""
FONT = dict(
    zip(
        "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789",
        _GLYPHS.split(),
        strict=True,
    )
)
"""Five columns by seven rows, one byte a row"""

Paint = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Textures:
    """All textures with their halved copies in one buffer, as the ray caster reads them."""

    texels: np.ndarray
    """uint8 [N, 3], sRGB"""
    start: np.ndarray
    """int64 [T, LEVELS]: first texel of each level; levels beyond the last repeat it"""
    size: np.ndarray
    """int32 [T, 3]: width, height, number of levels"""
    index: dict[str, int]
    """Row by name"""


def paint_textures(seed: int) -> Textures:
    """Paint all textures; each has a random stream of its own, so that adding one changes no other."""
    texels, starts, sizes = [], [], []
    total = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        painted = list(pool.map(_paint, repeat(seed), range(len(PAINTERS))))
    for levels in painted:
        offsets = total + np.cumsum([0] + [len(level) * level.shape[1] for level in levels])
        starts.append(np.append(offsets[:-1], np.full(LEVELS - len(levels), offsets[len(levels) - 1])))
        sizes.append((levels[0].shape[1], levels[0].shape[0], len(levels)))
        texels += [level.reshape(-1, 3) for level in levels]
        total = int(offsets[-1])
    return Textures(
        np.concatenate(texels),
        np.array(starts, dtype=np.int64),
        np.array(sizes, dtype=np.int32),
        {name: row for row, name in enumerate(PAINTERS)},
    )


def _paint(seed: int, row: int) -> list[np.ndarray]:
    return _halvings(list(PAINTERS.values())[row](np.random.default_rng([seed, 1, row])))


def _halvings(picture: np.ndarray) -> list[np.ndarray]:
    """The picture as uint8 and its halved copies, averaged in linear light, down to a side of one texel."""
    height, width = picture.shape[:2]
    if height & (height - 1) or width & (width - 1):
        raise ValueError(f"a texture's sides must be powers of two, but are {width}x{height}")
    levels = [np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)]
    light = LINEAR[levels[0]]
    while min(light.shape[:2]) > 1 and len(levels) < LEVELS:
        light = (light[::2, ::2] + light[1::2, ::2] + light[::2, 1::2] + light[1::2, 1::2]) / 4
        levels.append(np.rint(255 * srgb_from_linear(light)).astype(np.uint8))
    return levels


# Building blocks


def _noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int]) -> np.ndarray:
    """Smooth periodic value noise in [-1, 1], float32 [H, W], with cells (rows, columns) over the picture."""
    lattice = rng.uniform(-1, 1, cells).astype(np.float32)
    for axis in (0, 1):
        place = (np.arange(shape[axis], dtype=np.float32) + 0.5) * (cells[axis] / shape[axis])
        low = place.astype(np.int64)
        share = place - low
        share = share * share * (3 - 2 * share)
        share = share[:, None] if axis == 0 else share[None, :]
        first, second = np.take(lattice, low, axis), np.take(lattice, (low + 1) % cells[axis], axis)
        lattice = first + share * (second - first)
    return lattice


def _clouds(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int], octaves: int, gain: float = 0.55
) -> np.ndarray:
    """Sum of octaves of noise, about in [-1, 1], float32 [H, W]."""
    total = np.zeros(shape, np.float32)
    weights = [gain**octave for octave in range(octaves)]
    for octave, weight in enumerate(weights):
        total += weight * _noise(rng, shape, (cells[0] << octave, cells[1] << octave))
    return total * (1.6 / sum(weights))


def _grid(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Texel centres: y [H, 1] down and x [1, W] to the right, both in (0, 1)."""
    y = (np.arange(shape[0], dtype=np.float32)[:, None] + 0.5) / shape[0]
    x = (np.arange(shape[1], dtype=np.float32)[None, :] + 0.5) / shape[1]
    return y, x


def _mix(first: np.ndarray | Paint, second: np.ndarray | Paint, share: np.ndarray) -> np.ndarray:
    """From the first paint (share 0) to the second (share 1), float32 [H, W, 3]; share is [H, W]."""
    a, b = np.asarray(first, np.float32), np.asarray(second, np.float32)
    mixed: np.ndarray = a + (b - a) * np.clip(share, 0, 1).astype(np.float32)[..., None]
    return mixed


def _plain(shape: tuple[int, int], paint: Paint) -> np.ndarray:
    return np.broadcast_to(np.asarray(paint, np.float32), (*shape, 3)).copy()


def _step(value: np.ndarray, edge: float, width: float) -> np.ndarray:
    """0 below the edge, 1 above, smooth over the width."""
    share = np.clip((value - edge) / width + 0.5, 0, 1)
    return share * share * (3 - 2 * share)


def _vivid(rng: np.random.Generator, low: float = 0.15, high: float = 0.85) -> Paint:
    """A saturated colour, no channel beyond the limits."""
    hue = rng.uniform(0, 6)
    wave = [np.clip(abs((hue + shift) % 6 - 3) - 1, 0, 1) for shift in (0, 4, 2)]
    dull = rng.uniform(0.25, 0.7)
    r, g, b = (float(low + (high - low) * (dull * 0.5 + (1 - dull) * part)) for part in wave)
    return r, g, b


def _letters(picture: np.ndarray, text: str, top: int, left: int, dot: int, paint: Paint) -> None:
    """Write capital letters and digits in place, dot by dot; what does not fit is cut off."""
    for place, letter in enumerate(text):
        rows = bytes.fromhex(FONT[letter]) if letter in FONT else b""
        x = left + place * 6 * dot
        for line, row in enumerate(rows):
            for column in range(5):
                if row >> (4 - column) & 1:
                    y = top + line * dot
                    picture[y : y + dot, x + column * dot : x + (column + 1) * dot] = paint


def _word(rng: np.random.Generator, length: int) -> str:
    """Something that looks like a word: consonants and vowels in turn."""
    vowels, others = "AEIOU", "BCDFGHJKLMNPRSTVWZ"
    start = int(rng.integers(2))
    return "".join(str(rng.choice(list(vowels if (place + start) % 2 else others))) for place in range(length))


def _paragraph(
    picture: np.ndarray, rng: np.random.Generator, box: tuple[int, int, int, int], dot: int, paint: Paint
) -> None:
    """Fill a box (top, left, bottom, right) with lines of words."""
    top, left, bottom, right = box
    for line in range(top, bottom - 7 * dot, 10 * dot):
        x = left
        while x < right - 12 * dot:
            word = _word(rng, int(rng.integers(2, 9)))[: (right - x) // (6 * dot)]
            _letters(picture, word, line, x, dot, paint)
            x += (len(word) + 1) * 6 * dot


# Materials of the room


def _brick(rng: np.random.Generator) -> np.ndarray:
    shape, rows, columns = (1024, 1024), 32, 10
    y, x = _grid(shape)
    wobble = 0.0012 * _clouds(rng, shape, (24, 24), 3)
    row = np.floor((y + wobble) * rows)
    along = (x + wobble) * columns + 0.5 * (row % 2)
    across = ((y + wobble) * rows) % 1
    edge = np.minimum(np.minimum(along % 1, 1 - along % 1) * rows / columns, np.minimum(across, 1 - across))
    which = row.astype(np.int32) % rows, np.floor(along).astype(np.int32) % columns
    tone = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)[which]
    dark = rng.uniform(0, 1, (rows, columns)).astype(np.float32)[which]
    face = _mix((0.55, 0.29, 0.22), (0.72, 0.44, 0.33), 0.5 + 0.5 * tone)
    face = _mix(face, (0.33, 0.22, 0.21), (dark > 0.86) * 0.8)
    grain = _clouds(rng, shape, (64, 64), 4, 0.75)
    face += (0.09 * grain + 0.05 * _clouds(rng, shape, (4, 4), 3))[..., None]
    mortar = _mix((0.66, 0.64, 0.60), (0.50, 0.48, 0.45), 0.5 + 0.5 * grain)
    return _mix(mortar, face, _step(edge + 0.02 * grain, 0.075, 0.05))


def _planks(rng: np.random.Generator, light: Paint, dark: Paint, boards: int, joints: int) -> np.ndarray:
    """Boards along x, each with a tone, a grain and joints of its own."""
    shape = (1024, 1024)
    y, x = _grid(shape)
    board = np.broadcast_to((y * boards).astype(int), shape)
    across = np.broadcast_to((y * boards) % 1, shape)
    shift = rng.uniform(0, 1, boards).astype(np.float32)[board]
    along = (x + shift) * joints
    cell = along.astype(int) % joints
    tone = rng.uniform(0, 1, (boards, joints)).astype(np.float32)[board, cell]
    grain = _clouds(rng, shape, (128, 4), 3, 0.7) + 0.6 * _noise(rng, shape, (512, 24))
    rings = np.sin(40 * (across + 0.35 * _clouds(rng, shape, (2 * boards, 3), 2)) + 6 * tone)
    share = 0.15 + 0.6 * tone + 0.22 * grain + 0.10 * rings
    wood = _mix(light, dark, share)
    knots = _step(_noise(rng, shape, (4 * boards, 3 * joints)), 0.93, 0.08)
    wood = _mix(wood, 0.45 * np.array(dark), 0.7 * knots)
    gap = np.minimum(np.minimum(across, 1 - across), np.minimum(along % 1, 1 - along % 1) * boards / joints)
    return wood * (0.35 + 0.65 * _step(gap, 0.03, 0.03))[..., None]


def _floor(rng: np.random.Generator) -> np.ndarray:
    return _planks(rng, (0.74, 0.55, 0.37), (0.47, 0.31, 0.19), 18, 3)


def _wood_dark(rng: np.random.Generator) -> np.ndarray:
    return _planks(rng, (0.45, 0.29, 0.19), (0.26, 0.16, 0.11), 6, 2)


def _wood_light(rng: np.random.Generator) -> np.ndarray:
    return _planks(rng, (0.85, 0.71, 0.51), (0.66, 0.49, 0.31), 7, 2)


def _panels(rng: np.random.Generator) -> np.ndarray:
    """Painted wall panels with bevelled frames and brush strokes."""
    shape = (512, 512)
    y, x = _grid(shape)
    u, v = (2 * x) % 1, (y) % 1
    edge = np.minimum(np.minimum(u, 1 - u) / 2, np.minimum(v, 1 - v) * 0.6) + 0 * y
    groove = np.exp(-(((edge - 0.085) / 0.008) ** 2)) + 0.7 * np.exp(-(((edge - 0.11) / 0.006) ** 2))
    seam = np.exp(-((edge / 0.006) ** 2))
    strokes = _clouds(rng, shape, (8, 96), 3, 0.7)
    paint = _mix((0.38, 0.47, 0.46), (0.47, 0.56, 0.53), 0.5 + 0.45 * strokes)
    scuffs = _step(_clouds(rng, shape, (24, 24), 3, 0.8), 0.62, 0.2)
    panels: np.ndarray = (
        _mix(paint, (0.62, 0.62, 0.56), 0.5 * scuffs) * (1 - 0.45 * np.clip(groove + seam, 0, 1))[..., None]
    )
    return panels


def _plaster(rng: np.random.Generator, paint: Paint) -> np.ndarray:
    """Rough plaster: trowel marks, stains, pinholes."""
    shape = (1024, 1024)
    trowel = _clouds(rng, shape, (6, 14), 6, 0.72)
    stain = _clouds(rng, shape, (3, 3), 4)
    holes = _step(_noise(rng, shape, (160, 160)), 0.90, 0.1)
    chips = _step(_clouds(rng, shape, (20, 20), 4, 0.6), 0.72, 0.06)
    wall = np.asarray(paint, np.float32) * (1 + 0.13 * trowel + 0.07 * stain)[..., None]
    wall = _mix(wall, (0.42, 0.40, 0.38), 0.55 * holes)
    return _mix(wall, (0.80, 0.77, 0.72), 0.7 * chips)


def _plaster_blue(rng: np.random.Generator) -> np.ndarray:
    return _plaster(rng, (0.50, 0.60, 0.66))


def _plaster_warm(rng: np.random.Generator) -> np.ndarray:
    return _plaster(rng, (0.76, 0.69, 0.58))


def _wallpaper(rng: np.random.Generator) -> np.ndarray:
    """Damask: mirrored waves in two tones, on paper with fibres."""
    shape, repeats = (512, 512), 6
    y, x = _grid(shape)
    u = np.abs((x * repeats + 0.5 * ((y * repeats / 1).astype(int) % 2)) % 1 - 0.5) * 2
    v = (y * repeats) % 1 + 0 * x
    total = np.zeros(shape, np.float32)
    for _ in range(9):
        a, b = rng.integers(1, 7), rng.integers(1, 6)
        total += np.cos(np.pi * a * u) * np.cos(2 * np.pi * b * v + rng.uniform(0, 6.3)) / np.sqrt(a + b)
    motif = _step(np.abs(total), 0.55, 0.16) * (1 - 0.8 * _step(np.abs(total), 1.25, 0.16))
    paper = _mix((0.71, 0.68, 0.52), (0.45, 0.50, 0.36), motif)
    fibre = _clouds(rng, shape, (128, 32), 3, 0.8)
    return paper * (1 + 0.08 * fibre + 0.06 * _clouds(rng, shape, (4, 4), 4))[..., None]


def _ceiling(rng: np.random.Generator) -> np.ndarray:
    """Mineral tiles in a metal grid."""
    shape, tiles = (1024, 1024), 4
    y, x = _grid(shape)
    u, v = (x * tiles) % 1, (y * tiles) % 1
    edge = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    holes = _step(_noise(rng, shape, (128, 128)), 0.62, 0.25)
    tone = rng.uniform(0.9, 1.0, (tiles, tiles)).astype(np.float32)
    board = 0.80 * tone[(y * tiles).astype(int), (x * tiles).astype(int)]
    board = board * (1 + 0.05 * _clouds(rng, shape, (4, 4), 5, 0.8)) * (1 - 0.35 * holes)
    grey = np.where(edge < 0.02, 0.62, board) * np.where(np.abs(edge - 0.02) < 0.006, 0.6, 1)
    return grey[..., None] * np.array([1.0, 0.99, 0.95], np.float32)


def _rug(rng: np.random.Generator) -> np.ndarray:
    """Woven rug: a medallion of mirrored waves in five wools, borders with small figures."""
    shape = (1024, 1024)
    y, x = _grid(shape)
    u, v = np.abs(x - 0.5) * 2, np.abs(y - 0.5) * 2
    total = np.zeros(shape, np.float32)
    for _ in range(14):
        a, b = rng.integers(1, 12, 2)
        total += np.cos(np.pi * a * u + rng.uniform(0, 6.3)) * np.cos(np.pi * b * v) / np.sqrt(1 + 0.2 * (a + b))
    total += 2.2 * np.cos(9 * np.hypot(u, v))
    wools = np.array(
        [(0.55, 0.16, 0.15), (0.74, 0.65, 0.47), (0.17, 0.21, 0.36), (0.63, 0.40, 0.20), (0.29, 0.36, 0.31)],
        np.float32,
    )
    wool = wools[np.floor(total * 1.1).astype(int) % 5]
    edge = 1 - np.maximum(u, v)
    steps = np.floor((x + y) * 48).astype(int) % 2 == np.floor((x - y) * 48).astype(int) % 2
    border = np.where(steps[..., None], wools[1], wools[2])
    wool = np.where((edge < 0.16)[..., None], border, wool)
    for inner, outer, choice in ((0.0, 0.02, 2), (0.055, 0.075, 0), (0.14, 0.175, 3)):
        wool = np.where(((edge >= inner) & (edge < outer))[..., None], wools[choice], wool)
    knots = _noise(rng, shape, (256, 256)) + 0.6 * np.sin(2 * np.pi * 256 * y)
    rug: np.ndarray = wool * (1 + 0.12 * knots + 0.10 * _clouds(rng, shape, (8, 8), 3))[..., None]
    return rug


def _marble(rng: np.random.Generator) -> np.ndarray:
    shape = (512, 512)
    veins = np.abs(_clouds(rng, shape, (3, 3), 6, 0.62))
    stone = _mix((0.86, 0.85, 0.82), (0.64, 0.64, 0.64), 0.5 + 0.5 * _clouds(rng, shape, (2, 2), 5))
    return _mix(stone, (0.27, 0.27, 0.30), 0.9 * np.exp(-((veins / 0.045) ** 2)))


def _metal(rng: np.random.Generator) -> np.ndarray:
    shape = (256, 256)
    brushed = _clouds(rng, shape, (128, 4), 2, 0.8)
    return _plain(shape, (0.42, 0.43, 0.45)) * (1 + 0.2 * brushed + 0.1 * _clouds(rng, shape, (4, 4), 3))[..., None]


def _leaves(rng: np.random.Generator) -> np.ndarray:
    shape = (256, 256)
    y, x = _grid(shape)
    veins = np.abs(np.sin(2 * np.pi * (8 * x + 4 * np.abs((y * 4) % 1 - 0.5))))
    green = _mix((0.16, 0.33, 0.14), (0.42, 0.57, 0.23), 0.5 + 0.6 * _clouds(rng, shape, (6, 6), 4))
    return _mix(green, (0.62, 0.70, 0.40), 0.6 * (veins < 0.16))


def _weave(rng: np.random.Generator, first: Paint, second: Paint, threads: int) -> np.ndarray:
    """Two threads over and under, with worn patches."""
    shape = (256, 256)
    y, x = _grid(shape)
    over = np.sin(2 * np.pi * threads * x) * np.sin(2 * np.pi * threads * y)
    worn = _clouds(rng, shape, (8, 8), 4, 0.7)
    return _mix(first, second, 0.5 + 0.35 * over + 0.3 * worn)


def _denim(rng: np.random.Generator) -> np.ndarray:
    shape = (256, 256)
    y, x = _grid(shape)
    twill = np.sin(2 * np.pi * 48 * (x + y))
    worn = _clouds(rng, shape, (4, 6), 5, 0.7)
    cloth = _mix((0.14, 0.19, 0.32), (0.42, 0.50, 0.64), 0.4 + 0.14 * twill + 0.38 * worn)
    seams = (np.abs(x - 0.25) < 0.008) | (np.abs(x - 0.75) < 0.008)
    return _mix(cloth, (0.72, 0.52, 0.27), 0.8 * (seams & (np.sin(2 * np.pi * 40 * y) > -0.2)))


def _sofa(rng: np.random.Generator) -> np.ndarray:
    cloth = np.tile(_weave(rng, (0.36, 0.20, 0.24), (0.60, 0.38, 0.38), 32), (2, 2, 1))
    y, x = _grid((512, 512))
    petals = np.sin(2 * np.pi * 6 * x) * np.sin(2 * np.pi * 6 * y) + 0.4 * np.sin(2 * np.pi * 18 * x)
    return _mix(cloth, (0.78, 0.66, 0.45), 0.75 * _step(petals, 0.72, 0.1))


# Pictures and printed things


def _poster(rng: np.random.Generator) -> np.ndarray:
    """Overlapping discs, bars and triangles on a gradient, with a headline and small print, in a pale frame."""
    shape = (512, 512)
    y, x = _grid(shape)
    picture = _mix(_vivid(rng), _vivid(rng, 0.4, 0.95), y + 0 * x + 0.1 * _clouds(rng, shape, (3, 3), 4))
    for _ in range(26):
        _add_shape(picture, rng)
    picture *= (1 + 0.05 * _clouds(rng, shape, (32, 32), 4, 0.8))[..., None]
    ink: Paint = (0.10, 0.09, 0.12)
    picture[404:] = 0.25 * picture[404:] + np.float32(0.66)
    _letters(picture, _word(rng, 8), 414, 40, 9, ink)
    _paragraph(picture, rng, (484, 40, 506, 480), 1, ink)
    frame = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) + 0 * picture[..., 0]
    return _mix(picture, (0.86, 0.83, 0.77), frame < 0.03) * np.where(frame < 0.01, 0.35, 1)[..., None]


def _add_shape(picture: np.ndarray, rng: np.random.Generator) -> None:
    """Paint a disc, a bar, a triangle or a ring in place."""
    side = picture.shape[0]
    cx, cy, radius, turn = rng.uniform(0, 1), rng.uniform(0, 0.8), rng.uniform(0.03, 0.2), rng.uniform(0, 3.14)
    rows, columns = (slice(max(int((c - 1.7 * radius) * side), 0), int((c + 1.7 * radius) * side)) for c in (cy, cx))
    y, x = _grid(picture.shape[:2])
    y, x = y[rows] - cy, x[:, columns] - cx
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    shapes = (
        np.hypot(u, v) < radius,
        (np.abs(u) < 1.6 * radius) & (np.abs(v) < 0.25 * radius),
        (v > -radius / 2) & (v + 1.7 * np.abs(u) < radius),
        np.abs(np.hypot(u, v) - radius) < 0.012,
    )
    inside = shapes[rng.integers(len(shapes))]
    picture[rows, columns] = _mix(picture[rows, columns], _vivid(rng), 0.9 * inside)


def _landscape(rng: np.random.Generator) -> np.ndarray:
    """A painting: sky, clouds, hills one behind the other, a lake."""
    shape = (512, 512)
    y, x = _grid(shape)
    picture = _mix((0.38, 0.56, 0.78), (0.86, 0.83, 0.74), 1.8 * y + 0 * x)
    cloud = _clouds(rng, shape, (6, 3), 6)
    picture = _mix(picture, (0.93, 0.92, 0.90), _step(cloud - y, -0.25, 0.4))
    for layer in range(5):
        ridge = 0.40 + 0.11 * layer + (0.10 - 0.012 * layer) * _clouds(rng, (1, 512), (1, 3 + layer), 6)
        hill = _mix((0.52, 0.60, 0.68), (0.16, 0.30, 0.13), np.full(shape, layer / 4))
        hill *= (1 + 0.30 * _clouds(rng, shape, (32, 16), 4, 0.8))[..., None]
        picture = np.where((y > ridge)[..., None], hill, picture)
    frame = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) + 0 * picture[..., 0]
    carved = 0.5 + 0.5 * np.sin(frame * 320)
    return np.where((frame < 0.05)[..., None], _mix((0.36, 0.24, 0.10), (0.74, 0.58, 0.26), carved), picture)


def _chart(rng: np.random.Generator) -> np.ndarray:
    """A wall map: coast lines, contour lines, a grid, names."""
    shape = (512, 512)
    y, x = _grid(shape)
    height = _clouds(rng, shape, (3, 3), 6)
    land = _mix((0.50, 0.62, 0.36), (0.78, 0.64, 0.42), height * 1.2)
    picture = np.where((height > 0.05)[..., None], land, np.array((0.45, 0.62, 0.74), np.float32))
    contour = np.abs((height * 7) % 1 - 0.5) < 0.07
    picture = _mix(picture, (0.32, 0.26, 0.20), 0.55 * contour)
    lines = (np.abs((x * 8) % 1 - 0.5) < 0.012) | (np.abs((y * 8) % 1 - 0.5) < 0.012)
    picture = _mix(picture, (0.20, 0.24, 0.34), 0.6 * lines)
    for _ in range(34):
        top, left = rng.integers(8, 490), rng.integers(8, 440)
        _letters(
            picture, _word(rng, int(rng.integers(4, 9))), int(top), int(left), int(rng.integers(1, 3)), (0.1, 0.1, 0.15)
        )
    return picture


def _notices(rng: np.random.Generator) -> np.ndarray:
    """A cork board with notes pinned over each other."""
    shape = (512, 512)
    picture = _mix((0.58, 0.42, 0.26), (0.76, 0.60, 0.42), 0.5 + 0.7 * _clouds(rng, shape, (64, 64), 3, 0.8))
    for _ in range(22):
        high, wide = (int(side) for side in rng.integers(60, 150, 2))
        top, left = int(rng.integers(8, 504 - high)), int(rng.integers(8, 504 - wide))
        picture[top + 3 : top + high + 4, left + 3 : left + wide + 4] *= 0.55
        bright = float(rng.uniform(0.7, 0.95))
        picture[top : top + high, left : left + wide] = _mix(
            (bright,) * 3, _vivid(rng, 0.5, 0.95), np.full((high, wide), rng.uniform(0, 0.9), np.float32)
        )
        note = picture[top : top + high, left : left + wide]
        _letters(note, _word(rng, 5), 8, 8, 2, _vivid(rng, 0.0, 0.4))
        _paragraph(note, rng, (28, 8, high - 4, wide - 4), 1, (0.15, 0.15, 0.2))
        note[2:8, wide // 2 - 3 : wide // 2 + 3] = _vivid(rng, 0.05, 0.8)
    return picture


def _binding(rng: np.random.Generator) -> Paint:
    """Leather, linen or paper: brown, red, green, blue or pale, never bright."""
    kinds = (
        (0.40, 0.24, 0.14),
        (0.46, 0.13, 0.12),
        (0.16, 0.30, 0.20),
        (0.14, 0.20, 0.36),
        (0.74, 0.68, 0.54),
        (0.2, 0.2, 0.22),
    )
    r, g, b = np.array(kinds[rng.integers(len(kinds))]) * rng.uniform(0.75, 1.3) + rng.uniform(-0.05, 0.05, 3)
    return float(np.clip(r, 0.05, 0.9)), float(np.clip(g, 0.05, 0.9)), float(np.clip(b, 0.05, 0.9))


def _spines(rng: np.random.Generator) -> np.ndarray:
    """Sixteen book spines side by side, titles written upwards."""
    shape = (512, 1024)
    picture = np.empty((*shape, 3), np.float32)
    for book in range(16):
        spine = _plain((64, 512), _binding(rng))
        spine *= (1 + 0.10 * _clouds(rng, (64, 512), (8, 64), 3, 0.8))[..., None]
        ink = _vivid(rng, 0.55, 0.98) if rng.random() < 0.7 else (0.85, 0.72, 0.40)
        for band in rng.integers(10, 500, 4):
            spine[:, band : band + int(rng.integers(2, 9))] = ink
        spine[14:50, 60:380] = spine[14:50, 60:380].mean((0, 1))
        _letters(spine, _word(rng, int(rng.integers(5, 9))), 18, 70, 4, ink)
        _letters(spine, _word(rng, 6), 26, 400, 2, ink)
        picture[:, book * 64 : (book + 1) * 64] = np.rot90(spine)
    return picture


def _carton(rng: np.random.Generator) -> np.ndarray:
    """Corrugated cardboard with tape, a printed label and stamps."""
    shape = (512, 512)
    y, x = _grid(shape)
    flutes = np.sin(2 * np.pi * 64 * x)
    board = _plain(shape, (0.66, 0.50, 0.33))
    board *= (1 + 0.04 * flutes + 0.12 * _clouds(rng, shape, (8, 8), 5, 0.7))[..., None]
    tape = np.broadcast_to(np.abs(y - 0.5) < 0.06, shape)
    board = _mix(board, (0.80, 0.72, 0.55), 0.75 * tape)
    board[40:190, 60:300] = (0.90, 0.89, 0.85)
    _letters(board, _word(rng, 6), 52, 72, 5, (0.08, 0.08, 0.1))
    _paragraph(board, rng, (100, 72, 180, 292), 1, (0.12, 0.12, 0.15))
    bars = rng.integers(0, 2, 60).repeat(2).astype(bool)
    board[196:230, 60:180][:, bars] = 0.1
    _letters(board, _word(rng, 7), 330, 50, 9, (0.55, 0.16, 0.13))
    for _ in range(5):
        ring = np.abs(np.hypot(x - rng.uniform(0.1, 0.9), y - rng.uniform(0.62, 0.92)) - 0.05) < 0.006
        board = _mix(board, (0.16, 0.26, 0.50), 0.8 * ring)
    return board


def _tiles(rng: np.random.Generator) -> np.ndarray:
    """A crate's painted sides: bold squares, stars and numbers."""
    shape, side = (512, 512), 128
    picture = np.empty((*shape, 3), np.float32)
    y, x = _grid((side, side))
    for row in range(4):
        for column in range(4):
            tile = _plain((side, side), _binding(rng) if rng.random() < 0.6 else _vivid(rng, 0.2, 0.75))
            angle, radius = np.arctan2(y - 0.5, x - 0.5), np.hypot(y - 0.5, x - 0.5)
            points = rng.integers(3, 8)
            star = radius < 0.28 + 0.12 * np.cos(points * angle + rng.uniform(0, 6))
            tile = _mix(tile, _vivid(rng, 0.35, 0.85), star)
            _letters(tile, str(rng.integers(10, 99)), 44, 34, 5, _vivid(rng, 0.0, 0.5))
            tile[:4] = tile[-4:] = tile[:, :4] = tile[:, -4:] = (0.14, 0.12, 0.12)
            picture[row * side : (row + 1) * side, column * side : (column + 1) * side] = tile
    return picture * (1 + 0.07 * _clouds(rng, shape, (32, 32), 4, 0.8))[..., None]


# What moves


def _ball(rng: np.random.Generator) -> np.ndarray:
    """Six coloured gores with dots, white poles; wraps round a sphere."""
    shape = (256, 512)
    y, x = _grid(shape)
    gores = np.array([_vivid(rng, 0.1, 0.85) if gore % 2 else (0.88, 0.86, 0.80) for gore in range(6)], np.float32)
    picture = gores[np.broadcast_to((x * 6).astype(int), shape)]
    dots = np.hypot((x * 18) % 1 - 0.5, (y * 9) % 1 - 0.5) < 0.27
    picture = _mix(picture, 0.75 - 0.6 * picture, 0.85 * dots)
    seam = np.minimum((x * 6) % 1, 1 - (x * 6) % 1) < 0.03
    picture = _mix(picture, (0.10, 0.10, 0.12), 0.9 * (seam & (y > 0)))
    _letters(picture, _word(rng, 6), 116, 30, 3, (0.08, 0.08, 0.10))
    return picture * (1 + 0.06 * _clouds(rng, shape, (32, 64), 3, 0.8))[..., None]


def _banner(rng: np.random.Generator) -> np.ndarray:
    """A printed sheet: chevrons, a crest and a line of large letters."""
    shape = (512, 512)
    y, x = _grid(shape)
    chevron = ((y * 6 + np.abs(x - 0.5) * 5) % 1) < 0.42
    picture = _mix(_vivid(rng, 0.12, 0.7), (0.85, 0.80, 0.66), chevron)
    crest = np.hypot((x - 0.5) * 1.1, y - 0.42)
    picture = _mix(picture, (0.88, 0.86, 0.80), crest < 0.27)
    rays = np.sin(11 * np.arctan2(y - 0.42, x - 0.5)) > 0
    picture = _mix(picture, _vivid(rng, 0.05, 0.6), (crest < 0.23) & rays)
    picture = _mix(picture, (0.92, 0.78, 0.30), crest < 0.08)
    _letters(picture, _word(rng, 7), 400, 44, 10, (0.10, 0.09, 0.14))
    cloth = 0.5 * np.sin(2 * np.pi * 128 * x) * np.sin(2 * np.pi * 128 * y) + _clouds(rng, shape, (16, 16), 4, 0.8)
    woven: np.ndarray = picture * (1 + 0.07 * cloth)[..., None]
    return woven


def _inflatable(rng: np.random.Generator) -> np.ndarray:
    """Spiral stripes with spots and a smiling face."""
    shape = (512, 512)
    y, x = _grid(shape)
    stripes = np.sin(2 * np.pi * (7 * y + 2 * x)) > 0
    picture = _mix(_vivid(rng, 0.15, 0.9), _vivid(rng, 0.25, 0.95), stripes)
    spots = np.hypot((x * 8) % 1 - 0.5, (y * 11) % 1 - 0.5) < 0.22
    picture = _mix(picture, _vivid(rng, 0.05, 0.8), spots & (y > 0.4))
    face = np.hypot((x - 0.5) * 2.4, (y - 0.2) * 3.2)
    picture = _mix(picture, (0.90, 0.84, 0.55), face < 0.48)
    for side in (-1, 1):
        eye = np.hypot((x - 0.5 - side * 0.075) * 2.4, (y - 0.16) * 3.2)
        picture = _mix(_mix(picture, (0.94, 0.94, 0.92), eye < 0.13), (0.08, 0.08, 0.1), eye < 0.06)
    picture = _mix(picture, (0.6, 0.12, 0.12), (np.abs(face - 0.30) < 0.035) & (y > 0.22))
    return picture * (1 + 0.08 * _clouds(rng, shape, (24, 24), 4, 0.8))[..., None]


def _creases(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    creases: np.ndarray = np.abs(_clouds(rng, shape, (3, 5), 4)) * -0.25 + 0.08 * _clouds(rng, shape, (48, 48), 2)
    return creases


def _shirt(rng: np.random.Generator) -> np.ndarray:
    """Horizontal stripes, letters on chest and back; wraps round a body, chest in the middle."""
    shape = (512, 512)
    y, x = _grid(shape)
    picture = _mix((0.82, 0.79, 0.72), (0.62, 0.15, 0.16), np.sin(2 * np.pi * 15 * y) + 0 * x > 0.1)
    for left in (196, 452 - 512, 452):
        box = picture[150:232, max(left, 0) : max(left, 0) + 126 if left >= 0 else left + 126]
        box[:] = (0.16, 0.20, 0.32)
        _letters(box, _word(np.random.default_rng(int(rng.integers(9))), 4), 20, 8 + min(left, 0), 5, (0.92, 0.88, 0.7))
    worn: np.ndarray = picture * (1 + _creases(rng, shape))[..., None]
    return worn


def _plaid(rng: np.random.Generator) -> np.ndarray:
    shape = (512, 512)
    y, x = _grid(shape)
    bands = 0.5 * (np.sin(2 * np.pi * 11 * x) > 0.35) + 0.5 * (np.sin(2 * np.pi * 11 * y) > 0.35)
    lines = (np.abs((x * 11) % 1 - 0.75) < 0.05) | (np.abs((y * 11) % 1 - 0.75) < 0.05)
    picture = _mix((0.16, 0.33, 0.30), (0.60, 0.66, 0.42), bands)
    picture = _mix(picture, (0.86, 0.74, 0.30), 0.8 * lines)
    buttons = (np.abs(x - 0.5) < 0.012) & (np.abs((y * 9) % 1 - 0.5) < 0.1)
    worn: np.ndarray = _mix(picture, (0.92, 0.90, 0.86), buttons) * (1 + _creases(rng, shape))[..., None]
    return worn


def _skin(rng: np.random.Generator) -> np.ndarray:
    shape = (128, 128)
    skin = _plain(shape, (0.80, 0.60, 0.48)) * (1 + 0.05 * _clouds(rng, shape, (8, 8), 4, 0.8))[..., None]
    return _mix(skin, (0.52, 0.32, 0.24), 0.5 * _step(_noise(rng, shape, (40, 40)), 0.9, 0.1))


def _face(rng: np.random.Generator) -> np.ndarray:
    """A head unrolled: the face looks out at the middle, hair at the rim."""
    shape = (256, 256)
    y, x = _grid(shape)
    side, up = x - 0.5 + 0 * y, 0.5 - y + 0 * x
    picture = np.tile(_skin(rng), (2, 2, 1))
    picture = _mix(
        picture, (0.80, 0.42, 0.38), 0.4 * np.exp(-(((np.abs(side) - 0.1) / 0.04) ** 2 + ((up + 0.06) / 0.05) ** 2))
    )
    for sign in (-1, 1):
        u, v = side - sign * 0.062, up - 0.045
        eye = np.hypot(u / 0.034, v / 0.022)
        picture = _mix(picture, (0.93, 0.92, 0.90), eye < 1)
        picture = _mix(picture, (0.18, 0.24, 0.30), np.hypot(u, v * 1.1) < 0.016)
        brow = (np.abs(v - 0.05 + 6 * u * u) < 0.011) & (np.abs(u) < 0.045)
        picture = _mix(picture, (0.20, 0.13, 0.09), brow)
    mouth = (np.abs(up + 0.118 - 4 * side * side) < 0.014) & (np.abs(side) < 0.055)
    picture = _mix(picture, (0.62, 0.24, 0.23), mouth)
    stubble = np.exp(-((side / 0.09) ** 2) - (((up + 0.17) / 0.05) ** 2)) * (0.6 + 0.4 * _noise(rng, shape, (96, 96)))
    return _mix(picture, (0.36, 0.25, 0.20), 0.45 * stubble)


def _hair(rng: np.random.Generator) -> np.ndarray:
    shape = (256, 256)
    strands = _clouds(rng, shape, (6, 96), 3, 0.8)
    return _mix((0.09, 0.06, 0.05), (0.38, 0.25, 0.16), 0.4 + 0.45 * strands)


def _porcelain(rng: np.random.Generator) -> np.ndarray:
    """Cobalt vines and bands on white glaze."""
    shape = (512, 512)
    y, x = _grid(shape)
    total = np.zeros(shape, np.float32)
    for _ in range(10):
        a, b = rng.integers(2, 9, 2)
        total += np.cos(2 * np.pi * a * x + rng.uniform(0, 6)) * np.cos(2 * np.pi * b * y + rng.uniform(0, 6))
    vines = _step(np.abs(total), 0.35, 0.3)
    bands = ((np.abs((y * 5) % 1 - 0.5) > 0.44) & (x > -1)) | (np.abs(y - 0.5) < 0.01)
    glaze = _mix((0.16, 0.25, 0.58), (0.86, 0.88, 0.88), vines)
    return _mix(glaze, (0.12, 0.18, 0.45), bands) * (1 + 0.03 * _clouds(rng, shape, (16, 16), 4))[..., None]


def _white(rng: np.random.Generator) -> np.ndarray:
    shape = (256, 256)
    return _plain(shape, (0.85, 0.85, 0.85)) * (1 + 0.06 * _clouds(rng, shape, (8, 8), 5, 0.8))[..., None]


PAINTERS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "brick": _brick,
    "floor": _floor,
    "wood_dark": _wood_dark,
    "wood_light": _wood_light,
    "panels": _panels,
    "plaster_blue": _plaster_blue,
    "plaster_warm": _plaster_warm,
    "wallpaper": _wallpaper,
    "ceiling": _ceiling,
    "rug": _rug,
    "marble": _marble,
    "metal": _metal,
    "leaves": _leaves,
    "denim": _denim,
    "sofa": _sofa,
    "poster_1": _poster,
    "poster_2": _poster,
    "poster_3": _poster,
    "poster_4": _poster,
    "poster_5": _poster,
    "landscape_1": _landscape,
    "landscape_2": _landscape,
    "chart": _chart,
    "notices": _notices,
    "spines": _spines,
    "carton": _carton,
    "tiles": _tiles,
    "ball": _ball,
    "banner": _banner,
    "inflatable": _inflatable,
    "shirt": _shirt,
    "plaid": _plaid,
    "skin": _skin,
    "face": _face,
    "hair": _hair,
    "porcelain": _porcelain,
    "white": _white,
}
"""All textures by name; a new one goes to the end, since the place seeds the random stream"""
