"""How much memory of a GPU a fit will take, before it takes any.

Every tensor of `packuv.fit.resident` and of what it calls is counted, at the moments at which most of them live; only
the number of pairs of a Gaussian and a tile is an assumption. `reserve` then keeps what was foreseen for this process.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Sequence
from dataclasses import dataclass

from packuv.raster.view import TILE

OUTLINES = 87
"""Outlines that a pixel lies in, on average, as far as renderers draw them; an assumption. Seen cameras of "basketball"
(60,772 Gaussians) have 63 to 86 from 320x180 to 1920x1080, `packuv.fit.pace.made_up` 78 to 84 from 20,000 on;
a few hundred large ones, which reach beyond the picture, have up to 120"""
SORT_SCRATCH = 24
"""Of `torch.sort` for each pair, beside its results: numbers to sort along and CUB's second buffers of both"""
HELD = 1.2
"""Of torch's memory over what is alive in it: blocks are cut to sizes that change from picture to picture. An
assumption, for no GPU has been at hand"""
BASE_BYTES = 1_000_000_000
"""Of a process that draws anything at all: CUDA's context, torch's and numba's kernels and their stacks, and 24 MB for
a UV map of 1024x1024 while rows come and go; likewise"""
ROW_BYTES = 20 + 1 + 1 + 12 + 8 + 8
"""Of a Gaussian that may change, beside floats and codes: steps, whether it may, and has otherwise than by a step, code
of its place, screen gradients"""
RECORD_BYTES, PAIR_BYTES = 64, 16
"""Of a Gaussian as a camera sees it, and of a pair in its lists: key, Gaussian, blocks"""
TABLE_BYTES = 3 * 65536 * 4 + 147_304
"""Of the places that codes stand for, and of what Adam's first steps lack"""
TARGET_BYTES, WORKING_BYTES = 25, 116
"""Of a pixel of the picture in work: what is to be explained before a colour, and with it the rendering, what is
compared, its derivatives, and theirs"""


@dataclass(frozen=True)
class FitLoad:
    """What decides how much memory a fit takes."""

    sides: Sequence[tuple[int, int]]
    """Width and height of each camera's picture, pixels"""
    gaussians: int
    """That may change"""
    backdrop: int = 0
    """Gaussians that are drawn with them"""
    sh_degree: int = 0
    depths: int = 0
    """Pixels of a picture whose depth is known"""
    in_bytes: bool = True
    """Whether pictures are of 8 bits"""
    instants: int = 1
    """Whose pictures are there: of frames the next one's, too"""
    own_pairs: int | None = None
    """Of those that may change with the tiles of a picture; None: as `pairs_of`"""
    layer_pairs: int | None = None
    """Of the backdrop, likewise"""


@dataclass(frozen=True)
class GpuMemory:
    """What a fit takes."""

    needed_bytes: int
    layers_bytes: int = 0
    """Of the backdrop's layers of all cameras, if they stay; what does not fit is composed anew for each picture"""

    @property
    def all_bytes(self) -> int:
        return self.needed_bytes + round(HELD * self.layers_bytes)


class GpuFullError(RuntimeError):
    """A GPU has not as much memory left as a fit needs."""


def pairs_of(gaussians: int, width: int, height: int) -> int:
    """Pairs of a Gaussian and a tile in a picture that shows all of them: each is a box of equal area, which touches
    (1 + side / 16 px)^2 tiles."""
    return math.ceil((math.sqrt(gaussians) + math.sqrt(OUTLINES * _tiles(width, height))) ** 2)


