"""A camera's constants as kernels take them, and the limits that rasterizers share."""

from __future__ import annotations

import numpy as np

from packuv.camera import PinholeCamera

TILE = 16
"""Pixels along a side of a tile."""
MAX_LENGTH = 1e18
"""World units; squares of larger positions leave the range of float32."""
MAX_LOG_SCALE = 40.0
MAX_COLOUR = 1e12
MARGIN = 0.15
"""The local linear map of a Gaussian outside the picture is taken at most this share of the picture beyond its edge."""
# Entries of a view; before them stand the rotation, by rows, and the translation.
VIEW_FX, VIEW_FY, VIEW_CX, VIEW_CY = 12, 13, 14, 15
VIEW_CENTRE, VIEW_WIDTH, VIEW_HEIGHT = 16, 19, 20
VIEW_SLOPES, VIEW_NEAR, VIEW_LOW_PASS = 21, 25, 26


def pixels_of_tiles(tiles: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Each tile's value, [tiles_y, tiles_x], in all of its pixels, [H, W]."""
    return tiles.repeat(TILE, axis=0).repeat(TILE, axis=1)[: camera.height, : camera.width]


def view_constants(camera: PinholeCamera, near: float, low_pass_px2: float) -> np.ndarray:
    """Everything the kernels need to know of a camera, float64 [27]."""
    width, height = camera.width, camera.height
    x_low, x_high = -camera.cx - MARGIN * width, width - camera.cx + MARGIN * width
    y_low, y_high = -camera.cy - MARGIN * height, height - camera.cy + MARGIN * height
    return np.array([
        *camera.camera_from_world[:3, :3].ravel(), *camera.camera_from_world[:3, 3],
        camera.fx, camera.fy, camera.cx, camera.cy, *camera.centre, width, height,
        x_low / camera.fx, x_high / camera.fx, y_low / camera.fy, y_high / camera.fy, near, low_pass_px2,
    ], dtype=np.float64)  # fmt: skip
