"""What pictures of a compressed scene shall be: what cameras filmed, or those of the lossless scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.compress.filmed import Filmed
from packuv.compress.views import Views
from packuv.footage import Response
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

    def __init__(self, views: Views, filmed: Filmed | None = None, *, near: float) -> None:
        self._filmed = filmed
        self.views = views
        """From which the lossless scene is looked at"""
        self._options, self._arena = RasterOptions(near=near), Arena()

    def draw(self, frame: int, lossless: Callable[[], Gaussians], rng: np.random.Generator) -> Target:
        """One of a frame of the scene, whose Gaussians `lossless` tells."""
        if self._filmed and self._filmed.followed and rng.random() < FILMED:
            footage, followed = self._filmed.footage, self._filmed.followed
            number = footage.names.index(followed[rng.integers(len(followed))])
            if (picture := footage.filmed(number, frame)) is not None:
                return Target(footage.cameras[number], picture, footage.response(number, frame))
        camera = self.views.draw(rng)
        drawn = render(lossless(), camera, options=self._options, arena=self._arena).colour
        return Target(camera, np.clip(drawn, 0, 1), PLAIN)
