"""What a rasterizer is asked for and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.raster.view import TILE, VIEW_NEAR, view_constants


@dataclass(frozen=True)
class RasterOptions:
    """What every backend must agree on."""

    near: float
    """Gaussians whose centre is nearer than this along the viewing direction are not drawn; world units. No default:
    it is a share of the rig's size, since cameras may sit in the wall they film."""
    low_pass_px2: float = 0.3
    """Added to both variances of every ellipse in the picture, pixels squared, as in 3D Gaussian Splatting."""
    device: str = "cpu"
    """Who draws: cpu or cuda"""

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


@dataclass(frozen=True)
class Composed:
    """What holds of every layer: the camera and the tiles that it was made for."""

    view: np.ndarray
    """float64 [27], see `view`; of all that is drawn over it, too, but for the near plane"""
    active: np.ndarray
    """uint8 [tiles_y, tiles_x]: where it can be drawn over"""

    def tiles_to_draw(
        self, tiles: np.ndarray | None, weights: bool, camera: PinholeCamera, options: RasterOptions
    ) -> np.ndarray:
        """uint8 [tiles_y, tiles_x], from the arguments of a rendering. Raises ValueError where they do not fit."""
        if weights:
            raise ValueError("blending weights over a layer are not computed; render all Gaussians in one set")
        view = view_constants(camera, options.near, options.low_pass_px2)
        view[VIEW_NEAR] = self.view[VIEW_NEAR]
        if not np.array_equal(view, self.view):
            raise ValueError(
                "a layer must be drawn over with the camera and the low-pass filter that it was composed with, "
                f"but camera {camera.name!r} or its filter is another"
            )
        active = self.active if tiles is None else checked_tiles(tiles, camera)
        lacking = int(np.sum(active > self.active))
        if lacking:
            raise ValueError(
                f"the tiles to draw must be among the {self.active.sum()} that the layer was composed for, "
                f"but {lacking} of {active.sum()} are not"
            )
        return active


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


def checked_rows(rows: np.ndarray, count: int) -> np.ndarray:
    """The rows that may change, uint8 [count]; raises ValueError if bool `rows` does not fit."""
    if rows.shape != (count,) or rows.dtype != bool:
        raise ValueError(f"rows must be bool ({count},), but is {rows.dtype} {rows.shape}")
    return np.ascontiguousarray(rows).view(np.uint8)


def checked_slope(gradient: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The derivatives by a picture of `shape`, float32; raises ValueError if they have another."""
    if gradient.shape != shape:
        raise ValueError(f"the gradient of a picture {shape} must have its shape, but has {gradient.shape}")
    return np.ascontiguousarray(gradient, np.float32)
