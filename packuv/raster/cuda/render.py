"""The CUDA rasterizer's host side: it holds the tensors and runs the kernels in order.

`forward` and `backward` take and give numpy's arrays, so that callers need not know where they are drawn; `draw` and
`carry` are the same for tensors that stay on the GPU. Sums have one order, so that two
runs on one GPU give the same bytes; they are not those of the CPU, which adds and rounds in another order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.raster.cuda import blend, project
from packuv.raster.cuda.launch import MEMORY, on_device, run, run_rows
from packuv.raster.lists import check
from packuv.raster.picture import Composed, Gradients, RasterOptions, checked_rows, checked_slope, checked_tiles
from packuv.raster.project import DEPTH, RECORD
from packuv.raster.view import TILE, view_constants


@dataclass(frozen=True)
class Pairs:
    """Gaussians as one camera sees them, and their pairs with tiles."""

    record: Tensor
    """float32 [N, 16], see the CPU's `project`; undefined where nothing is drawn"""
    keys: Tensor
    """int64 [P]: the tile's number, and in the lower half the bits of the depth"""
    gaussians: Tensor
    """int32 [P]: row of the record"""
    masks: Tensor
    """int32 [P]: blocks of the tile that the Gaussian reaches"""

    @property
    def nbytes(self) -> int:
        """Memory of the GPU that they hold."""
        return sum(tensor.nbytes for tensor in (self.record, self.keys, self.gaussians, self.masks))


@dataclass(frozen=True)
class _Listed:
    """N Gaussians whose pairs are grouped by Gaussian: a pair's place is its slot."""

    pairs: Pairs
    visible: Tensor
    """int32 [N]: pairs of each Gaussian"""
    first_pair: Tensor
    """int64 [N + 1]: bounds of each Gaussian's slots"""
    invalid: Tensor
    """int32 [1]: Gaussians that are skipped"""


@dataclass(frozen=True)
class _Drawn:
    """The lists that a picture was blended from."""

    pairs: Pairs
    slots: Tensor
    """int64 [P], by tile and depth"""
    start: Tensor
    """int64 [tiles + 1]: bounds of each tile's list in `slots`"""
    tiles: Tensor
    """int64: numbers of those that are drawn"""
    used_end: Tensor
    """int64 [tiles]"""


@dataclass(frozen=True)
class OnGpu:
    """A rendering that stays on the GPU, with what its gradients need."""

    fields: tuple[Tensor, ...]
    """As the arrays of `Gaussians`"""
    view: Tensor
    sh_degree: int
    own: _Listed
    drawn: _Drawn
    pictures: tuple[Tensor, Tensor, Tensor]
    """Colour [3, H, W], depth and alpha [H, W], float32"""
    shares: Tensor
    """float32 by slot: what each pair shows, if asked for"""

    @property
    def visible(self) -> Tensor:
        """int32 [N], as `GpuRendering.visible`."""
        return self.own.visible

    @property
    def weights(self) -> Tensor:
        """float32 [N], as `GpuRendering.weights`, of a picture drawn with them; summed anew each time."""
        sums = torch.zeros(len(self.visible), device=MEMORY)
        run_rows(project.sum_shares, len(sums), self.shares, self.own.first_pair, sums)
        return sums


@dataclass(frozen=True)
class GpuRendering:
    """A picture of Gaussians drawn on a GPU; the fields mean what they mean in `cpu.Rendering`."""

    colour: np.ndarray
    """float32 [3, H, W], background included"""
    depth: np.ndarray
    """float32 [H, W]: sum of weight times z"""
    alpha: np.ndarray
    """float32 [H, W]"""
    visible: np.ndarray
    """int32 [N]: number of tiles whose pixels the Gaussian reaches, before occlusion"""
    weights: np.ndarray | None
    """float32 [N], if asked for: sum over pixels of transmittance * alpha"""
    invalid_count: int
    """Gaussians skipped because an attribute is not finite or absurd, or the quaternion is zero"""
    _kept: OnGpu = field(repr=False)


@dataclass(frozen=True)
class GpuLayer(Composed):
    """Gaussians that stay, projected and listed once; every rendering over them blends them anew."""

    pairs: Pairs
    """On the GPU, of what shows"""
    invalid_count: int
    """Gaussians skipped, as in a rendering"""

    @property
    def nbytes(self) -> int:
        """Memory that it holds, nearly all of it the GPU's: 64 bytes per Gaussian that shows and 16 per pair."""
        return self.view.nbytes + self.active.nbytes + self.pairs.nbytes


