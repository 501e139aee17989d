"""How alike two sets of Gaussians look."""

from __future__ import annotations

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians
from packuv.metrics import psnr
from packuv.raster import Arena, RasterOptions, render


def likeness(truth: Gaussians, other: Gaussians, cameras: tuple[PinholeCamera, ...], *, near: float) -> list[float]:
    """PSNR of renders of `other` against renders of `truth`, dB, one for each camera; black background."""
    options, arena = RasterOptions(near=near), Arena()
    found = []
    for camera in cameras:
        pictures = [render(g, camera, options=options, arena=arena).colour for g in (truth, other)]
        found.append(psnr(pictures[1], pictures[0]))
    return found
