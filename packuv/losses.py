"""Photometric loss of a picture against its target, value and gradient in one pass.

L = (1 - lambda) L1 + lambda (1 - SSIM), as in 3D Gaussian Splatting and the paper's §4.2: SSIM with an 11 x 11 Gaussian
window of sigma 1.5, zeros beyond the border, constants 0.01^2 and 0.03^2, mean over channels and pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange

from packuv.raster.cpu import prefer_tbb
from packuv.raster.project import TILE

RADIUS = 5
_WINDOW = 2 * RADIUS + 1
_STRIP = 6
"""Rows of tiles per piece of work. A piece computes 20 more rows than it owns, so short strips waste work; long ones
leave threads idle and, with few active tiles, cover pixels that nobody asked for."""
_f32 = np.float32
_weights = np.exp(-((np.arange(_WINDOW) - RADIUS) ** 2) / (2 * 1.5**2))
_KERNEL = (_weights / _weights.sum()).astype(np.float32)
_C1, _C2 = _f32(0.01**2), _f32(0.03**2)
_0, _1, _2 = _f32(0), _f32(1), _f32(2)
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "nogil": True,
    "fastmath": {"contract", "nsz", "arcp"},
}


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
) -> PhotometricLoss:
    """L1 and SSIM of a picture, and the gradient of their mix.

    `tiles` limits the loss to active tiles of 16 x 16 pixels: the means run over their pixels only, pixels elsewhere
    count as equal to the target where a window reaches them, and the gradient there is zero. `out` takes the gradient.
    Raises ValueError if shapes do not fit.
    """
    channels, height, width = _checked(picture, target)
    shape = (-(-height // TILE), -(-width // TILE))
    active = np.ones(shape, bool) if tiles is None else tiles
    if active.shape != shape or active.dtype != bool:
        raise ValueError(
            f"tiles must be bool {shape} for pictures {picture.shape}, but is {active.dtype} {active.shape}"
        )
    prefer_tbb()
    pieces = _pieces(active)
    sums = np.empty((channels * len(pieces), 2))
    gradient = np.empty_like(target) if out is None else out
    pixels = _pixel_count(active, height, width)
    scale = 1.0 / max(channels * pixels, 1)
    if tiles is not None:
        gradient[:] = 0
    _l1_ssim(picture, target, active.view(np.uint8), pieces, (1 - options.ssim_share) * scale,
             -options.ssim_share * scale, gradient, sums)  # fmt: skip
    l1, ssim = sums.sum(0) * scale if pixels else (0.0, 1.0)
    return PhotometricLoss((1 - options.ssim_share) * l1 + options.ssim_share * (1 - ssim), l1, ssim, gradient)


def _checked(picture: np.ndarray, target: np.ndarray) -> tuple[int, int, int]:
    if picture.shape != target.shape or picture.ndim != 3:
        raise ValueError(f"picture and target must both be [C, H, W], but are {picture.shape} and {target.shape}")
    for name, array in (("picture", picture), ("target", target)):
        if array.dtype != np.float32 or not array.flags.c_contiguous:
            raise ValueError(f"the {name} must be C-contiguous float32, but is {array.dtype}")
    return picture.shape


def _pixel_count(active: np.ndarray, height: int, width: int) -> int:
    """Pixels of the picture inside active tiles."""
    rows = np.minimum(TILE, height - TILE * np.arange(active.shape[0]))
    columns = np.minimum(TILE, width - TILE * np.arange(active.shape[1]))
    return int(rows @ active.astype(np.int64) @ columns)


def _pieces(active: np.ndarray) -> np.ndarray:
    """Rectangles of tiles [y0, y1, x0, x1), int64 [n, 4]: per strip, the runs of columns with an active tile."""
    pieces = []
    for y in range(0, active.shape[0], _STRIP):
        columns = np.concatenate([[False], active[y : y + _STRIP].any(0), [False]])
        edges = np.flatnonzero(columns[1:] != columns[:-1])
        pieces += [(y, min(y + _STRIP, active.shape[0]), x0, x1) for x0, x1 in edges.reshape(-1, 2)]
    return np.array(pieces, np.int64).reshape(-1, 4)


@njit(**_OPTIONS)
def _blur_row(source, out, count):
    """out[x] = sum of window[k] * source[x + k]; source has 10 values more."""
    w0, w1, w2, w3, w4, w5 = _KERNEL[0], _KERNEL[1], _KERNEL[2], _KERNEL[3], _KERNEL[4], _KERNEL[5]
    for x in range(count):
        out[x] = (
            w5 * source[x + 5] + w4 * (source[x + 4] + source[x + 6]) + w3 * (source[x + 3] + source[x + 7])
            + w2 * (source[x + 2] + source[x + 8]) + w1 * (source[x + 1] + source[x + 9])
            + w0 * (source[x] + source[x + 10])
        )  # fmt: skip


@njit(**_OPTIONS)
def _blur_column(ring, y, out, count):
    """out = sum over rows y - 5 .. y + 5 of a ring of 11 rows."""
    a0, b0 = ring[(y - 5) % 11], ring[(y + 5) % 11]
    a1, b1 = ring[(y - 4) % 11], ring[(y + 4) % 11]
    a2, b2 = ring[(y - 3) % 11], ring[(y + 3) % 11]
    a3, b3 = ring[(y - 2) % 11], ring[(y + 2) % 11]
    a4, b4, c = ring[(y - 1) % 11], ring[(y + 1) % 11], ring[y % 11]
    w0, w1, w2, w3, w4, w5 = _KERNEL[0], _KERNEL[1], _KERNEL[2], _KERNEL[3], _KERNEL[4], _KERNEL[5]
    for x in range(count):
        out[x] = (
            w5 * c[x] + w4 * (a4[x] + b4[x]) + w3 * (a3[x] + b3[x]) + w2 * (a2[x] + b2[x])
            + w1 * (a1[x] + b1[x]) + w0 * (a0[x] + b0[x])
        )  # fmt: skip


@njit(**_OPTIONS)
def _read_row(picture, target, active, y, x0, a, b, mask):
    """Row y from column x0 on: the target, the picture where active, and a 0/1 mask; zeros beyond the border."""
    for i in range(a.shape[0]):
        x = x0 + i
        a[i] = b[i] = mask[i] = _0
        if 0 <= x < target.shape[1] and 0 <= y < target.shape[0]:
            b[i] = target[y, x]
            mask[i] = _1 if active[y >> 4, x >> 4] != 0 else _0
            a[i] = picture[y, x] if mask[i] > _0 else b[i]


@njit(**_OPTIONS)
def _blur_products(a, b, product, rings, slot, count):
    """Blur a row of a, b, a a, b b and a b into their rings."""
    _blur_row(a, rings[0, slot], count)
    _blur_row(b, rings[1, slot], count)
    for x in range(a.shape[0]):
        product[x] = a[x] * a[x]
    _blur_row(product, rings[2, slot], count)
    for x in range(a.shape[0]):
        product[x] = b[x] * b[x]
    _blur_row(product, rings[3, slot], count)
    for x in range(a.shape[0]):
        product[x] = a[x] * b[x]
    _blur_row(product, rings[4, slot], count)


@njit(**_OPTIONS)
def _ssim_row(blurred, mask, derivatives, ssim):
    """SSIM of one row under the mask, and its derivatives by the blurs of a, a a and a b."""
    ma, mb, maa, mbb, mab = blurred[0], blurred[1], blurred[2], blurred[3], blurred[4]
    d_mean, d_square, d_product = derivatives[0], derivatives[1], derivatives[2]
    for x in range(mask.shape[0]):
        a, b = ma[x], mb[x]
        variances = max(maa[x] - a * a, _0) + max(mbb[x] - b * b, _0)  # rounding may leave them below zero
        a1, a2 = _2 * a * b + _C1, _2 * (mab[x] - a * b) + _C2
        b1, b2 = a * a + b * b + _C1, variances + _C2
        inverse = mask[x] / (b1 * b2)
        value = a1 * a2 * inverse
        to_product, to_square = _2 * a1 * inverse, -value / b2
        to_mean = _2 * b * a2 * inverse - _2 * a * value / b1
        d_mean[x] = to_mean - _2 * a * to_square - b * to_product
        d_square[x] = to_square
        d_product[x] = to_product
        ssim[x] = value


@njit(**_OPTIONS)
def _gradient_row(picture, target, mask, blurred, l1_scale, ssim_scale, out):
    """Gradient of one row where the mask is set; returns the row's absolute difference."""
    d_mean, d_square, d_product = blurred[0], blurred[1], blurred[2]
    total = _0
    for x in range(out.shape[0]):
        a, b = picture[x], target[x]
        difference = (a - b) * mask[x]
        total += abs(difference)
        sign = _1 if difference > _0 else (-_1 if difference < _0 else _0)
        ssim = d_mean[x] + _2 * a * d_square[x] + b * d_product[x]
        out[x] = l1_scale * sign + ssim_scale * ssim * mask[x]
    return total


