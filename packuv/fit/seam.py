"""How much the border between two segments shows.

What blinks in the render but not in the pictures is the change of their difference from one instant to the next: motion
that render and truth share cancels, so no optical flow is needed to compensate it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from packuv.fit.keyframe import DEAD_CODE, KeyState
from packuv.footage import Views
from packuv.gaussians.codes import OPACITY
from packuv.gaussians.floats import Gaussians
from packuv.gaussians.segment import Segment
from packuv.raster import Arena, RasterOptions, render


def seam(key: KeyState, segment: Segment, after: KeyState, views: Views) -> float:
    """Flicker from the segment's last frame to the keyframe `after`, over that between its last two frames.

    1 is seamless; NaN where no camera filmed these instants or nothing flickers. `segment` is that of `key` and has two
    frames at least.
    """
    if len(segment) < 2:
        raise ValueError("a seam is compared with the flicker inside the segment before it, which has one frame")
    last = segment.first + len(segment) - 1
    codes = [segment.frame(len(segment) - 2), segment.frame(len(segment) - 1), key.quantizer.encode(after.gaussians)]
    shown = [key.quantizer.decode(part) for part in codes]
    arena, inside, across = Arena(), [], []
    for index in range(len(views.cameras)):
        before, middle, border = (
            _error(gaussians, views, index, instant, key.bounds.near, arena)
            for gaussians, instant in zip(shown, (last - 1, last, last + 1), strict=True)
        )
        if before is not None and middle is not None and border is not None:
            inside.append(np.abs(middle - before).mean())
            across.append(np.abs(border - middle).mean())
    usual = float(np.mean(inside)) if inside else 0.0
    return float(np.mean(across)) / usual if usual else float("nan")


def tail(key: KeyState, segment: Segment) -> KeyState:
    """The state at a segment's last frame, without the rows that are empty there: a fit can go on from it."""
    codes = segment.frame(len(segment) - 1)
    living = codes[codes.attributes[:, OPACITY] > DEAD_CODE]
    instant = segment.first + len(segment) - 1
    return replace(key, instant=instant, gaussians=key.quantizer.decode(living), figures={})


def _error(
    gaussians: Gaussians, views: Views, index: int, instant: int, near: float, arena: Arena
) -> np.ndarray | None:
    """Render minus picture, float32 [3, H, W]; None where the camera has no picture."""
    filmed = views.filmed(index, instant)
    if filmed is None:
        return None
    drawn = render(gaussians, views.cameras[index], options=RasterOptions(near), arena=arena)
    return np.asarray(views.response(index, instant).shown(drawn.colour) - filmed)
