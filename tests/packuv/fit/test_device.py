"""The GPU's way, as far as a machine without one can go: our half of the work is tried against stand-ins for the other.

gsplat's place is taken by a dense rasterizer with its signature and conventions, CUDA's by numba's simulator. Where a
GPU is, the last test runs the real ones.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from packuv.camera import PinholeCamera
from packuv.fit import device
from packuv.fit.backdrop import Backdrop, joined
from packuv.fit.device import choose_device, drawn_differently, labelled_differently, obstacle
from packuv.fit.model import Model
from packuv.fit.options import FitOptions
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.floats import rows_of
from packuv.raster import RasterOptions, compose, gradients, render, tile_shape
from tests.support.dense_raster import BACKGROUND, blend, camera, ellipses, scene, sh_colour, upstream
from tests.support.needs import needs

STAND_IN = "cpu:0"
"""A torch device by a name that is not ours for the CPU, so that `render` goes gsplat's way"""
OPTIONS = RasterOptions(near=0.05, device=STAND_IN)


def dense_rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, far_plane,
                        eps2d, sh_degree, packed, tile_size, render_mode, rasterize_mode):  # fmt: skip
    """What gsplat 1.5 promises for one camera, every Gaussian at every pixel, in float64."""
    assert (packed, rasterize_mode, tile_size) == (False, "classic", 16)
    assert quats.dtype == scales.dtype == viewmats.dtype == Ks.dtype == torch.float32
    pose, lens = viewmats[0].double().numpy(), Ks[0].double().numpy()
    view = PinholeCamera("gsplat", width, height, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], pose)
    options = RasterOptions(near=near_plane, low_pass_px2=eps2d)
    means = means.double()
    centre, conic, z = ellipses(means, scales.double().log(), quats.double(), view, options)
    means2d = centre.float()[None]
    if sh_degree is not None:
        direction = torch.nn.functional.normalize(means - torch.from_numpy(view.centre), dim=-1)
        colors = sh_colour(sh_degree, colors.double(), direction)
    values = {"RGB": [colors], "RGB+D": [colors, z[:, None]]}[render_mode]
    picture, alpha, _ = blend(
        means2d[0].double(),
        conic,
        z,
        opacities.double(),
        torch.cat([v.double() for v in values], 1),
        view,
        near_plane,
    )
    meta = {"means2d": means2d, "tiles_per_gauss": (z >= near_plane).int()[None]}
    return picture.permute(1, 2, 0).float()[None], alpha.float()[None, ..., None], meta


@pytest.fixture
def gsplat(monkeypatch):
    module = SimpleNamespace(rasterization=dense_rasterization)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    return module


def test_pictures_and_gradients_agree_by_way_of_gsplat(gsplat):
    assert drawn_differently(STAND_IN) is None


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"eps2d": 0.5}, "its colour differs"),
        ({"near_plane": 4.0}, "its colour differs"),
        ({"render_mode": "RGB"}, "index 3"),
    ],
)
def test_a_gpu_that_draws_something_else_is_refused(gsplat, monkeypatch, change, sentence):
    gsplat.rasterization = lambda *args, **options: dense_rasterization(*args, **{**options, **change})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("numba.cuda.is_available", lambda: True)
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(device, "drawn_differently", lambda name: drawn_differently(STAND_IN))
    assert sentence in obstacle()
    assert choose_device("auto") == "cpu"
    with pytest.raises(ValueError, match=f"the GPU cannot be used: .*{sentence}.*--device cpu"):
        choose_device("cuda")


def test_broken_gaussians_are_left_out_and_counted(gsplat):
    gaussians, view = scene(40), camera()
    gaussians.means[3, 1], gaussians.quaternions[5], gaussians.log_scales[7, 0] = np.nan, 0, np.inf
    gaussians.sh[9, 0, 0], gaussians.opacity_logits[11] = np.inf, np.nan
    here, there = (render(gaussians, view, options=o) for o in (replace(OPTIONS, device="cpu"), OPTIONS))
    assert there.invalid_count == 5
    assert np.abs(there.colour - here.colour).max() < 1e-5
    found = gradients(there, *upstream(view))
    assert all(np.isfinite(getattr(found, name)).all() for name in ("means", "log_scales", "quaternions", "sh"))
    assert not found.means[[3, 5, 7, 9, 11]].any()


