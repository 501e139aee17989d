"""sRGB, as pictures hold it, and linear light, in which gains multiply. In [0, 1], of any shape and precision."""

from __future__ import annotations

import numpy as np


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, in their precision."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """sRGB values of linear light, in its precision; light beyond [0, 1] is cut off."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
