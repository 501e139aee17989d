"""The backdrop: Gaussians that are fitted once and drawn behind, before and between those that a fit changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from packuv.budget import Budget
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
    budget: Budget = field(default_factory=Budget)
    """For layers: whole ones stay, up to half of it; others, of the tiles of an instant, stay until `forget`. What does
    not fit is composed again for each picture"""
    _whole: dict[str, Any] = field(default_factory=dict)
    _whole_bytes: int = 0
    _full: bool = False
    """No room for a further whole layer"""
    _passing: dict[str, tuple[np.ndarray, Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.gaussians)

    def layer(self, camera: PinholeCamera, tiles: np.ndarray | None) -> Any:
        """What `packuv.raster.render` draws over in these tiles, bool [tiles_y, tiles_x]; None for an empty one."""
        if not len(self):
            return None
        if camera.name in self._whole:
            return self._whole[camera.name]
        if camera.name in self._passing and self._passing[camera.name][0] is tiles:
            return self._passing[camera.name][1]
        return self._compose_whole(camera) or self._compose(camera, tiles)

    def forget(self) -> None:
        """Let go of layers of single instants."""
        while self._passing:
            self.budget.give(self._passing.popitem()[1][1].nbytes)

    def _compose_whole(self, camera: PinholeCamera) -> Any:
        """A layer that stays; None without room for it."""
        if self._full:
            return None
        layer = compose(self.gaussians, camera, options=self._raster)
        if self._whole_bytes + layer.nbytes > self.budget.total_bytes / 2 or not self.budget.take(layer.nbytes):
            self._full = True
            return None
        self._whole[camera.name] = layer
        self._whole_bytes += layer.nbytes
        return layer

    def _compose(self, camera: PinholeCamera, tiles: np.ndarray | None) -> Any:
        """A layer of some tiles, which stays for this instant if there is room."""
        layer = compose(self.gaussians, camera, options=self._raster, tiles=tiles)
        if tiles is not None and camera.name not in self._passing and self.budget.take(layer.nbytes):
            self._passing[camera.name] = tiles, layer
        return layer

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
