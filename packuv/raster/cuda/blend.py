"""Blending of Gaussians over pixels and its gradients: a block of threads for each tile, a thread for each pixel.

Order, limits and ends are those of the CPU's `blend`: within a pixel front to back, and after every 32 Gaussians each
block of 4 x 4 pixels looks whether it goes on. A warp holds two such blocks side by side. What a pair adds up over
pixels goes from a warp to its place in shared memory, from there to the pair's slot, always in the same order.
"""

from __future__ import annotations

import math
from typing import Any

import numba.cuda
import numpy as np
from numba import float32, int32

from packuv.raster.blend import CHECK_EVERY, EXPONENT_MAX, EXPONENT_MIN, TRANSMITTANCE_MIN
from packuv.raster.cuda.launch import SIMULATED, THREADS
from packuv.raster.cuda.project import SUMS
from packuv.raster.project import (
    BLUE,
    DEPTH,
    EXPONENT_UNIT,
    GREEN,
    LOG_OPACITY,
    RED,
    XX,
    XY,
    YY,
    X,
    Y,
)
from packuv.raster.view import TILE

cuda: Any = numba.cuda
_f32 = np.float32
_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_UNIT = np.float32(EXPONENT_UNIT * math.log(2))
_BATCH = CHECK_EVERY
_COLUMNS = DEPTH + 1
"""Of a record that blending needs"""
_BLOCKS = 16
_WARPS = THREADS // 32
_EVERYONE = 0xFFFFFFFF


# -- over a warp ------------------------------------------------------------------------------------------------------

if SIMULATED:  # which has no warps

    @cuda.jit(device=True)
    def _any_in_warp(here):
        return here

    @cuda.jit(device=True)
    def _add_over_warp(sums, entry, warp, lane, k, value):
        cuda.atomic.add(sums, (entry, warp, k), value)

    @cuda.jit(device=True)
    def _add_ten_over_warp(sums, entry, warp, lane, v0, v1, v2, v3, v4, v5, v6, v7, v8, v9):
        for k, value in enumerate((v0, v1, v2, v3, v4, v5, v6, v7, v8, v9)):
            cuda.atomic.add(sums, (entry, warp, k), value)

else:

    @cuda.jit(device=True)
    def _any_in_warp(here):
        return cuda.any_sync(_EVERYONE, here)

    @cuda.jit(device=True)
    def _add_over_warp(sums, entry, warp, lane, k, value):
        """Add a value of each lane, in shared memory, float32 [batch, warps, sums], which no other warp touches."""
        step = 16
        while step > 0:
            value += cuda.shfl_down_sync(_EVERYONE, value, step)
            step >>= 1
        if lane == 0:
            sums[entry, warp, k] += value

    @cuda.jit(device=True)
    def _halved(low, high, lane, step):
        """Of a pair of lanes `step` apart the upper one goes on with `high`, the lower one with `low`, each with what
        both have of it."""
        upper = lane & step != 0
        kept, given = (high, low) if upper else (low, high)
        return kept + cuda.shfl_xor_sync(_EVERYONE, given, step)

    @cuda.jit(device=True)
    def _add_ten_over_warp(sums, entry, warp, lane, v0, v1, v2, v3, v4, v5, v6, v7, v8, v9):
        """As `_add_over_warp` of ten values, the sums of which are found in 16 exchanges instead of 50.

        In each step a lane halves the number of sums that it works at, until it has one with the lane beside it.
        """
        a0, a1, a2 = _halved(v0, v8, lane, 16), _halved(v1, v9, lane, 16), _halved(v2, _ZERO, lane, 16)
        a3, a4, a5 = _halved(v3, _ZERO, lane, 16), _halved(v4, _ZERO, lane, 16), _halved(v5, _ZERO, lane, 16)
        a6, a7 = _halved(v6, _ZERO, lane, 16), _halved(v7, _ZERO, lane, 16)
        b0, b1 = _halved(a0, a4, lane, 8), _halved(a1, a5, lane, 8)
        b2, b3 = _halved(a2, a6, lane, 8), _halved(a3, a7, lane, 8)
        total = _halved(_halved(b0, b2, lane, 4), _halved(b1, b3, lane, 4), lane, 2)
        total += cuda.shfl_xor_sync(_EVERYONE, total, 1)
        k = lane >> 1
        if lane & 1 == 0 and k < SUMS:
            sums[entry, warp, k] += total


@cuda.jit(device=True)
def _over_warps(sums, entry, k):
    total = _ZERO
    for warp in range(_WARPS):
        total += sums[entry, warp, k]
    return total


