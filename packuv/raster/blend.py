"""Blending of Gaussians over pixels, tile by tile, front to back, and the gradients of it.

A tile of 16 x 16 pixels is cut into blocks of 4 x (lanes / 4), one vector each. The tile's state lies block by block in
scratch: planes of 256 float32. A Gaussian visits only the blocks in its mask that are still alive; whether a block is
alive (some pixel's transmittance above 1e-4) is looked at after every 32 Gaussians. The backward pass repeats the
forward pass's products bit for bit, so it needs no division to recover a transmittance.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

from packuv.raster.bins import GAUSSIAN, MASK, SLOT
from packuv.raster.project import (
    ALPHA_MIN,
    BLUE,
    DEPTH,
    GREEN,
    LOG_OPACITY,
    RECORD,
    RED,
    TILE,
    XX,
    XY,
    YY,
    X,
    Y,
)
from packuv.raster.simd import (
    above,
    at_least,
    at_most,
    bit_count,
    bits,
    exp2,
    fma,
    larger,
    load,
    load_block,
    lowest_bit,
    prefetch,
    select,
    smaller,
    splat,
    store,
    store_block,
    store_sums,
)

_f32 = np.float32
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}
_ALPHA_MAX = _f32(0.99)
_TRANSMITTANCE_MIN = _f32(1e-4)
_EXPONENT_MIN = _f32(math.log2(ALPHA_MIN))
_CHECK_EVERY = 32
_AHEAD = 8
"""List entries between asking for a record and using it."""

PIXELS = TILE * TILE
# Planes of the scratch state, in floats. The first is shared, then those of each direction, then pixel centres.
_T = 0
_RED, _GREEN, _BLUE, _DEPTH = (PIXELS * plane for plane in range(1, 5))
_REST, _D_RED, _D_GREEN, _D_BLUE, _D_DEPTH = (PIXELS * plane for plane in range(1, 6))
_PIXEL_X, _PIXEL_Y = PIXELS * 6, PIXELS * 7
SCRATCH = PIXELS * 8


@njit(**_OPTIONS)
def _scratch(lanes):
    """State of a tile, aligned to cache lines: a vector across two of them costs twice."""
    raw = np.empty(SCRATCH + 16, np.float32)
    skip = ((64 - (raw.ctypes.data & 63)) & 63) >> 2
    state = raw[skip : skip + SCRATCH]
    width = len(lanes)
    for i in range(PIXELS):
        block, lane = i // width, i % width
        state[_PIXEL_X + i] = 4 * (block & 3) + (lane & 3) + 0.5
        state[_PIXEL_Y + i] = (width // 4) * (block >> 2) + (lane >> 2) + 0.5
    return state


@njit(**_OPTIONS)
def _still_alive(lanes, state, alive):
    remaining = alive
    while remaining != 0:
        block = lowest_bit(remaining)
        remaining &= remaining - 1
        if bits(above(load(lanes, state, block * len(lanes)), splat(lanes, _TRANSMITTANCE_MIN))) == 0:
            alive &= ~(np.int64(1) << block)
    return alive


@njit(**_OPTIONS)
def _all_blocks(lanes):
    return (np.int64(1) << (PIXELS // len(lanes))) - 1


@njit(**_OPTIONS)
def _open_tile(lanes, state, columns, rows):
    """Black, transmittance 1 in the `columns` x `rows` pixels that lie in the picture and 0 outside."""
    for at in range(0, PIXELS, len(lanes)):
        store(state, at, splat(lanes, _f32(1)))
        for plane in (_RED, _GREEN, _BLUE, _DEPTH):
            store(state, plane + at, splat(lanes, _f32(0)))
    if columns < TILE or rows < TILE:
        for i in range(PIXELS):
            if state[_PIXEL_X + i] > columns or state[_PIXEL_Y + i] > rows:
                state[i] = _f32(0)


@njit(**_OPTIONS)
def _blend_tile(lanes, record, pairs, begin, end, tile_x, tile_y, state, weights):
    """Blend a list over an open tile; returns the end of the part that was used and the number of blocks visited."""
    zero = splat(lanes, _f32(0))
    exponent_min, alpha_max = splat(lanes, _EXPONENT_MIN), splat(lanes, _ALPHA_MAX)
    below = splat(lanes, _EXPONENT_MIN - _f32(1))
    origin_x, origin_y = _f32(TILE * tile_x), _f32(TILE * tile_y)
    alive, visited, i = _all_blocks(lanes), 0, begin
    while i < end and alive != 0:
        stop = min(i + _CHECK_EVERY, end)
        while i < stop:
            blocks = np.int64(pairs[i, MASK]) & alive
            slot = np.int64(pairs[i, SLOT])
            r = np.int64(pairs[i, GAUSSIAN]) * RECORD
            if i + _AHEAD < end:
                prefetch(record, np.int64(pairs[i + _AHEAD, GAUSSIAN]) * RECORD)
            i += 1
            visited += bit_count(blocks)
            px, py = splat(lanes, record[r + X] - origin_x), splat(lanes, record[r + Y] - origin_y)
            xx, xy, yy = splat(lanes, record[r + XX]), splat(lanes, record[r + XY]), splat(lanes, record[r + YY])
            opacity = splat(lanes, record[r + LOG_OPACITY])
            red, green = splat(lanes, record[r + RED]), splat(lanes, record[r + GREEN])
            blue, depth = splat(lanes, record[r + BLUE]), splat(lanes, record[r + DEPTH])
            total = zero
            while blocks != 0:
                at = lowest_bit(blocks) * len(lanes)
                blocks &= blocks - 1
                dx, dy = load(lanes, state, at + _PIXEL_X) - px, load(lanes, state, at + _PIXEL_Y) - py
                exponent = fma(dx, fma(xx, dx, xy * dy), fma(yy * dy, dy, opacity))
                raw = exp2(larger(smaller(exponent, opacity), below))
                alpha = select(at_least(exponent, exponent_min), smaller(raw, alpha_max), zero)
                transmittance = load(lanes, state, at)
                weight = transmittance * alpha
                store(state, at, transmittance - weight)
                store(state, at + _RED, fma(weight, red, load(lanes, state, at + _RED)))
                store(state, at + _GREEN, fma(weight, green, load(lanes, state, at + _GREEN)))
                store(state, at + _BLUE, fma(weight, blue, load(lanes, state, at + _BLUE)))
                store(state, at + _DEPTH, fma(weight, depth, load(lanes, state, at + _DEPTH)))
                total = total + weight
            if weights.size > 0:
                store_sums(weights, slot * RECORD, (total,))
        alive = _still_alive(lanes, state, alive)
    return i, visited


@njit(**_OPTIONS)
def _write_vector(lanes, state, at, pixel, stride, plane, background, colour, depth, alpha):
    transmittance = load(lanes, state, at)
    for channel in range(3):
        value = load(lanes, state, at + _RED + PIXELS * channel)
        value = fma(transmittance, splat(lanes, background[channel]), value)
        store_block(colour, pixel + plane * channel, stride, value)
    store_block(depth, pixel, stride, load(lanes, state, at + _DEPTH))
    store_block(alpha, pixel, stride, splat(lanes, _f32(1)) - transmittance)


@njit(**_OPTIONS)
def _write_pixel(state, at, pixel, plane, background, colour, depth, alpha):
    for channel in range(3):
        colour[pixel + plane * channel] = state[at + _RED + PIXELS * channel] + state[at] * background[channel]
    depth[pixel] = state[at + _DEPTH]
    alpha[pixel] = _f32(1) - state[at]


@njit(**_OPTIONS)
def _write_tile(lanes, state, tile_x, tile_y, width, height, background, colour, depth, alpha):
    """Copy a tile's state to the pictures; only pixels inside them."""
    x0, y0 = TILE * tile_x, TILE * tile_y
    inside = x0 + TILE <= width and y0 + TILE <= height
    for at in range(0, PIXELS, len(lanes)):
        x, y = x0 + int(state[_PIXEL_X + at]), y0 + int(state[_PIXEL_Y + at])
        if inside:
            _write_vector(lanes, state, at, y * width + x, width, width * height, background, colour, depth, alpha)
            continue
        for lane in range(len(lanes)):
            px, py = x + (lane & 3), y + (lane >> 2)
            if px < width and py < height:
                _write_pixel(state, at + lane, py * width + px, width * height, background, colour, depth, alpha)


