"""A forward-backward check of optical flow: how far the flow back misses where the flow there came from.

Motion is lifted into the world with and without the cameras that the check rejects at a point, and held against the
exact motion of a simulated capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.lift import LiftOptions, lift_motion
from packuv.footage import FrameReader
from packuv.motion.step import MotionOptions, grey, grown, measure_step, optical_flow
from studio.truth import FrameTruth, Truth, read_truth

NEAR, EVERY = 0.05, 7
"""Near plane, metres; of the pixels that move, every so many is lifted"""


def gap_px(there: np.ndarray, back: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Distance of each pixel from itself after going there and back, float32 [H, W]; large where it leaves the picture.

    Flows are [h, w, 2], pixels of the full picture of `size` (H, W).
    """
    there, back = (np.asarray(cv2.resize(flow, size[::-1])) for flow in (there, back))
    y, x = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32)
    returned = cv2.remap(
        back, x + there[..., 0], y + there[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, (1e3, 1e3, 0, 0)
    )
    gap: np.ndarray = np.linalg.norm(there + returned, axis=2)
    return gap


class Moment:
    """What the cameras show of one step."""

    def __init__(self, pictures: Sequence[tuple[np.ndarray, np.ndarray]], truths: Sequence[FrameTruth]) -> None:
        options = MotionOptions()
        self.truths = truths
        self.flows = [optical_flow(before, after, options) for before, after in pictures]
        backs = [optical_flow(after, before, options) for before, after in pictures]
        shapes = [before.shape for before, _ in pictures]
        self.gaps = [gap_px(*each) for each in zip(self.flows, backs, shapes, strict=True)]
        steps = [measure_step(before, after, options) for before, after in pictures]
        self.masks = [
            grown(step.mask, width, height, options.dilation_px)
            for step, (height, width) in zip(steps, shapes, strict=True)
        ]


def lifted_rows(capture: Path) -> Iterator[Mapping[str, Any]]:
    """Error of lifted motion in the camera that sees the point, pixels, by the gap that a check tolerates."""
    truth = read_truth(capture)
    cameras, moments = _cameras(truth), list(_moments(capture, truth))
    for tolerance_px in (None, 0.5, 1.0, 2.0):
        found = [_errors(cameras, moment, index, tolerance_px) for moment in moments for index in range(len(cameras))]
        error, hidden = (np.concatenate(column) for column in zip(*found, strict=True))
        yield {
            "tolerance_px": "no check" if tolerance_px is None else tolerance_px,
            "points": len(error),
            "mean_px": float(error.mean()),
            "median_px": float(np.median(error)),
            "hidden_px": float(error[hidden].mean()),
        }


def _errors(
    cameras: Sequence[PinholeCamera], moment: Moment, index: int, tolerance_px: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Of the points that one camera sees move, float64 [N], and whether they are hidden after the step, bool [N]."""
    camera, truth = cameras[index], moment.truths[index]
    y, x = (each[::EVERY] for each in np.nonzero(truth.moves))
    depth = truth.depth[y, x].astype(np.float64)
    rays = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
    points = (depth[:, None] * rays - camera.camera_from_world[:3, 3]) @ camera.camera_from_world[:3, :3]
    steps = np.zeros(points.shape)
    rejected = np.stack(
        [_rejected(points, *each, tolerance_px) for each in zip(cameras, moment.gaps, strict=True)], axis=1
    )
    patterns, which = np.unique(rejected, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        rows = which.ravel() == number
        flows = [None if out else flow for out, flow in zip(pattern, moment.flows, strict=True)]
        steps[rows] = lift_motion(points[rows], cameras, flows, moment.masks, near=NEAR, options=LiftOptions())
    moved = camera.project(points + steps)[0] - camera.project(points)[0]
    return np.linalg.norm(moved - truth.flow[y, x], axis=1), ~truth.seen[y, x]


def _rejected(points: np.ndarray, camera: PinholeCamera, gap: np.ndarray, tolerance_px: float | None) -> np.ndarray:
    """Points at whose pixel the check fails, bool [N]."""
    pixels, depth = camera.project(points)
    inside = (depth > NEAR) & (pixels >= 0).all(axis=1) & (pixels < [camera.width, camera.height]).all(axis=1)
    x, y = np.where(inside[:, None], pixels, 0).astype(int).T
    failed: np.ndarray = inside & (gap[y, x] > (np.inf if tolerance_px is None else tolerance_px))
    return failed


def _cameras(truth: Truth) -> list[PinholeCamera]:
    found = (each.camera for each in truth.cameras.values())
    return [PinholeCamera(c.name, c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.camera_from_world) for c in found]


def _moments(capture: Path, truth: Truth) -> Iterator[Moment]:
    """Steps from one tick to the next that every camera recorded."""
    names = list(truth.cameras)
    reader = FrameReader({name: capture / "videos" / f"{name}.mp4" for name in names})
    frames = {name: {int(tick): i for i, tick in enumerate(truth.cameras[name].times.ticks)} for name in names}
    common = sorted(set.intersection(*(set(each) for each in frames.values())))
    for first, last in pairwise(common):
        if last == first + 1:
            places = [(name, frames[name][first], frames[name][last]) for name in names]
            pictures = [(grey(reader.read(name, a)), grey(reader.read(name, b))) for name, a, b in places]
            yield Moment(pictures, [truth.cameras[name].frame(a) for name, a, _ in places])
