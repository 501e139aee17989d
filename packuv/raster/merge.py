"""Blending of Gaussians that change over a layer of others that do not, and the gradients of it.

A layer keeps a tile's list in depth order, cut into runs of `EVERY` Gaussians, and a checkpoint after each run: the
state of the tile's pixels when only what comes before is blended. Blending is associative. A run that no changing
Gaussian falls into is therefore not walked but jumped over: with F the transmittance and C the colour of a
checkpoint, going from the one before some runs to the one behind them multiplies the pixel's transmittance T by
F_behind / F_before and adds T / F_before (C_behind - C_before) to its colour. T / F_before is what the changing ones
let through, so that errors of rounding do not grow, however little a wall lets through. It holds only in blocks that
are alive, whose every Gaussian so far was blended; no others are touched.

What is walked, of the layer and of what changes, is merged to one list per tile, in depth order, which the loops of
`blend` run over as over any other. Its Gaussians are numbered as in one array of records: the N that change, then room
for each pair of the layer, filled where it is walked.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from packuv.kernels.compile import kernel
from packuv.kernels.simd import WIDTH, fma, larger, load, lowest_bit, prefetch, splat, store
from packuv.raster.bins import GAUSSIAN, MASK, SLOT
from packuv.raster.blend import (
    BLOCKS,
    D_DEPTH,
    D_RED,
    EVERY_BLOCK,
    PLANE,
    REST,
    blend_tile,
    gradient_tile,
    last_chosen,
    open_tile,
    scratch,
    start_tile,
    still_alive,
    write_tile,
)
from packuv.raster.project import DEPTH, RECORD
from packuv.raster.view import TILE

_f32 = np.float32
EVERY = 32
"""Gaussians from checkpoint to checkpoint: half of them need twice the memory, and walk a fifth to a quarter less"""
_PLANES = 5
CHECKPOINT = _PLANES * TILE * TILE
"""Floats of a checkpoint: block by block a vector each of transmittance, red, green, blue, depth"""
_RED, _DEPTH = WIDTH, 4 * WIDTH
_TINY = _f32(1e-30)
"""Less transmittance shows nothing, and must not be divided by."""
_AHEAD = 4
"""List entries between asking for a cache line and using it."""

# Columns of a jump, int64: the entry before which it happens, and both checkpoints.
BEFORE, FROM, TO = range(3)


# -- the layer --------------------------------------------------------------------------------------------------------


@kernel(inner=True)
def _save_state(state, checkpoints, to):
    for at in range(0, BLOCKS * WIDTH, WIDTH):
        for plane in range(_PLANES):
            store(checkpoints, to + _PLANES * at + WIDTH * plane, load(state, PLANE * plane + at))


@kernel(parallel=True)
def take_checkpoints(sums, record, pairs, start, first, tiles_x, width, height, checkpoints, jobs):
    """Fill the checkpoints, flat [C * CHECKPOINT]; a tile's own begin at number `first` [tiles + 1].

    Number 0 is the state before everything, of any tile.
    """
    nothing = np.empty(0, np.float32)
    for at in range(CHECKPOINT):
        checkpoints[at] = _f32(1) if at // WIDTH % _PLANES == 0 else _f32(0)
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, start.shape[0] - 1, jobs):
            x, y, alive, at = tile % tiles_x, tile // tiles_x, EVERY_BLOCK, start[tile]
            open_tile(state, width - TILE * x, height - TILE * y)
            for number in range(first[tile], first[tile + 1]):
                end = min(at + EVERY, start[tile + 1])
                _, _, alive = blend_tile(sums, record, pairs, at, end, x, y, state, nothing, alive)
                _save_state(state, checkpoints, number * CHECKPOINT)
                at = end


# -- one list per tile ------------------------------------------------------------------------------------------------


@kernel(inline=True)
def _depth(record, pairs, i):
    return record[np.int64(pairs[i, GAUSSIAN]) * RECORD + DEPTH]


@kernel(inline=True)
def _checkpoint(first, passed):
    """Number of a tile's checkpoint after `passed` runs."""
    return 0 if passed == 0 else first + passed - 1