@njit(**_OPTIONS)
def _fill_tile(tile_x, tile_y, width, height, background, colour, depth, alpha):
    """Nothing but background."""
    for y in range(TILE * tile_y, min(TILE * tile_y + TILE, height)):
        for pixel in range(y * width + TILE * tile_x, y * width + min(TILE * tile_x + TILE, width)):
            for channel in range(3):
                colour[pixel + width * height * channel] = background[channel]
            depth[pixel] = alpha[pixel] = _f32(0)


@njit(parallel=True, **_OPTIONS)
def blend(lanes, record, pairs, start, tiles_x, width, height, background, colour, depth, alpha, used_end, visited,
          weights, jobs):  # fmt: skip
    """Draw every tile whose list is not empty, background elsewhere.

    `record` and the pictures are flat; `used_end` [tiles] receives the end of the part of each list that was used,
    `visited` [tiles] the number of blocks; `weights` is flat [pairs * 16], or empty when not wanted.
    """
    count = start.shape[0] - 1
    for job in prange(jobs):
        state = _scratch(lanes)
        for tile in range(job, count, jobs):
            x, y = tile % tiles_x, tile // tiles_x
            if start[tile] == start[tile + 1]:
                used_end[tile], visited[tile] = start[tile], 0
                _fill_tile(x, y, width, height, background, colour, depth, alpha)
                continue
            _open_tile(lanes, state, width - TILE * x, height - TILE * y)
            used_end[tile], visited[tile] = _blend_tile(
                lanes, record, pairs, start[tile], start[tile + 1], x, y, state, weights
            )
            _write_tile(lanes, state, x, y, width, height, background, colour, depth, alpha)


