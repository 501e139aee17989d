"""Who renders, compares and labels, the CPU or a GPU: decided once, before anything is fitted.

A GPU has to earn it. Before it is used, a made-up scene is drawn, derived, compared and labelled by both, and what
differs from the CPU is refused, whatever the cause: an old driver, a compiler that errs, a broken card.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.labels import LabelOptions, count_hits
from packuv.fit.losses import PhotometricOptions, photometric_loss
from packuv.gaussians.floats import Gaussians
from packuv.raster import RasterOptions, gradients, render

PICTURE_TOLERANCE = 2e-4
"""Largest difference of a pixel, or share of the largest depth; 1e-6 in numba's simulator. A GPU fuses products and
sums, and its exponential is another; by how much that differs has not been measured"""
GRADIENT_TOLERANCE = 1e-3
"""Norm of the difference by the norm, per attribute; 1e-6 in the simulator"""
OUT_OF_MEMORY = ("CUDA_ERROR_OUT_OF_MEMORY", "CUDA error: out of memory")
"""The driver's words by way of numba, and torch's for what it asks the driver for itself, such as a context"""
_NEAR = 0.05


def choose_device(asked: str) -> str:
    """The device to use, cpu or cuda, where the user asked for auto, cpu or cuda.

    Raises ValueError, saying what is in the way, where "cuda" is asked for and cannot be had.
    """
    if asked == "cpu":
        return "cpu"
    problem = obstacle()
    if problem and asked == "cuda":
        raise ValueError(f"the GPU cannot be used: {problem}; --device cpu does without")
    return "cpu" if problem else "cuda"


def obstacle() -> str | None:
    """What keeps this machine from using a GPU; None where nothing does. Compiles the kernels the first time."""
    if importlib.util.find_spec("numba_cuda") is None:
        return "numba-cuda is not installed (pip install 'packuv[cuda12]', or cuda13 where the driver is of CUDA 13)"
    import numba.cuda
    import torch

    cuda: Any = numba.cuda
    if not torch.cuda.is_available() or not cuda.is_available():
        return "torch or numba finds no CUDA device"
    try:
        return drawn_differently("cuda") or compared_differently("cuda") or labelled_differently("cuda")
    except Exception as error:  # a compiler, a driver, memory: whatever it is, the CPU does without
        return f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[-1]}"


def gpu_is_full(error: BaseException) -> bool:
    """Whether an error says that the GPU's memory is used up: torch's, or the driver's by way of numba."""
    said = str(error)
    return type(error).__name__ == "OutOfMemoryError" or any(words in said for words in OUT_OF_MEMORY)


def drawn_differently(device: str) -> str | None:
    """In what a device's pictures or gradients of a made-up scene differ from the CPU's; None where they agree."""
    gaussians, camera = _scene(), _camera()
    host, other = (
        render(gaussians, camera, options=RasterOptions(_NEAR, device=name), background=(0.2, 0.5, 0.9), weights=True)
        for name in ("cpu", device)
    )
    for name in ("colour", "depth", "alpha", "weights"):
        truth, found = getattr(host, name), getattr(other, name)
        error = float(np.abs(found - truth).max() / max(1.0, np.abs(truth).max()))
        if not error <= PICTURE_TOLERANCE:
            return f"its {name} differs from the CPU's by {error:.2g}, more than {PICTURE_TOLERANCE:g}"
    rng = np.random.default_rng(1)
    slopes = [rng.normal(size=getattr(host, name).shape).astype(np.float32) for name in ("colour", "depth", "alpha")]
    rows = rng.random(len(gaussians)) < 0.5
    here, there = gradients(host, *slopes, rows=rows), gradients(other, *slopes, rows=rows)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh", "means2d"):
        truth, found = getattr(here, name), getattr(there, name)
        error = float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
        if not error <= GRADIENT_TOLERANCE:
            return f"its gradient of {name} differs from the CPU's by {error:.2g}, more than {GRADIENT_TOLERANCE:g}"
    return None


def compared_differently(device: str) -> str | None:
    """Whether a device's loss of a made-up picture, or its gradient, differs from the CPU's; None where they agree."""
    rng = np.random.default_rng(3)
    target = rng.random((3, 33, 40)).astype(np.float32)
    picture = (target + rng.normal(0, 0.1, target.shape)).astype(np.float32)
    tiles = np.array([[True, True, False], [False, True, True], [True, False, True]])
    host, other = (
        photometric_loss(picture, target, options=PhotometricOptions(), tiles=tiles, device=name)
        for name in ("cpu", device)
    )
    error = float(np.linalg.norm(other.gradient - host.gradient) / np.linalg.norm(host.gradient))
    error = max(error, abs(other.value / host.value - 1))
    return (
        None
        if error <= GRADIENT_TOLERANCE
        else f"its loss or the loss's gradient differs from the CPU's by {error:.2g}"
    )


def labelled_differently(device: str) -> str | None:
    """Whether a device's labels of a made-up scene differ from the CPU's; None where they agree."""
    gaussians, cameras = _scene(), [_camera(width=61), _camera(), _camera(height=33)]
    rng = np.random.default_rng(2)
    masks = [rng.random((camera.height, camera.width)) < 0.02 for camera in cameras]
    depths = [None, np.full(masks[1].shape, 3.8, np.float32), None]
    counts = [
        count_hits(gaussians, cameras, masks, near=_NEAR, options=LabelOptions(), depths=depths, device=name)
        for name in ("cpu", device)
    ]
    differing = int(sum((here != there).sum() for here, there in zip(*counts, strict=True)))
    return f"its labels of {differing} Gaussians differ from the CPU's" if differing else None


def _scene() -> Gaussians:
    """200 Gaussians about the origin, none as opaque as the caps on alpha, in which renderers differ."""
    rng, count = np.random.default_rng(0), 200
    arrays = (
        rng.normal(size=(count, 3)),
        rng.normal(-2.6, 0.5, (count, 3)),
        rng.normal(size=(count, 4)),
        np.minimum(rng.normal(0, 1.5, count), 3.0),
        rng.normal(0, 0.3, (count, 16, 3)),
    )
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def _camera(width: int = 70, height: int = 50) -> PinholeCamera:
    """Four units before the origin, turned by 0.2 rad."""
    cos, sin = np.cos(0.2), np.sin(0.2)
    pose = np.array([[cos, 0, sin, 0.1], [0, 1, 0, -0.05], [-sin, 0, cos, 4], [0, 0, 0, 1]])
    return PinholeCamera("made up", width, height, 63.0, 64.0, width / 2 + 1.3, height / 2 - 0.7, pose)
