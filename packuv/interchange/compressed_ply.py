"""SuperSplat's compressed PLY: chunks of 256 neighbouring Gaussians, each with ranges of its own, 16 bytes a Gaussian.

Positions and scales take 11, 10 and 11 bits of their chunk's range, rotations 2 + 3 x 10 bits, colours and alpha 8
bits each; SH bands above 0 are 8-bit over -4..4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from packuv.gaussians.floats import SH_C0, Gaussians, rows_of
from packuv.interchange.conventions import (
    alpha_codes,
    drop_largest,
    is_drawn,
    logits_of_alpha,
    restore_largest,
    rows_out,
)
from packuv.interchange.ply import columns_of, write_tables

CHUNK = 256
"""Gaussians per chunk."""
LOG_SCALE_LIMIT = 20.0
"""Log scales beyond it, infinite ones too, would spoil the range of their chunk; other programs clip here as well."""

_POSITION, _SCALE, _COLOUR = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
_BITS = (11, 10, 11)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def write_compressed_ply(path: Path, gaussians: Gaussians, *, keep_rows: bool = False) -> int:
    """Write a compressed PLY and return the number of drawn Gaussians in it.

    What is not drawn is left out, and rows come in Morton order, so that chunks are small; or rows stay as they are.
    """
    mask = is_drawn(gaussians)
    kept = rows_out(gaussians, mask, keep_rows=keep_rows)
    kept = kept if keep_rows else _in_morton_order(kept)
    colour = 0.5 + SH_C0 * kept.sh[:, 0].astype(np.float64)
    scale = np.clip(kept.log_scales.astype(np.float64), -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    groups = [(_POSITION, kept.means.astype(np.float64)), (_SCALE, scale), (_COLOUR, colour)]
    chunk, shares = _chunks(groups, len(kept))
    vertex = np.empty(len(kept), [(name, "<u4") for name in _PACKED])
    vertex["packed_position"] = _pack(shares[0], _BITS)
    vertex["packed_rotation"] = _pack_rotation(kept.quaternions)
    vertex["packed_scale"] = _pack(shares[1], _BITS)
    vertex["packed_color"] = _pack(shares[2], (8, 8, 8)) << 8 | alpha_codes(kept.opacity_logits)
    tables = {"chunk": chunk, "vertex": vertex}
    if kept.sh_degree:
        tables["sh"] = _pack_bands(kept.sh[:, 1:])
    write_tables(path, tables)
    return int(mask.sum())


def unpack(path: Path, tables: dict[str, np.ndarray]) -> Gaussians:
    """Gaussians of the elements of a compressed PLY."""
    vertex, chunk = tables["vertex"], tables["chunk"]
    if len(chunk) * CHUNK < len(vertex):
        raise ValueError(f"{path} has {len(chunk)} chunks of {CHUNK} for {len(vertex)} Gaussians")
    if any(name not in (vertex.dtype.names or ()) or vertex.dtype[name].kind != "u" for name in _PACKED):
        raise ValueError(f"{path} lacks the packed columns {_PACKED} of a compressed PLY")
    position, rotation, scale, colour = (vertex[name].astype(np.int64) for name in _PACKED)
    rgb = np.stack([colour >> shift & 255 for shift in (24, 16, 8)], axis=1) / 255
    # Older files keep colours in 0..1 instead of a range per chunk.
    if "min_r" in (chunk.dtype.names or ()):
        rgb = _in_chunk(path, chunk, rgb, _COLOUR)
    dc = ((rgb - 0.5) / SH_C0)[:, None]  # [n, 1, 3]
    sh = np.concatenate([dc, _bands(path, tables.get("sh"), len(vertex))], axis=1)
    return Gaussians(
        _in_chunk(path, chunk, _three(position), _POSITION).astype(np.float32),
        _in_chunk(path, chunk, _three(scale), _SCALE).astype(np.float32),
        _unpack_rotation(rotation),
        logits_of_alpha(colour & 255),
        sh.astype(np.float32),
    )


# Writing


def _in_morton_order(gaussians: Gaussians) -> Gaussians:
    if not len(gaussians):
        return gaussians
    low, high = gaussians.means.min(axis=0), gaussians.means.max(axis=0)
    cells = ((gaussians.means - low) / np.maximum(high - low, 1e-30) * 1023).astype(np.int64)  # [n, 3]
    place = np.zeros(len(cells), np.int64)
    for bit in range(10):
        for axis in range(3):
            place |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return rows_of(gaussians, np.argsort(place, kind="stable"))


def _chunks(groups: Sequence[tuple[tuple[str, ...], np.ndarray]], count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """The ranges of all chunks, and every value's share of the range of its chunk, [n, 3] a group."""
    starts = np.arange(0, count, CHUNK)
    names = [f"{end}_{name}" for axes, _ in groups for end in ("min", "max") for name in axes]
    chunk = np.zeros(len(starts), [(name, "<f4") for name in names])
    shares = []
    for axes, values in groups:
        if count:
            _set_ranges(chunk, axes, np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts))
        low, high = (np.stack([chunk[f"{end}_{axis}"] for axis in axes], axis=1) for end in ("min", "max"))
        span = np.repeat(np.maximum(high.astype(np.float64) - low, 1e-30), CHUNK, axis=0)[:count]
        shares.append((values - np.repeat(low, CHUNK, axis=0)[:count]) / span)
    return chunk, shares


