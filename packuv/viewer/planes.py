"""Codes as planes of bytes that deflate well, and back.

A plane holds one byte of a column, row after row. Before it is deflated, it may be taken as differences to the row
before, and red and blue as differences to green, whichever makes it smaller; a position's differences are folded so
that small ones of either sign have a high byte of 0. docs/viewer.md has the layout byte by byte.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from packuv.gaussians.codes import DC

ROW_BEFORE, GREEN = 1, 2
"""Bits of a plane's filter: what was taken from it."""

RUNS_PAY = 0.5
"""Share of its most frequent byte from which on a plane is tried with runs: Huffman codes cost a bit at least"""


def column_planes(xyz: np.ndarray | None, attributes: np.ndarray, *, colours: int = DC.start) -> list[np.ndarray]:
    """Planes uint8 of positions uint16 [n, 3], if there are any, and attributes uint8 [n, k]; first their filters.

    Attributes from column `colours` on are r g b triples. Inverse of `read_columns`.
    """
    filters: list[int] = []
    planes: list[np.ndarray] = []
    for column in () if xyz is None else xyz.T:
        bits, halves = min(((bits, _halves(_less_row(column, bits))) for bits in (0, ROW_BEFORE)), key=_cost)
        filters.append(bits)
        planes.extend(halves)
    for number, column in enumerate(attributes.T):
        forms = [(0, column), (ROW_BEFORE, _less_row(column, ROW_BEFORE))]
        colour = (number - colours) % 3
        if number >= colours and colour != 1:
            left = column - attributes[:, number - colour + 1]
            forms += [(GREEN, left), (GREEN | ROW_BEFORE, _less_row(left, ROW_BEFORE))]
        bits, plane = min(((bits, form) for bits, form in forms), key=lambda form: _bits(form[1]))
        filters.append(bits)
        planes.append(plane)
    return [np.array(filters, np.uint8), *planes]


def _less_row(column: np.ndarray, bits: int) -> np.ndarray:
    """Differences to the row before, modulo the width; the first row is as it is."""
    return np.diff(column, prepend=column.dtype.type(0)) if bits & ROW_BEFORE else column


def _halves(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """High and low bytes of uint16 [n], folded: 0, -1, 1, -2 become 0, 1, 2, 3."""
    signed = column.view(np.int16)
    folded = (signed << 1 ^ signed >> 15).view(np.uint16)
    return (folded >> 8).astype(np.uint8), folded.astype(np.uint8)


def _cost(form: tuple[int, tuple[np.ndarray, np.ndarray]]) -> float:
    return sum(map(_bits, form[1]))


def _bits(plane: np.ndarray) -> float:
    """Bits that an ideal coder without context spends on a plane."""
    counts = np.bincount(plane, minlength=256)
    return float((counts * np.log2(max(1, len(plane)) / np.maximum(counts, 1))).sum())


def read_columns(
    body: bytes, offset: int, count: int, columns: int, *, positions: bool = True, colours: int = DC.start
) -> tuple[np.ndarray, np.ndarray]:
    """Positions uint16 [count, 3] (or [count, 0]) and attributes uint8 [count, columns] that lie in a body there.

    Raises ValueError where the body has another size.
    """
    axes = 3 if positions else 0
    needed = offset + axes + columns + count * (2 * axes + columns)
    if len(body) != needed:
        raise ValueError(f"a body of {count} rows has {needed} bytes, but here are {len(body)}")
    filters = np.frombuffer(body, np.uint8, axes + columns, offset)
    planes = np.frombuffer(body, np.uint8, -1, offset + axes + columns).reshape(2 * axes + columns, count)
    xyz, attributes = np.empty((count, axes), np.uint16), np.empty((count, columns), np.uint8)
    for axis in range(axes):
        folded = planes[2 * axis].astype(np.uint16) << 8 | planes[2 * axis + 1]
        xyz[:, axis] = _summed(folded >> 1 ^ -(folded & 1), int(filters[axis]))
    for number in range(columns):
        attributes[:, number] = _summed(planes[2 * axes + number], int(filters[axes + number]))
    for number in np.flatnonzero(filters[axes:] & GREEN).tolist():
        attributes[:, number] += attributes[:, number - (number - colours) % 3 + 1]
    return xyz, attributes


def _summed(column: np.ndarray, bits: int) -> np.ndarray:
    return np.cumsum(column, dtype=column.dtype) if bits & ROW_BEFORE else column


def deflated(parts: Sequence[np.ndarray | bytes]) -> bytes:
    """One zlib stream of all parts, in which each has Huffman codes of its own.

    Matches hardly occur in noise, and looking for them costs ten times the rest, so only runs are.
    """
    contents = [bytes(part) for part in parts]
    blocks = (min((_block(content, strategy) for strategy in _strategies(content)), key=len) for content in contents)
    check = zlib.adler32(b"".join(contents))
    return b"".join((b"\x78\x9c", *blocks, b"\x03\x00", check.to_bytes(4, "big")))  # an empty last block, the checksum


def _strategies(content: bytes) -> tuple[int, ...]:
    counts = np.bincount(np.frombuffer(content, np.uint8), minlength=256)
    often = counts.max() > RUNS_PAY * max(1, len(content))
    return (zlib.Z_RLE, zlib.Z_HUFFMAN_ONLY) if often else (zlib.Z_HUFFMAN_ONLY,)


def _block(content: bytes, strategy: int) -> bytes:
    """Deflated up to a whole byte, to be followed by more."""
    coder = zlib.compressobj(6, zlib.DEFLATED, -15, 9, strategy)
    return coder.compress(content) + coder.flush(zlib.Z_FULL_FLUSH)
