"""Preview: a fitted segment beside what cameras filmed, while the rest of the sequence is still being fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from packuv.files import save_json
from packuv.fit.keyframe import KeyState
from packuv.gaussians.segment import Segment
from packuv.metrics import psnr
from packuv.raster import Arena, RasterOptions, render
from tasks.artefacts.stage import Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.fitting import SEGMENT
from tasks.stages.footage import Footage, Take

PICTURE, FIGURES = "preview.jpg", "preview.json"
PICTURE_WIDTH = 480
"""Of truth and of render, pixels, at most"""


@dataclass(frozen=True, kw_only=True)
class Preview(Stage):
    """Score the last frame of a segment: preview.json, and preview.jpg, truth at the left and render at the right."""

    name, version = "preview", 1
    take: Take
    """Cameras to score on, the one that is shown first"""
    key: Key
    segment: Key
    number: int = field(compare=False)
    """Of the segment, counted from 1"""

    @property
    def label(self) -> str:
        return f"preview of segment {self.number}"

    def build(self, work: Work) -> Notes:
        key, segment = KeyState.load(work.path(self.key)), Segment.load(work.path(self.segment) / SEGMENT)
        views, last = Footage(self.take, work.site).open_views(), len(segment) - 1
        gaussians, instant = key.quantizer.decode(segment.frame(last)), segment.first + last
        options, arena, levels = RasterOptions(key.bounds.near), Arena(), dict[str, float | None]()
        for index, camera in enumerate(views.cameras):
            truth = views.filmed(index, instant)
            if truth is None:
                continue
            drawn = views.response(index, instant).shown(render(gaussians, camera, options=options, arena=arena).colour)
            level = psnr(drawn, truth)
            if not levels:
                _write(work, truth, drawn)
            levels[camera.name] = level if math.isfinite(level) else None
        facts = {"frames": [segment.first, instant], "psnr_db": levels}
        save_json(work.out / FIGURES, facts)
        return facts


def _write(work: Work, truth: np.ndarray, drawn: np.ndarray) -> None:
    pair = np.concatenate([truth, drawn], axis=2).transpose(1, 2, 0)
    pixels = np.rint(pair[..., ::-1] * 255).astype(np.uint8)
    height, width = pixels.shape[:2]
    if width > 2 * PICTURE_WIDTH:
        size = (2 * PICTURE_WIDTH, round(height * 2 * PICTURE_WIDTH / width))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if not cv2.imwrite(str(work.out / PICTURE), pixels):
        raise OSError(f"cannot write {work.out / PICTURE}")
