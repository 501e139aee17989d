"""Blending of Gaussians over pixels, tile by tile, front to back, and the gradients of it.

A tile of 16 x 16 pixels is cut into sixteen blocks of 4 x 4, one vector each. The tile's state lies in scratch, plane
by plane and in each plane block by block. A Gaussian visits only the blocks in its mask that are still alive; whether
a block is alive (some pixel's transmittance above 1e-4) is looked at after every 32 Gaussians. The backward pass
repeats the forward pass's products bit for bit, so it needs no division to recover a transmittance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from packuv.gaussians.floats import ALPHA_MIN
from packuv.kernels.compile import kernel
from packuv.kernels.simd import (
    ALL,
    WIDTH,
    above,
    align_stack,
    at_least,
    at_most,
    bit_count,
    bits,
    exp2_8,
    fma,
    fold,
    fold_product,
    load,
    load_block,
    lowest_bit,
    prefetch,
    prefetch_to_write,
    select,
    smaller,
    splat,
    store,
    store_block,
    store_sums,
    sum_lanes,
    zeros,
)
from packuv.raster.bins import GAUSSIAN, MASK, SLOT
from packuv.raster.project import BLUE, DEPTH, EXPONENT_UNIT, GREEN, LOG_OPACITY, RECORD, RED, XX, XY, YY, X, Y
from packuv.raster.view import TILE

_f32 = np.float32
TRANSMITTANCE_MIN = _f32(1e-4)
EXPONENT_MIN = _f32(math.log2(ALPHA_MIN) / EXPONENT_UNIT)
EXPONENT_MAX = _f32((math.log2(0.99) + 1.2e-6) / EXPONENT_UNIT)
"""Of alpha 0.99, or by rounding a few millionths more: two such layers must take the transmittance below 1e-4."""
CHECK_EVERY = 32
_AHEAD = 8
"""List entries between asking for a cache line and using it."""

BLOCKS = TILE * TILE // WIDTH
EVERY_BLOCK = np.int64((1 << BLOCKS) - 1)
PLANE = TILE * TILE + WIDTH
"""Floats from plane to plane: a multiple of 4096 bytes between two of them would look like a conflict to the CPU."""
# Planes of the state: transmittance, those of each direction, pixel centres.
_T = 0
RED_SUM, GREEN_SUM, BLUE_SUM, DEPTH_SUM = (PLANE * plane for plane in range(1, 5))
REST, D_RED, D_GREEN, D_BLUE, D_DEPTH = (PLANE * plane for plane in range(1, 6))
_PIXEL_X, _PIXEL_Y = PLANE * 6, PLANE * 7
_SCRATCH = PLANE * 8


@kernel(inner=True)
def scratch():
    """State of a tile, aligned to cache lines: a vector across two of them costs twice."""
    raw = np.empty(_SCRATCH + 16, np.float32)
    skip = ((64 - (raw.ctypes.data & 63)) & 63) >> 2
    state = raw[skip : skip + _SCRATCH]
    for i in range(BLOCKS * WIDTH):
        block, lane = i // WIDTH, i % WIDTH
        state[_PIXEL_X + i] = 4 * (block & 3) + (lane & 3) + 0.5
        state[_PIXEL_Y + i] = 4 * (block >> 2) + (lane >> 2) + 0.5
    return state


@kernel(inner=True)
def still_alive(state, alive):
    """Keep the bits of blocks with a pixel whose transmittance is above the limit."""
    remaining = alive
    while remaining != 0:
        block = lowest_bit(remaining)
        remaining &= remaining - 1
        if bits(above(load(state, block * WIDTH), splat(TRANSMITTANCE_MIN))) == 0:
            alive &= ~(np.int64(1) << block)
    return alive


@kernel(inner=True)
def open_tile(state, columns, rows):
    """Black, transmittance 1 in the `columns` x `rows` pixels that lie in the picture and 0 outside."""
    for at in range(0, BLOCKS * WIDTH, WIDTH):
        store(state, at, splat(_f32(1)))
        for plane in (RED_SUM, GREEN_SUM, BLUE_SUM, DEPTH_SUM):
            store(state, plane + at, zeros(ALL))
    if columns < TILE or rows < TILE:
        for i in range(BLOCKS * WIDTH):
            if state[_PIXEL_X + i] > columns or state[_PIXEL_Y + i] > rows:
                state[i] = _f32(0)


@kernel(inline=True)
def _add(state, at, weight, value):
    store(state, at, fma(weight, value, load(state, at)))


@kernel(inner=True)
def blend_tile(sums, record, pairs, begin, end, tile_x, tile_y, state, weights, alive):
    """Blend a list over the blocks of an open tile that are alive.

    Returns the end of the part that was used, the number of blocks visited, and the blocks that are still alive.
    Long because LLVM must see the loop over blocks with everything that stays fixed in it.
    """
    align_stack()
    zero, exponent_min, exponent_max = zeros(ALL), splat(EXPONENT_MIN), splat(EXPONENT_MAX)
    origin_x, origin_y = _f32(TILE * tile_x), _f32(TILE * tile_y)
    visited, i = 0, begin
    while i < end and alive != 0:
        stop = min(i + CHECK_EVERY, end)
        while i < stop:
            blocks, slot = np.int64(pairs[i, MASK]) & alive, np.int64(pairs[i, SLOT])
            r = np.int64(pairs[i, GAUSSIAN]) * RECORD
            if i + _AHEAD < end:
                prefetch(record, np.int64(pairs[i + _AHEAD, GAUSSIAN]) * RECORD)
            i += 1
            visited += bit_count(blocks)
            px, py = splat(record[r + X] - origin_x), splat(record[r + Y] - origin_y)
            xx, xy, yy = splat(record[r + XX]), splat(record[r + XY]), splat(record[r + YY])
            opacity = splat(record[r + LOG_OPACITY])
            red, green, blue = splat(record[r + RED]), splat(record[r + GREEN]), splat(record[r + BLUE])
            depth, total = splat(record[r + DEPTH]), zeros(sums)
            while blocks != 0:
                at = lowest_bit(blocks) * WIDTH
                blocks &= blocks - 1
                dx, dy = load(state, at + _PIXEL_X) - px, load(state, at + _PIXEL_Y) - py
                exponent = fma(dx, fma(xx, dx, xy * dy), fma(yy * dy, dy, opacity))
                alpha = select(at_least(exponent, exponent_min), exp2_8(smaller(exponent, exponent_max)), zero)
                transmittance = load(state, at)
                weight = transmittance * alpha
                store(state, at, transmittance - weight)
                _add(state, at + RED_SUM, weight, red)
                _add(state, at + GREEN_SUM, weight, green)
                _add(state, at + BLUE_SUM, weight, blue)
                _add(state, at + DEPTH_SUM, weight, depth)
                total = fold(weight, total)
            if weights.size > 0:
                weights[slot] = sum_lanes(total)
        alive = still_alive(state, alive)
    return i, visited, alive


@kernel(inline=True)
def _write_vector(state, at, pixel, stride, plane, background, colour, depth, alpha):
    transmittance = load(state, at)
    for channel in range(3):
        value = load(state, at + RED_SUM + PLANE * channel)
        value = fma(transmittance, splat(background[channel]), value)
        store_block(colour, pixel + plane * channel, stride, value)
    store_block(depth, pixel, stride, load(state, at + DEPTH_SUM))
    store_block(alpha, pixel, stride, splat(_f32(1)) - transmittance)


@kernel(inline=True)
def _write_pixel(state, at, pixel, plane, background, colour, depth, alpha):
    for channel in range(3):
        colour[pixel + plane * channel] = state[at + RED_SUM + PLANE * channel] + state[at] * background[channel]
    depth[pixel] = state[at + DEPTH_SUM]
    alpha[pixel] = _f32(1) - state[at]


@kernel(inner=True)
def write_tile(state, tile_x, tile_y, width, height, background, colour, depth, alpha):
    """Copy a tile's state to the pictures; only pixels inside them."""
    x0, y0 = TILE * tile_x, TILE * tile_y
    inside = x0 + TILE <= width and y0 + TILE <= height
    for at in range(0, BLOCKS * WIDTH, WIDTH):
        x, y = x0 + int(state[_PIXEL_X + at]), y0 + int(state[_PIXEL_Y + at])
        if inside:
            _write_vector(state, at, y * width + x, width, width * height, background, colour, depth, alpha)
            continue
        for lane in range(WIDTH):
            px, py = x + (lane & 3), y + (lane >> 2)
            if px < width and py < height:
                _write_pixel(state, at + lane, py * width + px, width * height, background, colour, depth, alpha)


