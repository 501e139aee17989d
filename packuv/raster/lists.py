"""What is drawn where: the projection of Gaussians and their lists per tile, of one camera.

The host side of `project` and `bins`: it holds the buffers and calls the kernels in order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.gaussians.floats import Gaussians, arrays
from packuv.raster import bins
from packuv.raster.arena import Arena
from packuv.raster.project import CHUNKS, RECORD, project
from packuv.raster.sh import MAX_DEGREE

BIN_CHUNKS = 16
"""Pieces of the depth order that are put into tiles side by side."""


@dataclass(frozen=True)
class Lists:
    """N Gaussians as one camera draws them; a pair is a Gaussian in a tile whose pixels it reaches."""

    record: np.ndarray
    """float32 [N + room, 16], see `project`; undefined where nothing is drawn"""
    visible: np.ndarray
    """int32 [N]: pairs of each Gaussian"""
    first_pair: np.ndarray
    """int64 [N + 1]: bounds of each Gaussian's slots, the places of its pairs when pairs are grouped by Gaussian"""
    pairs: np.ndarray
    """uint32 [P, 3], see `bins`, by tile and depth"""
    start: np.ndarray
    """int64 [tiles + 1]: bounds of each tile's list in `pairs`"""
    invalid_count: int
    """Gaussians that are skipped, see `project`"""


def listed(
    gaussians: Gaussians,
    degree: int,
    view: np.ndarray,
    active: np.ndarray,
    height: int,
    arena: Arena,
    *,
    room: int = 0,
) -> Lists:
    """Project and list in the active tiles, uint8 [tiles_y, tiles_x], with `room` for more records behind.

    Raises ValueError for arrays that do not fit.
    """
    check(gaussians, degree)
    record, box, cells, invalid = _project(gaussians, degree, view, active, arena, room)
    return Lists(record, *_bin(record, box, cells, active, height, arena), invalid)


def check(gaussians: Gaussians, degree: int) -> None:
    """Raise ValueError for arrays that do not fit, or a degree that cannot be rendered."""
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


def _project(
    gaussians: Gaussians, degree: int, view: np.ndarray, active: np.ndarray, arena: Arena, room: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Records, boxes, tiles per box, and how many Gaussians are invalid."""
    count = len(gaussians)
    active_sum = np.zeros((active.shape[0] + 1, active.shape[1] + 1), np.int32)
    active_sum[1:, 1:] = active.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    record, box = arena.take((count + room, RECORD), np.float32), arena.take((count, 4), np.int32)
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
