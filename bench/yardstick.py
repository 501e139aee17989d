"""gsplat 1.5 by our conventions: what the CUDA rasterizer's speed is held against, where it is installed.

It needs a compiler of CUDA at its first call. Versions differ in the cap on alpha (0.999 or 0.99, ours 0.99). It has
never run on a GPU here: `tests/bench/test_yardstick.py` puts a dense rasterizer in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.raster import Arena, Gradients, RasterOptions
from packuv.raster.picture import checked_tiles
from packuv.raster.view import TILE, pixels_of_tiles

_FAR = 1e10


@dataclass(frozen=True)
class Rendering:
    """A picture of Gaussians; the fields mean what they mean in `packuv.raster`."""

    colour: np.ndarray
    """float32 [3, H, W], background included"""
    depth: np.ndarray
    """float32 [H, W]: sum of weight times z"""
    alpha: np.ndarray
    """float32 [H, W]"""
    visible: np.ndarray
    """int32 [N]: tiles that the Gaussian's bounding box touches"""
    _pictures: tuple[Tensor, ...] = field(repr=False)
    _inputs: tuple[Tensor, ...] = field(repr=False)


def render(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    tiles: np.ndarray | None = None,
    arena: Arena | None = None,
) -> Rendering:
    """Render valid Gaussians on the torch device `options.device`; arguments as in `packuv.raster.render`.

    Tiles are laid over the finished picture as a mask, and save nothing; `arena` is not used.
    """
    device = torch.device(options.device)
    leaves = tuple(torch.tensor(array, device=device, requires_grad=True) for array in arrays(gaussians))
    mask = _pixel_mask(tiles, camera, device)
    with torch.enable_grad():
        values, alpha, meta = _rasterize(leaves, camera, options, gaussians.sh_degree)
        pictures = _composed(values, alpha, mask, background)
    visible = _array(meta["tiles_per_gauss"].reshape(-1).to(torch.int32))
    colour, depth, covered = map(_array, pictures)
    return Rendering(colour, depth, covered, visible, pictures, (*leaves, meta["means2d"]))


def gradients(
    rendering: Rendering,
    d_colour: np.ndarray,
    d_depth: np.ndarray | None = None,
    d_alpha: np.ndarray | None = None,
    *,
    rows: np.ndarray | None = None,
) -> Gradients:
    """Gradients as in `packuv.raster.gradients`. A rendering serves once: its graph is freed."""
    device = rendering._pictures[0].device
    pairs = zip(rendering._pictures, (d_colour, d_depth, d_alpha), strict=True)
    given = [(picture, torch.as_tensor(slope, device=device)) for picture, slope in pairs if slope is not None]
    pictures, slopes = [picture for picture, _ in given], [slope for _, slope in given]
    found = torch.autograd.grad(pictures, rendering._inputs, slopes, allow_unused=True)
    whole = [torch.zeros_like(a) if g is None else g for g, a in zip(found, rendering._inputs, strict=True)]
    whole[5] = whole[5].reshape(-1, 2)  # [1, N, 2] of one camera
    keep = torch.ones(len(whole[0]), dtype=torch.bool) if rows is None else torch.as_tensor(rows)
    keep = keep.to(device)
    kept = [_array(torch.where(keep.reshape(-1, *[1] * (g.ndim - 1)), g, 0)) for g in whole]
    return Gradients(kept[0], kept[1], kept[2], kept[3], kept[4], kept[5], 0)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _rasterize(
    leaves: tuple[Tensor, ...], camera: PinholeCamera, options: RasterOptions, sh_degree: int
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """One camera: colour and depth [H, W, 4], alpha [H, W], gsplat's intermediate results."""
    import gsplat

    means, log_scales, quaternions, logits, sh = leaves
    like: dict[str, Any] = {"dtype": torch.float32, "device": means.device}
    values, alpha, meta = gsplat.rasterization(
        means=means,
        quats=quaternions,
        scales=log_scales.exp(),
        opacities=torch.sigmoid(logits),
        colors=sh,
        viewmats=torch.as_tensor(camera.camera_from_world, **like)[None],
        Ks=torch.as_tensor(camera.matrix, **like)[None],
        width=camera.width,
        height=camera.height,
        near_plane=options.near,
        far_plane=_FAR,
        eps2d=options.low_pass_px2,
        sh_degree=sh_degree,
        packed=False,
        tile_size=TILE,
        render_mode="RGB+D",
        rasterize_mode="classic",
    )
    return values[0], alpha[0, ..., 0], meta


def _composed(values: Tensor, alpha: Tensor, mask: Tensor, background: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Colour over the background, depth and alpha; nothing but background where the mask is 0."""
    alpha, values = alpha * mask, values * mask[..., None]
    behind = torch.as_tensor(np.asarray(background, np.float32), device=alpha.device)
    colour = values[..., :3].permute(2, 0, 1) + (1 - alpha) * behind[:, None, None]
    return colour, values[..., 3], alpha


def _pixel_mask(tiles: np.ndarray | None, camera: PinholeCamera, device: torch.device) -> Tensor:
    """1 in active tiles, 0 elsewhere, [H, W]."""
    active = checked_tiles(tiles, camera).astype(np.float32)
    return torch.as_tensor(np.ascontiguousarray(pixels_of_tiles(active, camera)), device=device)
