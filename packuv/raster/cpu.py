"""The CPU rasterizer: projection, lists per tile, blending, and their gradients.

The host side: it holds the buffers and calls the kernels in order. Float32 results do not depend on the number of
threads, nor on the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numba
import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.kernels.compile import prefer_tbb
from packuv.kernels.simd import WIDTH, Lanes, register_lanes
from packuv.raster import bins, blend
from packuv.raster.arena import Arena
from packuv.raster.picture import Gradients, RasterOptions, checked_tiles, tile_shape
from packuv.raster.project import CHUNKS, RECORD, project, project_backward
from packuv.raster.sh import MAX_DEGREE
from packuv.raster.view import TILE, view_constants

BIN_CHUNKS = 16
"""Pieces of the depth order that are put into tiles side by side."""


@dataclass(frozen=True)
class _Kept:
    """What the gradients need of a rendering."""

    gaussians: Gaussians
    view: np.ndarray
    sh_degree: int
    sums: Lanes
    arena: Arena
    record: np.ndarray  # float32 [N, 16]
    first_pair: np.ndarray  # int64 [N + 1]
    pairs: np.ndarray  # uint32 [P, 3]
    start: np.ndarray  # int64 [tiles + 1]
    used_end: np.ndarray  # int64 [tiles]
    visited: np.ndarray  # int32 [tiles]


@dataclass(frozen=True)
class Rendering:
    """A picture of Gaussians. Stays valid, for `backward` too, whatever else is rendered meanwhile.

    The Gaussians' arrays must not change before `backward`.
    """

    colour: np.ndarray
    """float32 [3, H, W], background included"""
    depth: np.ndarray
    """float32 [H, W]: sum of weight times z; divide by alpha for a mean"""
    alpha: np.ndarray
    """float32 [H, W]: 1 - transmittance"""
    visible: np.ndarray
    """int32 [N]: number of tiles whose pixels the Gaussian reaches, before occlusion"""
    weights: np.ndarray | None
    """float32 [N], if asked for: sum over pixels of transmittance * alpha"""
    invalid_count: int
    """Gaussians skipped because an attribute is not finite or absurd, or the quaternion is zero"""
    _kept: _Kept = field(repr=False)

    @property
    def pair_count(self) -> int:
        """(Gaussian, tile) pairs."""
        return len(self._kept.pairs)

    @property
    def evaluation_count(self) -> int:
        """(Gaussian, pixel) pairs that were computed, idle lanes included."""
        return int(self._kept.visited.sum()) * WIDTH


def forward(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    tiles: np.ndarray | None = None,
    weights: bool = False,
    arena: Arena | None = None,
    sums: Lanes | None = None,
) -> Rendering:
    """Render N Gaussians.

    `tiles`, bool as `tile_shape(camera)`, limits the work: elsewhere the picture shows background, alpha 0.
    `sh_degree` may be less than the Gaussians carry. `weights` asks for the blending weight of each Gaussian.
    `sums`, the width of running sums in the gradients, is for tests and benchmarks. Raises ValueError if shapes or
    types do not fit.
    """
    prefer_tbb()
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    _check(gaussians, degree)
    sums, arena = sums or register_lanes(), arena or Arena()
    active = checked_tiles(tiles, camera)
    view = view_constants(camera, options.near, options.low_pass_px2)
    record, box, cells, invalid = _project(gaussians, degree, view, active, arena)
    visible, first_pair, pairs, start = _bin(record, box, cells, active, camera.height, arena)
    used_end, visited = arena.take(len(start) - 1, np.int64), arena.take(len(start) - 1, np.int32)
    kept = _Kept(gaussians, view, degree, sums, arena, record, first_pair, pairs, start, used_end, visited)
    colour, depth, alpha, shares = _blend(kept, camera, np.asarray(background, np.float32), weights)
    return Rendering(colour, depth, alpha, visible, shares, invalid, kept)


def backward(
    rendering: Rendering,
    d_colour: np.ndarray,
    d_depth: np.ndarray | None = None,
    d_alpha: np.ndarray | None = None,
    *,
    rows: np.ndarray | None = None,
) -> Gradients:
    """Gradients of a scalar from its derivatives by the pictures.

    d_colour [3, H, W], d_depth and d_alpha [H, W] or None for zero. `rows`, bool [N], names the Gaussians that may
    change: for the others nothing is computed but the light that they take away.
    """
    kept = rendering._kept
    gaussians, arena, count = kept.gaussians, kept.arena, len(kept.gaussians)
    chosen = np.ones(count, np.uint8) if rows is None else _checked_rows(rows, count)
    pictures = [rendering.colour, rendering.depth, rendering.alpha]
    upstream = [_flat(d, p) for d, p in zip((d_colour, d_depth, d_alpha), pictures, strict=True)]
    height, width = rendering.alpha.shape
    pair_count = len(kept.pairs)
    partial, used = arena.take(pair_count * RECORD, np.float32), arena.take(pair_count, np.uint8)
    lists = kept.record.reshape(-1), kept.pairs, kept.start, kept.used_end
    flat = [picture.reshape(-1) for picture in pictures]
    blend.blend_backward(
        kept.sums, *lists, -(-width // TILE), width, height, *flat, *upstream, chosen, partial, used, _jobs()
    )
    shapes = [(count, 3), (count, 3), (count, 4), (count,), gaussians.sh.shape, (count, 2)]
    out = [arena.take(shape, np.float32) for shape in shapes]
    overflown = np.empty(CHUNKS, np.int64)
    what, where = (kept.sh_degree, kept.view, kept.record, chosen), (kept.first_pair, used, partial)
    project_backward(*arrays(gaussians), *what, *where, *out, overflown)
    return Gradients(out[0], out[1], out[2], out[3], out[4], out[5], int(overflown.sum()))


def _jobs() -> int:
    # More jobs than threads, since tiles differ in cost; results do not depend on it.
    return 8 * numba.get_num_threads()


def _check(gaussians: Gaussians, degree: int) -> None:
    count = len(gaussians)
    shapes = {
        "means": (count, 3),
        "log_scales": (count, 3),
        "quaternions": (count, 4),
        "opacity_logits": (count,),
        "sh": (count, (gaussians.sh_degree + 1) ** 2, 3),
    }
    for name, shape in shapes.items():
        array = getattr(gaussians, name)
        if array.shape != shape or array.dtype != np.float32 or not array.flags.c_contiguous:
            raise ValueError(f"{name} must be C-contiguous float32 {shape}, but is {array.dtype} {array.shape}")
    if not 0 <= degree <= min(gaussians.sh_degree, MAX_DEGREE):
        raise ValueError(
            f"cannot render SH degree {degree}: these Gaussians carry degree {gaussians.sh_degree}, "
            f"and {MAX_DEGREE} is the highest there is"
        )


def _checked_rows(rows: np.ndarray, count: int) -> np.ndarray:
    if rows.shape != (count,) or rows.dtype != bool:
        raise ValueError(f"rows must be bool ({count},), but is {rows.dtype} {rows.shape}")
    return np.ascontiguousarray(rows).view(np.uint8)


def _flat(gradient: np.ndarray | None, picture: np.ndarray) -> np.ndarray:
    if gradient is None:
        return np.zeros(picture.size, np.float32)
    if gradient.shape != picture.shape:
        raise ValueError(f"the gradient of a picture {picture.shape} must have its shape, but has {gradient.shape}")
    return np.ascontiguousarray(gradient, np.float32).reshape(-1)


def _project(
    gaussians: Gaussians, degree: int, view: np.ndarray, active: np.ndarray, arena: Arena
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Records, boxes, tiles per box, and how many Gaussians are invalid."""
    count = len(gaussians)
    active_sum = np.zeros((active.shape[0] + 1, active.shape[1] + 1), np.int32)
    active_sum[1:, 1:] = active.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    record, box = arena.take((count, RECORD), np.float32), arena.take((count, 4), np.int32)
    cells, invalid = arena.take(count, np.int32), np.empty(CHUNKS, np.int64)
    project(*arrays(gaussians), degree, view, active_sum, record, box, cells, invalid)
    return record, box, cells, int(invalid.sum())


