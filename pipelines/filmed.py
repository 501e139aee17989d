"""What cameras filmed at the frames of a scene, to lay beside it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from threading import Lock

import numpy as np

from packuv.colour import lit
from packuv.footage import Views
from packuv.score import as_pixels


class Filmed:
    """A `packuv.viewer.source.Truth`. The videos are opened when somebody looks."""

    def __init__(
        self, cameras: tuple[str, ...], open_views: Callable[[], Views], instants: np.ndarray, light: np.ndarray
    ) -> None:
        """`open_views` gives pictures of these cameras in this order; frame f is their instant `instants[f]`, lit by
        `light[f]`, natural logarithms [r, g, b]."""
        self.cameras = cameras
        self._open, self._instants, self._light, self._guard = open_views, instants, light, Lock()

    def picture(self, camera: str, frame: int) -> np.ndarray | None:
        with self._guard:
            picture = self._views.picture(self.cameras.index(camera), int(self._instants[frame]))
        return None if picture is None else as_pixels(lit(picture, self._light[frame]))

    @cached_property
    def _views(self) -> Views:
        return self._open()
