"""sRGB, as pictures hold it, and linear light, in which gains multiply. In [0, 1], of any shape and precision."""

from __future__ import annotations

import numpy as np

GAMMA = 2.4
OFFSET = 0.055
"""Of sRGB's curve: but for the darkest tones, a factor k on light is k ^ (1 / GAMMA) on sRGB + OFFSET"""


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, in their precision."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """sRGB values of linear light, in its precision; light beyond [0, 1] is cut off."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def light_factors(light: np.ndarray) -> np.ndarray:
    """What light, natural logarithms of factors on linear light, makes of sRGB + OFFSET: float64 of its shape."""
    return np.exp(np.asarray(light, np.float64) / GAMMA)


def lit(picture: np.ndarray, light: np.ndarray) -> np.ndarray:
    """A picture drawn in steady light as it is seen in `light`, natural logarithms [3] by channel.

    Both pictures are float32 [3, H, W], sRGB; what is too bright or too dark for a picture is not cut off.
    """
    if not np.any(light):
        return picture
    factor, offset = light_factors(light).astype(np.float32)[:, None, None], np.float32(OFFSET)
    return factor * (picture + offset) - offset