def compose(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    tiles: np.ndarray | None = None,
) -> GpuLayer:
    """Arguments as in `cpu.forward`."""
    view, active = view_constants(camera, options.near, options.low_pass_px2), checked_tiles(tiles, camera)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    check(gaussians, degree)
    listed = _listed(_uploaded(gaussians), degree, view, active, camera.height)
    return GpuLayer(view, active, _shown(listed), int(listed.invalid))


def forward(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    tiles: np.ndarray | None = None,
    weights: bool = False,
    over: GpuLayer | None = None,
) -> GpuRendering:
    """Arguments and errors as in `cpu.forward`."""
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    check(gaussians, degree)
    drawn = draw(
        _uploaded(gaussians),
        camera,
        options=options,
        sh_degree=degree,
        background=background,
        tiles=tiles,
        weights=weights,
        over=over,
    )
    colour, depth, alpha = map(_array, drawn.pictures)
    shown = _array(drawn.weights) if weights else None
    return GpuRendering(colour, depth, alpha, _array(drawn.visible), shown, int(drawn.own.invalid), drawn)


def draw(
    fields: tuple[Tensor, ...],
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int,
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    tiles: np.ndarray | None = None,
    weights: bool = False,
    over: GpuLayer | None = None,
) -> OnGpu:
    """As `forward`, of Gaussians on the GPU, in the order of `ATTRIBUTES`."""
    view = view_constants(camera, options.near, options.low_pass_px2)
    active = checked_tiles(tiles, camera) if over is None else over.tiles_to_draw(tiles, weights, camera, options)
    own = _listed(fields, sh_degree, view, active, camera.height)
    drawn = _sorted(own.pairs if over is None else _joined(over, own.pairs, active), active)
    shares = torch.zeros(len(own.pairs.keys) if weights else 1, device=MEMORY)
    pictures = _blended(drawn, camera, on_device(np.asarray(background, np.float32)), weights, shares)
    return OnGpu(fields, on_device(view), sh_degree, own, drawn, pictures, shares)


def backward(
    rendering: GpuRendering,
    d_colour: np.ndarray,
    d_depth: np.ndarray | None = None,
    d_alpha: np.ndarray | None = None,
    *,
    rows: np.ndarray | None = None,
) -> Gradients:
    """Arguments and errors as in `cpu.backward`."""
    kept = rendering._kept
    count = len(kept.visible)
    chosen = on_device(np.ones(count, np.uint8) if rows is None else checked_rows(rows, count))
    slopes = [_slope(d, p) for d, p in zip((d_colour, d_depth, d_alpha), kept.pictures, strict=True)]
    out, overflown = carry(kept, slopes, chosen)
    means, log_scales, quaternions, logits, sh, screen = map(_array, out)
    return Gradients(means, log_scales, quaternions, logits, sh, screen, int(overflown))


def carry(kept: OnGpu, slopes: Sequence[Tensor], chosen: Tensor) -> tuple[list[Tensor], Tensor]:
    """Gradients by the Gaussians, in the order of `ATTRIBUTES`, and by their centres in the picture, [N, 2]; and how
    many rows were set to zero, int32 [1]. `slopes` by colour, depth and alpha; `chosen` uint8 [N]."""
    own, fields = kept.own, kept.fields
    count, pair_count = len(own.visible), len(own.pairs.keys)
    partial = torch.empty((pair_count, project.SUMS), device=MEMORY)
    used = torch.zeros(pair_count, dtype=torch.uint8, device=MEMORY)
    _blend_backward(kept, slopes, chosen, partial, used)
    out = [torch.zeros_like(f) for f in fields] + [torch.zeros((count, 2), device=MEMORY)]
    overflown = torch.zeros(1, dtype=torch.int32, device=MEMORY)
    given = *fields, kept.sh_degree, kept.view, own.pairs.record, chosen, own.first_pair, used, partial
    run_rows(project.project_backward, count, *given, *out, overflown)
    return out, overflown


def _listed(fields: tuple[Tensor, ...], degree: int, view: np.ndarray, active: np.ndarray, height: int) -> _Listed:
    """Project, and find the active tiles, uint8 [tiles_y, tiles_x], that each Gaussian reaches."""
    count, areas = len(fields[0]), np.zeros((active.shape[0] + 1, active.shape[1] + 1), np.int32)
    areas[1:, 1:] = active.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    record, box = torch.empty((count, RECORD), device=MEMORY), _integers(count, 4)
    drawn, invalid, hits = torch.zeros(count, dtype=torch.uint8, device=MEMORY), _integers(1), _integers(count)
    given = *fields, degree, on_device(view), on_device(areas)
    run_rows(project.project, count, *given, record, box, drawn, invalid)
    tiles = on_device(active)
    run_rows(project.count_tiles, count, record, box, drawn, tiles, height, hits)
    first_pair = torch.zeros(count + 1, dtype=torch.int64, device=MEMORY)
    torch.cumsum(hits, 0, out=first_pair[1:])
    pairs = int(first_pair[-1])
    keys, gaussians, masks = torch.empty(pairs, dtype=torch.int64, device=MEMORY), _integers(pairs), _integers(pairs)
    depth_bits = record[:, DEPTH].contiguous().view(torch.int32)
    run_rows(project.list_tiles, count, record, box, depth_bits, tiles, height, first_pair, keys, gaussians, masks)
    return _Listed(Pairs(record, keys, gaussians, masks), hits, first_pair, invalid)


