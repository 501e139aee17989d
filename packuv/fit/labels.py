"""Which Gaussians move, and which parts of a picture they touch (paper §4.2.2 and appendix, algorithm 4).

A Gaussian is dynamic if its ellipse in the picture overlaps a camera's motion mask. The paper joins cameras by OR; as
the mask of a camera also covers everything behind and before what moves, that makes half of a room's wall dynamic when
many cameras look inward. By default most of the cameras that see a Gaussian must agree: what moves lies in the mask of
nearly every camera that sees it, the wall behind it only in a few. `least_share=0` is the paper's rule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import prange

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import ALPHA_MIN, DRAWN_LOGIT, Gaussians, opacity
from packuv.kernels.compile import kernel, prefer_tbb
from packuv.raster import ewa
from packuv.raster.view import (
    TILE,
    VIEW_CX,
    VIEW_CY,
    VIEW_FX,
    VIEW_FY,
    VIEW_HEIGHT,
    VIEW_LOW_PASS,
    VIEW_NEAR,
    VIEW_WIDTH,
    view_constants,
)

CHUNKS = 64
"""Pieces of work, whatever the number of threads."""


@dataclass(frozen=True)
class LabelOptions:
    """When a Gaussian counts as dynamic."""

    sigmas: float = 3.0
    """Size of the ellipse, in standard deviations (paper: Mahalanobis distance squared <= 9)"""
    low_pass_px2: float = 0.3
    """Added to the variances in the picture, as the renderer does"""
    radius_limit_px: float = 400.0
    """A larger ellipse is cut off here: near the camera the projection's linear map means little"""
    least_overlap: float = 0.4
    """Share of the ellipse's pixels in the picture that must be in the mask; 0: a single pixel, as in the paper. A wide
    faint Gaussian that touches a mask would make every tile that it reaches active: 99 % of them on a real capture at
    0, 43 % at 0.4, at equal error"""
    min_cameras: int = 1
    """Cameras whose mask must be hit; 1 is the paper's OR"""
    least_share: float = 0.6
    """Share of the cameras that see a Gaussian whose mask must be hit; 0 is the paper's OR. With 27 cameras around two
    people, OR labels 46 % of a wall and 70 % of the empty room, this 2 % and 0.5 %; 1 % and 0.5 % are in every mask"""
    depth_tolerance: float = 0.05
    """A centre deeper than the depth map by more than this share is hidden, and that camera has no say"""
    centres_only: bool = False
    """The paper's fallback: only the pixel under the centre counts"""

    def __post_init__(self) -> None:
        if not (self.sigmas > 0 and self.low_pass_px2 >= 0 and self.radius_limit_px > 0 and self.min_cameras >= 1):
            raise ValueError(
                "labels need sigmas > 0, low_pass_px2 >= 0, radius_limit_px > 0 and min_cameras >= 1, but have "
                f"{self.sigmas}, {self.low_pass_px2}, {self.radius_limit_px} and {self.min_cameras}"
            )
        if not (0 <= self.least_overlap <= 1 and 0 <= self.least_share <= 1 and self.depth_tolerance >= 0):
            raise ValueError(
                "least_overlap and least_share are shares from 0 to 1 and depth_tolerance is not negative, but they "
                f"are {self.least_overlap}, {self.least_share} and {self.depth_tolerance}"
            )


def dynamic_labels(
    gaussians: Gaussians,
    cameras: Sequence[PinholeCamera],
    masks: Sequence[np.ndarray | None],
    *,
    near: float,
    options: LabelOptions,
    depths: Sequence[np.ndarray | None] | None = None,
    device: str = "cpu",
) -> np.ndarray:  # bool [N]
    """Which Gaussians overlap the motion masks, bool [H, W] per camera at the camera's size.

    A camera without a mask (None) has no say, nor has one nearer than `near` to the Gaussian, or one where the
    Gaussian is hidden by `depths` (float [H, W] along the camera's z axis; 0 or NaN where nothing is). A mask that
    is empty does have a say: it saw no motion. Takes O(N * cameras * rows of the ellipse), whatever its width.
    `device` "cpu" or "cuda" tells who counts.
    """
    hits, views = count_hits(gaussians, cameras, masks, near=near, options=options, depths=depths, device=device)
    return np.asarray((hits >= options.min_cameras) & (hits >= options.least_share * views))


