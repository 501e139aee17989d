"""Pictures that tell how far a compressed scene is from the lossless one, and both from what was filmed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from packuv.colour import lit
from packuv.compress.imagined import IMAGINED, looked_at
from packuv.compress.views import Views
from packuv.footage import Views as Footage
from packuv.gaussians.floats import Gaussians
from packuv.metrics import decibels
from packuv.raster import Arena, RasterOptions, render
from packuv.scene import Scene, open_scene

EXACT = 1e-12
"""Mean squared error of pictures that are told apart from equal ones, which have no PSNR"""
UNLIKE_DB = 6.0
"""By how much less than the middle one a camera that films something else is like the lossless scene"""
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
    """By how much PSNR against footage has fallen, the larger of that of these cameras and that of the others; None
    without footage"""


class Judge:
    """Pictures of a scene, to which those of others are compared."""

    def __init__(self, scene: Scene, footage: Footage | None = None) -> None:
        """Raises ValueError for footage that has no picture to judge by."""
        header = looked_at(scene)
        held_out = [camera for camera in header.cameras if camera.name in header.held_out]
        fitted = [camera for camera in header.cameras if camera.name not in header.held_out]
        unseen = _spread(held_out, CAMERAS // 3 if fitted else CAMERAS)
        self.learned = _spread(fitted, CAMERAS - len(unseen)) or unseen
        """Cameras from which sensitivity is learned"""
        self.views = Views(fitted or unseen, filmed=header is scene.header)
        """From which rows are weighed and tuned"""
        self.cameras = tuple(self.learned) + tuple(camera for camera in unseen if camera not in self.learned)
        self.frames = tuple(_spread(range(len(scene)), FRAMES))
        self._unseen = {camera.name for camera in self.cameras} - {camera.name for camera in self.learned}
        self.near = header.near
        self.imagined = header.extra.get(IMAGINED)
        """What imagined cameras circle, JSON; None where the cameras are the scene's own"""
        self._options, self._arena = RasterOptions(near=self.near), Arena()
        self._truth = {(frame, name): picture for frame, name, picture in self._pictures(scene)}
        self._footage = footage
        self.unfollowed = {} if footage is None else self._unlike(scene, footage, [camera.name for camera in fitted])
        """Fitted cameras whose footage does not show what the scene does, and why that is thought of them"""
        self.followed = tuple(camera.name for camera in fitted if camera.name not in self.unfollowed)
        self.filmed = footage is not None
        self._fitted = None if footage is None else self._filmed(scene, footage)

    def errors(self, path: Path) -> Errors:
        """Of a scene file."""
        wrong = [(unseen, _squared(picture, truth)) for unseen, picture, truth in self.pairs(path)]
        others = [error for unseen, error in wrong if unseen]
        mean, unseen = float(np.mean([error for _, error in wrong])), float(np.mean(others)) if others else None
        if self._footage is None or self._fitted is None:
            return Errors(mean, unseen, None)
        with open_scene(path) as scene:
            now = self._filmed(scene, self._footage)
        return Errors(mean, unseen, max(level - now[group] for group, level in self._fitted.items()))

    def pairs(self, path: Path) -> Iterator[tuple[bool, np.ndarray, np.ndarray]]:
        """Whether nothing was learned from the camera, a scene file's picture and the true one, float32 [3, H, W]."""
        with open_scene(path) as scene:
            for frame, name, picture in self._pictures(scene):
                yield name in self._unseen, picture, self._truth[frame, name]

    def _pictures(self, scene: Scene) -> Iterator[tuple[int, str, np.ndarray]]:
        """Frame, camera, and float32 [3, H, W] as a display shows it in the light of the instant."""
        for frame in self.frames:
            gaussians = scene.gaussians(frame)
            for camera in self.cameras:
                drawn = render(gaussians, camera, options=self._options, arena=self._arena).colour
                yield frame, camera.name, np.clip(lit(drawn, scene.light(frame)), 0, 1).astype(np.float32)

    def _filmed(self, scene: Scene, footage: Footage) -> dict[bool, float]:
        """PSNR against footage, mean over pictures, of cameras from which nothing was learned (True) and of others."""
        found = dict[bool, list[float]]()
        judged = self._unseen | ({camera.name for camera in self.cameras} & set(self.followed))
        for frame in self.frames:
            gaussians = scene.gaussians(frame)
            for number, camera in enumerate(footage.cameras):
                level = self._level(gaussians, footage, number, frame) if camera.name in judged else None
                if level is not None:
                    found.setdefault(camera.name in self._unseen, []).append(level)
        if not found or (self._unseen and True not in found):
            names = sorted(self._unseen or (camera.name for camera in self.cameras))
            raise ValueError(
                f"{scene.path} must be compared with what {', '.join(names)} filmed, but the capture has no picture of "
                f"theirs at frames {', '.join(map(str, self.frames))}; leave the capture out"
            )
        return {group: float(np.mean(levels)) for group, levels in found.items()}

    def _unlike(self, scene: Scene, footage: Footage, fitted: Sequence[str]) -> dict[str, str]:
        """Cameras of these that have no picture at any of the frames, or are much further from the scene in the first
        one than others are, and why."""
        levels = dict[str, float]()
        for frame in self.frames:
            gaussians = scene.gaussians(frame)
            for number, name in enumerate(footage.names):
                if name in fitted and name not in levels:
                    level = self._level(gaussians, footage, number, frame)
                    levels.update({} if level is None else {name: level})
        middle = float(np.median([*levels.values()])) if levels else 0.0
        at = f"no picture at frames {', '.join(map(str, self.frames))}"
        unlike = {name: f"{level:.1f} dB to the scene, others {middle:.1f}" for name, level in levels.items()
                  if level < middle - UNLIKE_DB}  # fmt: skip
        return {name: unlike.get(name, at) for name in fitted if name in unlike or name not in levels}

    def _level(self, gaussians: Gaussians, footage: Footage, number: int, frame: int) -> float | None:
        """PSNR of a camera's picture, drawn as it would film it, dB; None where it has none."""
        if (filmed := footage.filmed(number, frame)) is None:
            return None
        drawn = render(gaussians, footage.cameras[number], options=self._options, arena=self._arena).colour
        return decibels(max(_squared(footage.response(number, frame).shown(drawn), filmed), EXACT))


def _squared(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.square(one - other, dtype=np.float64).mean())


def _spread(items: Sequence[Any], count: int) -> list[Any]:
    """`count` of the items at equal distances; all of them if there are fewer."""
    if count >= len(items):
        return list(items)
    return [items[(2 * place + 1) * len(items) // (2 * count)] for place in range(count)]
