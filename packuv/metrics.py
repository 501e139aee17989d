"""How close a picture is to the truth, by the field's definitions; tests hold them against scikit-image's."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from packuv.kernels.compile import kernel

_WINDOW, _EDGE = 11, 5
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2
LEAST_FRAMES = 30
"""Fewer frames show no trend"""


def psnr(picture: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio, dB, of pictures of one shape with values in [0, 1]; infinite where they are equal.

    Values beyond [0, 1] are clipped first, as a display would. Raises ValueError if the shapes differ.
    """
    _check_shapes(picture, truth)
    return decibels(float(np.mean((_clipped(picture) - _clipped(truth)) ** 2)))


def cut_out(picture: np.ndarray, mask: np.ndarray, *, least_px: int = _WINDOW) -> np.ndarray:
    """The box around what a mask, bool [H, W], covers of a picture [3, H, W], with black everywhere else.

    The box has sides of at least `least_px`, as far as the picture has. The mask must not be empty.
    """
    rows, columns = (_around(np.flatnonzero(mask.any(axis=axis)), mask.shape[1 - axis], least_px) for axis in (1, 0))
    return np.asarray(picture[:, rows, columns] * mask[rows, columns])


def _around(places: np.ndarray, size: int, least: int) -> slice:
    """From the first to the last of the places, or around them, within `size`."""
    first, stop = int(places[0]), int(places[-1]) + 1
    length = min(size, max(least, stop - first))
    first = min(max(0, (first + stop - length) // 2), size - length)
    return slice(first, first + length)


def decibels(squared_error: float) -> float:
    """PSNR, dB, of a mean squared error of values in [0, 1]; infinite for 0."""
    return float("inf") if squared_error == 0 else -10.0 * float(np.log10(squared_error))


def ssim(picture: np.ndarray, truth: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of pictures [3, H, W] or [H, W] with values in [0, 1].

    Gaussian window 11 x 11, sigma 1.5, constants 0.01^2 and 0.03^2, population variances, in float64. The mean runs
    over channels and over the pixels whose window lies inside the picture, so no border rule enters: as scikit-image
    does with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`, and torchmetrics does by default. The
    loss of 3D Gaussian Splatting pads with zeros instead and differs by some 1e-3. Values are clipped to [0, 1]
    first. Raises ValueError if the shapes differ or the picture is smaller than the window.
    """
    return likenesses([picture], truth)[0][1]


def likenesses(pictures: Sequence[np.ndarray], truth: np.ndarray) -> list[tuple[float, float]]:
    """`psnr` and `ssim` of several pictures beside one truth, whose own means and variances are computed once."""
    for picture in pictures:
        _check_shapes(picture, truth)
    if truth.ndim not in (2, 3) or min(truth.shape[-2:]) < _WINDOW:
        raise ValueError(
            f"SSIM needs pictures [3, H, W] or [H, W] of at least {_WINDOW} pixels a side, not {truth.shape}"
        )
    planes = [picture.reshape(-1, *truth.shape[-2:]) for picture in (truth, *pictures)]
    similar, wrong = np.empty((len(pictures), len(planes[0]))), np.empty((len(pictures), *planes[0].shape))
    a, square, product = np.empty((3, *truth.shape[-2:]))
    for channel, (plane, *others) in enumerate(zip(*planes, strict=True)):
        b = _clipped(plane)
        mean_b, square_b = _blur(b), _blur(b * b)
        for row, other in enumerate(others):
            _multiply(other, b, a, square, product, wrong[row, channel])
            similar[row, channel] = _ssim(_blur(a), mean_b, _blur(square), square_b, _blur(product))
    return [(decibels(float(np.mean(w))), float(row.mean())) for w, row in zip(wrong, similar, strict=True)]


def trend(frames: Sequence[int], levels: Sequence[float]) -> float | None:
    """Slope of a line through the levels by least squares, per 100 frames; None for fewer than `LEAST_FRAMES` levels.

    >>> round(trend(range(50), [30 - 0.01 * frame for frame in range(50)]), 6)
    -1.0
    """
    if len(levels) < LEAST_FRAMES:
        return None
    at = np.asarray(frames, np.float64) - np.mean(frames)
    return 100 * float(at @ np.asarray(levels, np.float64) / (at @ at))


def _check_shapes(picture: np.ndarray, truth: np.ndarray) -> None:
    if picture.shape != truth.shape:
        raise ValueError(f"pictures to compare must have one shape, but have {picture.shape} and {truth.shape}")


def _clipped(picture: np.ndarray) -> np.ndarray:
    clipped: np.ndarray = np.clip(picture, 0, 1).astype(np.float64)
    return clipped


def _ssim(
    mean_a: np.ndarray, mean_b: np.ndarray, square_a: np.ndarray, square_b: np.ndarray, product: np.ndarray
) -> float:
    """Mean SSIM where the window lies inside, from means over windows, float64 [H, W] each."""
    similarity = np.empty((mean_a.shape[0] - 2 * _EDGE, mean_a.shape[1] - 2 * _EDGE))
    _compare(mean_a, mean_b, square_a, square_b, product, similarity)
    return float(similarity.mean())


def _blur(plane: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(plane, (_WINDOW, _WINDOW), _SIGMA)


@kernel()
def _multiply(picture, b, a, square, product, wrong):
    """The picture, clipped, its square, its product with b, and the square of its difference from b."""
    for y in range(b.shape[0]):
        for x in range(b.shape[1]):
            given = np.float64(picture[y, x])
            value = 0.0 if given < 0 else 1.0 if given > 1 else given
            a[y, x], square[y, x], product[y, x] = value, value * value, value * b[y, x]
            wrong[y, x] = (value - b[y, x]) * (value - b[y, x])


@kernel()
def _compare(mean_a, mean_b, square_a, square_b, product, out):
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            at = y + _EDGE, x + _EDGE
            a, b = mean_a[at], mean_b[at]
            variance_a, variance_b, covariance = square_a[at] - a * a, square_b[at] - b * b, product[at] - a * b
            luminance = (2 * a * b + _C1) / (a * a + b * b + _C1)
            out[y, x] = luminance * (2 * covariance + _C2) / (variance_a + variance_b + _C2)