@kernel(inner=True)
def _fill_row(tile_x, tile_end, tile_y, width, height, background, colour, depth, alpha):
    """Nothing but background from one tile to another of a row of tiles, line by line as memory likes it."""
    plane = width * height
    for y in range(TILE * tile_y, min(TILE * tile_y + TILE, height)):
        begin, end = y * width + TILE * tile_x, y * width + min(TILE * tile_end, width)
        for channel in range(3):
            colour[begin + plane * channel : end + plane * channel] = background[channel]
        depth[begin:end] = _f32(0)
        alpha[begin:end] = _f32(0)


@kernel(parallel=True)
def fill(shown, width, height, background, colour, depth, alpha):
    """Background in all tiles but those `shown`, bool [tiles_y, tiles_x]; the pictures are flat."""
    for y in prange(shown.shape[0]):
        x = 0
        while x < shown.shape[1]:
            end = x
            while end < shown.shape[1] and not shown[y, end]:
                end += 1
            if end > x:
                _fill_row(x, end, y, width, height, background, colour, depth, alpha)
            x = end + 1


@kernel(parallel=True)
def blend(sums, record, pairs, start, tiles_x, width, height, background, colour, depth, alpha, used_end, visited,
          weights, jobs):  # fmt: skip
    """Draw every tile whose list is not empty; the others are left to `fill`.

    `record` and the pictures are flat; `used_end` [tiles] receives the end of the part of each list that was used,
    `visited` [tiles] the number of blocks; `weights` [pairs] receives the sum of transmittance * alpha
    per slot; empty when not wanted.
    """
    count = start.shape[0] - 1
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, count, jobs):
            x, y = tile % tiles_x, tile // tiles_x
            if start[tile] == start[tile + 1]:
                used_end[tile], visited[tile] = start[tile], 0
                continue
            open_tile(state, width - TILE * x, height - TILE * y)
            used_end[tile], visited[tile], _ = blend_tile(
                sums, record, pairs, start[tile], start[tile + 1], x, y, state, weights, EVERY_BLOCK
            )
            write_tile(state, x, y, width, height, background, colour, depth, alpha)
            for i in range(used_end[tile], start[tile + 1] if weights.size > 0 else 0):
                weights[pairs[i, SLOT]] = _f32(0)


