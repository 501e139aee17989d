"""The terms of the loss: each looks at one picture as it is drawn now, and pulls (paper §4.2, objective).

A further term is a function and its entry in `TERMS`; its weight is a field of `LossOptions`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from packuv.fit.depth import depth_loss
from packuv.fit.losses import photometric_loss
from packuv.fit.options import LossOptions
from packuv.fit.shots import Shot
from packuv.gaussians.floats import Gaussians, opacity
from packuv.raster import Rendering


@dataclass(frozen=True)
class Seen:
    """What a term looks at."""

    rendering: Rendering
    picture: np.ndarray
    """float32 [3, H, W]: what the camera makes of the rendering with what lies behind it"""
    target: np.ndarray
    """float32 [3, H, W]; the picture itself where nothing is known"""
    shot: Shot
    gaussians: Gaussians
    """float32 masters of what is drawn"""
    rows: np.ndarray
    """bool [N], which may change and are seen"""
    radius: float
    """Of the scene"""


@dataclass(frozen=True)
class Pull:
    """A term's value, already weighted, and its derivatives by what it looks at; None for zero."""

    value: float
    colour: np.ndarray | None = None
    """float32 [3, H, W], by the picture"""
    depth: np.ndarray | None = None
    """float32 [H, W]"""
    alpha: np.ndarray | None = None
    """float32 [H, W]"""
    gaussians: Mapping[str, np.ndarray] = field(default_factory=dict)
    """float32, by attribute"""


Array = TypeVar("Array")
"""Of numpy or of torch"""

Term = Callable[[Seen, LossOptions], Pull | None]
"""None where the term does not apply"""


def photometric(seen: Seen, options: LossOptions) -> Pull | None:
    """L1 and SSIM."""
    loss = photometric_loss(seen.picture, seen.target, options=options.photometric, tiles=seen.shot.tiles)
    return Pull(loss.value, colour=loss.gradient)


def depth(seen: Seen, options: LossOptions) -> Pull | None:
    """Depth where the surface is known to be."""
    weight = np.float32(options.depth_weight)
    if seen.shot.depths is None or not weight:
        return None
    rendering = seen.rendering
    value, d_depth, d_alpha = depth_loss(rendering.depth, rendering.alpha, seen.shot.depths, scale=seen.radius)
    return Pull(float(weight) * value, depth=weight * d_depth, alpha=weight * d_alpha)


def opaqueness(seen: Seen, options: LossOptions) -> Pull | None:
    """Mean alpha (1 - alpha) over the rows."""
    if not options.opacity_weight:
        return None
    weight = options.opacity_weight / max(1, int(seen.rows.sum()))
    alpha = opacity(seen.gaussians)
    slope = alpha * (1 - alpha) * (1 - 2 * alpha) * weight
    value = weight * float((alpha * (1 - alpha))[seen.rows].sum())
    return Pull(value, gaussians={"opacity_logits": (slope * seen.rows).astype(np.float32)})


def size(seen: Seen, options: LossOptions) -> Pull | None:
    """Mean squared excess of the longest standard deviation over the rows."""
    if not options.scale_weight:
        return None
    weight, log_scales = options.scale_weight / max(1, int(seen.rows.sum())), seen.gaussians.log_scales
    axis = log_scales.argmax(axis=1)[:, None]
    longest = np.exp(np.take_along_axis(log_scales, axis, 1)) / seen.radius
    excess = np.maximum(longest - options.scale_limit, 0) * seen.rows[:, None]
    pull = np.zeros_like(log_scales)
    np.put_along_axis(pull, axis, (2 * weight * excess * longest).astype(np.float32), 1)
    return Pull(weight * float(np.square(excess).sum()), gaussians={"log_scales": pull})


TERMS: Mapping[str, Term] = {"photometric": photometric, "depth": depth, "opacity": opaqueness, "scale": size}
"""By the name under which its value is reported"""


def pulls(seen: Seen, options: LossOptions) -> dict[str, Pull]:
    """The pulls of all terms that apply, by name. Raises ValueError for a value that is not finite."""
    found = {name: pull for name, term in TERMS.items() if (pull := term(seen, options)) is not None}
    for name, pull in found.items():
        if not np.isfinite(pull.value):
            raise ValueError(
                f"the {name} loss of camera {seen.shot.camera.name!r} is {pull.value}: its picture or the Gaussians "
                "hold values that are not finite"
            )
    return found


def summed(parts: Iterable[Array | None]) -> Array | None:
    """Sum of those that are there; None if none is."""
    found: list[Any] = [part for part in parts if part is not None]
    return sum(found[1:], start=found[0]) if found else None