def _set_ranges(chunk: np.ndarray, axes: tuple[str, ...], low: np.ndarray, high: np.ndarray) -> None:
    for column, axis in enumerate(axes):
        chunk[f"min_{axis}"], chunk[f"max_{axis}"] = low[:, column], high[:, column]


def _pack(share: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Shares 0..1 [n, k] as one uint32 [n], first column in the top bits."""
    packed = np.zeros(len(share), np.uint32)
    for column, width in zip(share.T, bits, strict=True):
        code = np.rint(np.clip(column, 0, 1) * (2**width - 1)).astype(np.uint32)
        packed = packed << np.uint32(width) | code
    return packed


def _pack_rotation(quaternions: np.ndarray) -> np.ndarray:
    """2 bits name the largest component of w x y z, 10 bits each hold the others in order."""
    largest, others = drop_largest(quaternions)
    packed: np.ndarray = largest.astype(np.uint32) << np.uint32(30) | _pack(others / math.sqrt(2) + 0.5, (10, 10, 10))
    return packed


def _pack_bands(sh: np.ndarray) -> np.ndarray:
    """SH bands above 0 [n, coefficients, 3] as an element of bytes, channel by channel."""
    codes = np.clip(np.floor((sh.astype(np.float64) / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    flat = codes.transpose(0, 2, 1).reshape(len(sh), 3 * sh.shape[1])
    table = np.empty(len(sh), [(f"f_rest_{k}", "u1") for k in range(flat.shape[1])])
    for k, name in enumerate(table.dtype.names or ()):
        table[name] = flat[:, k]
    return table


# Reading


def _three(packed: np.ndarray) -> np.ndarray:
    """11, 10 and 11 bits, from the top, as shares of their range, [n, 3]."""
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _in_chunk(path: Path, chunk: np.ndarray, share: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Shares [n, 3] of the ranges that each row's chunk states."""
    of_row = np.arange(len(share)) // CHUNK
    low = columns_of(path, chunk, [f"min_{name}" for name in names]).astype(np.float64)[of_row]
    high = columns_of(path, chunk, [f"max_{name}" for name in names]).astype(np.float64)[of_row]
    values: np.ndarray = low * (1 - share) + high * share
    return values


def _unpack_rotation(packed: np.ndarray) -> np.ndarray:
    """Quaternions float32 [n, 4], w x y z."""
    others = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    return restore_largest(packed >> 30, (others - 0.5) * math.sqrt(2))


def _bands(path: Path, table: np.ndarray | None, count: int) -> np.ndarray:
    """SH bands above 0, [n, coefficients, 3], of bytes that span -4..4."""
    if table is None:
        return np.empty((count, 0, 3))
    names = [f"f_rest_{k}" for k in range(len(table.dtype.names or ()))]
    if len(table) != count or len(names) not in (9, 24, 45):
        raise ValueError(f"{path}: element sh has {len(table)} rows of {len(names)} columns for {count} Gaussians")
    codes = columns_of(path, table, names)
    share = np.select([codes == 0, codes == 255], [0.0, 1.0], (codes + 0.5) / 256)
    values = (share - 0.5) * 8
    return values.reshape(count, 3, len(names) // 3).transpose(0, 2, 1)