def count_hits(
    gaussians: Gaussians,
    cameras: Sequence[PinholeCamera],
    masks: Sequence[np.ndarray | None],
    *,
    near: float,
    options: LabelOptions,
    depths: Sequence[np.ndarray | None] | None = None,
    device: str = "cpu",
) -> tuple[np.ndarray, np.ndarray]:
    """Per Gaussian, the cameras whose mask it overlaps and the cameras that see it, int32 [N] each.

    A camera sees a Gaussian whose centre is in its picture, or that overlaps its mask.
    """
    if len(masks) != len(cameras) or (depths is not None and len(depths) != len(cameras)):
        raise ValueError(f"{len(cameras)} cameras need a mask each (or None), and a depth map each if any is given")
    shapes, visible = _shapes(gaussians), _visible(gaussians)
    limits = options.sigmas, options.radius_limit_px, options.least_overlap, 1 + options.depth_tolerance
    rule = np.array([*limits, options.centres_only], dtype=np.float64)
    voters = (
        _voter(camera, mask, depth, near, options.low_pass_px2)
        for camera, mask, depth in zip(cameras, masks, depths or [None] * len(cameras), strict=True)
        if mask is not None
    )
    if device != "cpu":
        from packuv.fit.labels_cuda import count_on_gpu

        return count_on_gpu(_opinion, gaussians.means, shapes, visible, voters, rule)
    hits, views = np.zeros(len(gaussians), dtype=np.int32), np.zeros(len(gaussians), dtype=np.int32)
    for view, mask, depth in voters:
        _vote(gaussians.means, shapes, visible, view, summed_area(mask), depth, rule, hits, views)
    return hits, views


