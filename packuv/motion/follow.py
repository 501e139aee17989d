"""A camera's pictures, filmed and rendered, from each to the next: what moves in the one, and how the other moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.motion.step import MotionOptions, grey, grown, measure_step, optical_flow

OPTIONS = MotionOptions()
"""Those of every score, whatever a run's own are, so that scores of different runs compare"""


@dataclass(frozen=True)
class Change:
    """From the picture before to this one."""

    moving: np.ndarray
    """bool [H, W]: what moved in the filmed pictures, where it was and where it is"""
    tof_px: float
    """Mean length of the difference between the optical flow of the filmed pictures and that of the rendered ones"""


class Follower:
    """Follows one camera, whose pictures come in order."""

    def __init__(self) -> None:
        self._before: tuple[np.ndarray, np.ndarray] | None = None

    def step(self, filmed: np.ndarray, render: np.ndarray) -> Change | None:
        """The change to the next picture, uint8 [H, W, 3] both, in steady light; None for the first one."""
        before, now = self._before, (grey(filmed), grey(render))
        self._before = now
        if before is None:
            return None
        height, width = now[0].shape
        truth = measure_step(before[0], now[0], OPTIONS)
        apart = truth.optical_flow - optical_flow(before[1], now[1], OPTIONS)  # [h, w, 2]
        moving = grown(truth.mask, width, height, OPTIONS.dilation_px)
        return Change(moving, float(np.hypot(apart[..., 0], apart[..., 1]).mean()))