@kernel(inline=True)
def _append(entries, at, gaussian, slot, mask):
    entries[at, GAUSSIAN], entries[at, SLOT], entries[at, MASK] = gaussian, slot, mask


@kernel(inner=True)
def _merge_tile(still_record, still_pairs, f, f_end, first, runs, reach, count, record, pairs, m, m_end, at, entries,
                jumps, jump):  # fmt: skip
    """Merge a tile's list [m, m_end) of what changes, `count` in all, into the layer's [f, f_end) of `runs` runs.

    Of Gaussians at the same depth those of the layer come first. Returns the ends of the merged list and of the jumps.
    """
    begin, passed = f, 0
    while m < m_end:
        if m + _AHEAD < m_end:
            prefetch(record, np.int64(pairs[m + _AHEAD, GAUSSIAN]) * RECORD)
        depth, before = _depth(record, pairs, m), passed
        while passed < runs and reach[first + passed] <= depth:
            passed += 1
        if passed > before:
            jumps[jump, BEFORE], jumps[jump, FROM] = at, _checkpoint(first, before)
            jumps[jump, TO] = _checkpoint(first, passed)
            jump, f = jump + 1, min(begin + EVERY * passed, f_end)
        if f == f_end or depth < _depth(still_record, still_pairs, f):
            _append(entries, at, pairs[m, GAUSSIAN], pairs[m, SLOT], pairs[m, MASK])
            at, m = at + 1, m + 1
            continue
        stop, passed = min(f + EVERY, f_end), passed + 1
        while f < stop:
            if f + _AHEAD < f_end:
                prefetch(still_record, np.int64(still_pairs[f + _AHEAD, GAUSSIAN]) * RECORD)
            if m < m_end and _depth(record, pairs, m) < _depth(still_record, still_pairs, f):
                _append(entries, at, pairs[m, GAUSSIAN], pairs[m, SLOT], pairs[m, MASK])
                m += 1
            else:
                store(record, (count + f) * RECORD, load(still_record, np.int64(still_pairs[f, GAUSSIAN]) * RECORD))
                _append(entries, at, count + f, 0, still_pairs[f, MASK])
                f += 1
            at += 1
    if passed < runs:
        jumps[jump, BEFORE], jumps[jump, FROM] = at, _checkpoint(first, passed)
        jumps[jump, TO] = _checkpoint(first, runs)
        jump += 1
    return at, jump


# -- pictures ---------------------------------------------------------------------------------------------------------


@kernel(inner=True)
def _jump(state, checkpoints, before, behind, alive):
    """Go from checkpoint to checkpoint in the blocks that are alive; returns those that still are."""
    remaining = alive
    while remaining != 0:
        at = lowest_bit(remaining) * WIDTH
        remaining &= remaining - 1
        a, b = before * CHECKPOINT + _PLANES * at, behind * CHECKPOINT + _PLANES * at
        through = load(state, at) / larger(load(checkpoints, a), splat(_TINY))
        store(state, at, through * load(checkpoints, b))
        for plane in range(1, _PLANES):
            added = load(checkpoints, b + WIDTH * plane) - load(checkpoints, a + WIDTH * plane)
            store(state, PLANE * plane + at, fma(through, added, load(state, PLANE * plane + at)))
    return still_alive(state, alive)