def _voter(
    camera: PinholeCamera, mask: np.ndarray, depth: np.ndarray | None, near: float, low_pass_px2: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A camera's view, its mask, and its depths, float32 [H, W], or [0, 0] where it has none."""
    view, mask = view_constants(camera, near, low_pass_px2), _check_picture(mask, camera, "mask")
    if depth is None:
        return view, mask, np.zeros((0, 0), np.float32)
    return view, mask, np.ascontiguousarray(_check_picture(depth, camera, "depth"), np.float32)


def active_tiles(
    mask: np.ndarray | None,
    moving: Gaussians,
    camera: PinholeCamera,
    *,
    near: float = 0.0,
    low_pass_px2: float = 0.3,
) -> np.ndarray:  # bool [tiles_y, tiles_x]
    """Tiles of 16 x 16 pixels that the motion mask (bool [H, W]) or a moving Gaussian touches.

    A Gaussian reaches as far as its alpha is 1/255 or more, which is where every renderer draws it. Without a mask
    everything is active. Pass the renderer's `near`: a Gaussian closer to the camera is not drawn.
    """
    rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
    if mask is None:
        return np.ones((rows, columns), dtype=bool)
    _check_picture(mask, camera, "mask")
    padded = np.pad(mask, ((0, rows * TILE - camera.height), (0, columns * TILE - camera.width)))
    by_row = padded.reshape(rows, TILE, columns * TILE).any(axis=1)  # at once over both axes takes seven times as long
    tiles = np.asarray(by_row.reshape(rows, columns, TILE).any(axis=2))
    reach = np.sqrt(2 * np.log(np.maximum(opacity(moving) * (1 / ALPHA_MIN), 1)))  # in standard deviations, [N]
    _touch(moving.means, _shapes(moving), _visible(moving), reach, view_constants(camera, near, low_pass_px2), tiles)
    return tiles


def summed_area(mask: np.ndarray) -> np.ndarray:
    """int32 [H + 1, W + 1]: number of true pixels above and left of each corner."""
    return np.asarray(cv2.integral(np.ascontiguousarray(mask).view(np.uint8), sdepth=cv2.CV_32S))


def _check_picture(picture: np.ndarray, camera: PinholeCamera, name: str) -> np.ndarray:
    if picture.shape != (camera.height, camera.width):
        raise ValueError(
            f"camera {camera.name!r}: the {name} must be [{camera.height}, {camera.width}], but is {picture.shape}"
        )
    return picture


def _visible(gaussians: Gaussians) -> np.ndarray:
    """Gaussians that renderers draw at all, bool [N]."""
    return np.asarray(gaussians.opacity_logits >= DRAWN_LOGIT)


def _shapes(gaussians: Gaussians) -> np.ndarray:
    """Rotation by rows and the three standard deviations, world, float64 [N, 12]."""
    prefer_tbb()
    out = np.empty((len(gaussians), 12))
    _fill_shapes(gaussians.quaternions, gaussians.log_scales, out)
    return out


_in_camera, _linear_map, _rotation, _screen_axes, _covariance = (
    kernel(inline=True)(function)
    for function in (ewa.in_camera, ewa.linear_map, ewa.rotation, ewa.screen_axes, ewa.covariance)
)


@kernel(parallel=True)
def _fill_shapes(quaternions, log_scales, out):
    count = len(out)
    for chunk in prange(CHUNKS):
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            w, x, y, z = (
                np.float64(quaternions[i, 0]),
                np.float64(quaternions[i, 1]),
                np.float64(quaternions[i, 2]),
                np.float64(quaternions[i, 3]),
            )
            unit = 1 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
            rotation = _rotation(w * unit, x * unit, y * unit, z * unit)
            for k in range(9):
                out[i, k] = rotation[k]
            for axis in range(3):
                out[i, 9 + axis] = math.exp(np.float64(log_scales[i, axis]))


@kernel(inner=True)
def _project(means, shapes, view, i):
    """Pixel x and y of the centre, its depth, xx xy yy of the covariance in the picture; depth 0 if it has none."""
    x, y, z = _in_camera(view, means[i, 0], means[i, 1], means[i, 2])
    if not (z > 0 and z >= view[VIEW_NEAR]):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    inverse_z = 1 / z
    u, v = x * inverse_z, y * inverse_z
    _, axes = _linear_map(view, u, v, inverse_z)
    shape = shapes[i]
    xx, xy, yy, _ = _covariance(_screen_axes(axes, shape, shape[9], shape[10], shape[11]), view[VIEW_LOW_PASS])
    return view[VIEW_FX] * u + view[VIEW_CX], view[VIEW_FY] * v + view[VIEW_CY], z, xx, xy, yy


@kernel(inner=True)
def _row_span(x, y, xx, xy, yy, square, limit, width, row):
    """Pixels of a row, half-open, whose centres lie in the ellipse d^2 <= square and within `limit`."""
    dy = row + 0.5 - y
    # d^2 = dy^2 / yy + (dx - dy xy / yy)^2 / (xx - xy^2 / yy)
    rest = (square - dy * dy / yy) * (xx - xy * xy / yy)
    if not rest >= 0:
        return 0, 0
    middle, half = x + dy * xy / yy, math.sqrt(rest)
    low, high = max(middle - half, x - limit), min(middle + half, x + limit)
    return int(max(math.ceil(low - 0.5), 0.0)), int(min(math.floor(high - 0.5) + 1.0, width))


@kernel(inner=True)
def _rows(y, yy, sigmas, limit, height):
    """First row, and the one past the last, that an ellipse reaches."""
    half = min(sigmas * math.sqrt(yy), limit)
    return int(max(math.ceil(y - half - 0.5), 0.0)), int(min(math.floor(y + half - 0.5) + 1.0, height))


@kernel(inner=True)
def _overlap(x, y, xx, xy, yy, sigmas, limit, table):
    """Pixels of the ellipse that are in the picture, and those of them that are in the mask."""
    height, width = table.shape[0] - 1, table.shape[1] - 1
    inside = masked = 0
    first, end = _rows(y, yy, sigmas, limit, height)
    for row in range(first, end):
        left, right = _row_span(x, y, xx, xy, yy, sigmas * sigmas, limit, width, row)
        if left < right:
            inside += right - left
            masked += table[row + 1, right] - table[row + 1, left] - table[row, right] + table[row, left]
    return inside, masked


@kernel(inner=True)
def _box_is_clear(x, y, xx, yy, sigmas, limit, table):
    """Whether no masked pixel lies in the ellipse's bounding box."""
    height, width = table.shape[0] - 1, table.shape[1] - 1
    top, bottom = _rows(y, yy, sigmas, limit, height)
    left, right = _rows(x, xx, sigmas, limit, width)
    if top >= bottom or left >= right:
        return True
    return table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left] == 0


