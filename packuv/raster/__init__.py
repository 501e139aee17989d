"""CPU and GPU Gaussian rasterizers behind one pair of functions.

`render` draws Gaussians with one camera, `gradients` carries derivatives of the picture back to them. `compose` makes
Gaussians that stay a layer, over which a few others are drawn again and again at little cost. The options' device
decides who does the work, which must be cpu or cuda; arrays are numpy's either way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians
from packuv.raster import cpu, layer
from packuv.raster.arena import Arena
from packuv.raster.cpu import Rendering
from packuv.raster.layer import Layer
from packuv.raster.picture import Gradients, RasterOptions, tile_shape

__all__ = [
    "Arena",
    "Gradients",
    "Layer",
    "RasterOptions",
    "Rendering",
    "compose",
    "gradients",
    "render",
    "tile_shape",
]


def render(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    background: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    tiles: np.ndarray | None = None,
    weights: bool = False,
    arena: Arena | None = None,
    over: Any = None,
) -> Any:
    """Picture of N Gaussians: `cpu.Rendering`, or `cuda.render.GpuRendering` with the same fields.

    `tiles`, bool as `tile_shape(camera)`, names the tiles to draw; the rest shows background. `weights` asks for
    the blending weight of each Gaussian. `arena` holds memory between calls, CPU only. `over` is a layer: the picture
    is that of its Gaussians and these, which come behind them in order, in one set; what else the rendering tells, and
    its gradients, are of these only. Where it is given, `tiles` must lie in its own, which None stands for, and
    `weights` cannot be had. Raises ValueError if shapes do not fit.
    """
    if options.device == "cpu":
        return cpu.forward(
            gaussians,
            camera,
            options=options,
            sh_degree=sh_degree,
            background=background,
            tiles=tiles,
            weights=weights,
            arena=arena,
            over=over,
        )
    return _cuda().forward(
        gaussians,
        camera,
        options=options,
        sh_degree=sh_degree,
        background=background,
        tiles=tiles,
        weights=weights,
        over=over,
    )


def compose(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    options: RasterOptions,
    sh_degree: int | None = None,
    tiles: np.ndarray | None = None,
) -> Any:
    """Layer of N Gaussians for one camera and these tiles: `Layer`, or `cuda.render.GpuLayer`.

    The near plane of `options` stays that of these Gaussians, whatever is drawn over them.
    """
    backend = layer if options.device == "cpu" else _cuda()
    return backend.compose(gaussians, camera, options=options, sh_degree=sh_degree, tiles=tiles)


def gradients(
    rendering: Any,
    d_colour: np.ndarray,
    d_depth: np.ndarray | None = None,
    d_alpha: np.ndarray | None = None,
    *,
    rows: np.ndarray | None = None,
) -> Gradients:
    """Gradients of a scalar by the Gaussians, from its derivatives by the pictures of `rendering`.

    d_colour [3, H, W]; d_depth and d_alpha [H, W], None for zero; `rows`, bool [N], the Gaussians that may change, the
    others get zeros.
    """
    if isinstance(rendering, Rendering):
        return cpu.backward(rendering, d_colour, d_depth, d_alpha, rows=rows)
    found: Gradients = _cuda().backward(rendering, d_colour, d_depth, d_alpha, rows=rows)
    return found


def _cuda() -> Any:
    """The CUDA rasterizer, imported late: it needs torch, which takes seconds to load."""
    from packuv.raster.cuda import render

    return render
