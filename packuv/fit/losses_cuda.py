"""The photometric loss on a GPU: a block of threads for each active tile of each channel, a thread for each pixel.

As `losses` on the CPU, in two passes: SSIM and its derivatives by the blurs, then what these make of each pixel. Every
sum has a fixed order.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numba.cuda
import numpy as np
import torch
from numba import float32
from torch import Tensor

from packuv.fit.ssim import C1, C2, RADIUS, WINDOW
from packuv.raster.cuda.launch import MEMORY, THREADS, on_device, run
from packuv.raster.view import TILE

cuda: Any = numba.cuda
_f32 = np.float32
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_SIDE = TILE + 2 * RADIUS
_TAPS = 2 * RADIUS + 1


def compare_on_gpu(
    picture: np.ndarray, target: np.ndarray, active: np.ndarray, l1_scale: float, ssim_scale: float
) -> tuple[float, float, np.ndarray]:
    """Sums of absolute differences and of SSIM over active pixels, and the gradient [C, H, W]; see `losses`."""
    where = on_device(active.view(np.uint8)), on_device(np.flatnonzero(active))
    sums, gradient = compare(on_device(picture), on_device(target), *where, l1_scale, ssim_scale)
    absolute, similarity = sums.tolist()
    return absolute, similarity, gradient.cpu().numpy()


def compare(
    picture: Tensor, target: Tensor, active: Tensor, tiles: Tensor, l1_scale: float, ssim_scale: float
) -> tuple[Tensor, Tensor]:
    """The same of tensors that stay on the GPU: both sums, float64 [2], and the gradient.

    `tiles` numbers the `active` ones, uint8. The gradient is that of `l1_scale` times the first and `ssim_scale` times
    the second sum.
    """
    blocks, pictures = len(picture) * len(tiles), (picture, target, active, tiles)
    derivatives = torch.zeros((3, *picture.shape), device=MEMORY)
    gradient, sums = torch.zeros(picture.shape, device=MEMORY), torch.zeros((blocks, 2), device=MEMORY)
    run(_compare, blocks, *pictures, _window(), derivatives, sums)
    run(_slopes, blocks, *pictures, _window(), derivatives, _f32(l1_scale), _f32(ssim_scale), gradient)
    return sums.double().sum(0), gradient


@cache
def _window() -> Tensor:
    return on_device(WINDOW)


@cuda.jit(device=True)
def _picture_or_target(picture, target, active, channel, y, x):
    """What is compared: the picture in active tiles, elsewhere the target."""
    if active[y // TILE, x // TILE] != 0:
        return picture[channel, y, x]
    return target[channel, y, x]


@cuda.jit(device=True)
def _blur_rows(t, planes, count, window, blurred):
    """Blur `count` planes [count, 26, 26] along x, to [count, 26, 16]."""
    for j in range(t, count * _SIDE * TILE, THREADS):
        plane, row, column = j // (_SIDE * TILE), j // TILE % _SIDE, j % TILE
        total = _ZERO
        for k in range(_TAPS):
            total += window[k] * planes[plane, row, column + k]
        blurred[plane, row, column] = total


@cuda.jit(device=True)
def _blur_column(blurred, plane, row, column, window):
    total = _ZERO
    for k in range(_TAPS):
        total += window[k] * blurred[plane, row + k, column]
    return total


@cuda.jit(device=True)
def _sum(t, values):
    """Sum of a value per thread, shared [256], in thread 0; the others' is part of it."""
    cuda.syncthreads()
    total = _ZERO
    if t < TILE:
        for k in range(TILE):
            total += values[TILE * t + k]
        values[TILE * t] = total
    cuda.syncthreads()
    if t == 0:
        total = _ZERO
        for k in range(TILE):
            total += values[TILE * k]
    cuda.syncthreads()
    return total


