"""Lists of Gaussians per tile, in depth order, with an exact mask of the blocks of pixels that each one reaches."""

from __future__ import annotations

import numpy as np
from numba import prange

from packuv.kernels.compile import kernel
from packuv.kernels.simd import (
    ALL,
    at_least,
    at_most,
    bits,
    both,
    greatest_of_four,
    larger,
    least_of_four,
    load,
    prefetch,
    select,
    splat,
    square_root,
    zeros,
)
from packuv.raster.project import CHUNKS, DEPTH, INVERSE_VARIANCE_Y, INVERSE_XX, REACH, RECORD, SHEAR, X, Y
from packuv.raster.view import TILE

_f32 = np.float32
_ROWS = np.array([4 * (lane % 4) + lane // 4 + 0.5 for lane in range(TILE)], np.float32)
"""Rows of pixels of a tile, so ordered that lanes k, k + 4, k + 8, k + 12 hold the four of the k-th row of blocks"""
_COLUMNS = np.array([4 * (lane % 4) + 0.5 for lane in range(TILE)], np.float32)
"""Centre of the first pixel of each of a tile's blocks"""
_FAR = np.float32(1e6)
"""Beyond every picture"""
_RADIX_BITS = 11
_AHEAD = 8
"""Gaussians between asking for a cache line and using it."""

# Columns of a pair, uint32.
GAUSSIAN, SLOT, MASK = range(3)


@kernel()
def drawn(cells, record, order, keys):
    """Collect the Gaussians that are drawn; their keys are the bits of a positive float, which sort like it."""
    count = 0
    for i in range(cells.shape[0]):
        if cells[i] > 0:
            order[count] = i
            keys[count] = record[i * RECORD + DEPTH]
            count += 1
    return count


@kernel()
def sort_by_depth(count, order, keys, other_order, other_keys, histogram):
    """Stable radix sort in three passes of 11 bits; the result is in `other_order`. Keys are uint32 [N]."""
    histogram[:] = 0
    for i in range(count):
        for digit in range(3):
            histogram[digit, (keys[i] >> np.uint32(_RADIX_BITS * digit)) & np.uint32(2047)] += 1
    for digit in range(3):
        total = 0
        for value in range(2048):
            total, histogram[digit, value] = total + histogram[digit, value], total
    _sort_digit(count, 0, order, keys, other_order, other_keys, histogram)
    _sort_digit(count, 1, other_order, other_keys, order, keys, histogram)
    _sort_digit(count, 2, order, keys, other_order, other_keys, histogram)


@kernel(inner=True)
def _sort_digit(count, digit, order, keys, to_order, to_keys, histogram):
    shift = np.uint32(_RADIX_BITS * digit)
    for i in range(count):
        value = (keys[i] >> shift) & np.uint32(2047)
        at = histogram[digit, value]
        histogram[digit, value] = at + 1
        to_keys[at], to_order[at] = keys[i], order[i]


@kernel()
def running_sum(counts, out):
    """Exclusive prefix sum, int64 [N + 1]; returns the total."""
    total = 0
    for i in range(counts.shape[0]):
        out[i] = total
        total += counts[i]
    out[counts.shape[0]] = total
    return total


@kernel(inline=True)
def _intervals(record, g, tile_y, height):
    """From where to where the outline of Gaussian g reaches along x, in each of a tile row's four rows of blocks.

    Two vectors of pixels, lanes 4 j to 4 j + 3 for row j; the first is greater where nothing is reached. In each row
    of pixels the outline covers one interval, so this is exact but for gaps in a needle's outline.
    """
    r = g * RECORD
    row, far = load(_ROWS, 0), splat(_FAR)
    dy = row - splat(record[r + Y] - _f32(TILE * tile_y))
    room = splat(record[r + REACH]) - dy * dy * splat(record[r + INVERSE_VARIANCE_Y])
    half = square_root(larger(room * splat(record[r + INVERSE_XX]), zeros(ALL)))
    centre = splat(record[r + X]) - splat(record[r + SHEAR]) * dy
    reached = both(at_least(room, zeros(ALL)), at_most(row, splat(_f32(height - TILE * tile_y))))
    first = least_of_four(select(reached, centre - half, far))
    return first, greatest_of_four(select(reached, centre + half, zeros(ALL) - far))


@kernel(parallel=True)
def find_tiles(box, cells, first_cell, record, active, height, tiles, masks, hits):
    """List the tiles of each Gaussian from its first cell on: tile number, block mask; `hits` [N] counts them.

    Bit 4 j + i of a mask is the block in row j and column i of a tile.
    """
    count = cells.shape[0]
    for chunk in prange(CHUNKS):
        for g in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            hits[g] = 0
            if cells[g] == 0:
                continue
            at = first_cell[g]
            for tile_y in range(box[g, 1], box[g, 3] + 1):
                first, last = _intervals(record, np.int64(g), tile_y, height)
                for tile_x in range(box[g, 0], box[g, 2] + 1):
                    left = load(_COLUMNS, 0) + splat(_f32(TILE * tile_x))
                    mask = bits(both(at_least(last, left), at_most(first, left + splat(_f32(3)))))
                    if mask != 0 and active[tile_y, tile_x] != 0:
                        tiles[at], masks[at] = tile_y * active.shape[1] + tile_x, mask
                        at += 1
            hits[g] = at - first_cell[g]


@kernel(parallel=True)
def count_pairs(count, order, first_cell, hits, tiles, histogram):
    """Pairs per chunk of the depth order and tile, int32 [CHUNKS, tiles]."""
    for chunk in prange(histogram.shape[0]):
        end = count * (chunk + 1) // histogram.shape[0]
        histogram[chunk, :] = 0
        for s in range(count * chunk // histogram.shape[0], end):
            if s + _AHEAD < end:
                prefetch(tiles, first_cell[order[s + _AHEAD]])
            g = order[s]
            for cell in range(first_cell[g], first_cell[g] + hits[g]):
                histogram[chunk, tiles[cell]] += 1


@kernel()
def start_tiles(histogram, start):
    """Turn counts into positions, tile by tile and chunk by chunk; `start` [tiles + 1] bounds each tile's list."""
    total = 0
    for tile in range(histogram.shape[1]):
        start[tile] = total
        for chunk in range(histogram.shape[0]):
            total, histogram[chunk, tile] = total + histogram[chunk, tile], total
    start[histogram.shape[1]] = total
    return total


@kernel(parallel=True)
def scatter_pairs(count, order, first_cell, first_pair, tiles, masks, histogram, pairs):
    """Write the lists, uint32 [pairs, 3]; a slot is the place of a pair when pairs are grouped by Gaussian."""
    for chunk in prange(histogram.shape[0]):
        end = count * (chunk + 1) // histogram.shape[0]
        for s in range(count * chunk // histogram.shape[0], end):
            if s + _AHEAD < end:
                prefetch(tiles, first_cell[order[s + _AHEAD]])
                prefetch(masks, first_cell[order[s + _AHEAD]])
            g = order[s]
            cell = first_cell[g]
            for slot in range(first_pair[g], first_pair[g + 1]):
                at = histogram[chunk, tiles[cell]]
                histogram[chunk, tiles[cell]] = at + 1
                pairs[at, GAUSSIAN], pairs[at, SLOT], pairs[at, MASK] = g, slot, masks[cell]
                cell += 1