# -- gradients ------------------------------------------------------------------------------------------------------


@njit(**_OPTIONS)
def _gradient_tile(lanes, record, pairs, begin, end, tile_x, tile_y, rows, state, partial):
    """Walk a tile's list again; write, per pair whose row is chosen, ten sums over its pixels to its slot.

    The sums are of v, v dx, v dy, v dx^2, v dx dy, v dy^2 with v the gradient of the exponent (natural log), then of
    the gradients of red, green, blue and depth. Returns the end of the part of the list that was used.
    """
    one, zero = splat(lanes, _f32(1)), splat(lanes, _f32(0))
    exponent_min, alpha_max = splat(lanes, _EXPONENT_MIN), splat(lanes, _ALPHA_MAX)
    below = splat(lanes, _EXPONENT_MIN - _f32(1))
    origin_x, origin_y = _f32(TILE * tile_x), _f32(TILE * tile_y)
    alive, i = _all_blocks(lanes), begin
    while i < end and alive != 0:
        stop = min(i + _CHECK_EVERY, end)
        while i < stop:
            blocks = np.int64(pairs[i, MASK]) & alive
            slot, g = np.int64(pairs[i, SLOT]), np.int64(pairs[i, GAUSSIAN])
            r = g * RECORD
            if i + _AHEAD < end:
                prefetch(record, np.int64(pairs[i + _AHEAD, GAUSSIAN]) * RECORD)
            i += 1
            px, py = splat(lanes, record[r + X] - origin_x), splat(lanes, record[r + Y] - origin_y)
            xx, xy, yy = splat(lanes, record[r + XX]), splat(lanes, record[r + XY]), splat(lanes, record[r + YY])
            opacity = splat(lanes, record[r + LOG_OPACITY])
            red, green = splat(lanes, record[r + RED]), splat(lanes, record[r + GREEN])
            blue, depth = splat(lanes, record[r + BLUE]), splat(lanes, record[r + DEPTH])
            s, sx, sy, sxx, sxy, syy = zero, zero, zero, zero, zero, zero
            s_red, s_green, s_blue, s_depth = zero, zero, zero, zero
            chosen = rows[g] != 0
            while blocks != 0:
                at = lowest_bit(blocks) * len(lanes)
                blocks &= blocks - 1
                dx, dy = load(lanes, state, at + _PIXEL_X) - px, load(lanes, state, at + _PIXEL_Y) - py
                exponent = fma(dx, fma(xx, dx, xy * dy), fma(yy * dy, dy, opacity))
                raw = exp2(larger(smaller(exponent, opacity), below))
                alpha = select(at_least(exponent, exponent_min), smaller(raw, alpha_max), zero)
                transmittance = load(lanes, state, at)
                d_red, d_green = load(lanes, state, at + _D_RED), load(lanes, state, at + _D_GREEN)
                d_blue, d_depth = load(lanes, state, at + _D_BLUE), load(lanes, state, at + _D_DEPTH)
                weight = transmittance * alpha
                gain = fma(red, d_red, fma(green, d_green, fma(blue, d_blue, depth * d_depth)))
                rest = load(lanes, state, at + _REST) - weight * gain
                store(state, at + _REST, rest)
                store(state, at, transmittance - weight)
                if chosen:
                    d_alpha = transmittance * gain - rest / (one - alpha)
                    v = select(at_most(raw, alpha_max), alpha * d_alpha, zero)
                    vx, vy = v * dx, v * dy
                    s, sx, sy = s + v, sx + vx, sy + vy
                    sxx, sxy, syy = fma(vx, dx, sxx), fma(vx, dy, sxy), fma(vy, dy, syy)
                    s_red, s_green = fma(weight, d_red, s_red), fma(weight, d_green, s_green)
                    s_blue, s_depth = fma(weight, d_blue, s_blue), fma(weight, d_depth, s_depth)
            if chosen:
                store_sums(partial, slot * RECORD, (s, sx, sy, sxx, sxy, syy, s_red, s_green, s_blue, s_depth))
        alive = _still_alive(lanes, state, alive)
    return i