def _shown(listed: _Listed) -> Pairs:
    """The pairs, and the records that they need."""
    pairs, shows = listed.pairs, listed.visible > 0
    rows = torch.cumsum(shows, 0, dtype=torch.int32) - 1
    return Pairs(pairs.record[shows], pairs.keys, rows[pairs.gaussians], pairs.masks)


def _sorted(pairs: Pairs, active: np.ndarray) -> _Drawn:
    """Lists by tile and depth; at equal depth in the order of slots."""
    keys, slots = torch.sort(pairs.keys, stable=True)
    bounds = torch.arange(active.size + 1, device=MEMORY) << 32
    start = torch.searchsorted(keys, bounds)
    return _Drawn(pairs, slots, start, on_device(np.flatnonzero(active)), torch.zeros_like(start[1:]))


def _joined(layer: GpuLayer, own: Pairs, active: np.ndarray) -> Pairs:
    """Those of a layer, which come first, and others, in the active tiles."""
    still = layer.pairs
    if not np.array_equal(active, layer.active):
        kept = torch.nonzero(on_device(active).reshape(-1)[still.keys >> 32])[:, 0]
        still = Pairs(still.record, still.keys[kept], still.gaussians[kept], still.masks[kept])
    return Pairs(
        torch.cat([still.record, own.record]),
        torch.cat([still.keys, own.keys]),
        torch.cat([still.gaussians, own.gaussians + len(still.record)]),
        torch.cat([still.masks, own.masks]),
    )


def _blended(
    drawn: _Drawn, camera: PinholeCamera, background: Tensor, weighed: bool, shares: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, depth and alpha, [3, H, W], [H, W] and [H, W]; nothing but background where nothing is listed."""
    shape = camera.height, camera.width
    colour = background[:, None, None].expand(3, *shape).contiguous()
    depth, alpha = torch.zeros(shape, device=MEMORY), torch.zeros(shape, device=MEMORY)
    out = colour, depth, alpha, drawn.used_end, int(weighed), shares
    run(blend.blend, _blocks(drawn), *_walked(drawn), -(-camera.width // TILE), background, *out)
    return colour, depth, alpha


def _blend_backward(kept: OnGpu, slopes: Sequence[Tensor], chosen: Tensor, partial: Tensor, used: Tensor) -> None:
    """Partial gradients of a rendering's own Gaussians; a layer's, which come before them, are not chosen."""
    drawn, own = kept.drawn, kept.own.pairs
    still = len(drawn.pairs.record) - len(own.record)
    rows = torch.cat([torch.zeros(still, dtype=torch.uint8, device=MEMORY), chosen])
    columns = -(-kept.pictures[1].shape[1] // TILE)
    first_slot = len(drawn.slots) - len(own.keys)
    given = *_walked(drawn), drawn.used_end, columns, *kept.pictures, *slopes, rows, first_slot
    run(blend.blend_backward, _blocks(drawn), *given, partial, used)


def _walked(drawn: _Drawn) -> tuple[Tensor, ...]:
    """What kernels walk the lists by."""
    pairs = drawn.pairs
    return pairs.record, pairs.gaussians, pairs.masks, drawn.slots, drawn.start, drawn.tiles


def _blocks(drawn: _Drawn) -> int:
    """One for each tile. How many lists are empty only the GPU knows, and to ask would be to wait for it."""
    return len(drawn.tiles) if len(drawn.slots) else 0


def _slope(gradient: np.ndarray | None, picture: Tensor) -> Tensor:
    if gradient is None:
        return torch.zeros_like(picture)
    return on_device(checked_slope(gradient, tuple(picture.shape)))


def _uploaded(gaussians: Gaussians) -> tuple[Tensor, ...]:
    return tuple(on_device(array) for array in arrays(gaussians))


def _integers(*shape: int) -> Tensor:
    return torch.zeros(shape, dtype=torch.int32, device=MEMORY)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.cpu().numpy()