@kernel(parallel=True)
def blend_over(sums, still_record, still_pairs, still_start, first, reach, checkpoints, count, record, pairs, start,
               shown, tiles_x, width, height, background, entries, jumps, jump_end, colour, depth, alpha,
               used_end, visited, jobs):  # fmt: skip
    """Merge and draw every tile that is `shown`, bool [tiles]; the others are left to `blend.fill`.

    A tile's merged list begins at the sum of its `still_start` and `start`, its jumps where its checkpoints do, less
    one; `jump_end` [tiles] receives the end of them, `used_end` and `visited` [tiles] what they do in `blend.blend`.
    """
    nothing = np.empty(0, np.float32)
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, shown.shape[0], jobs):
            x, y, runs = tile % tiles_x, tile // tiles_x, first[tile + 1] - first[tile]
            i, visited[tile] = still_start[tile] + start[tile], 0
            used_end[tile], jump_end[tile] = i, first[tile] - 1
            if not shown[tile]:
                continue
            end, jump_end[tile] = _merge_tile(
                still_record, still_pairs, still_start[tile], still_start[tile + 1], first[tile], runs, reach, count,
                record, pairs, start[tile], start[tile + 1], i, entries, jumps, first[tile] - 1
            )  # fmt: skip
            open_tile(state, width - TILE * x, height - TILE * y)
            alive = EVERY_BLOCK
            for jump in range(first[tile] - 1, jump_end[tile] + 1):
                stop = end if jump == jump_end[tile] else jumps[jump, BEFORE]
                i, more, alive = blend_tile(sums, record, entries, i, stop, x, y, state, nothing, alive)
                visited[tile] += more
                if jump < jump_end[tile] and alive != 0:
                    alive = _jump(state, checkpoints, jumps[jump, FROM], jumps[jump, TO], alive)
            used_end[tile] = i
            write_tile(state, x, y, width, height, background, colour, depth, alpha)


# -- gradients --------------------------------------------------------------------------------------------------------


@kernel(inner=True)
def _jump_backward(state, checkpoints, before, behind, alive):
    """The same jump where the state is that of gradients: what is passed no longer counts as the rest."""
    remaining = alive
    while remaining != 0:
        at = lowest_bit(remaining) * WIDTH
        remaining &= remaining - 1
        a, b = before * CHECKPOINT + _PLANES * at, behind * CHECKPOINT + _PLANES * at
        through = load(state, at) / larger(load(checkpoints, a), splat(_TINY))
        store(state, at, through * load(checkpoints, b))
        gain = (load(checkpoints, b + _DEPTH) - load(checkpoints, a + _DEPTH)) * load(state, D_DEPTH + at)
        for channel in range(3):
            colour = _RED + WIDTH * channel
            added = load(checkpoints, b + colour) - load(checkpoints, a + colour)
            gain = fma(added, load(state, D_RED + PLANE * channel + at), gain)
        store(state, REST + at, load(state, REST + at) - through * gain)
    return still_alive(state, alive)


@kernel(parallel=True)
def blend_over_backward(sums, still_start, first, checkpoints, record, pairs, start, entries, jumps, jump_end, used_end,
                        rows, tiles_x, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha, partial,
                        used, jobs):  # fmt: skip
    """Partial gradients of pairs whose row is chosen, flat [pairs * 16]; `used` [pairs] says which slots hold one.

    `rows`, uint8, are those of the records, so that of the layer none is chosen.
    """
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, start.shape[0] - 1, jobs):
            for k in range(start[tile], start[tile + 1]):
                used[pairs[k, SLOT]] = 0
            begin, x, y = still_start[tile] + start[tile], tile % tiles_x, tile // tiles_x
            end = last_chosen(entries, rows, begin, used_end[tile])
            if end == begin:
                continue
            start_tile(state, x, y, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha)
            i, alive, jump = begin, EVERY_BLOCK, first[tile] - 1
            while i < end and alive != 0:
                stop = end if jump == jump_end[tile] else min(end, jumps[jump, BEFORE])
                i, alive = gradient_tile(sums, record, entries, i, stop, x, y, rows, state, partial, alive)
                if i < end and alive != 0:
                    alive = _jump_backward(state, checkpoints, jumps[jump, FROM], jumps[jump, TO], alive)
                    jump += 1
            for k in range(begin, i):
                if rows[entries[k, GAUSSIAN]] != 0:
                    used[entries[k, SLOT]] = 1