@njit(**_OPTIONS)
def _start_vector(lanes, state, at, pixel, stride, plane, colour, depth, alpha, d_colour, d_depth, d_alpha):
    one = splat(lanes, _f32(1))
    g_depth = load_block(lanes, d_depth, pixel, stride)
    rest = load_block(lanes, depth, pixel, stride) * g_depth
    transmittance = one - load_block(lanes, alpha, pixel, stride)
    rest = rest - transmittance * load_block(lanes, d_alpha, pixel, stride)
    for channel in range(3):
        gradient = load_block(lanes, d_colour, pixel + plane * channel, stride)
        rest = fma(load_block(lanes, colour, pixel + plane * channel, stride), gradient, rest)
        store(state, at + _D_RED + PIXELS * channel, gradient)
    store(state, at + _D_DEPTH, g_depth)
    store(state, at + _REST, rest)
    store(state, at, one)


@njit(**_OPTIONS)
def _start_pixel(state, at, pixel, plane, colour, depth, alpha, d_colour, d_depth, d_alpha):
    rest = depth[pixel] * d_depth[pixel] - (_f32(1) - alpha[pixel]) * d_alpha[pixel]
    for channel in range(3):
        rest += colour[pixel + plane * channel] * d_colour[pixel + plane * channel]
        state[at + _D_RED + PIXELS * channel] = d_colour[pixel + plane * channel]
    state[at + _D_DEPTH], state[at + _REST], state[at] = d_depth[pixel], rest, _f32(1)


@njit(**_OPTIONS)
def _start_tile(lanes, state, tile_x, tile_y, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha):
    """Set transmittance 1, the gradients of the pixels, and what all Gaussians together add to the loss's differential.

    Pixels outside the picture have gradient and transmittance zero.
    """
    x0, y0 = TILE * tile_x, TILE * tile_y
    inside = x0 + TILE <= width and y0 + TILE <= height
    for at in range(0, PIXELS, len(lanes)):
        x, y = x0 + int(state[_PIXEL_X + at]), y0 + int(state[_PIXEL_Y + at])
        if inside:
            _start_vector(lanes, state, at, y * width + x, width, width * height, colour, depth, alpha,
                          d_colour, d_depth, d_alpha)  # fmt: skip
            continue
        for lane in range(len(lanes)):
            px, py, to = x + (lane & 3), y + (lane >> 2), at + lane
            if px < width and py < height:
                _start_pixel(state, to, py * width + px, width * height, colour, depth, alpha,
                             d_colour, d_depth, d_alpha)  # fmt: skip
            else:
                for plane in range(0, _D_DEPTH + 1, PIXELS):
                    state[plane + to] = _f32(0)


@njit(**_OPTIONS)
def _last_chosen(pairs, rows, begin, end):
    """End of the list after its last pair whose row is chosen: nothing behind it matters."""
    while end > begin and rows[pairs[end - 1, GAUSSIAN]] == 0:
        end -= 1
    return end


@njit(parallel=True, **_OPTIONS)
def blend_backward(lanes, record, pairs, start, used_end, tiles_x, width, height, colour, depth, alpha,
                   d_colour, d_depth, d_alpha, rows, partial, used, jobs):  # fmt: skip
    """Partial gradients of pairs whose row is chosen, flat [pairs * 16]; `used` [pairs] says which slots hold one."""
    count = start.shape[0] - 1
    for job in prange(jobs):
        state = _scratch(lanes)
        for tile in range(job, count, jobs):
            begin, x, y = start[tile], tile % tiles_x, tile // tiles_x
            end = _last_chosen(pairs, rows, begin, used_end[tile])
            if end > begin:
                _start_tile(lanes, state, x, y, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha)
                end = _gradient_tile(lanes, record, pairs, begin, end, x, y, rows, state, partial)
            for i in range(begin, start[tile + 1]):
                used[pairs[i, SLOT]] = i < end and rows[pairs[i, GAUSSIAN]] != 0


@njit(parallel=True, **_OPTIONS)
def gather_weights(weights, first_pair, start, used_end, pairs, used, out):
    """Sum of transmittance * alpha per Gaussian, float32 [N], over its tiles in their order."""
    for tile in prange(start.shape[0] - 1):
        for i in range(start[tile], start[tile + 1]):
            used[pairs[i, SLOT]] = i < used_end[tile]
    for g in prange(out.shape[0]):
        total = _f32(0)
        for slot in range(first_pair[g], first_pair[g + 1]):
            if used[slot] != 0:
                total += weights[slot * RECORD]
        out[g] = total
