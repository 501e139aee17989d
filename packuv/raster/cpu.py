"""The CPU rasterizer: projection, lists per tile, blending, and their gradients.

The host side: it holds the buffers and calls the kernels in order. Float32 results do not depend on the number of
threads, nor on the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.kernels.compile import prefer_tbb
from packuv.kernels.simd import WIDTH, Lanes, register_lanes
from packuv.raster import blend, merge
from packuv.raster.arena import Arena
from packuv.raster.layer import Layer, jobs
from packuv.raster.lists import Lists, listed
from packuv.raster.picture import Gradients, RasterOptions, checked_rows, checked_slope, checked_tiles, tile_shape
from packuv.raster.project import CHUNKS, RECORD, project_backward
from packuv.raster.view import TILE, view_constants


@dataclass(frozen=True)
class _Merged:
    """The lists of what is drawn over a layer, merged with those of the layer."""

    layer: Layer
    entries: np.ndarray  # uint32 [E, 3], as pairs; slots are those of what changes
    jumps: np.ndarray  # int64 [C, 3]
    jump_end: np.ndarray  # int64 [tiles]


@dataclass(frozen=True)
class _Kept:
    """What the gradients need of a rendering."""

    gaussians: Gaussians
    view: np.ndarray
    sh_degree: int
    sums: Lanes
    arena: Arena
    lists: Lists
    used_end: np.ndarray  # int64 [tiles]
    visited: np.ndarray  # int32 [tiles]
    merged: _Merged | None = None


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
        """(Gaussian, tile) pairs, without those of a layer."""
        return len(self._kept.lists.pairs)

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
    over: Layer | None = None,
    sums: Lanes | None = None,
) -> Rendering:
    """Render N Gaussians.

    `tiles`, bool as `tile_shape(camera)`, limits the work: elsewhere the picture shows background, alpha 0.
    `sh_degree` may be less than the Gaussians carry. `weights` asks for the blending weight of each Gaussian. `over`
    is a layer of other Gaussians, drawn with these as if they stood before them in one set; it needs no `tiles` where
    its own are meant. `sums`, the width of running sums in the gradients, is for tests and benchmarks. Raises
    ValueError if shapes or types do not fit.
    """
    prefer_tbb()
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    sums, arena = sums or register_lanes(), arena or Arena()
    view = view_constants(camera, options.near, options.low_pass_px2)
    if over is None:
        active = checked_tiles(tiles, camera)
    else:
        active = over.tiles_to_draw(tiles, weights, camera, options)
    lists = listed(gaussians, degree, view, active, camera.height, arena, room=0 if over is None else len(over.pairs))
    used_end, visited = arena.take(active.size, np.int64), arena.take(active.size, np.int32)
    merged = None if over is None else _room_to_merge(over, lists, arena)
    kept = _Kept(gaussians, view, degree, sums, arena, lists, used_end, visited, merged)
    behind = np.asarray(background, np.float32)
    if merged is not None:
        colour, depth, alpha, shares = *_blend_over(kept, merged, active, camera, behind), None
    else:
        colour, depth, alpha, shares = _blend(kept, camera, behind, weights)
    return Rendering(colour, depth, alpha, lists.visible, shares, lists.invalid_count, kept)


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
    gaussians, lists, arena, count = kept.gaussians, kept.lists, kept.arena, len(kept.gaussians)
    chosen = np.ones(count, np.uint8) if rows is None else checked_rows(rows, count)
    pictures = [rendering.colour, rendering.depth, rendering.alpha]
    upstream = [_flat(d, p) for d, p in zip((d_colour, d_depth, d_alpha), pictures, strict=True)]
    height, width = rendering.alpha.shape
    pair_count = len(lists.pairs)
    partial, used = arena.take(pair_count * RECORD, np.float32), arena.take(pair_count, np.uint8)
    given = -(-width // TILE), width, height, *(picture.reshape(-1) for picture in pictures), *upstream
    if kept.merged is not None:
        _blend_over_backward(kept, kept.merged, given, chosen, partial, used)
    else:
        walked = lists.record.reshape(-1), lists.pairs, lists.start, kept.used_end
        blend.blend_backward(kept.sums, *walked, *given, chosen, partial, used, jobs())
    shapes = [(count, 3), (count, 3), (count, 4), (count,), gaussians.sh.shape, (count, 2)]
    out = [arena.take(shape, np.float32) for shape in shapes]
    overflown = np.empty(CHUNKS, np.int64)
    what, where = (kept.sh_degree, kept.view, lists.record, chosen), (lists.first_pair, used, partial)
    project_backward(*arrays(gaussians), *what, *where, *out, overflown)
    return Gradients(out[0], out[1], out[2], out[3], out[4], out[5], int(overflown.sum()))


def _flat(gradient: np.ndarray | None, picture: np.ndarray) -> np.ndarray:
    if gradient is None:
        return _no_gradient(picture.size)
    return checked_slope(gradient, picture.shape).reshape(-1)


@lru_cache(maxsize=8)
def _no_gradient(size: int) -> np.ndarray:
    """Zeros for kernels, which only read them."""
    return np.zeros(size, np.float32)


def _pictures(camera: PinholeCamera, arena: Arena) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Room for colour, depth and alpha."""
    shape = camera.height, camera.width
    return arena.take((3, *shape), np.float32), arena.take(shape, np.float32), arena.take(shape, np.float32)


