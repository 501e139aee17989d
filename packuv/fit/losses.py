"""Photometric loss of a picture against its target, value and gradient in one pass.

L = (1 - lambda) L1 + lambda (1 - SSIM), as in 3D Gaussian Splatting and the paper's §4.2: SSIM with an 11 x 11 Gaussian
window of sigma 1.5, zeros beyond the border, constants 0.01^2 and 0.03^2, mean over channels and pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange

from packuv.fit.ssim import C1, C2, RADIUS, WINDOW
from packuv.kernels.compile import kernel, prefer_tbb
from packuv.kernels.simd import ALL, WIDTH, above, fma, larger, load, select, splat, store, sum_lanes, zeros
from packuv.raster.view import TILE

_LENGTH = 2 * RADIUS + 1
_STRIP = 6
"""Rows of tiles per piece of work. A piece computes 20 more rows than it owns, so short strips waste work; long ones
leave threads idle and, with few active tiles, cover pixels that nobody asked for."""
_f32 = np.float32
_0, _1, _2 = _f32(0), _f32(1), _f32(2)


@dataclass(frozen=True)
class PhotometricOptions:
    ssim_share: float = 0.2
    """lambda: weight of 1 - SSIM; the rest goes to L1. 3D Gaussian Splatting's value."""

    def __post_init__(self) -> None:
        if not 0 <= self.ssim_share <= 1:
            raise ValueError(f"the share of SSIM must lie in [0, 1], but is {self.ssim_share}")


@dataclass(frozen=True)
class PhotometricLoss:
    value: float
    """The loss"""
    l1: float
    """Mean absolute difference"""
    ssim: float
    """Mean SSIM"""
    gradient: np.ndarray
    """float32 [3, H, W], derivative of the value by the picture"""


