"""sRGB of 8 bits and linear light in [0, 1] (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np

LINEAR = np.array(
    [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in np.arange(256) / 255], dtype=np.float32
)
"""Linear light of 8-bit values, float32 [256]"""


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear light."""
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    coded: np.ndarray = np.rint(np.clip(curved, 0, 1) * 255).astype(np.uint8)
    return coded
