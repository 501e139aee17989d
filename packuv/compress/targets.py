"""What pictures of a compressed scene shall be: what cameras filmed, or those of the lossless scene."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.compress.views import Views
from packuv.footage import Response
from packuv.footage import Views as Footage
from packuv.footage.response import PLAIN
from packuv.gaussians.floats import Gaussians
from packuv.raster import Arena, RasterOptions, render

FILMED = 0.7
"""Share of filmed pictures among those drawn; the others keep what no camera sees as it was"""


@dataclass(frozen=True)
class Target:
    """One picture."""

    camera: PinholeCamera
    picture: np.ndarray
    """float32 [3, H, W], sRGB, as the camera films it"""
    response: Response

    def pull(self, colour: np.ndarray) -> np.ndarray:
        """Derivative of half the squared error by what is drawn, both float32 [3, H, W]."""
        return self.response.carried(self.response.shown(colour) - self.picture)


class Targets:
    """Pictures by chance."""

    def __init__(self, views: Views, footage: Footage | None, followed: Collection[str], *, near: float) -> None:
        """Instant i of `footage` is frame i of the scene; cameras that are not `followed` set no targets."""
        self.views, self._footage = views, footage
        names = footage.names if footage else ()
        self._filming = [number for number, name in enumerate(names) if name in followed]
        self._options, self._arena = RasterOptions(near=near), Arena()

    def draw(self, frame: int, lossless: Callable[[], Gaussians], rng: np.random.Generator) -> Target:
        """One of a frame of the scene, whose Gaussians `lossless` tells."""
        if self._footage and self._filming and rng.random() < FILMED:
            number = self._filming[rng.integers(len(self._filming))]
            if (filmed := self._footage.filmed(number, frame)) is not None:
                return Target(self._footage.cameras[number], filmed, self._footage.response(number, frame))
        camera = self.views.draw(rng)
        drawn = render(lossless(), camera, options=self._options, arena=self._arena).colour
        return Target(camera, np.clip(drawn, 0, 1), PLAIN)
