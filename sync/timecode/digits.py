"""Compiled parsers: bytes to int64.

Numba keeps machine code until the file that holds the function changes, whatever happens in other files. So these use
nothing from elsewhere, and the limit of times is an argument.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def parse_rig_lines(data: np.ndarray, times: np.ndarray, indices: np.ndarray, limit_ns: int) -> int:
    """Parse lines into ns below the limit and index; the number of good lines before the first bad one.

    The index must have its 12 digits, so that a last line cut short by a crash is not taken for frame 0.
    """
    size, at = data.size, 0
    for line in range(times.size):
        for letter in (102, 114, 97, 109, 101, 95):  # frame_
            if at >= size or data[at] != letter:
                return line
            at += 1
        time, digits, at = _digits(data, at, 16)
        if digits == 0 or at >= size or data[at] != 95 or time >= limit_ns // 1000:
            return line
        index, digits, at = _digits(data, at + 1, 13)
        if at < size and data[at] == 13:
            at += 1
        if digits != 12 or (at < size and data[at] != 10):
            return line
        at += 1
        times[line] = time * 1000
        indices[line] = index
    return times.size


@njit(cache=True, error_model="numpy")
def parse_decimals(data: np.ndarray, ends: np.ndarray, power: int, integer: bool, limit: int, out: np.ndarray) -> int:
    """[+-]digits[.digits][e[+-]digits] times 10 to `power`; the number of good rows before the first bad one.

    Numbers from the limit on are bad.
    """
    digits = np.empty(64, np.uint8)
    for row in range(out.size):
        at, end = ends[row], ends[row + 1]
        negative = at < end and data[at] == 45
        if at < end and (data[at] == 45 or data[at] == 43):
            at += 1
        count, point, at = _mantissa(data, at, end, digits)
        if count == 0 or (integer and point >= 0):
            return row
        exponent, ok = _exponent(data, at, end)
        if not ok:
            return row
        keep = (count if point < 0 else point) + exponent + power
        value = _leading(digits, count, keep, limit)
        if value < 0:
            return row
        out[row] = -value if negative else value
    return out.size


@njit(cache=True, error_model="numpy")
def _digits(data: np.ndarray, at: int, most: int) -> tuple[int, int, int]:
    """Value of up to `most` digits from `at`, how many there are, and where they end."""
    value, start = 0, at
    while at < data.size and at - start < most and 48 <= data[at] <= 57:
        value = value * 10 + (data[at] - 48)
        at += 1
    return value, at - start, at


@njit(cache=True, error_model="numpy")
def _mantissa(data: np.ndarray, at: int, end: int, digits: np.ndarray) -> tuple[int, int, int]:
    """Digits up to the exponent into `digits`: how many (0 if too many or none), how many before the point, the end."""
    count, point = 0, -1
    while at < end:
        byte = data[at]
        if byte == 46 and point < 0:
            point = count
        elif 48 <= byte <= 57:
            if count == digits.size:
                return 0, point, at
            digits[count] = byte - 48
            count += 1
        else:
            break
        at += 1
    return count, point, at


@njit(cache=True, error_model="numpy")
def _exponent(data: np.ndarray, at: int, end: int) -> tuple[int, bool]:
    """Value of an exponent that reaches from `at` to `end`, and whether nothing else stands there."""
    if at == end:
        return 0, True
    if data[at] != 101 and data[at] != 69:
        return 0, False
    at += 1
    sign = -1 if at < end and data[at] == 45 else 1
    if at < end and (data[at] == 45 or data[at] == 43):
        at += 1
    value, count, stop = _digits(data, at, min(3, end - at))  # not into the number that follows
    return sign * value, count > 0 and stop == end


@njit(cache=True, error_model="numpy")
def _leading(digits: np.ndarray, count: int, keep: int, limit: int) -> int:
    """The first `keep` of `count` digits as a number, rounded by the next digit; -1 from the limit on."""
    value = 0
    for place in range(keep):
        value = value * 10 + (digits[place] if place < count else 0)
        if value >= limit // 10 and place + 1 < keep:
            return -1
    if 0 <= keep < count and digits[keep] >= 5:
        value += 1
    return value if value < limit else -1