@cuda.jit
def _compare(picture, target, active, tiles, window, derivatives, sums):
    """Derivatives of each pixel's SSIM by the blurs of a, of a a + b b and of a b, [3, C, H, W]; `sums` [blocks, 2]."""
    planes = cuda.shared.array((4, _SIDE, _SIDE), float32)
    blurred = cuda.shared.array((4, _SIDE, TILE), float32)
    values = cuda.shared.array(THREADS, float32)
    t, channel, tile = cuda.threadIdx.x, cuda.blockIdx.x // tiles.shape[0], tiles[cuda.blockIdx.x % tiles.shape[0]]
    height, width = picture.shape[1], picture.shape[2]
    y0, x0 = TILE * (tile // active.shape[1]), TILE * (tile % active.shape[1])
    for j in range(t, _SIDE * _SIDE, THREADS):
        row, column = j // _SIDE, j % _SIDE
        y, x = y0 - RADIUS + row, x0 - RADIUS + column
        a, b = _ZERO, _ZERO
        if 0 <= y < height and 0 <= x < width:
            a, b = _picture_or_target(picture, target, active, channel, y, x), target[channel, y, x]
        planes[0, row, column], planes[1, row, column] = a, b
        planes[2, row, column], planes[3, row, column] = a * a + b * b, a * b
    cuda.syncthreads()
    _blur_rows(t, planes, 4, window, blurred)
    cuda.syncthreads()
    row, column = t // TILE, t % TILE
    y, x = y0 + row, x0 + column
    ssim, difference = _ZERO, _ZERO
    if y < height and x < width:
        a, b = _blur_column(blurred, 0, row, column, window), _blur_column(blurred, 1, row, column, window)
        squares, product = (
            _blur_column(blurred, 2, row, column, window),
            _blur_column(blurred, 3, row, column, window),
        )
        power = a * a + b * b
        a1, a2 = _TWO * a * b + C1, _TWO * (product - a * b) + C2
        b1, b2 = power + C1, max(squares - power, _ZERO) + C2  # rounding may leave a variance below zero
        inverse = _ONE / (b1 * b2)
        ssim = a1 * a2 * inverse
        to_square, to_product = -ssim * b1 * inverse, _TWO * a1 * inverse
        to_mean = _TWO * (b * a2 * inverse - a * ssim * b2 * inverse)
        derivatives[0, channel, y, x] = to_mean - _TWO * a * to_square - b * to_product
        derivatives[1, channel, y, x] = to_square
        derivatives[2, channel, y, x] = to_product
        difference = abs(picture[channel, y, x] - target[channel, y, x])
    values[t] = difference
    absolute = _sum(t, values)
    values[t] = ssim
    similarity = _sum(t, values)
    if t == 0:
        sums[cuda.blockIdx.x, 0], sums[cuda.blockIdx.x, 1] = absolute, similarity


@cuda.jit
def _slopes(picture, target, active, tiles, window, derivatives, l1_scale, ssim_scale, gradient):
    """The gradient by active pixels, from the derivatives, which are zero where nothing is active."""
    planes = cuda.shared.array((3, _SIDE, _SIDE), float32)
    blurred = cuda.shared.array((3, _SIDE, TILE), float32)
    t, channel, tile = cuda.threadIdx.x, cuda.blockIdx.x // tiles.shape[0], tiles[cuda.blockIdx.x % tiles.shape[0]]
    height, width = picture.shape[1], picture.shape[2]
    y0, x0 = TILE * (tile // active.shape[1]), TILE * (tile % active.shape[1])
    for j in range(t, 3 * _SIDE * _SIDE, THREADS):
        plane, row, column = j // (_SIDE * _SIDE), j // _SIDE % _SIDE, j % _SIDE
        y, x = y0 - RADIUS + row, x0 - RADIUS + column
        value = _ZERO
        if 0 <= y < height and 0 <= x < width:
            value = derivatives[plane, channel, y, x]
        planes[plane, row, column] = value
    cuda.syncthreads()
    _blur_rows(t, planes, 3, window, blurred)
    cuda.syncthreads()
    row, column = t // TILE, t % TILE
    y, x = y0 + row, x0 + column
    if y < height and x < width:
        a, b = picture[channel, y, x], target[channel, y, x]
        slope = _blur_column(blurred, 0, row, column, window)
        slope += _TWO * a * _blur_column(blurred, 1, row, column, window)
        slope = ssim_scale * (slope + b * _blur_column(blurred, 2, row, column, window))
        if a > b:
            slope += l1_scale
        elif a < b:
            slope -= l1_scale
        gradient[channel, y, x] = slope