def _bin(
    record: np.ndarray, box: np.ndarray, cells: np.ndarray, active: np.ndarray, height: int, arena: Arena
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tiles per Gaussian, first pair per Gaussian, pairs in tile and depth order, bounds of the tiles' lists."""
    count, take = len(cells), arena.take
    order, keys = [take(count, np.int32) for _ in range(2)], [take(count, np.float32) for _ in range(2)]
    drawn = bins.drawn(cells, record.reshape(-1), order[0], keys[0])
    bins.sort_by_depth(
        drawn, order[0], keys[0].view(np.uint32), order[1], keys[1].view(np.uint32), np.empty((3, 2048), np.int64)
    )
    first_cell, first_pair = take(count + 1, np.int64), take(count + 1, np.int64)
    cell_count = bins.running_sum(cells, first_cell)
    tiles, masks, visible = take(cell_count, np.int32), take(cell_count, np.uint32), take(count, np.int32)
    bins.find_tiles(box, cells, first_cell, record.reshape(-1), active, height, tiles, masks, visible)
    pairs = take((int(bins.running_sum(visible, first_pair)), 3), np.uint32)
    histogram, start = take((BIN_CHUNKS, active.size), np.int64), take(active.size + 1, np.int64)
    bins.count_pairs(drawn, order[1], first_cell, visible, tiles, histogram)
    bins.start_tiles(histogram, start)
    bins.scatter_pairs(drawn, order[1], first_cell, first_pair, tiles, masks, histogram, pairs)
    return visible, first_pair, pairs, start


def _blend(
    kept: _Kept, camera: PinholeCamera, background: np.ndarray, weights: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Colour, depth, alpha, and the blending weights if they are wanted."""
    take, width, height = kept.arena.take, camera.width, camera.height
    colour, depth, alpha = (
        take((3, height, width), np.float32),
        take((height, width), np.float32),
        take((height, width), np.float32),
    )
    partial = take(len(kept.pairs) if weights else 0, np.float32)
    lists = kept.record.reshape(-1), kept.pairs, kept.start
    flat = [picture.reshape(-1) for picture in (colour, depth, alpha)]
    out = kept.used_end, kept.visited, partial
    blend.blend(kept.sums, *lists, tile_shape(camera)[1], width, height, background, *flat, *out, _jobs())
    if not weights:
        return colour, depth, alpha, None
    shares = take(len(kept.gaussians), np.float32)
    blend.sum_weights(partial, kept.first_pair, shares)
    return colour, depth, alpha, shares
