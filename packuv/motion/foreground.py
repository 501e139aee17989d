"""Whether foreground masks that come with a capture agree with what was measured to move."""

from __future__ import annotations

from dataclasses import dataclass

from packuv.footage import Views, foreground
from packuv.motion.cache import MotionCache
from packuv.motion.step import grown


@dataclass(frozen=True)
class Agreement:
    """Of one camera's masks."""

    pictures: int
    """Of which a mask was read"""
    foreground_share: float
    """Of these pictures"""
    outside_share: float | None
    """Share of the moving pixels that lie in no mask of the step's two pictures; None where nothing moves"""


def compare_masks(masks: Views, motion: MotionCache, camera: int) -> Agreement:
    """Read all masks of a camera, an index into those of `masks`, beside the measured motion of its pictures."""
    column, radius_px = motion.names.index(masks.names[camera]), motion.options.dilation_px
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
        before = inside
    return Agreement(pictures, covered / max(1, pictures), outside / moving if moving else None)