def _blend(
    kept: _Kept, camera: PinholeCamera, background: np.ndarray, weights: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Colour, depth, alpha, and the blending weights if they are wanted."""
    take, lists = kept.arena.take, kept.lists
    colour, depth, alpha = _pictures(camera, kept.arena)
    partial = take(len(lists.pairs) if weights else 0, np.float32)
    walked = lists.record.reshape(-1), lists.pairs, lists.start
    flat = [picture.reshape(-1) for picture in (colour, depth, alpha)]
    out, shape, size = (kept.used_end, kept.visited, partial), tile_shape(camera), (camera.width, camera.height)
    blend.fill((np.diff(lists.start) > 0).reshape(shape), *size, background, *flat)
    blend.blend(kept.sums, *walked, shape[1], *size, background, *flat, *out, jobs())
    if not weights:
        return colour, depth, alpha, None
    shares = take(len(kept.gaussians), np.float32)
    blend.sum_weights(partial, lists.first_pair, shares)
    return colour, depth, alpha, shares


def _room_to_merge(layer: Layer, lists: Lists, arena: Arena) -> _Merged:
    """Room for the merged lists; what is not walked stays untouched."""
    entries = arena.take((len(layer.pairs) + len(lists.pairs), 3), np.uint32)
    return _Merged(layer, entries, arena.take((len(layer.reach), 3), np.int64), arena.take(layer.active.size, np.int64))


def _blend_over(
    kept: _Kept, merged: _Merged, active: np.ndarray, camera: PinholeCamera, background: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, depth, alpha over a layer."""
    layer, lists, pictures = merged.layer, kept.lists, _pictures(camera, kept.arena)
    still = layer.record, layer.pairs, layer.start, layer.first, layer.reach, layer.checkpoints
    shown = (active > 0) & (np.diff(lists.start) + np.diff(layer.start) > 0).reshape(active.shape)
    moving = len(kept.gaussians), lists.record.reshape(-1), lists.pairs, lists.start, shown.reshape(-1)
    size = camera.width, camera.height
    room = merged.entries, merged.jumps, merged.jump_end
    flat = [picture.reshape(-1) for picture in pictures]
    out = kept.used_end, kept.visited
    blend.fill(shown, *size, background, *flat)
    merge.blend_over(kept.sums, *still, *moving, active.shape[1], *size, background, *room, *flat, *out, jobs())
    return pictures


def _blend_over_backward(
    kept: _Kept, merged: _Merged, given: Sequence[Any], chosen: np.ndarray, partial: np.ndarray, used: np.ndarray
) -> None:
    """Partial gradients of what was drawn over a layer."""
    layer, lists = merged.layer, kept.lists
    rows = kept.arena.take(len(lists.record), np.uint8)
    rows[: len(chosen)], rows[len(chosen) :] = chosen, 0
    where = layer.start, layer.first, layer.checkpoints, lists.record.reshape(-1), lists.pairs, lists.start
    walked = merged.entries, merged.jumps, merged.jump_end, kept.used_end, rows
    merge.blend_over_backward(kept.sums, *where, *walked, *given, partial, used, jobs())
