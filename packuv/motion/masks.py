"""Masks of one picture: where brightness changes beyond the noise, and which connected parts of a mask count."""

from __future__ import annotations

import numpy as np

from packuv.kernels.compile import kernel

_f32 = np.float32
_SLOPE = _f32(0.02)
_ROW, _START, _STOP = range(3)


def change(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """`after` minus `before`, uint8 [H, W] each, less the median of every other row and column: float32 [H, W]."""
    out = np.empty(before.shape, np.float32)
    _change(before, after, out)
    return out


def beyond(
    size: np.ndarray, across: np.ndarray, down: np.ndarray, *, noise: float, low: float, high: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where a change of `size` exceeds `low` and `high` times the noise plus 2 % of the slope, bool [H, W] both.

    All are float32 [H, W], the slope by its parts; codecs spend fewer bits on edges, and a shaking rig moves them.
    """
    weak, strong = np.empty(size.shape, bool), np.empty(size.shape, bool)
    _beyond(size, across, down, _f32(noise), _f32(low), _f32(high), weak, strong)
    return weak, strong


def connected(low: np.ndarray, high: np.ndarray, least_area: int) -> np.ndarray:
    """Components of `low`, corners touching, that hold a pixel of `high` and at least `least_area`, bool [H, W]."""
    kept = np.zeros(low.shape, bool)
    _connected(low, high, least_area, kept)
    return kept


def filled(outline: np.ndarray, moving: np.ndarray, hole_share: float) -> np.ndarray:
    """The outline with its holes, bounded by the border too, if small and more than half moving, bool [H, W]."""
    whole = outline.copy()
    _filled(outline, moving, hole_share * outline.size, whole)
    return whole


@kernel()
def _change(before, after, out):
    counts, total = np.zeros(511, np.int64), 0
    for y in range(0, before.shape[0], 2):
        for x in range(0, before.shape[1], 2):
            counts[np.int64(after[y, x]) - np.int64(before[y, x]) + 255] += 1
            total += 1
    median = _f32(_ranked(counts, (total - 1) // 2) + _ranked(counts, total // 2)) / _f32(2)
    for y in range(before.shape[0]):
        for x in range(before.shape[1]):
            out[y, x] = _f32(after[y, x]) - _f32(before[y, x]) - median


@kernel(inner=True)
def _ranked(counts, rank):
    """The value of a rank, from 0 on, of values -255 to 255 that are counted."""
    below, value = counts[0], 0
    while below <= rank:
        value += 1
        below += counts[value]
    return value - 255


@kernel()
def _beyond(size, across, down, noise, low, high, weak, strong):
    for y in range(size.shape[0]):
        for x in range(size.shape[1]):
            dx, dy = np.float64(across[y, x]), np.float64(down[y, x])
            score = size[y, x] / (noise + _SLOPE * _f32(np.sqrt(dx * dx + dy * dy)))
            weak[y, x], strong[y, x] = score > low, score > high


@kernel()
def _connected(low, high, least_area, kept):
    runs, root, area, marked = _components(low, True, high, 1)
    for r in range(len(runs)):
        if marked[root[r]] > 0 and area[root[r]] >= least_area:
            for x in range(runs[r, _START], runs[r, _STOP]):
                kept[runs[r, _ROW], x] = True


@kernel()
def _filled(outline, moving, most_area, whole):
    runs, root, area, marked = _components(outline, False, moving, 0)
    for r in range(len(runs)):
        if marked[root[r]] > 0.5 * area[root[r]] and area[root[r]] <= most_area:
            for x in range(runs[r, _START], runs[r, _STOP]):
                whole[runs[r, _ROW], x] = True


@kernel(inner=True)
def _components(plane, wanted, mark, reach):
    """Runs along rows where the plane is `wanted`, int32 [R, 3], and the first run of the component of each.

    Runs of neighbouring rows are connected where they overlap, or with a `reach` of 1 meet at a corner. By first run
    also the area of the component, and how many of its pixels are marked.
    """
    height, width = plane.shape
    most = height * (width // 2 + 1)
    runs, root = np.empty((most, 3), np.int32), np.empty(most, np.int32)
    area, marked = np.empty(most, np.int64), np.empty(most, np.int64)
    count, above, begin = 0, 0, 0
    for y in range(height):
        above, begin = begin, count  # runs [above, begin) are of the row before
        x = 0
        while x < width:
            if plane[y, x] != wanted:
                x += 1
                continue
            start, hits = x, 0
            while x < width and plane[y, x] == wanted:
                hits += mark[y, x]
                x += 1
            runs[count, _ROW], runs[count, _START], runs[count, _STOP] = y, start, x
            root[count], area[count], marked[count] = count, x - start, hits
            while above < begin and runs[above, _STOP] + reach <= start:
                above += 1
            other = above
            while other < begin and runs[other, _START] < x + reach:
                _join(root, area, marked, other, count)
                other += 1
            count += 1
    for r in range(count):
        root[r] = _first(root, r)
    return runs[:count], root[:count], area[:count], marked[:count]


@kernel(inner=True)
def _first(root, r):
    while root[r] != r:
        root[r] = root[root[r]]
        r = root[r]
    return r


@kernel(inner=True)
def _join(root, area, marked, first, second):
    a, b = _first(root, first), _first(root, second)
    if a != b:
        low, high = min(a, b), max(a, b)
        root[high] = low
        area[low] += area[high]
        marked[low] += marked[high]
