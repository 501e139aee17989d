"""What a rasterizer is asked for and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.raster.view import TILE


@dataclass(frozen=True)
class RasterOptions:
    """What every backend must agree on."""

    near: float
    """Gaussians whose centre is nearer than this along the viewing direction are not drawn; world units. No default:
    it is a share of the rig's size, since cameras may sit in the wall they film."""
    low_pass_px2: float = 0.3
    """Added to both variances of every ellipse in the picture, pixels squared, as in 3D Gaussian Splatting."""
    device: str = "cpu"
    """cpu, or the name of a torch device that gsplat draws on"""

    def __post_init__(self) -> None:
        if not (self.near > 0 and self.low_pass_px2 > 0):
            raise ValueError(
                f"near plane and low-pass filter must be positive, but are {self.near}, {self.low_pass_px2}"
            )


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a scalar; zero in rows that were not asked for or not drawn."""

    means: np.ndarray
    """float32 [N, 3]"""
    log_scales: np.ndarray
    """float32 [N, 3]"""
    quaternions: np.ndarray
    """float32 [N, 4], of the quaternion as given, not normalised"""
    opacity_logits: np.ndarray
    """float32 [N]"""
    sh: np.ndarray
    """float32 [N, K, 3]; zero beyond the degree that was rendered"""
    means2d: np.ndarray
    """float32 [N, 2]: of the centre in the picture, per pixel"""
    overflow_count: int
    """Rows set to zero because their gradient was not finite"""


def tile_shape(camera: PinholeCamera) -> tuple[int, int]:
    """Rows and columns of tiles of 16 x 16 pixels that cover the picture."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def checked_tiles(tiles: np.ndarray | None, camera: PinholeCamera) -> np.ndarray:
    """Active tiles as uint8 [tiles_y, tiles_x], all where None; raises ValueError if the shape does not fit."""
    shape = tile_shape(camera)
    if tiles is None:
        return np.ones(shape, np.uint8)
    if tiles.shape != shape or tiles.dtype != bool:
        raise ValueError(
            f"tiles must be bool {shape} for a picture of {camera.width}x{camera.height} pixels, "
            f"but is {tiles.dtype} {tiles.shape}"
        )
    return np.ascontiguousarray(tiles).view(np.uint8)