# -- a tile -----------------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _place(t):
    """Column and row of a thread's pixel in its tile, and the number of its block."""
    warp, lane = t // 32, t % 32
    column, row = 8 * (warp % 2) + lane % 8, 4 * (warp // 2) + lane // 8
    return column, row, 4 * (row // 4) + column // 4


@cuda.jit(device=True)
def _load(t, begin, count, x0, y0, record, gaussians, masks, slots, seen, seen_masks):
    """Copy a batch of the list to shared memory, centres from the tile's corner on."""
    for j in range(t, count * _COLUMNS, THREADS):
        entry, column = j // _COLUMNS, j % _COLUMNS
        seen[entry, column] = record[gaussians[slots[begin + entry]], column]
        if column == X:
            seen[entry, X] -= _f32(x0)
        elif column == Y:
            seen[entry, Y] -= _f32(y0)
    if t < count:
        seen_masks[t] = masks[slots[begin + t]]


@cuda.jit(device=True)
def _exponent(seen, k, dx, dy):
    linear = seen[k, XX] * dx + seen[k, XY] * dy
    return dx * linear + (seen[k, YY] * dy * dy + seen[k, LOG_OPACITY])


@cuda.jit(device=True)
def _alpha(exponent):
    if exponent < EXPONENT_MIN:
        return _ZERO
    return _f32(math.exp(min(exponent, EXPONENT_MAX) * _UNIT))


@cuda.jit
def blend(record, gaussians, masks, slots, start, tiles, tiles_x, background, colour, depth, alpha, used_end,
          weighed, shares):  # fmt: skip
    """Draw the tiles whose numbers are `tiles`, a block each; the others are left as they are.

    Pairs by slot: `gaussians` and `masks`; a tile's list is `slots` from its `start` to the next. `used_end` [tiles]
    receives the end of what was walked. Where `weighed` is not 0, `shares` [pairs] receives per slot the sum of
    transmittance * alpha. Colour [3, H, W], depth and alpha [H, W].
    """
    seen = cuda.shared.array((_BATCH, _COLUMNS), float32)
    seen_masks = cuda.shared.array(_BATCH, int32)
    living = cuda.shared.array(_BLOCKS, int32)
    sums = cuda.shared.array((_BATCH, _WARPS, 1), float32)
    t, tile = cuda.threadIdx.x, tiles[cuda.blockIdx.x]
    warp, lane = t // 32, t % 32
    x0, y0 = TILE * (tile % tiles_x), TILE * (tile // tiles_x)
    column, row, block = _place(t)
    inside = x0 + column < depth.shape[1] and y0 + row < depth.shape[0]
    transmittance = _ONE if inside else _ZERO
    red, green, blue, far = _ZERO, _ZERO, _ZERO, _ZERO
    i, end, alive, going = start[tile], start[tile + 1], 1, 1
    while i < end and going != 0:
        count = min(_BATCH, end - i)
        _load(t, i, count, x0, y0, record, gaussians, masks, slots, seen, seen_masks)
        if t < _BLOCKS:
            living[t] = 0
        for j in range(t, _BATCH * _WARPS, THREADS):
            sums[j // _WARPS, j % _WARPS, 0] = _ZERO
        cuda.syncthreads()
        for k in range(count):
            weight = _ZERO
            if alive != 0 and (seen_masks[k] >> block) & 1:
                dx, dy = _f32(column) + _HALF - seen[k, X], _f32(row) + _HALF - seen[k, Y]
                weight = transmittance * _alpha(_exponent(seen, k, dx, dy))
                transmittance -= weight
                red += weight * seen[k, RED]
                green += weight * seen[k, GREEN]
                blue += weight * seen[k, BLUE]
                far += weight * seen[k, DEPTH]
            if weighed != 0 and _any_in_warp(weight != _ZERO):
                _add_over_warp(sums, k, warp, lane, 0, weight)
        if transmittance > TRANSMITTANCE_MIN:
            living[block] = 1
        cuda.syncthreads()
        alive = living[block]
        if weighed != 0 and t < count:
            shares[slots[i + t]] = _over_warps(sums, t, 0)
        i += count
        going = cuda.syncthreads_or(alive)
    if t == 0:
        used_end[tile] = i
    if inside:
        x, y = x0 + column, y0 + row
        colour[0, y, x] = red + transmittance * background[0]
        colour[1, y, x] = green + transmittance * background[1]
        colour[2, y, x] = blue + transmittance * background[2]
        depth[y, x] = far
        alpha[y, x] = _ONE - transmittance


# -- gradients --------------------------------------------------------------------------------------------------------


@cuda.jit(device=True)
def _last_chosen(t, begin, end, gaussians, slots, rows, last):
    """End of a list after its last pair whose row is chosen, by way of `last` in shared memory [1]."""
    if t == 0:
        last[0] = begin
    cuda.syncthreads()
    mine = begin
    for j in range(begin + t, end, THREADS):
        if rows[gaussians[slots[j]]] != 0:
            mine = j + 1
    cuda.atomic.max(last, 0, int32(mine))
    cuda.syncthreads()
    return last[0]


@cuda.jit
def blend_backward(record, gaussians, masks, slots, start, tiles, used_end, tiles_x, colour, depth, alpha,
                   d_colour, d_depth, d_alpha, rows, first_slot, partial, used):  # fmt: skip
    """Partial gradients [pairs, 10] of pairs whose row is chosen, as the CPU's; `used` [pairs] says which there are.

    Both begin at `first_slot`, before which no row is chosen.
    """
    seen = cuda.shared.array((_BATCH, _COLUMNS), float32)
    seen_masks = cuda.shared.array(_BATCH, int32)
    chosen = cuda.shared.array(_BATCH, int32)
    living = cuda.shared.array(_BLOCKS, int32)
    sums = cuda.shared.array((_BATCH, _WARPS, SUMS), float32)
    last = cuda.shared.array(1, int32)
    t, tile = cuda.threadIdx.x, tiles[cuda.blockIdx.x]
    warp, lane = t // 32, t % 32
    x0, y0 = TILE * (tile % tiles_x), TILE * (tile // tiles_x)
    column, row, block = _place(t)
    transmittance, rest = _ZERO, _ZERO
    d_red, d_green, d_blue, d_far = _ZERO, _ZERO, _ZERO, _ZERO
    if x0 + column < depth.shape[1] and y0 + row < depth.shape[0]:
        x, y = x0 + column, y0 + row
        d_red, d_green, d_blue, d_far = d_colour[0, y, x], d_colour[1, y, x], d_colour[2, y, x], d_depth[y, x]
        transmittance = _ONE
        rest = depth[y, x] * d_far - (_ONE - alpha[y, x]) * d_alpha[y, x]
        rest += colour[0, y, x] * d_red + colour[1, y, x] * d_green + colour[2, y, x] * d_blue
    i, alive, going = start[tile], 1, 1
    end = _last_chosen(t, i, used_end[tile], gaussians, slots, rows, last)
    while i < end and going != 0:
        count = min(_BATCH, end - i)
        _load(t, i, count, x0, y0, record, gaussians, masks, slots, seen, seen_masks)
        if t < count:
            chosen[t] = rows[gaussians[slots[i + t]]]
        if t < _BLOCKS:
            living[t] = 0
        for j in range(t, _BATCH * _WARPS * SUMS, THREADS):
            sums[j // (_WARPS * SUMS), j // SUMS % _WARPS, j % SUMS] = _ZERO
        cuda.syncthreads()
        for k in range(count):
            weight, v, dx, dy = _ZERO, _ZERO, _ZERO, _ZERO
            if alive != 0 and (seen_masks[k] >> block) & 1:
                dx, dy = _f32(column) + _HALF - seen[k, X], _f32(row) + _HALF - seen[k, Y]
                exponent = _exponent(seen, k, dx, dy)
                own = _alpha(exponent)
                weight = transmittance * own
                gain = seen[k, RED] * d_red + seen[k, GREEN] * d_green
                gain += seen[k, BLUE] * d_blue + seen[k, DEPTH] * d_far
                rest -= weight * gain
                if exponent <= EXPONENT_MAX:
                    v = own * (transmittance * gain - rest / (_ONE - own))
                transmittance -= weight
            if chosen[k] != 0 and _any_in_warp(weight != _ZERO):
                vx, vy = v * dx, v * dy
                _add_ten_over_warp(sums, k, warp, lane, v, vx, vy, vx * dx, vx * dy, vy * dy,
                                   weight * d_red, weight * d_green, weight * d_blue, weight * d_far)  # fmt: skip
        if transmittance > TRANSMITTANCE_MIN:
            living[block] = 1
        cuda.syncthreads()
        alive = living[block]
        for j in range(t, count * SUMS, THREADS):
            if chosen[j // SUMS] != 0:
                slot = slots[i + j // SUMS] - first_slot
                partial[slot, j % SUMS] = _over_warps(sums, j // SUMS, j % SUMS)
                used[slot] = 1
        i += count
        going = cuda.syncthreads_or(alive)
