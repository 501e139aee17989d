"""Blending of Gaussians that change over a layer of others that do not, and the gradients of it.

A layer keeps a tile's list in depth order, cut into runs of `EVERY` Gaussians, and a checkpoint after each run: the
state of the tile's pixels when only what comes before is blended. Blending is associative. A run that no changing
Gaussian falls into is therefore not walked but jumped over: with F the transmittance and C the colour of a
checkpoint, going from the one before some runs to the one behind them multiplies the pixel's transmittance T by
F_behind / F_before and adds T / F_before (C_behind - C_before) to its colour. T / F_before is what the changing ones
let through, so that errors of rounding do not grow, however little a wall lets through. It holds only in blocks that
are alive, whose every Gaussian so far was blended; no others are touched.

What is walked, of the layer and of what changes, is copied to one list per tile, in depth order, which the loops of
`blend` run over as over any other.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from packuv.kernels.compile import kernel
from packuv.kernels.simd import ALL, WIDTH, fma, larger, load, lowest_bit, prefetch, splat, store
from packuv.raster.bins import GAUSSIAN, MASK, SLOT
from packuv.raster.blend import (
    BLOCKS,
    BLUE_SUM,
    D_BLUE,
    D_DEPTH,
    D_GREEN,
    D_RED,
    DEPTH_SUM,
    EVERY_BLOCK,
    GREEN_SUM,
    PLANE,
    RED_SUM,
    REST,
    blend_tile,
    fill_tile,
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
EVERY = 16
"""Gaussians from checkpoint to checkpoint: with half of them a layer needs twice the memory, with twice as many more
is walked at both ends of what changes"""
_PIXELS = TILE * TILE
CHECKPOINT = 5 * _PIXELS
"""Floats of a checkpoint: planes of transmittance, red, green, blue, depth"""
_RED, _GREEN, _BLUE, _DEPTH = (_PIXELS * plane for plane in range(1, 5))
_TINY = _f32(1e-30)
"""Less transmittance shows nothing, and must not be divided by."""
_AHEAD = 4
"""List entries between asking for a cache line and using it."""

# Columns of a jump, int64: the entry before which it happens, and both checkpoints.
BEFORE, FROM, TO = range(3)


# -- the layer --------------------------------------------------------------------------------------------------------


@kernel(inner=True)
def _save_state(state, checkpoints, to):
    for plane in range(5):
        for at in range(0, _PIXELS, WIDTH):
            store(checkpoints, to + _PIXELS * plane + at, load(state, PLANE * plane + at))


@kernel(parallel=True)
def take_checkpoints(sums, record, pairs, start, first, tiles_x, width, height, checkpoints, jobs):
    """Fill the checkpoints, flat [C * CHECKPOINT]; a tile's own begin at number `first` [tiles + 1].

    Number 0 is the state before everything, of any tile.
    """
    nothing = np.empty(0, np.float32)
    checkpoints[:_PIXELS] = _f32(1)
    checkpoints[_PIXELS:CHECKPOINT] = _f32(0)
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
def _append(stream, entries, moves, at, record, pairs, i, slot, moving):
    """Copy a pair and its Gaussian's record to the end of a merged list."""
    store(stream, at * RECORD, load(record, np.int64(pairs[i, GAUSSIAN]) * RECORD))
    entries[at, GAUSSIAN], entries[at, SLOT], entries[at, MASK] = at, slot, pairs[i, MASK]
    moves[at] = moving


@kernel(inline=True)
def _depth(record, pairs, i):
    return record[np.int64(pairs[i, GAUSSIAN]) * RECORD + DEPTH]


@kernel(inline=True)
def _checkpoint(first, passed):
    """Number of a tile's checkpoint after `passed` runs."""
    return 0 if passed == 0 else first + passed - 1


@kernel(inner=True)
def _merge_tile(still_record, still_pairs, f, f_end, first, runs, reach, record, pairs, m, m_end, at, stream, entries,
                moves, jumps, jump):  # fmt: skip
    """Merge a tile's list [m, m_end) of what changes into the layer's [f, f_end), which is `runs` runs.

    Of Gaussians at the same depth those of the layer come first. Returns the ends of the merged list and of the jumps.
    """
    begin, passed = f, 0
    while m < m_end:
        depth, before = _depth(record, pairs, m), passed
        while passed < runs and reach[first + passed] <= depth:
            passed += 1
        if passed > before:
            jumps[jump, BEFORE], jumps[jump, FROM] = at, _checkpoint(first, before)
            jumps[jump, TO] = _checkpoint(first, passed)
            jump, f = jump + 1, min(begin + EVERY * passed, f_end)
        if f == f_end or depth < _depth(still_record, still_pairs, f):
            _append(stream, entries, moves, at, record, pairs, m, pairs[m, SLOT], 1)
            at, m = at + 1, m + 1
            continue
        stop, passed = min(f + EVERY, f_end), passed + 1
        while f < stop:
            if f + _AHEAD < f_end:
                prefetch(still_record, np.int64(still_pairs[f + _AHEAD, GAUSSIAN]) * RECORD)
            if m < m_end and _depth(record, pairs, m) < _depth(still_record, still_pairs, f):
                _append(stream, entries, moves, at, record, pairs, m, pairs[m, SLOT], 1)
                m += 1
            else:
                _append(stream, entries, moves, at, still_record, still_pairs, f, 0, 0)
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
    a, b, remaining = before * CHECKPOINT, behind * CHECKPOINT, alive
    while remaining != 0:
        at = lowest_bit(remaining) * WIDTH
        remaining &= remaining - 1
        through = load(state, at) / larger(load(checkpoints, a + at), splat(_TINY))
        store(state, at, through * load(checkpoints, b + at))
        for plane in range(1, 5):
            here = _PIXELS * plane + at
            added = load(checkpoints, b + here) - load(checkpoints, a + here)
            store(state, PLANE * plane + at, fma(through, added, load(state, PLANE * plane + at)))
    return still_alive(state, alive)


