"""Depths that are known in some pixels, and the loss by which a rendering keeps to them (paper §4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COVERED = 0.5
"""Alpha from which on the depth of a pixel counts"""


@dataclass(frozen=True)
class SparseDepth:
    """Depths along a camera's z axis that are known in some pixels."""

    pixels: np.ndarray
    """int64 [P], row * width + column"""
    depth: np.ndarray
    """float32 [P], world units"""


def depth_loss(
    depth: np.ndarray,  # float32 [H, W], sum of weight times z
    alpha: np.ndarray,  # float32 [H, W]
    known: SparseDepth,
    *,
    scale: float,
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mean |depth / alpha - known| in units of `scale`, and its derivatives by `depth` and `alpha`, [H, W] each.

    Pixels that are less than half covered do not count (paper §4.2: sparse structure-from-motion depth).
    """
    d_depth, d_alpha = np.zeros_like(depth), np.zeros_like(alpha)
    covered = alpha.ravel()[known.pixels] > COVERED
    pixels, wanted = known.pixels[covered], known.depth[covered]
    if not len(pixels):
        return 0.0, d_depth, d_alpha
    share = alpha.ravel()[pixels]
    mean = depth.ravel()[pixels] / share
    error = (mean - wanted) / np.float32(scale)
    slope = np.sign(error) / np.float32(len(pixels) * scale)
    np.add.at(d_depth.ravel(), pixels, slope / share)
    np.add.at(d_alpha.ravel(), pixels, -slope * mean / share)
    return float(np.abs(error).mean()), d_depth, d_alpha
