"""What a GPU does in a fit beside drawing: labels, the photometric loss; and a fit. On a GPU, or in numba's simulator.

See `tests/packuv/raster/test_cuda.py`.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from packuv.fit.density import DensityOptions
from packuv.fit.device import compared_differently, drawn_differently, labelled_differently
from packuv.fit.labels import summed_area
from packuv.fit.labels_cuda import _summed_area
from packuv.fit.losses import PhotometricOptions, photometric_loss
from packuv.fit.model import Model
from packuv.fit.options import FitOptions
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.fit.solvers import open_solver
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.floats import arrays
from packuv.raster import render
from tests.support.dense_raster import OPTIONS, camera, scene
from tests.support.needs import needs

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
pytestmark = needs("cuda", SIMULATED or torch.cuda.is_available(), "no CUDA device")


def test_labels_are_the_cpus():
    assert labelled_differently("cuda") is None


def test_sums_of_masks_are_the_cpus():
    mask = np.random.default_rng(1).random((13, 9)) < 0.4
    assert np.array_equal(_summed_area(mask).cpu().numpy(), summed_area(mask))


def test_the_loss_of_a_made_up_picture_is_the_cpus():
    assert compared_differently("cuda") is None


def pair(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A picture and a target that is like it in half of the pixels, and equal in some."""
    rng = np.random.default_rng(width)
    target = rng.random((3, height, width)).astype(np.float32)
    picture = (target + rng.normal(0, 0.1, target.shape) * rng.integers(0, 2, target.shape)).astype(np.float32)
    return picture, target


def losses(width: int, height: int, **given):
    return [
        photometric_loss(*pair(width, height), options=PhotometricOptions(), device=device, **given)
        for device in ("cpu", "cuda")
    ]


@pytest.mark.parametrize(
    ("width", "height", "tiles"),
    [(16, 16, None), (17, 33, None), (40, 17, [[True, False, True], [False, False, True]]), (5, 3, None)],
)
def test_the_loss_is_the_cpus(width, height, tiles):
    here, there = losses(width, height, tiles=None if tiles is None else np.array(tiles))
    assert (there.value, there.l1, there.ssim) == pytest.approx((here.value, here.l1, here.ssim), rel=1e-5)
    assert np.linalg.norm(there.gradient - here.gradient) < 1e-5 * np.linalg.norm(here.gradient)
    assert not there.gradient[here.gradient == 0].any()


def test_without_an_active_tile_there_is_no_loss():
    here, there = losses(20, 20, tiles=np.zeros((2, 2), bool), out=np.ones((3, 20, 20), np.float32))
    assert (there.value, there.l1, there.ssim) == (here.value, here.l1, here.ssim) == (0, 0, 1)
    assert not there.gradient.any()


on_a_gpu = needs("cuda", torch.cuda.is_available(), "no CUDA device, and the simulator would take minutes")


def fitted(device: str) -> tuple[Solver, list[float]]:
    """A fit that grows, and its losses."""
    views = [camera(), camera(64, 48)]
    targets = [render(scene(60, degree=0, seed=4), view, options=OPTIONS).colour.clip(0, 1) for view in views]
    shots = [Shot(view, target) for view, target in zip(views, targets, strict=True)]
    options = FitOptions(device=device, density=DensityOptions(cap=90, every=2))
    solver = open_solver(Model(scene(60, degree=0)), Bounds(np.zeros(3), 2.0, 0.05), options, np.random.default_rng(0))
    return solver, [solver.run(shots, 4, of=12, grow_from=60)["photometric"] for _ in range(3)]


@on_a_gpu
def test_the_made_up_scene_and_a_fit_are_the_cpus():
    assert drawn_differently("cuda") is None
    (_, losses), (_, found) = fitted("cpu"), fitted("cuda")
    assert found == pytest.approx(losses, rel=1e-3)
    assert found[-1] < 0.9 * found[0]


@on_a_gpu
def test_a_fit_is_the_same_every_time():
    """Every sum has one order."""
    (first, losses), (second, again) = fitted("cuda"), fitted("cuda")
    assert losses == again
    assert len(first.model) > 60
    same = zip(*(arrays(solver.model.gaussians) for solver in (first, second)), strict=True)
    assert all(np.array_equal(one, other) for one, other in same)
