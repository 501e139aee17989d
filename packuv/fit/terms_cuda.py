"""The terms of the loss on a GPU, as `terms` on the CPU; values stay there, too."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from packuv.fit.depth import COVERED
from packuv.fit.losses_cuda import compare
from packuv.fit.options import LossOptions
from packuv.fit.shots_cuda import ShotOnGpu
from packuv.raster.cuda.render import OnGpu


@dataclass(frozen=True)
class SeenOnGpu:
    """What a term looks at, see `terms.Seen`."""

    rendering: OnGpu
    picture: Tensor
    target: Tensor
    shot: ShotOnGpu
    masters: tuple[Tensor, ...]
    rows: Tensor
    """bool [N]"""
    radius: float


@dataclass(frozen=True)
class PullOnGpu:
    """See `terms.Pull`."""

    value: Tensor
    """float64 []"""
    colour: Tensor | None = None
    depth: Tensor | None = None
    alpha: Tensor | None = None
    gaussians: Mapping[str, Tensor] = field(default_factory=dict)


def photometric(seen: SeenOnGpu, options: LossOptions) -> PullOnGpu | None:
    """L1 and SSIM."""
    share, count = options.photometric.ssim_share, len(seen.picture) * seen.shot.pixel_count
    if not count:
        return PullOnGpu(torch.zeros((), dtype=torch.float64, device=seen.picture.device))
    shot, scale = seen.shot, 1.0 / count
    scales = (1 - share) * scale, -share * scale
    sums, gradient = compare(seen.picture, seen.target, shot.active, shot.tiles, *scales)
    return PullOnGpu((1 - share) * scale * sums[0] + share * (1 - scale * sums[1]), colour=gradient)


def depth(seen: SeenOnGpu, options: LossOptions) -> PullOnGpu | None:
    """Depth where the surface is known to be; its mean is over covered pixels, as many as there are."""
    weight = options.depth_weight
    if seen.shot.depths is None or not weight:
        return None
    (pixels, wanted), (_, drawn, alpha) = seen.shot.depths, seen.rendering.pictures
    share = alpha.reshape(-1)[pixels]
    covered = share > COVERED
    share = torch.where(covered, share, 1)
    mean = drawn.reshape(-1)[pixels] / share
    error = torch.where(covered, (mean - wanted) / seen.radius, 0)
    count = covered.sum().clamp(min=1)
    slope = weight * torch.sign(error) / (count * seen.radius) / share
    d_depth, d_alpha = torch.zeros_like(drawn), torch.zeros_like(alpha)
    d_depth.view(-1).index_put_((pixels,), slope, accumulate=True)
    d_alpha.view(-1).index_put_((pixels,), -slope * mean, accumulate=True)
    return PullOnGpu(weight * (error.abs().sum() / count).double(), depth=d_depth, alpha=d_alpha)


def opaqueness(seen: SeenOnGpu, options: LossOptions) -> PullOnGpu | None:
    """Mean alpha (1 - alpha) over the rows."""
    if not options.opacity_weight:
        return None
    weight = options.opacity_weight / seen.rows.sum().clamp(min=1)
    alpha = torch.sigmoid(seen.masters[3].double())
    between = alpha * (1 - alpha) * seen.rows
    slope = weight * between * (1 - 2 * alpha)
    return PullOnGpu(weight * between.sum(), gaussians={"opacity_logits": slope.float()})


def size(seen: SeenOnGpu, options: LossOptions) -> PullOnGpu | None:
    """Mean squared excess of the longest standard deviation over the rows."""
    if not options.scale_weight:
        return None
    weight, log_scales = options.scale_weight / seen.rows.sum().clamp(min=1), seen.masters[1]
    axis = log_scales.argmax(dim=1, keepdim=True)
    longest = torch.exp(log_scales.gather(1, axis)) / seen.radius
    excess = (longest - options.scale_limit).clamp(min=0) * seen.rows[:, None]
    pull = torch.zeros_like(log_scales).scatter(1, axis, 2 * weight * excess * longest)
    return PullOnGpu((weight * excess.square().sum()).double(), gaussians={"log_scales": pull})


Term = Callable[[SeenOnGpu, LossOptions], PullOnGpu | None]
TERMS: Mapping[str, Term] = {"photometric": photometric, "depth": depth, "opacity": opaqueness, "scale": size}
"""Those of `terms.TERMS`, by the same names"""


def pulls(seen: SeenOnGpu, options: LossOptions) -> dict[str, PullOnGpu]:
    """The pulls of all terms that apply, by name."""
    return {name: pull for name, term in TERMS.items() if (pull := term(seen, options)) is not None}
