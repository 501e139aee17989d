"""Whether foreground masks that come with a capture agree with what was measured to move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.footage import Views, foreground
from packuv.motion.cache import MotionCache
from packuv.motion.step import grown

SHIFTS = 0.03, 0.06
"""Distances in shares of the picture's width by which masks are moved to see whether they fit better there"""


@dataclass(frozen=True)
class Fit:
    """How much of what moves lies inside masks as they are, and where they are moved to."""

    inside_share: float
    """As they are, not grown"""
    shifted_share: float
    """Where they fit best among the places tried"""
    shift_px: tuple[int, int]
    """Columns and rows by which they are moved there, pixels of the fitted pictures"""


@dataclass(frozen=True)
class Agreement:
    """Of one camera's masks."""

    pictures: int
    """Of which a mask was read"""
    foreground_share: float
    """Of these pictures"""
    outside_share: float | None
    """Share of the moving pixels that lie in no mask of the step's two pictures; None where nothing moves"""
    fit: Fit | None
    """Likewise"""


def compare_masks(masks: Views, motion: MotionCache, camera: int) -> Agreement:
    """Read all masks of a camera, an index into those of `masks`, beside the measured motion of its pictures."""
    column, radius_px = motion.names.index(masks.names[camera]), motion.options.dilation_px
    width, shifts = motion.sizes[column][0], dict[tuple[int, int], int]()
    pictures, covered, moving, outside = 0, 0.0, 0, 0
    before = None
    for instant in range(len(masks)):
        pixels = masks.pixels(camera, instant, remember=False)
        if pixels is None:
            continue
        inside = foreground(pixels)
        pictures, covered = pictures + 1, covered + float(inside.mean())
        moved = motion.measured(column, instant)
        if moved is not None and before is not None:
            # what moved covers both places of a thing, as the two masks do together
            either = grown(inside | before, moved.shape[1], moved.shape[0], radius_px)
            moving, outside = moving + int(moved.sum()), outside + int((moved & ~either).sum())
            exact = grown(inside | before, moved.shape[1], moved.shape[0], 0)
            for shift in _shifts(moved.shape[1]):
                shifts[shift] = shifts.get(shift, 0) + _overlap(moved, exact, *shift)
            scale = width / moved.shape[1]
        before = inside
    if not moving:
        return Agreement(pictures, covered / max(1, pictures), None, None)
    x, y = max(shifts, key=lambda shift: shifts[shift])
    fit = Fit(shifts[0, 0] / moving, shifts[x, y] / moving, (round(scale * x), round(scale * y)))
    return Agreement(pictures, covered / pictures, outside / moving, fit)


def _shifts(width: int) -> list[tuple[int, int]]:
    """Columns and rows: none, and eight directions at each distance."""
    steps = [max(1, round(share * width)) for share in SHIFTS]
    around = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]
    return [(0, 0), *((step * x, step * y) for step in steps for x, y in around)]


def _overlap(moved: np.ndarray, mask: np.ndarray, x: int, y: int) -> int:
    """Moving pixels inside the mask when it is moved by x columns and y rows."""
    height, width = mask.shape
    there = mask[max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
    return int((moved[max(0, y) : height + min(0, y), max(0, x) : width + min(0, x)] & there).sum())