@kernel(parallel=True)
def blend_over(sums, still_record, still_pairs, still_start, first, reach, checkpoints, record, pairs, start, active,
               tiles_x, width, height, background, stream, entries, moves, jumps, jump_end, colour, depth, alpha,
               used_end, visited, jobs):  # fmt: skip
    """Merge and draw every active tile, background elsewhere.

    A tile's merged list begins at the sum of its `still_start` and `start`, its jumps where its checkpoints do, less
    one; `jump_end` [tiles] receives the end of them, `used_end` and `visited` [tiles] what they do in `blend.blend`.
    """
    nothing = np.empty(0, np.float32)
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, active.shape[0], jobs):
            x, y, runs = tile % tiles_x, tile // tiles_x, first[tile + 1] - first[tile]
            i, visited[tile] = still_start[tile] + start[tile], 0
            used_end[tile], jump_end[tile] = i, first[tile] - 1
            if active[tile] == 0 or (runs == 0 and start[tile] == start[tile + 1]):
                fill_tile(x, y, width, height, background, colour, depth, alpha)
                continue
            end, jump_end[tile] = _merge_tile(
                still_record, still_pairs, still_start[tile], still_start[tile + 1], first[tile], runs, reach, record,
                pairs, start[tile], start[tile + 1], i, stream, entries, moves, jumps, first[tile] - 1
            )  # fmt: skip
            open_tile(state, width - TILE * x, height - TILE * y)
            alive = EVERY_BLOCK
            for jump in range(first[tile] - 1, jump_end[tile] + 1):
                stop = end if jump == jump_end[tile] else jumps[jump, BEFORE]
                i, more, alive = blend_tile(sums, stream, entries, i, stop, x, y, state, nothing, alive)
                visited[tile] += more
                if jump < jump_end[tile] and alive != 0:
                    alive = _jump(state, checkpoints, jumps[jump, FROM], jumps[jump, TO], alive)
            used_end[tile] = i
            write_tile(state, x, y, width, height, background, colour, depth, alpha)


# -- gradients --------------------------------------------------------------------------------------------------------


@kernel(inner=True)
def _jump_backward(state, checkpoints, before, behind, alive):
    """The same jump where the state is that of gradients: what is passed no longer counts as the rest."""
    a, b, remaining = before * CHECKPOINT, behind * CHECKPOINT, alive
    while remaining != 0:
        at = lowest_bit(remaining) * WIDTH
        remaining &= remaining - 1
        through = load(state, at) / larger(load(checkpoints, a + at), splat(_TINY))
        store(state, at, through * load(checkpoints, b + at))
        gain = (load(checkpoints, b + _DEPTH + at) - load(checkpoints, a + _DEPTH + at)) * load(state, D_DEPTH + at)
        for channel in range(3):
            here = _RED + _PIXELS * channel + at
            added = load(checkpoints, b + here) - load(checkpoints, a + here)
            gain = fma(added, load(state, D_RED + PLANE * channel + at), gain)
        store(state, REST + at, load(state, REST + at) - through * gain)
    return still_alive(state, alive)


@kernel(parallel=True)
def blend_over_backward(sums, still_start, first, checkpoints, pairs, start, stream, entries, moves, jumps, jump_end,
                        used_end, tiles_x, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha, partial,
                        used, jobs):  # fmt: skip
    """Partial gradients of what changes, flat [pairs * 16]; `used` [pairs] says which slots hold one."""
    for job in prange(jobs):
        state = scratch()
        for tile in range(job, start.shape[0] - 1, jobs):
            for k in range(start[tile], start[tile + 1]):
                used[pairs[k, SLOT]] = 0
            begin, x, y = still_start[tile] + start[tile], tile % tiles_x, tile // tiles_x
            end = last_chosen(entries, moves, begin, used_end[tile])
            if end == begin:
                continue
            start_tile(state, x, y, width, height, colour, depth, alpha, d_colour, d_depth, d_alpha)
            i, alive, jump = begin, EVERY_BLOCK, first[tile] - 1
            while i < end and alive != 0:
                stop = end if jump == jump_end[tile] else min(end, jumps[jump, BEFORE])
                i, alive = gradient_tile(sums, stream, entries, i, stop, x, y, moves, state, partial, alive)
                if i < end and alive != 0:
                    alive = _jump_backward(state, checkpoints, jumps[jump, FROM], jumps[jump, TO], alive)
                    jump += 1
            for k in range(begin, i):
                if moves[k] != 0:
                    used[entries[k, SLOT]] = 1