@kernel(inner=True)
def _is_hidden(x, y, z, depth, slack):
    row, column = np.int64(math.floor(y)), np.int64(math.floor(x))  # on CUDA floor is a float
    if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
        return False
    return depth[row, column] > 0 and z > depth[row, column] * slack


@kernel(inner=True)
def _is_hit(x, y, xx, xy, yy, rule, table):
    """Whether the mask holds enough of an ellipse; `rule` as in `_vote`."""
    sigmas, limit, least_overlap = rule[0], rule[1], rule[2]
    if _box_is_clear(x, y, xx, yy, sigmas, limit, table):
        return False
    inside, masked = _overlap(x, y, xx, xy, yy, sigmas, limit, table)
    return masked > 0 and masked >= least_overlap * inside


@kernel(inner=True)
def _pixel(x, y, table):
    """Whether the pixel under a point in the picture is in the mask."""
    row, column = np.int64(math.floor(y)), np.int64(math.floor(x))  # on CUDA floor is a float
    return table[row + 1, column + 1] - table[row, column + 1] - table[row + 1, column] + table[row, column] > 0


@kernel(inner=True)
def _opinion(means, shapes, view, table, depth, rule, i):
    """One camera of one Gaussian: whether it sees it, and whether its mask is hit as well.

    `rule`, float64 [5]: sigmas, radius limit, least overlap, depth slack, and whether only centres count.
    """
    x, y, z, xx, xy, yy = _project(means, shapes, view, i)
    # Algorithm 4, step 3; the comparisons also refuse what is not a number.
    if not (z > 0 and xx * yy - xy * xy > 1e-7 and abs(x) < 1e9 and abs(y) < 1e9):
        return False, False
    if _is_hidden(x, y, z, depth, rule[3]):
        return False, False
    centred = 0 <= x < view[VIEW_WIDTH] and 0 <= y < view[VIEW_HEIGHT]
    hit = centred and _pixel(x, y, table) if rule[4] else _is_hit(x, y, xx, xy, yy, rule, table)
    return centred or hit, hit


@kernel(parallel=True)
def _vote(means, shapes, visible, view, table, depth, rule, hits, views):
    """Add one camera's opinion: `views` [N] grows where it sees a Gaussian, `hits` [N] where its mask is hit too."""
    count = len(means)
    for chunk in prange(CHUNKS):
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            if visible[i]:
                seen, hit = _opinion(means, shapes, view, table, depth, rule, i)
                views[i] += seen
                hits[i] += hit


@kernel(parallel=True)
def _touch(means, shapes, visible, reach, view, tiles):
    """Set the tiles, bool [rows, columns], that hold a pixel of an ellipse of `reach` [N] standard deviations."""
    width, height = int(view[VIEW_WIDTH]), int(view[VIEW_HEIGHT])
    for chunk in prange(CHUNKS):
        for i in range(len(means) * chunk // CHUNKS, len(means) * (chunk + 1) // CHUNKS):
            if not visible[i]:
                continue
            x, y, z, xx, xy, yy = _project(means, shapes, view, i)
            if not (z > 0 and xx * yy - xy * xy > 0 and abs(x) < 1e9 and abs(y) < 1e9):
                continue
            first, end = _rows(y, yy, reach[i], 1e9, height)
            for row in range(first, end):
                left, right = _row_span(x, y, xx, xy, yy, reach[i] * reach[i], 1e9, width, row)
                # Threads may set the same tile; all of them write the same value.
                for column in range(left // TILE, (right + TILE - 1) // TILE if right > left else 0):
                    tiles[row // TILE, column] = True
