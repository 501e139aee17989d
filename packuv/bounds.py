"""The most that a file may say of itself, checked before anything is allocated for it.

Files come from other people. Whatever a reader takes from one, a count, a size, a number, passes through here: what is
too large, not finite or of another kind is a ValueError that names the field. docs/scene-format.md lists the bounds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from numbers import Integral
from typing import Any

import numpy as np

MOST_SIDE_PX = 2**15
"""Width or height of a picture, pixels"""
MOST_PIXELS = 2**28
"""Of a picture"""
MOST_SH_DEGREE = 3
"""What every renderer of splats draws"""
MOST_GAUSSIANS = 2**26
"""Of a frame"""
MOST_CAMERAS = 10_000
MOST_FRAMES = 2**18
"""Of a scene, 2.4 hours at 30 a second; their part of the header stays below MOST_JSON_BYTES"""
MOST_LIT_FRAMES = 216_000
"""Of a scene whose light changes, 2 hours at 30 a second: three numbers more for each"""
MOST_REFERENCES = 64
"""Keys that are decoded for one key"""
MOST_NUMBER = 1e30
"""Absolute value of a length, a coordinate or a code's value; float32 ends at 3e38"""
MOST_NS = 4 * 10**18
"""Absolute value of a time, ns; differences of two still fit int64"""
MOST_LIGHT = 10.0
"""Absolute value of the natural logarithm of light: 22,000 times as much as in steady light, or as little"""
MOST_RATE_PART = 2**31 - 1
"""Numerator and denominator of a frame rate: FFmpeg's"""
MOST_SAMPLE_RATE, MOST_SOUND_CHANNELS, MOST_SAMPLES = 655_350, 8, 2**36 - 1
"""Of sound: FLAC's"""
MOST_SOUND_PACKETS = 2**19
"""14 hours"""
MOST_TEXT = 1000
"""Characters of a name"""
MOST_JSON_BYTES = 24 << 20
MOST_JSON_VALUES = 2**21
"""Commas and opening brackets of a JSON document; Python takes up to 200 bytes for a value"""
MOST_JSON_DEPTH = 64
ALWAYS_UNPACKED_BYTES, MOST_RATIO = 16 << 20, 64
"""What a compressed file may always unpack to, and how many times its own size beyond that"""

_RATE = re.compile(r"(\d{1,10})(?:/(\d{1,10}))?", re.ASCII)
_SHOWN = 60


def shown(value: object) -> str:
    """A value for a message, not longer than a line."""
    if isinstance(value, int) and abs(value) >= 10**_SHOWN:
        return f"a number of about {value.bit_length() * 3 // 10} digits"
    if isinstance(value, (list, tuple, dict)):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def whole(value: object, what: str, *, least: int = 0, most: int) -> int:
    """A whole number from `least` to `most`."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, Integral) or isinstance(value, bool) or not least <= int(value) <= most:
        raise ValueError(f"{what} must be a whole number from {least} to {most}, but is {shown(value)}")
    return int(value)


def wholes(value: object, what: str, *, least: int = 0, most: int, count: int | None = None) -> list[int]:
    """A list of whole numbers from `least` to `most`, as many as `count` says."""
    found = items(value, what, most=MOST_FRAMES)
    if count is not None and len(found) != count:
        raise ValueError(f"{what} must hold {count} numbers, but holds {len(found)}")
    for item in found:
        if type(item) is not int or not least <= item <= most:
            raise ValueError(f"{what} must hold whole numbers from {least} to {most}, but has {shown(item)}")
    return found


def finite(value: object, what: str) -> float:
    """A number that is finite and not absurd."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not abs(value) <= MOST_NUMBER:  # type: ignore[arg-type]  # only numbers come so far
        raise ValueError(f"{what} must be a finite number up to {MOST_NUMBER:g}, but is {shown(value)}")
    return float(value)  # type: ignore[arg-type]  # the same


