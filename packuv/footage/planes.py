"""Pictures as bytes and as planes of floats."""

from __future__ import annotations

import numpy as np
from numba import prange

from packuv.kernels.compile import kernel, prefer_tbb

_LEVELS = np.arange(256, dtype=np.float32) / np.float32(255)


def as_planes(pixels: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] as float32 [3, H, W] in [0, 1]."""
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"pixels must be uint8 [H, W, 3], but are {pixels.dtype} {pixels.shape}")
    prefer_tbb()
    planes = np.empty((3, *pixels.shape[:2]), np.float32)
    _split(np.ascontiguousarray(pixels), _LEVELS, planes)
    return planes


@kernel(parallel=True)
def _split(pixels, levels, planes):
    for y in prange(pixels.shape[0]):
        for x in range(pixels.shape[1]):
            for c in range(3):
                planes[c, y, x] = levels[pixels[y, x, c]]
