"""Coarse codes, moved so that pictures of them are what they shall be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from packuv.compress.sensitivity import by_code
from packuv.compress.steps import Steps
from packuv.compress.targets import Targets
from packuv.gaussians.codes import OPACITY, Codes, Quantizer
from packuv.gaussians.floats import Gaussians
from packuv.gaussians.segment import Segment
from packuv.progress import Ticks
from packuv.raster import RasterOptions, gradients, render

RATE = 0.11
"""Steps by which an iteration moves a code whose gradient is that of its kind; in the second half less and less"""
DRAWN = 4
"""Pictures that take as long to draw as an iteration: it draws two, or reads one, and goes back through one"""
FADING, SQUARES_FADING = 0.9, 0.99
"""Of the last gradients and their squares in their means"""
ALIKE = 2.0
"""By how much the gradients of a kind count against the row's own: where each row moves alike however little it does,
as with Adam, codes of no weight wander off, and their bits with them. Measured, docs/compression.md"""


def tune(
    segment: Segment,
    steps: Steps,
    quantizer: Quantizer,
    truth: Callable[[int], Gaussians],
    targets: Targets,
    offsets: np.ndarray,
    *,
    free: np.ndarray,
    iterations: int,
    near: float,
    rng: np.random.Generator,
    ticks: Ticks,
) -> np.ndarray:
    """By how much to move each row throughout a segment in coarse steps, float64 [N, 3 + A], codes of these steps.

    `offsets` are where to begin, `free` bool [N] who may move, `truth` the Gaussians of a segment's frame in the
    lossless scene. One picture an iteration, of a frame by chance and a target there, from which that of `moved` codes
    shall differ least; a gradient is that of the codes as they are drawn, rounded, and moves what rounds to them.
    """
    options, unit = RasterOptions(near=near), _unit(steps, offsets.shape[1])
    mean, squares = np.zeros_like(offsets), np.zeros_like(offsets)
    for iteration in range(iterations):
        frame = int(rng.integers(len(segment)))
        target = targets.draw(segment.first + frame, partial(truth, frame), rng)
        codes = moved(segment.frame(frame), offsets, steps)
        gaussians = quantizer.decode(codes)
        drawn = render(gaussians, target.camera, options=options)
        pull = target.pull(drawn.colour)
        slope = by_code(gradients(drawn, pull, rows=free), gaussians, codes, quantizer) * unit
        mean = FADING * mean + (1 - FADING) * slope
        squares = SQUARES_FADING * squares + (1 - SQUARES_FADING) * np.square(slope)
        near_now = 1 - FADING ** (iteration + 1), 1 - SQUARES_FADING ** (iteration + 1)
        scale = np.sqrt(squares / near_now[1])
        scale += ALIKE * np.sqrt(squares.mean(axis=0) / near_now[1]) + 1e-30
        rate = RATE * ALIKE * min(1.0, 2 * (1 - iteration / iterations))
        offsets = offsets - np.where(free[:, None], rate * (mean / near_now[0]) / scale, 0)
        ticks.advance(DRAWN)
    return offsets


def moved(codes: Codes, offsets: np.ndarray, steps: Steps) -> Codes:
    """Codes [N] with offsets [N, 3 + A] added, to the nearest; nobody comes or goes. Equal rows stay equal."""
    unit = _unit(steps, offsets.shape[1])
    shift = np.rint(offsets) * unit
    xyz = np.clip(codes.xyz + shift[:, :3], 0, 65535).astype(np.uint16)
    there = codes.attributes[:, OPACITY] > 0
    return Codes(xyz, steps.limited(codes.attributes + shift[:, 3:], there))


def moved_segment(segment: Segment, offsets: np.ndarray, steps: Steps) -> Segment:
    """Each row moved throughout."""
    moving = offsets[segment.dynamic]
    frames = [
        moved(Codes(xyz, attributes), moving, steps)
        for xyz, attributes in zip(segment.xyz, segment.attributes, strict=True)
    ]
    return replace(
        segment,
        key=moved(segment.key, offsets, steps),
        xyz=np.array([frame.xyz for frame in frames], np.uint16).reshape(segment.xyz.shape),
        attributes=np.array([frame.attributes for frame in frames], np.uint8).reshape(segment.attributes.shape),
    )


def _unit(steps: Steps, columns: int) -> np.ndarray:
    """Codes that an offset of one stands for, float64 [3 + A]."""
    unit = np.ones(columns)
    unit[:3] = steps.multiple
    return unit
