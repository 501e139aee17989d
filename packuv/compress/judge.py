"""Pictures that tell how far a compressed scene is from the lossless one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from packuv.colour import lit
from packuv.compress.filmed import Filmed
from packuv.compress.imagined import IMAGINED, looked_at
from packuv.compress.views import Views
from packuv.each import spread
from packuv.footage import Views as Footage
from packuv.progress import Ticks, no_progress
from packuv.raster import Arena, RasterOptions, render
from packuv.scene import Scene, open_scene

FRAMES, CAMERAS = 3, 12
"""Of which pictures tell distortion, at most, spread evenly: 36 of them differ from all by some tenths of a decibel"""


@dataclass(frozen=True)
class Errors:
    """Of a compressed scene's pictures."""

    mean: float
    """Mean squared error to those of the lossless scene"""
    unseen: float | None
    """Of cameras from which nothing was learned; None where there are none"""
    lost_db: float | None
    """By how much PSNR against footage has fallen, see `Filmed`; None without footage"""


class Judge:
    """Pictures of a scene, to which those of others are compared: which ones is settled at once, `look` draws them."""

    def __init__(self, scene: Scene) -> None:
        header = looked_at(scene)
        held_out = [camera for camera in header.cameras if camera.name in header.held_out]
        fitted = [camera for camera in header.cameras if camera.name not in header.held_out]
        unseen = spread(held_out, CAMERAS // 3 if fitted else CAMERAS)
        self.learned = spread(fitted, CAMERAS - len(unseen)) or unseen
        """Cameras from which sensitivity is learned"""
        self.views = Views(fitted or unseen, filmed=header is scene.header)
        """From which rows are weighed and tuned"""
        self.cameras = self.learned + tuple(camera for camera in unseen if camera not in self.learned)
        self.frames = spread(range(len(scene)), FRAMES)
        self._unseen = {camera.name for camera in self.cameras} - {camera.name for camera in self.learned}
        self.near = header.near
        self.imagined = header.extra.get(IMAGINED)
        """What imagined cameras circle, JSON; None where the cameras are the scene's own"""
        self._fitted = [camera.name for camera in fitted]
        self._options, self._arena = RasterOptions(near=self.near), Arena()
        self._truth = dict[tuple[int, str], np.ndarray]()
        self._ticks = Ticks(no_progress, 0)
        self.filmed: Filmed | None = None

    def pictures(self, footage: Footage | None) -> tuple[int, int]:
        """How many are drawn at the start, and by each trial; at most, where not all was filmed."""
        trial = len(self.cameras) * len(self.frames)
        if footage is None:
            return trial, trial
        return 2 * trial + len(self._fitted) * len(self.frames), 2 * trial

    def look(self, scene: Scene, footage: Footage | None = None, ticks: Ticks | None = None) -> Self:
        """Draw the scene, whose pictures are the true ones. Ticks of this and of later trials count pictures.

        Raises ValueError for footage that has no picture to judge by.
        """
        self._ticks = ticks or self._ticks
        self._truth = {(frame, name): picture for frame, name, picture in self._pictures(scene)}
        if footage is not None:
            judged = {camera.name for camera in self.cameras}
            self.filmed = Filmed(
                scene, footage, fitted=self._fitted, judged=judged, frames=self.frames, near=self.near,
                ticks=self._ticks,
            )  # fmt: skip
        return self

    def errors(self, path: Path) -> Errors:
        """Of a scene file."""
        with open_scene(path) as scene:
            wrong = [
                (unseen, float(np.square(picture - truth, dtype=np.float64).mean()))
                for unseen, picture, truth in self.pairs(scene)
            ]
            lost_db = self.filmed.lost_db(scene) if self.filmed else None
        others = [error for unseen, error in wrong if unseen]
        return Errors(
            float(np.mean([error for _, error in wrong])), float(np.mean(others)) if others else None, lost_db
        )

    def pairs(self, scene: Scene) -> Iterator[tuple[bool, np.ndarray, np.ndarray]]:
        """Whether nothing was learned from the camera, a scene's picture and the true one, float32 [3, H, W]."""
        for frame, name, picture in self._pictures(scene):
            yield name in self._unseen, picture, self._truth[frame, name]

    def _pictures(self, scene: Scene) -> Iterator[tuple[int, str, np.ndarray]]:
        """Frame, camera, and float32 [3, H, W] as a display shows it in the light of the instant."""
        for frame in self.frames:
            gaussians = scene.gaussians(frame)
            for camera in self.cameras:
                drawn = render(gaussians, camera, options=self._options, arena=self._arena).colour
                yield frame, camera.name, np.clip(lit(drawn, scene.light(frame)), 0, 1).astype(np.float32)
                self._ticks.advance()