@njit(**_OPTIONS)
def _piece(picture, target, active, y0, y1, x0, x1, l1_scale, ssim_scale, gradient):
    """One channel of one rectangle of pixels, row by row: products, SSIM five rows behind, gradient ten behind.

    Returns the sums of absolute differences and of SSIM. Rings hold the last 11 rows of each blur along x.
    """
    wide, owned = x1 - x0 + 2 * RADIUS, x1 - x0
    a, b = np.empty(wide + 2 * RADIUS, np.float32), np.empty(wide + 2 * RADIUS, np.float32)
    mask, product = np.empty(wide + 2 * RADIUS, np.float32), np.empty(wide + 2 * RADIUS, np.float32)
    rings, d_rings = np.zeros((5, _WINDOW, wide), np.float32), np.zeros((3, _WINDOW, owned), np.float32)
    masks, ssim = np.zeros((_WINDOW, wide), np.float32), np.empty(wide, np.float32)
    blurred, derivatives = np.empty((5, wide), np.float32), np.empty((3, wide), np.float32)
    absolute = similarity = 0.0
    for row in range(y0 - 2 * RADIUS, y1 + 2 * RADIUS):
        _read_row(picture, target, active, row, x0 - 2 * RADIUS, a, b, mask)
        masks[row % _WINDOW, :] = mask[RADIUS : RADIUS + wide]
        _blur_products(a, b, product, rings, row % _WINDOW, wide)
        y = row - RADIUS
        if y < y0 - RADIUS:
            continue
        for k in range(5):
            _blur_column(rings[k], y, blurred[k], wide)
        _ssim_row(blurred, masks[y % _WINDOW], derivatives, ssim)
        if y0 <= y < y1:
            similarity += ssim[RADIUS : RADIUS + owned].sum()
        for k in range(3):
            _blur_row(derivatives[k], d_rings[k, y % _WINDOW], owned)
        y = row - 2 * RADIUS
        if y >= y0:
            for k in range(3):
                _blur_column(d_rings[k], y, blurred[k], owned)
            absolute += _gradient_row(picture[y, x0:x1], target[y, x0:x1], masks[y % _WINDOW, RADIUS : RADIUS + owned],
                                      blurred, l1_scale, ssim_scale, gradient[y, x0:x1])  # fmt: skip
    return absolute, similarity


@njit(parallel=True, **_OPTIONS)
def _l1_ssim(picture, target, active, pieces, l1_scale, ssim_scale, gradient, sums):
    """All pieces of all channels; `sums` [channels * pieces, 2] receives absolute differences and SSIM."""
    channels, height, width = target.shape
    for job in prange(channels * len(pieces)):
        channel, piece = job % channels, pieces[job // channels]
        sums[job, 0], sums[job, 1] = _piece(
            picture[channel], target[channel], active,
            TILE * piece[0], min(TILE * piece[1], height), TILE * piece[2], min(TILE * piece[3], width),
            _f32(l1_scale), _f32(ssim_scale), gradient[channel],
        )  # fmt: skip