def alive_bytes(load: FitLoad) -> int:
    """Of all tensors at the worst moment, with the layer of one camera. Labels, a camera at a time, take less."""
    rows, still, floats = load.gaussians, load.backdrop, 4 * _columns(load.sh_degree)
    width, height = _largest(load)
    pixels, tiles = width * height, _tiles(width, height)
    own, layer = pairs(load)
    both, drawn = own + layer, rows + still
    listed = 76 * rows + PAIR_BYTES * own
    joined = RECORD_BYTES * drawn + PAIR_BYTES * both if still else 0
    compared = WORKING_BYTES * pixels + listed + joined + 8 * both + 36 * tiles
    iteration = max(
        TARGET_BYTES * pixels + max((floats + 97) * still + PAIR_BYTES * layer, 157 * still + 28 * layer),  # composed
        TARGET_BYTES * pixels + 101 * rows + PAIR_BYTES * own,  # listed
        TARGET_BYTES * pixels + listed + joined + 13 * layer,  # joined
        TARGET_BYTES * pixels + listed + joined + (16 + SORT_SCRATCH) * both + 16 * tiles,  # sorted
        compared + 52 * rows,
        compared + 41 * own + (floats + 25) * rows + 2 * still,  # carried back
    )
    resident = rows * (5 * floats + ROW_BYTES + _columns(load.sh_degree) - 4) + _layer_bytes(still, layer)
    resident += TABLE_BYTES + 1024 * _columns(load.sh_degree) + _shots_bytes(load)
    whole = (floats + 101) * drawn + (20 + PAIR_BYTES + 16 + SORT_SCRATCH) * both + 20 * pixels + _shots_bytes(load)
    return max(resident + max(iteration, _changed_bytes(load)), whole)


def fit_memory(load: FitLoad, *, budget_bytes: int) -> GpuMemory:
    """What a fit takes of a GPU; layers stay as far as the budget goes."""
    layers = len(load.sides) * _layer_bytes(load.backdrop, pairs(load)[1])
    return GpuMemory(BASE_BYTES + round(HELD * alive_bytes(load)), min(layers, budget_bytes))


def pairs(load: FitLoad) -> tuple[int, int]:
    """Of the Gaussians that may change, and of the backdrop, in the largest picture."""
    width, height = _largest(load)
    own = pairs_of(load.gaussians, width, height) if load.own_pairs is None else load.own_pairs
    if load.layer_pairs is not None or not load.backdrop:
        return own, load.layer_pairs or 0
    return own, pairs_of(load.backdrop, width, height)


def reserve(memory: GpuMemory) -> int:
    """Keep what a fit needs for this process, and what its layers take as far as it is there; returns the bytes for
    layers. Raises GpuFullError where less is free, also because others have reserved it meanwhile."""
    free, _ = memory_of_gpu()
    needed = memory.needed_bytes
    room = min(memory.layers_bytes, max(0, round((free - needed) / HELD)))
    if needed > free or not _hold(needed - BASE_BYTES + round(HELD * room)):
        raise GpuFullError(f"needs {needed / 1e9:.1f} GB, {memory_of_gpu()[0] / 1e9:.1f} GB are free")
    return room


def memory_of_gpu() -> tuple[int, int]:
    """Bytes that are free on the GPU, and that it has."""
    import torch  # takes seconds to load, and who only forecasts does without

    return torch.cuda.mem_get_info()


def let_go() -> None:
    """Give back what this process holds and does not use."""
    import torch

    gc.collect()  # tracebacks and the frames that they name hold each other
    torch.cuda.empty_cache()


def _hold(size: int) -> bool:
    """Whether there is a block of so many bytes; then torch keeps it, and cuts from it what it is asked for."""
    import torch

    try:
        torch.empty(size, dtype=torch.uint8, device="cuda")
    except torch.OutOfMemoryError:
        return False
    return True


def _largest(load: FitLoad) -> tuple[int, int]:
    """Sides of the largest picture."""
    return max(load.sides, key=math.prod)


def _columns(sh_degree: int) -> int:
    """Floats of a Gaussian."""
    return 11 + 3 * (sh_degree + 1) ** 2


def _tiles(width: int, height: int) -> int:
    return -(-width // TILE) * -(-height // TILE)


def _layer_bytes(gaussians: int, layer_pairs: int) -> int:
    return RECORD_BYTES * gaussians + PAIR_BYTES * layer_pairs


def _shots_bytes(load: FitLoad) -> int:
    """Of what is to be explained, with what of it is known, active tiles, and depths."""
    picture = (3 if load.in_bytes else 12) * load.instants + 1
    return sum(picture * w * h + 9 * _tiles(w, h) + 12 * load.depths for w, h in load.sides)


def _changed_bytes(load: FitLoad) -> int:
    """Beside what is resident, while rows come and go: who has a place in the UV map, or the rows before and after."""
    seats = 184 * (load.gaussians + load.backdrop)
    return max(seats, load.gaussians * (8 * _columns(load.sh_degree) + 72))
