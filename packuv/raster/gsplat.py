"""The CUDA rasterizer: gsplat 1.5 behind the functions and conventions of the CPU one.

Arrays come and go as numpy's, so that callers need not know where they are drawn. gsplat is an optional dependency,
imported when first used. It differs in three things: versions differ in the cap on alpha (0.999 or 0.99, ours 0.99),
sums on the GPU have no fixed order, and tiles cannot be left out, so a mask of tiles is laid over the finished picture
and saves no time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.raster.picture import Composed, Gradients, RasterOptions, checked_tiles
from packuv.raster.view import MAX_COLOUR, MAX_LENGTH, MAX_LOG_SCALE, TILE, VIEW_NEAR, pixels_of_tiles, view_constants

_FAR = 1e10


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
    """int32 [N]: tiles that the Gaussian's bounding box touches"""
    weights: np.ndarray | None
    """float32 [N], if asked for: sum over pixels of transmittance * alpha"""
    invalid_count: int
    """Gaussians skipped because an attribute is not finite or absurd, or the quaternion is zero"""
    _pictures: tuple[Tensor, ...] = field(repr=False)
    _inputs: tuple[Tensor, ...] = field(repr=False)


@dataclass(frozen=True)
class GpuLayer(Composed):
    """Gaussians that stay, drawn anew in every rendering over them: a GPU saves nothing by a layer yet."""

    gaussians: Gaussians
    sh_degree: int

    @property
    def nbytes(self) -> int:
        """Memory that it holds beside the Gaussians."""
        return 0


def compose(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    tiles: np.ndarray | None = None,
) -> GpuLayer:
    """Arguments as in `cpu.forward`."""
    view = view_constants(camera, options.near, options.low_pass_px2)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    return GpuLayer(view, checked_tiles(tiles, camera), gaussians, degree)


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
    """Render on the torch device `options.device`; arguments as in `cpu.forward`.

    Raises ImportError, saying what to install, where gsplat is missing.
    """
    device = torch.device(options.device)
    leaves = tuple(torch.tensor(array, device=device, requires_grad=True) for array in arrays(gaussians))
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    active = None if over is None else over.tiles_to_draw(tiles, weights, camera, options)
    mask = _pixel_mask(tiles if active is None else active > 0, camera, device)
    with torch.enable_grad():
        if over is None:
            scene, valid = _sanitized(*leaves)
        else:
            scene, valid, degree, options = _joined(over, leaves, degree, camera, options)
        values, alpha, meta = _rasterize(scene, scene["sh"], camera, options, degree, "RGB+D")
        pictures = _composed(values, alpha, mask, background)
    sums = _array(_weights(scene, camera, options, mask)) if weights else None
    first = 0 if over is None else len(over.gaussians)
    touched = meta["tiles_per_gauss"].reshape(-1)
    if over is not None:
        touched = (touched * (scene["opacities"] > 0))[first:]
    visible = _array(touched.to(torch.int32))
    invalid, inputs = int((~valid[first:]).sum()), (*leaves, meta["means2d"])
    shown = [_array(picture) for picture in pictures]
    return GpuRendering(shown[0], shown[1], shown[2], visible, sums, invalid, pictures, inputs)


