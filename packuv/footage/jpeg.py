"""Whether the entropy-coded data of a baseline JPEG picture is whole: decoders show what they find, right or wrong.

Huffman codes fall into step again after a wrong bit, so that only the picture in between is wrong, and no decoder says
a word; but then the blocks end before or after the data does, which is what is looked at here. A progressive or
arithmetically coded picture is not looked into.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from packuv.kernels.compile import kernel

_LAST = 128
"""More coefficients than a block has, at once: its end"""
_LONGEST = 256
"""Bytes of a block at most, and some more"""
_SCAN = 0xDA
"""Marker before the coded data"""
WHOLE, SHORT, LONG, WRONG = range(4)
_PADDING = 16
"""Bits after the last block from which on they are too many: less than a byte is usual, some encoders add one"""
_FAULTS = {
    SHORT: "its data ends before the picture",
    LONG: "its data goes on after the picture",
    WRONG: "its data holds codes that mean nothing",
}


def jpeg_fault(file: bytes | memoryview) -> str:
    """What is wrong with a JPEG picture, for people; empty for one that is whole, or of a kind not looked into."""
    content = np.frombuffer(file, np.uint8)
    try:
        scan = [*_segments(content)][-1][2]
        tables = _headers(content[:scan].tobytes())
    except (IndexError, ValueError, ArithmeticError):
        return "its headers are damaged"
    if tables is None:
        return ""
    data = content[scan:]
    flat, ends = np.zeros(len(data) + _LONGEST, np.uint8), np.empty(tables.parts, np.int64)
    parts = _flatten(data, flat, ends)
    if parts < 0:
        return _FAULTS[LONG]
    return _FAULTS.get(int(_walk(flat, ends, parts, *tables)), "")


class _Tables(NamedTuple):
    """What a scan is read by."""

    tables: np.ndarray
    """uint16 [k, 65536]: for each 16 bits that may come, coefficients to go on by << 5 | bits; 0: they mean nothing"""
    short: np.ndarray
    """uint16 [k, 1024]: the same by the first ten bits, where those tell; small enough to be near"""
    which: np.ndarray
    """int64 [b, 2]: by block of a unit the tables of its first and of its other coefficients"""
    units: int
    interval: int
    """Units between restart markers; 0 for none"""

    @property
    def parts(self) -> int:
        """Between restart markers."""
        return -(-self.units // self.interval) if self.interval else 1


def _segments(file: np.ndarray) -> Iterator[tuple[int, np.ndarray, int]]:
    """Markers with what they say and where that ends, up to the one behind which the scan begins."""
    at, marker = 2, 0
    while marker != _SCAN:
        while file[at] == 0xFF and file[at + 1] == 0xFF:
            at += 1
        if file[at] != 0xFF:
            raise ValueError
        marker, end = int(file[at + 1]), at + 2 + (int(file[at + 2]) << 8 | int(file[at + 3]))
        yield marker, file[at + 4 : end], end
        at = end


@lru_cache(maxsize=8)
def _headers(header: bytes) -> _Tables | None:
    """What the pictures of a video share, mostly; None for kinds that are not looked into."""
    huffman, components, sides, interval = dict[int, np.ndarray](), dict[int, tuple[int, int]](), (0, 0), 0
    for marker, body, _ in _segments(np.frombuffer(header, np.uint8)):
        if marker == 0xC4:
            _read_tables(body, huffman)
        elif marker in (0xC0, 0xC1):
            sides = (int(body[1]) << 8 | int(body[2]), int(body[3]) << 8 | int(body[4]))
            if body[0] != 8:
                return None
            components = {int(c[0]): (int(c[1]) >> 4, int(c[1]) & 15) for c in body[6 : 6 + 3 * body[5]].reshape(-1, 3)}
        elif 0xC2 <= marker <= 0xCF and marker not in (0xC8, 0xCC):
            return None
        elif marker == 0xDD:
            interval = int(body[0]) << 8 | int(body[1])
        elif marker == _SCAN:
            return _scan(body, huffman, components, sides, interval)
    raise ValueError


def _scan(
    body: np.ndarray,
    huffman: dict[int, np.ndarray],
    components: dict[int, tuple[int, int]],
    sides: tuple[int, int],
    interval: int,
) -> _Tables | None:
    if body[0] != len(components) or not sides[0]:
        return None  # a scan for each component, or a height that comes later
    across, down = (max(factors) for factors in zip(*components.values(), strict=True))
    if len(components) == 1:
        components, across, down = dict.fromkeys(components, (1, 1)), 1, 1
    dc, ac = list[np.ndarray](), list[np.ndarray]()
    uses = body[1 : 1 + 2 * body[0]].reshape(-1, 2).tolist()
    if any(name not in components for name, _ in uses):
        raise ValueError
    if any(use >> 4 not in huffman or 16 | use & 15 not in huffman for _, use in uses):
        return None  # the tables that everybody knows, as in some AVI files
    for name, use in uses:
        blocks = components[name][0] * components[name][1]
        dc += [huffman[use >> 4]] * blocks
        ac += [huffman[16 | use & 15]] * blocks
    units = -(-sides[0] // (8 * down)) * -(-sides[1] // (8 * across))
    kinds = {id(table): table for table in [*dc, *ac]}
    places = {name: place for place, name in enumerate(kinds)}
    which = np.array([[places[id(d)], places[id(a)]] for d, a in zip(dc, ac, strict=True)], np.int64)
    tables = np.stack(list(kinds.values()))
    grouped = tables.reshape(len(tables), 1 << 10, 1 << 6)
    short = np.where((grouped == grouped[..., :1]).all(axis=2), grouped[..., 0], 0).astype(np.uint16)
    return _Tables(tables, short, which, units, interval)


def _read_tables(body: np.ndarray, huffman: dict[int, np.ndarray]) -> None:
    """Tables by class and number."""
    while len(body):
        size = 17 + int(body[1:17].sum(dtype=int))
        huffman[int(body[0])] = _table(bytes(body[1:size]), first=body[0] < 16)
        body = body[size:]


@lru_cache(maxsize=64)
def _table(said: bytes, *, first: bool) -> np.ndarray:
    """See `_Tables`; `first` for first coefficients, whose values are sizes alone."""
    table, begin, index = np.zeros(1 << 16, np.uint16), 0, 16
    for bits, count in enumerate(said[:16], start=1):
        for _ in range(count):
            stop, value = begin + (1 << 16 - bits), said[index]
            table[begin:stop] = (1 if first else _step(value)) << 5 | bits + (value & 15)
            begin, index = stop, index + 1
    return table


def _step(value: int) -> int:
    """Coefficients that a code passes over, its own included; the rest of the block is _LAST."""
    return _LAST if value & 15 == 0 and value != 0xF0 else (value >> 4) + 1


@kernel()
def _flatten(data, flat, ends):
    """The scan without the zeros that follow bytes of 255, and where its parts between restart markers end in `flat`.

    Returns the number of parts; -1 for more than there may be.
    """
    count, at, size = 0, 0, data.size
    parts = 0
    while at < size:
        byte = data[at]
        if byte != 0xFF:
            flat[count] = byte
            count += 1
            at += 1
        elif at + 1 < size and data[at + 1] == 0:
            flat[count] = byte
            count += 1
            at += 2
        elif at + 1 < size and data[at + 1] == 0xFF:
            at += 1
        elif at + 1 < size and 0xD0 <= data[at + 1] <= 0xD7:
            if parts == ends.size:
                return -1
            ends[parts] = count
            parts += 1
            at += 2
        else:
            break
    if parts == ends.size:
        return -1
    ends[parts] = count
    return parts + 1


@kernel()
def _walk(flat, ends, parts, tables, short, which, units, interval):
    """Read every block of a scan; one of WHOLE, SHORT, LONG, WRONG."""
    bit, part = np.uint64(0), 0
    blocks, left = which.shape[0], interval
    for _ in range(units):
        if interval and left == 0:
            end = np.uint64(8 * ends[part])
            if bit + np.uint64(_PADDING) <= end:
                return LONG
            part += 1
            if part == parts:
                return SHORT
            bit, left = end, interval
        left -= 1
        end = np.uint64(8 * ends[part])
        for block in range(blocks):
            place, table = np.uint64(0), which[block, 0]
            while place < 64:
                byte = bit >> np.uint64(3)
                three = np.uint32(flat[byte]) << 16 | np.uint32(flat[byte + np.uint64(1)]) << 8
                three |= np.uint32(flat[byte + np.uint64(2)])
                look = (three >> (np.uint32(8) - np.uint32(bit & np.uint64(7)))) & np.uint32(0xFFFF)
                entry = np.uint64(short[table, look >> np.uint32(6)])
                if entry == 0:
                    entry = np.uint64(tables[table, look])
                    if entry == 0:
                        return WRONG
                bit += entry & np.uint64(31)
                place += entry >> np.uint64(5)
                table = which[block, 1]
            if 64 < place < _LAST:
                return WRONG
            if bit > end:
                return SHORT
    if part + 1 < parts or bit + np.uint64(_PADDING) <= end:
        return LONG
    return WHOLE
