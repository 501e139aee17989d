"""Where Gaussians are taken away, on a GPU: as `density`, over tensors that stay there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from packuv.camera import PinholeCamera
from packuv.fit.density import DensityOptions, ScreenGradient
from packuv.fit.depth import COVERED
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.uvsize import UvOptions
from packuv.raster.cuda.launch import MEMORY, on_device
from packuv.raster.cuda.render import OnGpu


def prune(
    masters: Sequence[Tensor],
    gradient: ScreenGradient,
    taken: np.ndarray,
    *,
    bounds: Bounds,
    options: DensityOptions,
    uv: UvOptions,
) -> Tensor:
    """As `density.prune`, bool [N]; `masters` in the order of `ATTRIBUTES`."""
    means, log_scales, _, logits, _ = masters
    keep = torch.sigmoid(logits.double()) > options.min_opacity
    keep &= log_scales.amax(dim=1) < np.log(options.max_scale * bounds.radius)
    keep &= torch.isfinite(means).all(dim=1)
    if options.min_gradient > 0:
        keep &= on_device((gradient.seen == 0) | (gradient.mean >= options.min_gradient))
    rows = torch.nonzero(keep)[:, 0]
    points = torch.cat([on_device(taken), means[rows]])
    reserved = torch.full((len(taken),), np.inf, dtype=torch.float64, device=MEMORY)
    seated = _seated(_texels(points, bounds.centre, uv), torch.cat([reserved, logits[rows].double()]), uv)
    keep[rows] = seated[len(taken) :]
    return keep


def views_showing(rendering: OnGpu, means: Tensor, camera: PinholeCamera, options: DensityOptions) -> Tensor:
    """As `density.views_showing`, int64 [N]."""
    shown = rendering.weights >= options.least_shown * camera.width * camera.height / options.cap
    _, depth, alpha = rendering.pictures
    drawn = alpha > COVERED
    surface = torch.sort(depth[drawn] / alpha[drawn]).values
    usual = float(surface[[(len(surface) - 1) // 2, len(surface) // 2]].mean()) if len(surface) else 0.0
    axis = camera.camera_from_world[2]
    z = (means.double() * on_device(axis[:3])).sum(dim=1) + axis[3]
    return shown * torch.where(z >= options.afar * usual, options.least_views, 1)


def _texels(points: Tensor, centre: np.ndarray, uv: UvOptions) -> Tensor:
    """As `uvmap.sphere_texels`, int64 [N, 2], of finite points."""
    x, y, z = (points.double() - on_device(centre)).unbind(dim=1)
    rho = torch.sqrt(x * x + y * y + z * z)
    theta = torch.atan2(y, x)
    phi = torch.arccos((z / rho).clamp(-1, 1).where(rho > 0, 1.0))
    row = torch.floor((np.pi + theta) / (2 * np.pi) * uv.rows).long() % uv.rows
    return torch.stack([row, torch.floor(phi / np.pi * uv.columns).long().clamp(max=uv.columns - 1)], dim=1)


def _seated(texels: Tensor, opacity: Tensor, uv: UvOptions) -> Tensor:
    """Who has a place in the map, bool [N], as `uvmap.assign_slots`: layer by layer the most opaque, or of equals the
    first, of each texel. Largest and smallest are the same in any order of the threads."""
    count = len(texels)
    seated = torch.zeros(count, dtype=torch.bool, device=MEMORY)
    waiting = torch.arange(count, device=MEMORY)
    for rows, columns in uv.sizes:
        place = texels[waiting, 0] // (uv.rows // rows) * columns + texels[waiting, 1] // (uv.columns // columns)
        most = torch.full((rows * columns,), -np.inf, dtype=torch.float64, device=MEMORY)
        most.scatter_reduce_(0, place, opacity[waiting], "amax")
        best = torch.where(opacity[waiting] == most[place], waiting, count)
        winner = torch.full((rows * columns,), count, device=MEMORY)
        winner.scatter_reduce_(0, place, best, "amin")
        won = winner[place] == waiting
        seated[waiting[won]] = True
        waiting = waiting[~won]
    return seated