@kernel()
def sum_weights(weights, first_pair, out):
    """Blending weight per Gaussian, float32 [N], over its tiles in their order."""
    for g in range(out.shape[0]):
        total = _f32(0)
        for slot in range(first_pair[g], first_pair[g + 1]):
            total += weights[slot]
        out[g] = total


# -- gradients ------------------------------------------------------------------------------------------------------


@kernel(inner=True)
def gradient_tile(sums, record, pairs, begin, end, tile_x, tile_y, rows, state, partial, alive):
    """Walk a tile's list again; write, per pair whose row is chosen, ten sums over its pixels to its slot.

    The sums are of v, v dx, v dy, v dx^2, v dx dy, v dy^2 with v the gradient of the exponent (natural log), then of
    the gradients of red, green, blue and depth. Returns the end of the part of the list that was used. Long for the
    reason that `blend_tile` is.
    """
    align_stack()
    one, zero, exponent_min, exponent_max = splat(_f32(1)), zeros(ALL), splat(EXPONENT_MIN), splat(EXPONENT_MAX)
    origin_x, origin_y = _f32(TILE * tile_x), _f32(TILE * tile_y)
    i = begin
    while i < end and alive != 0:
        stop = min(i + CHECK_EVERY, end)
        while i < stop:
            blocks, slot = np.int64(pairs[i, MASK]) & alive, np.int64(pairs[i, SLOT])
            r, chosen = np.int64(pairs[i, GAUSSIAN]) * RECORD, rows[pairs[i, GAUSSIAN]] != 0
            if i + _AHEAD < end:
                prefetch(record, np.int64(pairs[i + _AHEAD, GAUSSIAN]) * RECORD)
                prefetch_to_write(partial, np.int64(pairs[i + _AHEAD, SLOT]) * RECORD)
            i += 1
            px, py = splat(record[r + X] - origin_x), splat(record[r + Y] - origin_y)
            xx, xy, yy = splat(record[r + XX]), splat(record[r + XY]), splat(record[r + YY])
            opacity = splat(record[r + LOG_OPACITY])
            red, green, blue = splat(record[r + RED]), splat(record[r + GREEN]), splat(record[r + BLUE])
            depth = splat(record[r + DEPTH])
            s, sx, sy, sxx, sxy, syy = zeros(sums), zeros(sums), zeros(sums), zeros(sums), zeros(sums), zeros(sums)
            s_red, s_green, s_blue, s_depth = zeros(sums), zeros(sums), zeros(sums), zeros(sums)
            while blocks != 0:
                at = lowest_bit(blocks) * WIDTH
                blocks &= blocks - 1
                dx, dy = load(state, at + _PIXEL_X) - px, load(state, at + _PIXEL_Y) - py
                exponent = fma(dx, fma(xx, dx, xy * dy), fma(yy * dy, dy, opacity))
                alpha = select(at_least(exponent, exponent_min), exp2_8(smaller(exponent, exponent_max)), zero)
                transmittance = load(state, at)
                d_red, d_green = load(state, at + D_RED), load(state, at + D_GREEN)
                d_blue, d_depth = load(state, at + D_BLUE), load(state, at + D_DEPTH)
                weight = transmittance * alpha
                gain = fma(red, d_red, fma(green, d_green, fma(blue, d_blue, depth * d_depth)))
                rest = load(state, at + REST) - weight * gain
                store(state, at + REST, rest)
                store(state, at, transmittance - weight)
                if chosen:
                    d_alpha = transmittance * gain - rest / (one - alpha)
                    v = select(at_most(exponent, exponent_max), alpha * d_alpha, zero)
                    vx, vy = v * dx, v * dy
                    s, sx, sy = fold(v, s), fold(vx, sx), fold(vy, sy)
                    sxx, sxy, syy = fold_product(vx, dx, sxx), fold_product(vx, dy, sxy), fold_product(vy, dy, syy)
                    s_red, s_green = fold_product(weight, d_red, s_red), fold_product(weight, d_green, s_green)
                    s_blue, s_depth = fold_product(weight, d_blue, s_blue), fold_product(weight, d_depth, s_depth)
            if chosen:
                store_sums(partial, slot * RECORD, (s, sx, sy, sxx, sxy, syy, s_red, s_green, s_blue, s_depth))
        alive = still_alive(state, alive)
    return i, alive