def photometric_loss(
    picture: np.ndarray,  # float32 [3, H, W], in [0, 1]
    target: np.ndarray,  # float32 [3, H, W]
    *,
    options: PhotometricOptions,
    tiles: np.ndarray | None = None,  # bool [tiles_y, tiles_x]
    out: np.ndarray | None = None,  # float32 [3, H, W]
    device: str = "cpu",
) -> PhotometricLoss:
    """L1 and SSIM of a picture, and the gradient of their mix.

    `tiles` limits the loss to active tiles of 16 x 16 pixels: the means run over their pixels only, pixels elsewhere
    count as equal to the target where a window reaches them, and the gradient there is zero. `out` takes the gradient.
    `device`, cpu or cuda, tells who compares. Raises ValueError if shapes do not fit.
    """
    channels, height, width = _checked(picture, target)
    shape = (-(-height // TILE), -(-width // TILE))
    active = np.ones(shape, bool) if tiles is None else tiles
    if active.shape != shape or active.dtype != bool:
        raise ValueError(
            f"tiles must be bool {shape} for pictures {picture.shape}, but is {active.dtype} {active.shape}"
        )
    gradient = np.empty_like(target) if out is None else out
    pixels = pixel_count(active, height, width)
    scale = 1.0 / max(channels * pixels, 1)
    scales = (1 - options.ssim_share) * scale, -options.ssim_share * scale
    if tiles is not None:
        gradient[:] = 0
    compare = _compare_on_cpu if device == "cpu" else _compare_on_gpu
    l1, ssim = compare(picture, target, active, *scales, gradient) * scale if pixels else (0.0, 1.0)
    return PhotometricLoss((1 - options.ssim_share) * l1 + options.ssim_share * (1 - ssim), l1, ssim, gradient)


def _compare_on_cpu(
    picture: np.ndarray, target: np.ndarray, active: np.ndarray, l1_scale: float, ssim_scale: float, out: np.ndarray
) -> np.ndarray:  # float64 [2]
    """Sums of absolute differences and of SSIM over active pixels; `out` takes the gradient of both, scaled."""
    prefer_tbb()
    pieces = _pieces(active, picture.shape[2], picture.shape[1])
    sums = np.empty((len(picture) * len(pieces), 2))
    _l1_ssim(picture.reshape(-1), target.reshape(-1), active.view(np.uint8), pieces, l1_scale, ssim_scale,
             out.reshape(-1), sums)  # fmt: skip
    return np.asarray(sums.sum(0))


def _compare_on_gpu(
    picture: np.ndarray, target: np.ndarray, active: np.ndarray, l1_scale: float, ssim_scale: float, out: np.ndarray
) -> np.ndarray:  # float64 [2]
    """The same by CUDA; imported late, for it needs torch."""
    from packuv.fit.losses_cuda import compare_on_gpu

    absolute, similarity, out[:] = compare_on_gpu(picture, target, active, l1_scale, ssim_scale)
    return np.array([absolute, similarity])


def _checked(picture: np.ndarray, target: np.ndarray) -> tuple[int, int, int]:
    if picture.shape != target.shape or picture.ndim != 3:
        raise ValueError(f"picture and target must both be [C, H, W], but are {picture.shape} and {target.shape}")
    for name, array in (("picture", picture), ("target", target)):
        if array.dtype != np.float32 or not array.flags.c_contiguous:
            raise ValueError(f"the {name} must be C-contiguous float32, but is {array.dtype}")
    return picture.shape


def pixel_count(active: np.ndarray, height: int, width: int) -> int:
    """Pixels of the picture inside active tiles."""
    rows = np.minimum(TILE, height - TILE * np.arange(active.shape[0]))
    columns = np.minimum(TILE, width - TILE * np.arange(active.shape[1]))
    return int(rows @ active.astype(np.int64) @ columns)


def _pieces(active: np.ndarray, width: int, height: int) -> np.ndarray:
    """Rectangles of pixels y0, y1, x0, x1, then width and height, int64 [n, 6].

    They are the runs of columns that have an active tile, in each strip of the picture.
    """
    pieces = []
    for y in range(0, active.shape[0], _STRIP):
        columns = np.concatenate([[False], active[y : y + _STRIP].any(0), [False]])
        for x0, x1 in np.flatnonzero(columns[1:] != columns[:-1]).reshape(-1, 2):
            rows, run = (y, min(y + _STRIP, active.shape[0])), (x0, x1)
            pieces.append((*(min(TILE * v, height) for v in rows), *(min(TILE * v, width) for v in run), width, height))
    return np.array(pieces, np.int64).reshape(-1, 6)


# Kernels work on one flat piece of memory, since every array costs Numba compile time. `stride` is the length of a row.


@kernel(inner=True)
def _blur_row(memory, source, out, stride):
    """memory[out + x] = sum of window[k] * memory[source + x + k]; the source has ten values more."""
    w0, w1, w2 = splat(WINDOW[0]), splat(WINDOW[1]), splat(WINDOW[2])
    w3, w4, w5 = splat(WINDOW[3]), splat(WINDOW[4]), splat(WINDOW[5])
    for x in range(source, source + stride, WIDTH):
        total = w5 * load(memory, x + 5)
        total = fma(w4, load(memory, x + 4) + load(memory, x + 6), total)
        total = fma(w3, load(memory, x + 3) + load(memory, x + 7), total)
        total = fma(w2, load(memory, x + 2) + load(memory, x + 8), total)
        total = fma(w1, load(memory, x + 1) + load(memory, x + 9), total)
        store(memory, out + x - source, fma(w0, load(memory, x) + load(memory, x + 10), total))


@kernel(inner=True)
def _blur_column(memory, ring, y, out, stride):
    """Sum of window[k] times row y - 5 + k of a ring of 11 rows."""
    w0, w1, w2 = splat(WINDOW[0]), splat(WINDOW[1]), splat(WINDOW[2])
    w3, w4, w5 = splat(WINDOW[3]), splat(WINDOW[4]), splat(WINDOW[5])
    a0, b0 = ring + (y - 5) % _LENGTH * stride, ring + (y + 5) % _LENGTH * stride
    a1, b1 = ring + (y - 4) % _LENGTH * stride, ring + (y + 4) % _LENGTH * stride
    a2, b2 = ring + (y - 3) % _LENGTH * stride, ring + (y + 3) % _LENGTH * stride
    a3, b3 = ring + (y - 2) % _LENGTH * stride, ring + (y + 2) % _LENGTH * stride
    a4, b4 = ring + (y - 1) % _LENGTH * stride, ring + (y + 1) % _LENGTH * stride
    c = ring + y % _LENGTH * stride
    for x in range(0, stride, WIDTH):
        total = w5 * load(memory, c + x)
        total = fma(w4, load(memory, a4 + x) + load(memory, b4 + x), total)
        total = fma(w3, load(memory, a3 + x) + load(memory, b3 + x), total)
        total = fma(w2, load(memory, a2 + x) + load(memory, b2 + x), total)
        total = fma(w1, load(memory, a1 + x) + load(memory, b1 + x), total)
        store(memory, out + x, fma(w0, load(memory, a0 + x) + load(memory, b0 + x), total))


@kernel(inner=True)
def _read_row(picture, target, active, base, x0, x1, memory, row, step):
    """Columns x0 to x1, inside the picture, of the row at flat element `base`, into five rows of `memory`.

    They are a, the picture where active, else the target; b, the target; a a + b b; a b; the mask, 0 or 1.
    """
    for tile in range(x0 // TILE, -(-x1 // TILE)):
        on = active[tile] != 0
        x = TILE * tile
        if x >= x0 and x + TILE <= x1:
            b = load(target, base + x)
            a = load(picture, base + x) if on else b
            at = row + x - x0
            store(memory, at, a)
            store(memory, at + step, b)
            store(memory, at + 2 * step, fma(a, a, b * b))
            store(memory, at + 3 * step, a * b)
            store(memory, at + 4 * step, splat(_1 if on else _0))
            continue
        for i in range(max(x, x0), min(x + TILE, x1)):
            v = target[base + i]
            u = picture[base + i] if on else v
            at = row + i - x0
            memory[at], memory[at + step], memory[at + 2 * step], memory[at + 3 * step] = u, v, u * u + v * v, u * v
            memory[at + 4 * step] = _1 if on else _0


@kernel(inner=True)
def _ssim_row(memory, blurred, mask, owned, derivatives, step, stride):
    """SSIM of one row under the mask, and its derivatives by the blurs of a, of a a + b b and of a b.

    `blurred` begins four rows of `stride`: a, b, a a + b b, a b; `derivatives` three rows of `step`. Returns the sum
    where the row `owned` is 1.
    """
    one, two, c1, c2, zero, total = splat(_1), splat(_2), splat(C1), splat(C2), zeros(ALL), zeros(ALL)
    for x in range(0, stride, WIDTH):
        a, b = load(memory, blurred + x), load(memory, blurred + stride + x)
        squares, product = load(memory, blurred + 2 * stride + x), load(memory, blurred + 3 * stride + x)
        both = a * b
        power = fma(a, a, b * b)
        a1, a2 = fma(two, both, c1), fma(two, product - both, c2)
        b1, b2 = power + c1, larger(squares - power, zero) + c2  # rounding may leave a variance below zero
        inverse = one / (b1 * b2)
        factor = inverse * load(memory, mask + x)
        ssim = a1 * a2 * factor
        total = fma(ssim, load(memory, owned + x), total)
        to_square, to_product = zero - ssim * b1 * inverse, two * a1 * factor
        to_mean = two * (b * a2 * factor - a * ssim * b2 * inverse)
        store(memory, derivatives + x, to_mean - two * a * to_square - b * to_product)
        store(memory, derivatives + step + x, to_square)
        store(memory, derivatives + 2 * step + x, to_product)
    return sum_lanes(total)


@kernel(inner=True)
def _gradient_row(memory, row, step, blurred, owned, stride, l1_scale, ssim_scale):
    """Gradient of one row, in place of the first of its three `blurred` rows.

    Returns the absolute difference where the row `owned` is 1. `row` is the first of the rows read.
    """
    zero, two, plus, minus = zeros(ALL), splat(_2), splat(l1_scale), splat(-l1_scale)
    scale, total = splat(ssim_scale), zeros(ALL)
    for x in range(0, stride, WIDTH):
        a, b, on = load(memory, row + x), load(memory, row + step + x), load(memory, row + 4 * step + x)
        difference = (a - b) * on
        total = fma(larger(difference, zero - difference), load(memory, owned + x), total)
        sign = select(above(difference, zero), plus, select(above(zero, difference), minus, zero))
        d_square, d_product = load(memory, blurred + stride + x), load(memory, blurred + 2 * stride + x)
        ssim = fma(two * a, d_square, fma(b, d_product, load(memory, blurred + x)))
        store(memory, blurred + x, fma(scale * on, ssim, sign))
    return sum_lanes(total)


@kernel(inner=True)
def _piece(picture, target, active, width, height, y0, y1, x0, x1, l1_scale, ssim_scale, gradient):
    """One channel of one rectangle of pixels, row by row: products, SSIM five rows behind, gradient ten behind.

    Returns the sums of absolute differences and of SSIM. Rings hold the last 11 rows: those read, with ten columns
    more than the rectangle on either side, their blurs along x, with five, and the blurs of the derivatives.
    """
    count = x1 - x0
    stride = (count + 2 * RADIUS + WIDTH - 1) // WIDTH * WIDTH
    step, ring = stride + 2 * WIDTH, _LENGTH * stride
    derivatives = 5 * _LENGTH * step
    owned = derivatives + 3 * step
    rings = owned + step
    blurred = rings + 7 * ring
    memory = np.zeros(blurred + 4 * stride, np.float32)
    memory[owned + RADIUS : owned + RADIUS + count] = _1
    absolute, similarity = np.float64(0), np.float64(0)
    for row in range(y0 - 2 * RADIUS, y1 + 2 * RADIUS):
        read = row % _LENGTH * 5 * step
        if 0 <= row < height:
            begin, end = max(x0 - 2 * RADIUS, 0), min(x1 + 2 * RADIUS, width)
            _read_row(picture, target, active[row // TILE], row * width, begin, end, memory,
                      read + begin - x0 + 2 * RADIUS, step)  # fmt: skip
        else:
            memory[read : read + 5 * step] = _0
        for k in range(4):
            _blur_row(memory, read + k * step, rings + k * ring + row % _LENGTH * stride, stride)
        y = row - RADIUS
        if y < y0 - RADIUS:
            continue
        for k in range(4):
            _blur_column(memory, rings + k * ring, y, blurred + k * stride, stride)
        mask = (y % _LENGTH * 5 + 4) * step + RADIUS
        total = _ssim_row(memory, blurred, mask, owned, derivatives, step, stride)
        similarity += total if y0 <= y < y1 else _0
        for k in range(3):
            _blur_row(memory, derivatives + k * step, rings + (4 + k) * ring + y % _LENGTH * stride, stride)
        y = row - 2 * RADIUS
        if y >= y0:
            for k in range(3):
                _blur_column(memory, rings + (4 + k) * ring, y, blurred + k * stride, stride)
            read = y % _LENGTH * 5 * step + 2 * RADIUS
            absolute += _gradient_row(memory, read, step, blurred, owned + RADIUS, stride, l1_scale, ssim_scale)
            for x in range(count):
                gradient[y * width + x0 + x] = memory[blurred + x]
    return absolute, similarity


@kernel(parallel=True)
def _l1_ssim(picture, target, active, pieces, l1_scale, ssim_scale, gradient, sums):
    """All pieces of all channels of flat pictures; `sums` [channels * pieces, 2]: absolute differences and SSIM.

    `pieces` [n, 6] are rectangles of pixels y0, y1, x0, x1, then the width and height of the picture.
    """
    for job in prange(sums.shape[0]):
        y0, y1, x0, x1, width, height = pieces[job % len(pieces)]
        begin = job // len(pieces) * width * height
        end = begin + width * height
        sums[job, 0], sums[job, 1] = _piece(
            picture[begin:end], target[begin:end], active, width, height, y0, y1, x0, x1, _f32(l1_scale),
            _f32(ssim_scale), gradient[begin:end],
        )  # fmt: skip
