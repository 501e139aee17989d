"""A picture to explain that stays on the GPU, and what its camera makes of the rig's colours there."""

from __future__ import annotations

from typing import Any

import numba.cuda
import numpy as np
import torch
from torch import Tensor

from packuv.fit.losses import pixel_count
from packuv.fit.shots import VOID, Shot
from packuv.footage.response import OFFSET, shading
from packuv.raster.cuda.launch import MEMORY, on_device, run_rows, send, shared
from packuv.raster.picture import checked_tiles

cuda: Any = numba.cuda
_f32 = np.float32
_LEVELS = 255


class ShotOnGpu:
    """The arrays of a shot. What was filmed takes a byte per value."""

    def __init__(self, shot: Shot) -> None:
        self.shot = shot
        camera, known = shot.camera, shot.certain
        active = checked_tiles(shot.tiles, camera)
        self.active, self.tiles = on_device(active), on_device(np.flatnonzero(active))
        """uint8 [tiles_y, tiles_x], and the numbers of the active ones, int64"""
        self.pixel_count = pixel_count(active.view(bool), camera.height, camera.width)
        """Of the active tiles"""
        self.known = None if known is None else on_device(known)
        """bool [H, W] where the picture counts; None: everywhere"""
        depths = shot.depths
        self.depths = None if depths is None else (on_device(depths.pixels), on_device(depths.depth))
        """Known depths: pixels, int64 [P], and depth, float32 [P]"""
        self._response = tuple(map(on_device, shot.response.arrays))
        self._source: Tensor = (shot.sent or send(shot.filmed))()
        self._most = torch.tensor(float(_LEVELS), device=MEMORY)  # torch would multiply by a plain number's inverse

    @property
    def target(self) -> Tensor:
        """float32 [3, H, W] in [0, 1], as filmed."""
        source = self._source
        if source.dtype != torch.uint8:
            return source
        planes = source.permute(2, 0, 1).to(torch.float32, memory_format=torch.contiguous_format)
        return planes.div_(self._most)

    @property
    def void_share(self) -> float:
        """Share of the pixels that may show nothing."""
        return float(self.void(self.target).sum(dtype=torch.int64)) / (self.shot.camera.height * self.shot.camera.width)

    def void(self, target: Tensor) -> Tensor:
        """Where the picture may show nothing, bool [H, W]."""
        return target.amax(dim=0) <= VOID

    def wanted(self, target: Tensor, picture: Tensor) -> Tensor:
        """As `Shot.wanted`."""
        return target if self.known is None else torch.where(self.known, target, picture)

    def shown(self, picture: Tensor) -> Tensor:
        """As `Response.shown`."""
        return self._applied(_show, picture)

    def carried(self, gradient: Tensor) -> Tensor:
        """As `Response.carried`."""
        return self._applied(_carry, gradient)

    def _applied(self, how: Any, picture: Tensor) -> Tensor:
        out = torch.empty_like(picture)
        run_rows(how, picture[0].numel(), picture, *self._response, out)
        return out


_shading = shared(shading)


@cuda.jit
def _show(picture, factors, lens, out):
    """A thread for each pixel, as all here."""
    i = cuda.grid(1)
    y, x = i // picture.shape[2], i % picture.shape[2]
    if y < picture.shape[1]:
        local = _shading(lens, x, y)
        for c in range(3):
            value = factors[c] * local * (picture[c, y, x] + _f32(OFFSET)) - _f32(OFFSET)
            out[c, y, x] = min(max(value, _f32(0)), _f32(1))


@cuda.jit
def _carry(gradient, factors, lens, out):
    i = cuda.grid(1)
    y, x = i // gradient.shape[2], i % gradient.shape[2]
    if y < gradient.shape[1]:
        local = _shading(lens, x, y)
        for c in range(3):
            out[c, y, x] = factors[c] * local * gradient[c, y, x]
