"""A layer: Gaussians that stay, ready for one camera, so that a few others are drawn over and between them cheaply."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numba
import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians
from packuv.kernels.compile import prefer_tbb
from packuv.kernels.simd import Lanes, register_lanes
from packuv.raster import blend, merge
from packuv.raster.arena import Arena
from packuv.raster.bins import GAUSSIAN, SLOT
from packuv.raster.lists import Lists, listed
from packuv.raster.picture import Composed, RasterOptions, checked_tiles
from packuv.raster.project import DEPTH
from packuv.raster.view import TILE, view_constants


@dataclass(frozen=True)
class Layer(Composed):
    """Gaussians as one camera sees them, blended as far as that can be done once: see `merge`.

    Takes 64 bytes per Gaussian that shows and, of the active tiles up to where they are opaque, 12 bytes per pair and
    5 KiB per started run of 32 pairs.
    """

    record: np.ndarray
    """float32 [N * 16]"""
    pairs: np.ndarray
    """uint32 [P, 3], by tile and depth; slots are not used"""
    start: np.ndarray
    """int64 [tiles + 1]: bounds of each tile's list in `pairs`"""
    first: np.ndarray
    """int64 [tiles + 1]: number of each tile's first checkpoint; number 0 is of all"""
    reach: np.ndarray
    """float32 [C]: depth of the last Gaussian before each checkpoint"""
    checkpoints: np.ndarray
    """float32 [C * 1280]"""
    invalid_count: int
    """Gaussians skipped, as in a rendering"""

    @property
    def nbytes(self) -> int:
        """Memory that it holds."""
        values = (getattr(self, field.name) for field in fields(self))
        return sum(value.nbytes for value in values if isinstance(value, np.ndarray))


def compose(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    tiles: np.ndarray | None = None,
    sums: Lanes | None = None,
) -> Layer:
    """Compose a layer of N Gaussians; arguments as in `cpu.forward`. Costs about two pictures of them."""
    prefer_tbb()
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    sums, arena, active = sums or register_lanes(), Arena(), checked_tiles(tiles, camera)
    view = view_constants(camera, options.near, options.low_pass_px2)
    lists = listed(gaussians, degree, view, active, camera.height, arena)
    record, pairs, start = _shown(lists, _opaque_from(lists, sums, camera, arena))
    first = 1 + _bounds(-(-np.diff(start) // merge.EVERY))
    reach, checkpoints = np.zeros(first[-1], np.float32), np.empty(first[-1] * merge.CHECKPOINT, np.float32)
    reach[1:] = record[pairs[_run_ends(start, first) - 1, GAUSSIAN], DEPTH]
    record, columns = record.reshape(-1), active.shape[1]
    merge.take_checkpoints(sums, record, pairs, start, first, columns, camera.width, camera.height, checkpoints, jobs())
    return Layer(view, active, record, pairs, start, first, reach, checkpoints, lists.invalid_count)


def jobs() -> int:
    """Pieces of work of a loop over tiles, more than threads, since tiles differ in cost; no result depends on it."""
    return 8 * numba.get_num_threads()


def _opaque_from(lists: Lists, sums: Lanes, camera: PinholeCamera, arena: Arena) -> np.ndarray:
    """End of what shows in each tile's list, int64 [tiles]."""
    count, pixels = len(lists.start) - 1, camera.width * camera.height
    used_end, visited, black = arena.take(count, np.int64), arena.take(count, np.int32), np.zeros(3, np.float32)
    pictures = [arena.take(size, np.float32) for size in (3 * pixels, pixels, pixels)]
    given = lists.record.reshape(-1), lists.pairs, lists.start, -(-camera.width // TILE), camera.width, camera.height
    blend.blend(sums, *given, black, *pictures, used_end, visited, np.empty(0, np.float32), jobs())
    return used_end


def _shown(lists: Lists, used_end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Records [N, 16], pairs and bounds of the tiles' lists, of what shows and without what does not."""
    lengths, shown = np.diff(lists.start), used_end - lists.start[:-1]
    places = np.arange(len(lists.pairs)) - np.repeat(lists.start[:-1], lengths)
    pairs = lists.pairs[places < np.repeat(shown, lengths)]
    used = np.zeros(len(lists.record), bool)
    used[pairs[:, GAUSSIAN]] = True
    pairs[:, GAUSSIAN] = (np.cumsum(used, dtype=np.uint32) - 1)[pairs[:, GAUSSIAN]]
    pairs[:, SLOT] = 0
    return lists.record[used], pairs, _bounds(shown)


def _bounds(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _run_ends(start: np.ndarray, first: np.ndarray) -> np.ndarray:
    """End in the pairs of each run of each tile, int64 [runs]."""
    counts = np.diff(first)
    place = np.arange(first[-1] - 1) - np.repeat(first[:-1] - 1, counts)
    whole = np.repeat(start[:-1], counts) + merge.EVERY * (place + 1)
    return np.asarray(np.minimum(whole, np.repeat(start[1:], counts)))
