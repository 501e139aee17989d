"""sRGB and linear light, both in [0, 1] (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """sRGB of linear light."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


LINEAR = linear_from_srgb(np.arange(256) / 255).astype(np.float32)
"""Linear light of 8-bit values, float32 [256]"""
