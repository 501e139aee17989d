"""Projection of Gaussians, the tiles that they reach, and the gradients of it: a thread for each Gaussian.

The arithmetic is the CPU's, in double precision: these kernels call the same functions.
"""

from __future__ import annotations

import math
from typing import Any

import numba.cuda
import numpy as np
from numba import float32

from packuv.raster import project as cpu
from packuv.raster.cuda.launch import shared
from packuv.raster.project import INVERSE_VARIANCE_Y, INVERSE_XX, REACH, SHEAR, X, Y
from packuv.raster.view import TILE

cuda: Any = numba.cuda
_f32 = np.float32
_HALF = np.float32(0.5)
_FAR = np.float32(1e6)
"""Beyond every picture"""
SUMS = 10
"""Gradients of a pair, see `blend.gradient_tile` of the CPU"""

_is_valid, _project_one, _colour = map(shared, (cpu.is_valid, cpu.project_one, cpu.colour))
_project_one_backward, _colour_gradient = map(shared, (cpu.project_one_backward, cpu.colour_gradient))
_clear, _is_finite = map(shared, (cpu.clear, cpu.is_finite))


@cuda.jit
def project(means, log_scales, quaternions, logits, sh, degree, view, active_sum, record, box, drawn, invalid):
    """Fill records [N, 16], boxes [N, 4] (tiles), and `drawn`, uint8 [N]; add to `invalid` [1] what is skipped."""
    i = cuda.grid(1)
    if i >= means.shape[0]:
        return
    values = cuda.local.array(16, float32)
    if not _is_valid(means, log_scales, quaternions, logits, i):
        cuda.atomic.add(invalid, 0, 1)
    elif _project_one(means, log_scales, quaternions, logits, view, active_sum, record, box, i):
        if _colour(view, means, sh, degree, values, record, i):
            drawn[i] = 1
        else:
            cuda.atomic.add(invalid, 0, 1)


# -- tiles ------------------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _interval(record, i, tile_y, height, row):
    """From where to where an outline reaches along x in one row of a row of tiles; empty: the first is greater."""
    middle = _f32(row) + _HALF
    dy = middle - (record[i, Y] - _f32(TILE * tile_y))
    room = record[i, REACH] - dy * dy * record[i, INVERSE_VARIANCE_Y]
    if not (room >= _f32(0) and middle <= _f32(height - TILE * tile_y)):
        return _FAR, -_FAR
    half = math.sqrt(max(room * record[i, INVERSE_XX], _f32(0)))
    centre = record[i, X] - record[i, SHEAR] * dy
    return _f32(centre - half), _f32(centre + half)


@cuda.jit(device=True)
def _intervals(record, i, tile_y, height, first, last):
    """The same for the four rows of blocks of a row of tiles, [4] each."""
    for block in range(4):
        first[block], last[block] = _FAR, -_FAR
        for row in range(4 * block, 4 * block + 4):
            low, high = _interval(record, i, tile_y, height, row)
            first[block], last[block] = min(first[block], low), max(last[block], high)


@cuda.jit(device=True)
def _blocks(first, last, tile_x):
    """Bit 4 j + i is the block in row j and column i of a tile, set where the outline reaches its pixels."""
    mask = 0
    for row in range(4):
        for column in range(4):
            left = _f32(TILE * tile_x + 4 * column) + _HALF
            if last[row] >= left and first[row] <= left + _f32(3):
                mask |= 1 << (4 * row + column)
    return mask


@cuda.jit
def count_tiles(record, box, drawn, active, height, hits):
    """The active tiles whose pixels each Gaussian reaches, int32 [N]."""
    i = cuda.grid(1)
    if i >= drawn.shape[0] or drawn[i] == 0:
        return
    first, last = cuda.local.array(4, float32), cuda.local.array(4, float32)
    count = 0
    for tile_y in range(box[i, 1], box[i, 3] + 1):
        _intervals(record, i, tile_y, height, first, last)
        for tile_x in range(box[i, 0], box[i, 2] + 1):
            if active[tile_y, tile_x] != 0 and _blocks(first, last, tile_x) != 0:
                count += 1
    hits[i] = count


@cuda.jit
def list_tiles(record, box, depth_bits, active, height, first_pair, keys, gaussians, masks):
    """Write each Gaussian's pairs to its slots: keys of tile and depth, int64, its number and its blocks, int32."""
    i = cuda.grid(1)
    if i >= depth_bits.shape[0] or first_pair[i] == first_pair[i + 1]:
        return
    first, last = cuda.local.array(4, float32), cuda.local.array(4, float32)
    slot = first_pair[i]
    for tile_y in range(box[i, 1], box[i, 3] + 1):
        _intervals(record, i, tile_y, height, first, last)
        for tile_x in range(box[i, 0], box[i, 2] + 1):
            mask = _blocks(first, last, tile_x)
            if active[tile_y, tile_x] != 0 and mask != 0:
                tile = np.int64(tile_y * active.shape[1] + tile_x)
                keys[slot] = (tile << np.int64(32)) | np.int64(depth_bits[i])
                gaussians[slot], masks[slot] = i, mask
                slot += 1


# -- sums over tiles, and gradients -----------------------------------------------------------------------------------


@cuda.jit
def sum_shares(shares, first_pair, out):
    """Blending weight per Gaussian, float32 [N], over its tiles in their order."""
    i = cuda.grid(1)
    if i < out.shape[0]:
        total = _f32(0)
        for slot in range(first_pair[i], first_pair[i + 1]):
            total += shares[slot]
        out[i] = total


@cuda.jit(device=True)
def _sum_pairs(partial, used, begin, end, out):
    """Sum the partial gradients of one Gaussian over its tiles, in their order; False if no tile drew it."""
    hit = False
    for k in range(SUMS):
        out[k] = _f32(0)
    for slot in range(begin, end):
        if used[slot] != 0:
            hit = True
            for k in range(SUMS):
                out[k] += partial[slot, k]
    return hit


@cuda.jit
def project_backward(means, log_scales, quaternions, logits, sh, degree, view, record, rows, first_pair, used, partial,
                     d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, overflown):  # fmt: skip
    """Reduce the partial gradients [pairs, 10] of every chosen Gaussian and carry them to its parameters.

    The others are left as they are. `overflown` [1] grows by the rows that are set to zero as they are not finite.
    """
    i = cuda.grid(1)
    if i >= means.shape[0] or rows[i] == 0:
        return
    values, d_values = cuda.local.array(16, float32), cuda.local.array(16, float32)
    g = cuda.local.array(16, float32)
    if not _sum_pairs(partial, used, first_pair[i], first_pair[i + 1], g):
        return
    x, y, z = _project_one_backward(
        means, log_scales, quaternions, logits, view, g, d_log_scales, d_quaternions, d_logits, d_screen, i
    )
    cx, cy, cz = _colour_gradient(view, means, sh, degree, record, g, values, d_values, d_sh, i)
    d_means[i, 0], d_means[i, 1], d_means[i, 2] = x + cx, y + cy, z + cz
    if not _is_finite(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i):
        _clear(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i)
        cuda.atomic.add(overflown, 0, 1)