def test_a_layer_is_drawn_with_what_changes_and_gets_no_gradient(gsplat):
    still, moving, view = scene(60), scene(20, seed=1, degree=1), camera()
    moving.means[3, 1] = np.nan
    found = []
    for stand_in in (replace(OPTIONS, device="cpu"), OPTIONS):
        layer = compose(still, view, options=replace(stand_in, near=3.5), sh_degree=2)
        drawn = render(moving, view, options=replace(stand_in, near=4.0), background=BACKGROUND, over=layer)
        found.append((drawn, gradients(drawn, *upstream(view))))
    (here, expected), (there, got) = found
    assert np.abs(there.colour - here.colour).max() < 1e-5
    assert here.invalid_count == there.invalid_count == 1
    assert np.array_equal(here.visible > 0, (there.visible > 0) & (here.visible > 0))
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh", "means2d"):
        truth = getattr(expected, name)
        assert getattr(got, name).shape == truth.shape
        assert np.linalg.norm(getattr(got, name) - truth) < 1e-4 * np.linalg.norm(truth)


def test_a_backdrop_has_layers_on_either_device(gsplat):
    for stand_in in ("cpu", STAND_IN):
        backdrop = Backdrop(scene(60), OPTIONS.near, stand_in)
        layer = backdrop.layer(camera(), None)
        assert backdrop.layer(camera(), None) is layer
        moving = scene(20, seed=1)
        plain = render(joined(scene(60), moving), camera(), options=replace(OPTIONS, device=stand_in))
        drawn = render(moving, camera(), options=replace(OPTIONS, device=stand_in), over=layer)
        assert np.abs(drawn.colour - plain.colour).max() < 2e-4
    nothing = rows_of(scene(4), slice(0, 0))
    assert Backdrop(nothing, OPTIONS.near).layer(camera(), None) is None


def test_tiles_that_are_not_asked_for_show_background_and_give_no_gradient(gsplat):
    gaussians, view = scene(60), camera()
    tiles = np.zeros(tile_shape(view), bool)
    tiles[1, :2] = True
    here, there = (
        render(gaussians, view, options=o, tiles=tiles, background=BACKGROUND, weights=True)
        for o in (replace(OPTIONS, device="cpu"), OPTIONS)
    )
    assert np.abs(there.colour - here.colour).max() < 1e-5
    assert np.abs(there.weights - here.weights).max() < 1e-3
    expected, found = gradients(here, *upstream(view)), gradients(there, *upstream(view))
    assert np.linalg.norm(found.means - expected.means) < 1e-4 * np.linalg.norm(expected.means)


def test_a_fit_goes_the_same_way_by_way_of_gsplat(gsplat):
    views = [camera(), camera(64, 48)]
    truth = scene(60, degree=0, seed=4)
    targets = [render(truth, view, options=replace(OPTIONS, device="cpu")).colour.clip(0, 1) for view in views]
    shots = [Shot(view, target) for view, target in zip(views, targets, strict=True)]

    def losses(name: str) -> list[float]:
        rng, options = np.random.default_rng(0), FitOptions(device=name)
        solver = Solver(Model(scene(60, degree=0)), Bounds(np.zeros(3), 2.0, 0.05), options, rng)
        return [solver.run(shots, 4, of=12)["photometric"] for _ in range(3)]

    here, there = losses("cpu"), losses(STAND_IN)
    assert there == pytest.approx(here, rel=1e-3)
    assert there[-1] < 0.9 * there[0]


def test_labels_agree_in_the_simulator_of_cuda():
    """The kernel, grid and padding run as Python; the CPU's functions, too, hence in an interpreter of its own."""
    program = "from packuv.fit.device import labelled_differently as d; print(d('cuda'))"
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=300)
    assert done.stdout.strip() == "None", done.stderr


def test_without_gsplat_the_cpu_does_everything(monkeypatch):
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: None)
    assert choose_device("auto") == choose_device("cpu") == "cpu"
    with pytest.raises(ValueError, match=r"gsplat is not installed \(pip install 'packuv\[cuda\]'\); --device cpu"):
        choose_device("cuda")


@needs("cuda", torch.cuda.is_available(), "no CUDA device")
def test_a_real_gpu_agrees():
    assert drawn_differently("cuda") is None
    assert labelled_differently("cuda") is None
