"""How close a picture is to the truth, by the field's definitions; tests hold them against scikit-image's."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

_WINDOW = 11
_SIGMA = 1.5
LEAST_FRAMES = 30
"""Fewer frames show no trend"""


def psnr(picture: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio, dB, of pictures of one shape with values in [0, 1]; infinite where they are equal.

    Values beyond [0, 1] are clipped first, as a display would. Raises ValueError if the shapes differ.
    """
    a, b = _clipped(picture, truth)
    return decibels(float(np.mean((a - b) ** 2)))


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
    a, b = _clipped(picture, truth)
    if a.ndim not in (2, 3) or min(a.shape[-2:]) < _WINDOW:
        raise ValueError(f"SSIM needs pictures [3, H, W] or [H, W] of at least {_WINDOW} pixels a side, not {a.shape}")
    planes = zip(a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:]), strict=True)
    return float(np.mean([_ssim_map(x, y).mean() for x, y in planes]))


def trend(frames: Sequence[int], levels: Sequence[float]) -> float | None:
    """Slope of a line through the levels by least squares, per 100 frames; None for fewer than `LEAST_FRAMES` levels.

    >>> round(trend(range(50), [30 - 0.01 * frame for frame in range(50)]), 6)
    -1.0
    """
    if len(levels) < LEAST_FRAMES:
        return None
    at = np.asarray(frames, np.float64) - np.mean(frames)
    return 100 * float(at @ np.asarray(levels, np.float64) / (at @ at))


def _clipped(picture: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if picture.shape != truth.shape:
        raise ValueError(f"pictures to compare must have one shape, but have {picture.shape} and {truth.shape}")
    return np.clip(picture, 0, 1).astype(np.float64), np.clip(truth, 0, 1).astype(np.float64)


def _ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM where the window lies inside, float64 [H - 10, W - 10]."""
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = _blur(a), _blur(b)
    variance_a, variance_b = _blur(a * a) - mean_a**2, _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    similarity: np.ndarray = luminance * (2 * covariance + c2) / (variance_a + variance_b + c2)
    return similarity


def _blur(plane: np.ndarray) -> np.ndarray:
    edge = _WINDOW // 2
    return cv2.GaussianBlur(plane, (_WINDOW, _WINDOW), _SIGMA)[edge:-edge, edge:-edge]