def backward(
    rendering: GpuRendering,
    d_colour: np.ndarray,
    d_depth: np.ndarray | None = None,
    d_alpha: np.ndarray | None = None,
    *,
    rows: np.ndarray | None = None,
) -> Gradients:
    """Gradients as in `cpu.backward`. A rendering serves once: its graph is freed."""
    device = rendering._pictures[0].device
    pairs = zip(rendering._pictures, (d_colour, d_depth, d_alpha), strict=True)
    given = [(picture, torch.as_tensor(slope, device=device)) for picture, slope in pairs if slope is not None]
    pictures, slopes = [picture for picture, _ in given], [slope for _, slope in given]
    found = torch.autograd.grad(pictures, rendering._inputs, slopes, allow_unused=True)
    whole = [torch.zeros_like(a) if g is None else g for g, a in zip(found, rendering._inputs, strict=True)]
    whole[5] = whole[5].reshape(-1, 2)  # [1, N, 2] of one camera; those of a layer come first
    whole[5] = whole[5][len(whole[5]) - len(whole[0]) :]
    finite = torch.stack([g.reshape(len(g), math.prod(g.shape[1:])).isfinite().all(1) for g in whole]).all(0)
    keep = finite if rows is None else finite & torch.as_tensor(rows, device=device)
    kept = [_array(torch.where(keep.reshape(-1, *[1] * (g.ndim - 1)), g, 0)) for g in whole]
    return Gradients(kept[0], kept[1], kept[2], kept[3], kept[4], kept[5], int((~finite).sum()))


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _sanitized(
    means: Tensor, log_scales: Tensor, quaternions: Tensor, logits: Tensor, sh: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """gsplat's inputs, with invalid rows replaced by harmless ones of opacity 0, and which rows are valid, bool [N]."""
    with torch.no_grad():
        valid = (means.abs().amax(1) <= MAX_LENGTH) & (log_scales.amax(1) <= MAX_LOG_SCALE)
        valid &= log_scales.isfinite().all(1) & logits.isfinite() & quaternions.isfinite().all(1)
        valid &= (sh.abs().flatten(1).amax(1) <= MAX_COLOUR) & (quaternions.double().square().sum(1) > 1e-24)
    row = valid[:, None]
    scene = {
        "means": torch.where(row, means, 0),
        "quats": torch.where(row, quaternions, torch.tensor([1.0, 0, 0, 0], device=means.device)),
        "scales": torch.where(row, log_scales, 0).exp(),
        "opacities": torch.where(valid, torch.sigmoid(torch.where(valid, logits, 0)), 0),
        "sh": torch.where(row[..., None], sh, 0),
    }
    return scene, valid


def _joined(
    layer: GpuLayer, leaves: tuple[Tensor, ...], degree: int, camera: PinholeCamera, options: RasterOptions
) -> tuple[dict[str, Tensor], Tensor, int, RasterOptions]:
    """Inputs and which rows are valid, as from `_sanitized`, of a layer and `leaves`; degree and options for both.

    Each keeps its degree and near plane: coefficients are filled up with zeros, what is too near has opacity 0.
    """
    still = [torch.as_tensor(array, device=leaves[0].device) for array in arrays(layer.gaussians)]
    highest, near = max(degree, layer.sh_degree), float(layer.view[VIEW_NEAR])
    both = [torch.cat(pair) for pair in zip(still[:4], leaves[:4], strict=True)]
    both.append(torch.cat([_of_degree(still[4], layer.sh_degree, highest), _of_degree(leaves[4], degree, highest)]))
    scene, valid = _sanitized(*both)
    pose = torch.as_tensor(camera.camera_from_world, dtype=torch.float32, device=leaves[0].device)
    depth = scene["means"].detach() @ pose[2, :3] + pose[2, 3]
    planes = torch.full_like(depth, options.near)
    planes[: len(still[0])] = near
    scene["opacities"] = torch.where(depth >= planes, scene["opacities"], 0)
    return scene, valid, highest, replace(options, near=min(near, options.near))


def _of_degree(sh: Tensor, degree: int, highest: int) -> Tensor:
    """Coefficients [N, (highest + 1) ** 2, 3], zero above `degree`."""
    out = torch.zeros((len(sh), (highest + 1) ** 2, 3), device=sh.device)
    out[:, : (degree + 1) ** 2] = sh[:, : (degree + 1) ** 2]
    return out


def _rasterize(
    scene: dict[str, Tensor],
    colours: Tensor,
    camera: PinholeCamera,
    options: RasterOptions,
    sh_degree: int | None,
    mode: str,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """One camera: values [H, W, D], alpha [H, W], gsplat's intermediate results."""
    like: dict[str, Any] = {"dtype": torch.float32, "device": colours.device}
    geometry = {name: scene[name] for name in ("means", "quats", "scales", "opacities")}
    values, alpha, meta = _gsplat().rasterization(
        **geometry,
        colors=colours,
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
        render_mode=mode,
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


def _weights(scene: dict[str, Tensor], camera: PinholeCamera, options: RasterOptions, mask: Tensor) -> Tensor:
    """Blending weight per Gaussian: the derivative of a picture's sum by a colour that all Gaussians share."""
    frozen = {name: tensor.detach() for name, tensor in scene.items()}
    ones = torch.ones((len(frozen["means"]), 1), device=frozen["means"].device, requires_grad=True)
    with torch.enable_grad():
        values, _, _ = _rasterize(frozen, ones, camera, options, None, "RGB")
        total = (values[..., 0] * mask).sum()
    return torch.autograd.grad(total, ones)[0][:, 0]


def _gsplat() -> Any:
    try:
        import gsplat
    except ImportError as error:
        raise ImportError("rendering on a GPU needs gsplat: pip install 'packuv[cuda]'") from error
    return gsplat