@kernel(inline=True)
def _start_vector(state, at, pixel, stride, plane, colour, depth, alpha, d_colour, d_depth, d_alpha):
    one = splat(_f32(1))
    g_depth = load_block(d_depth, pixel, stride)
    rest = load_block(depth, pixel, stride) * g_depth
    transmittance = one - load_block(alpha, pixel, stride)
    rest = rest - transmittance * load_block(d_alpha, pixel, stride)
    for channel in range(3):
        gradient = load_block(d_colour, pixel + plane * channel, stride)
        rest = fma(load_block(colour, pixel + plane * channel, stride), gradient, rest)
        store(state, at + D_RED + PLANE * channel, gradient)
    store(state, at + D_DEPTH, g_depth)
    store(state, at + REST, rest)
    store(state, at, one)


@kernel(inline=True)
def _start_pixel(state, at, pixel, plane, colour, depth, alpha, d_colour, d_depth, d_alpha):
    rest = depth[pixel] * d_depth[pixel] - (_f32(1) - alpha[pixel]) * d_alpha[pixel]
    for channel in range(3):
        rest += colour[pixel + plane * channel] * d_colour[pixel + plane * channel]
        state[at + D_RED + PLANE * channel] = d_colour[pixel + plane * channel]
    state[at + D_DEPTH], state[at + REST], state[at] = d_depth[pixel], rest, _f32(1)


@kernel(inner=True)
def start_tile(state, tile_x, tile_y, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha):
    """Set transmittance 1, the gradients of the pixels, and what all Gaussians together add to the loss's differential.

    Pixels outside the picture have gradient and transmittance zero.
    """
    x0, y0 = TILE * tile_x, TILE * tile_y
    inside = x0 + TILE <= width and y0 + TILE <= height
    for at in range(0, BLOCKS * WIDTH, WIDTH):
        x, y = x0 + int(state[_PIXEL_X + at]), y0 + int(state[_PIXEL_Y + at])
        if inside:
            _start_vector(
                state, at, y * width + x, width, width * height, colour, depth, alpha, d_colour, d_depth, d_alpha
            )
            continue
        for lane in range(WIDTH):
            px, py, to = x + (lane & 3), y + (lane >> 2), at + lane
            if px < width and py < height:
                _start_pixel(
                    state, to, py * width + px, width * height, colour, depth, alpha, d_colour, d_depth, d_alpha
                )
            else:
                for plane in range(0, D_DEPTH + 1, PLANE):
                    state[plane + to] = _f32(0)


@kernel(inline=True)
def last_chosen(pairs, rows, begin, end):
    """End of the list after its last pair whose row is chosen: nothing behind it matters."""
    while end > begin and rows[pairs[end - 1, GAUSSIAN]] == 0:
        end -= 1
    return end


@kernel(parallel=True)
def blend_backward(sums, record, pairs, start, used_end, tiles_x, width, height, colour, depth, alpha,
                   d_colour, d_depth, d_alpha, rows, partial, used, jobs):  # fmt: skip
    """Partial gradients of pairs whose row is chosen, flat [pairs * 16]; `used` [pairs] says which slots hold one."""
    count = start.shape[0] - 1
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, count, jobs):
            begin, x, y = start[tile], tile % tiles_x, tile // tiles_x
            end = last_chosen(pairs, rows, begin, used_end[tile])
            if end > begin:
                start_tile(state, x, y, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha)
                end, _ = gradient_tile(sums, record, pairs, begin, end, x, y, rows, state, partial, EVERY_BLOCK)
            for i in range(begin, start[tile + 1]):
                used[pairs[i, SLOT]] = i < end and rows[pairs[i, GAUSSIAN]] != 0