def positive(value: object, what: str) -> float:
    """A finite number above 0, and not so small that dividing by it overflows."""
    number = finite(value, what)
    if not number >= 1 / MOST_NUMBER:
        raise ValueError(f"{what} must be positive, at least {1 / MOST_NUMBER:g}, but is {number}")
    return number


def numbers(value: object, what: str, shape: tuple[int, ...]) -> np.ndarray:
    """Nested lists of finite numbers, float64 of this shape."""
    return np.array(_numbers(value, what, shape), np.float64).reshape(shape)


def _numbers(value: object, what: str, shape: tuple[int, ...]) -> Any:
    if not shape:
        return finite(value, what)
    if not isinstance(value, (list, tuple)) or len(value) != shape[0]:
        raise ValueError(f"{what} must hold {shape[0]} entries, but is {shown(value)}")
    return [_numbers(item, what, shape[1:]) for item in value]


def rate_of(value: object, what: str) -> Fraction:
    """A frame rate above 0 from text as "30/1"."""
    match = _RATE.fullmatch(value) if isinstance(value, str) else None
    parts = [int(part or 1) for part in match.groups()] if match else [0]
    if not all(0 < part <= MOST_RATE_PART for part in parts):
        raise ValueError(
            f'{what} must be a fraction above 0 as "30/1", both parts up to {MOST_RATE_PART}, but is {shown(value)}'
        )
    return Fraction(*parts)


def words(value: object, what: str) -> str:
    """Text that can be printed."""
    if not isinstance(value, str) or len(value) > MOST_TEXT or not value.isprintable():
        raise ValueError(f"{what} must be printable text of at most {MOST_TEXT} characters, but is {shown(value)}")
    return value


def items(value: object, what: str, *, most: int) -> list[Any]:
    """A list of at most so many entries."""
    if not isinstance(value, list) or len(value) > most:
        raise ValueError(f"{what} must be a list of at most {most} entries, but is {shown(value)}")
    return value


def fields(value: object, what: str) -> Mapping[str, Any]:
    """A JSON object."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{what} must be an object with fields, but is {shown(value)}")
    return value


def field(data: Mapping[str, Any], name: str, what: str) -> Any:
    """A field that must be there."""
    if name not in data:
        raise ValueError(f"{what} needs the field {name!r}, but has {shown(', '.join(sorted(data)))}")
    return data[name]


def check_picture(width: object, height: object, what: str) -> None:
    """Raises ValueError for a size that no picture here has."""
    sides = {"width": width, "height": height}
    pixels = math.prod(whole(side, f"{what}: {name}", least=1, most=MOST_SIDE_PX) for name, side in sides.items())
    if pixels > MOST_PIXELS:
        raise ValueError(f"{what}: a picture has at most {MOST_PIXELS} pixels, but {width} x {height} are {pixels}")


def check_count(count: int, what: str) -> None:
    """Raises ValueError for more Gaussians than a frame may have."""
    if not 0 <= count <= MOST_GAUSSIANS:
        raise ValueError(f"{what} must hold 0 to {MOST_GAUSSIANS} Gaussians, but says that it holds {shown(count)}")


def check_unpacked(unpacked_bytes: int, packed_bytes: int, what: str) -> None:
    """Raises ValueError for what unpacks to far more than pictures and splats do."""
    if unpacked_bytes > max(ALWAYS_UNPACKED_BYTES, MOST_RATIO * packed_bytes):
        raise ValueError(
            f"{what} would unpack from {packed_bytes} bytes to {shown(unpacked_bytes)}, more than {MOST_RATIO} times "
            "as many; it is damaged, or made to fill the memory"
        )


def check_depth(value: object, what: str) -> None:
    """Raises ValueError for lists and objects within one another more than MOST_JSON_DEPTH deep."""
    level: Sequence[Any] = [value]
    for _ in range(MOST_JSON_DEPTH):
        level = [
            child
            for node in level
            if isinstance(node, (list, dict))
            for child in (node.values() if isinstance(node, dict) else node)
            if isinstance(child, (list, dict))
        ]
        if not level:
            return
    raise ValueError(f"{what} is nested more than {MOST_JSON_DEPTH} deep")
