"""The backdrop: Gaussians that are fitted once and drawn behind, before and between those that a fit changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.raster import Arena, RasterOptions, compose, render


@dataclass
class Backdrop:
    """Frozen Gaussians, with what drawing over them needs, by camera."""

    gaussians: Gaussians
    """As their codes decode"""
    near: float
    """Near plane of these Gaussians, world"""
    device: str = "cpu"
    memory_bytes: int = 1 << 30
    """For whole layers that stay; cameras beyond it have theirs composed again for each instant"""
    _layers: dict[str, Any] = field(default_factory=dict)
    _held_bytes: int = 0

    def __len__(self) -> int:
        return len(self.gaussians)

    def layer(self, camera: PinholeCamera, tiles: np.ndarray | None) -> Any:
        """What `packuv.raster.render` draws over in these tiles, bool [tiles_y, tiles_x]; None for an empty one."""
        if not len(self):
            return None
        if camera.name not in self._layers:
            if self._held_bytes >= self.memory_bytes:
                return compose(self.gaussians, camera, options=self._raster, tiles=tiles)
            layer = compose(self.gaussians, camera, options=self._raster)
            self._layers[camera.name] = layer
            self._held_bytes += layer.nbytes
        return self._layers[camera.name]

    def shares(self, gaussians: Gaussians, camera: PinholeCamera, arena: Arena) -> np.ndarray:
        """What each of the other Gaussians shows beside the backdrop: its blending weight, float32 [N]."""
        both = joined(self.gaussians, gaussians)
        weights = render(both, camera, options=self._raster, weights=True, arena=arena).weights
        return np.array(weights[len(self) :])

    @property
    def _raster(self) -> RasterOptions:
        return RasterOptions(self.near, device=self.device)


def joined(first: Gaussians, second: Gaussians) -> Gaussians:
    """The rows of both."""
    pairs = zip(arrays(first), arrays(second), strict=True)
    return Gaussians(*(np.concatenate(pair) for pair in pairs))
