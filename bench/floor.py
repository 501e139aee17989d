"""The least that codes of noisy Gaussians can cost: entropy of the noise alone, for one who knows everything else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from packuv.gaussians.codes import ROTATION, Quantizer, attribute_values
from packuv.gaussians.floats import Gaussians

WIDE = 6.0
"""Steps of standard deviation from which rounding is noise of variance 1 / 12, to 1e-5 bits, away from the ends"""
TAIL = 6
"""Standard deviations that are summed on either side"""
PART = 100_000
"""Values at a time"""


def noise_bits(expected: Gaussians, sigma: Sequence[np.ndarray | float], quantizer: Quantizer) -> np.ndarray:
    """Entropy of the codes of each Gaussian, bits [n], where every value has Gaussian noise about what is expected.

    `sigma` are standard deviations in the order of the fields of Gaussians, [n, 1] or for all. Of unit quaternions the
    noise is taken to first order, and x, y, z one after the other, each given those before.
    """
    means, scales, rotations, opacities, colours = sigma
    centre, unit, edge, low, per_step = quantizer.scale
    offset = (expected.means - centre) / unit
    place = (np.sign(offset) * np.log1p(np.abs(offset)) / edge + 1) * 32767.5
    spread = means / (unit * (1 + np.abs(offset)) * edge) * 32767.5
    values = (attribute_values(expected) - low) * per_step
    widths = np.empty_like(values)
    for columns, width in ((slice(0, 3), scales), (slice(6, 7), opacities), (slice(7, None), colours)):
        widths[:, columns] = width
    widths[:, ROTATION] = _rotation_widths(expected.quaternions, float(rotations))
    parts = rounded_bits(place, spread, 65535), rounded_bits(values, widths * per_step, 255)
    return np.asarray(np.concatenate(parts, axis=1).sum(axis=1))


def _rotation_widths(quaternions: np.ndarray, sigma: float) -> np.ndarray:
    """Standard deviations [n, 3] of x, of y given x, and of z given both, of what is made a unit quaternion."""
    length = np.linalg.norm(quaternions, axis=1)[:, None]
    axes = (quaternions / length)[:, 1:].astype(np.float64)
    covariance = np.eye(3) * (1 + 1e-9) - axes[:, :, None] * axes[:, None]  # of noise across the quaternion; w may be 0
    widths = np.diagonal(np.linalg.cholesky(covariance), axis1=1, axis2=2)
    return np.asarray(widths * sigma / length)


def rounded_bits(mean: np.ndarray, sigma: np.ndarray, most: int) -> np.ndarray:
    """Entropy, bits, of Gaussian values that are rounded to 0, 1, ... most, each on its own; shape of `mean`."""
    middle = mean.astype(np.float64).ravel()
    width = np.maximum(np.broadcast_to(sigma, mean.shape).ravel().astype(np.float64), 1e-9)
    bits: np.ndarray = np.log2(2 * np.pi * np.e * (width**2 + 1 / 12)) / 2
    ends = (middle < TAIL * width) | (middle > most - TAIL * width)
    summed = np.flatnonzero((width < WIDE) | ends)
    summed = summed[np.argsort(width[summed])]  # so that a part needs no more codes than its values do
    for part in np.array_split(summed, -(-len(summed) // PART)) if len(summed) else []:
        bits[part] = _summed(middle[part, None], width[part, None], most)
    return bits.reshape(mean.shape)


def _summed(middle: np.ndarray, width: np.ndarray, most: int) -> np.ndarray:
    reach = int(np.ceil(TAIL * width.max())) + 1
    edges = np.clip(np.rint(middle), 0, most) + (np.arange(-reach, reach + 2) - 0.5)  # below each code, and the last's
    below = ndtr((edges - middle) / width)
    below[edges < 0], below[edges > most] = 0, 1
    share = np.diff(below, axis=1)
    bits: np.ndarray = -(share * np.log2(np.maximum(share, 1e-300))).sum(axis=1)
    return bits
