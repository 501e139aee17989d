"""Frame rates, exactly, and the time of a frame or a tick by its number."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction

import numpy as np

NANOSECONDS = 1_000_000_000


def parse_rate(value: int | str | float | Decimal | Fraction) -> Fraction:
    """Frames per second, exactly; 23.976, 29.97 and the like mean n * 1000 / 1001.

    >>> parse_rate("29.97"), parse_rate("60000/1001"), parse_rate(25)
    (Fraction(30000, 1001), Fraction(60000, 1001), Fraction(25, 1))
    """
    try:
        rate = Fraction(str(value))
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"a frame rate is a number such as 30, 29.97 or '30000/1001', but is {value!r}") from None
    if not 0 < rate <= 100_000:
        raise ValueError(f"a frame rate lies between 0 and 100000 frames per second, but is {value!r}")
    ntsc = Fraction(round(rate * 1001 / 1000) * 1000, 1001)
    # 0.004 takes in 23.98 for 23.976..., and leaves whole rates alone, which are 0.02 away at the nearest
    return ntsc if rate.denominator != 1 and abs(rate - ntsc) < Fraction(4, 1000) else rate


def frames_to_ns(frames: np.ndarray, rate: Fraction) -> np.ndarray:
    """Start of each frame at a constant rate, int64 ns, rounded half up."""
    return ticks_to_ns(frames, 1 / rate)


def ticks_to_ns(ticks: np.ndarray, unit_s: Fraction) -> np.ndarray:
    """Integer ticks of `unit_s` seconds each to int64 ns, rounded half up, without overflow on the way."""
    scale = unit_s * NANOSECONDS
    whole, rest = np.divmod(np.asarray(ticks, dtype=np.int64), scale.denominator)
    part = (2 * rest * (scale.numerator % scale.denominator) + scale.denominator) // (2 * scale.denominator)
    times: np.ndarray = whole * scale.numerator + rest * (scale.numerator // scale.denominator) + part
    return times
