"""The CUDA rasterizer against the CPU's and the dense reference: pictures, gradients of every parameter, tiles, layers.

On a GPU where there is one. Elsewhere the same tests run in numba's simulator, in an interpreter of their own, which
`tests/packuv/fit/test_device.py` starts; scenes are tiny, since there each thread is one of Python's.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest
import torch

from packuv.gaussians.floats import Gaussians
from packuv.raster import RasterOptions, compose, gradients, render, tile_shape
from tests.support.dense_raster import BACKGROUND, FIELDS, OPTIONS, camera, reference, scene, upstream
from tests.support.needs import needs

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
pytestmark = needs("cuda", SIMULATED or torch.cuda.is_available(), "no CUDA device")

TOLERANCE = 1e-5
"""Of pictures; measured 1e-6 in the simulator"""
GRADIENT_TOLERANCE = 2e-5
"""Relative, per array; measured 1e-6 in the simulator"""
PICTURES = ("colour", "depth", "alpha")
SLOPES = (*FIELDS, "means2d")


def both(gaussians, view, *, slopes=None, rows=None, near=OPTIONS.near, still=None, beneath=None, **given):
    """A rendering and its gradients, by the CPU and by CUDA; `beneath`: near plane and tiles of a layer of `still`."""
    found = []
    for device in ("cpu", "cuda"):
        options = RasterOptions(near, device=device)
        over = None
        if still is not None:
            layer_near, tiles = beneath or (near, None)
            over = compose(still, view, options=dataclasses.replace(options, near=layer_near), tiles=tiles)
            assert over.invalid_count == 0
        drawn = render(gaussians, view, options=options, background=BACKGROUND, over=over, **given)
        found.append((drawn, gradients(drawn, *(slopes or upstream(view)), rows=rows)))
    return found


def assert_agree(found, *, gradient_tolerance=GRADIENT_TOLERANCE):
    (here, expected), (there, got) = found
    for name in PICTURES:
        truth = getattr(here, name)
        assert np.abs(getattr(there, name) - truth).max() < TOLERANCE * max(1.0, truth.max()), name
    assert np.array_equal(there.visible, here.visible)
    assert there.invalid_count == here.invalid_count
    if here.weights is not None:
        assert np.linalg.norm(there.weights - here.weights) <= GRADIENT_TOLERANCE * np.linalg.norm(here.weights)
    for name in SLOPES:
        truth = getattr(expected, name)
        error = np.linalg.norm(getattr(got, name) - truth)
        assert error <= gradient_tolerance * max(np.linalg.norm(truth), 1e-6), name
    assert got.overflow_count == expected.overflow_count


def test_pictures_and_gradients_are_the_cpus_up_to_tiles_of_one_pixel():
    assert_agree(both(scene(14, seed=3), camera(17, 17), weights=True))


@pytest.mark.parametrize("degree", [0, 2])
def test_the_dense_reference(degree):
    gaussians, view = scene(8, seed=degree), camera(18, 15)
    fields = [torch.from_numpy(getattr(gaussians, name)).double().requires_grad_() for name in FIELDS]
    truth = reference(fields, view, degree)
    slopes = upstream(view)
    scalar = sum((p * torch.from_numpy(d)).sum() for p, d in zip(truth, slopes, strict=False))
    expected = torch.autograd.grad(scalar, fields)
    _, (drawn, found) = both(gaussians, view, sh_degree=degree)
    for name, picture in zip(PICTURES, truth, strict=False):
        picture = picture.detach().numpy()
        assert np.abs(getattr(drawn, name) - picture).max() < TOLERANCE * max(1.0, picture.max()), name
    for name, value in zip(FIELDS, expected, strict=True):
        error = np.linalg.norm(getattr(found, name) - value.numpy())
        assert error < GRADIENT_TOLERANCE * np.linalg.norm(value.numpy()), name


def test_only_active_tiles_are_drawn_and_only_chosen_rows_have_gradients():
    view, rng = camera(40, 20), np.random.default_rng(0)
    tiles, rows = np.array([[True, False, False], [True, False, True]]), rng.random(12) < 0.4
    found = both(scene(12, seed=6), view, tiles=tiles, rows=rows, weights=True)
    assert_agree(found)
    (_, _), (drawn, got) = found
    assert not drawn.alpha[:16, 16:].any()
    for name in SLOPES:
        assert not getattr(got, name)[~rows].any(), name


def test_opaque_walls_end_the_blending_where_the_cpus_do():
    gaussians, view = scene(70, degree=0), camera(16, 16)
    gaussians.means[:] = view.centre + view.forward * np.linspace(1, 2, 70)[:, None]
    gaussians.log_scales[:] = 5.0
    gaussians.opacity_logits[:] = 80.0
    found = both(gaussians, view, weights=True)
    assert_agree(found)
    drawn = found[1][0]
    assert drawn.weights[:2].sum() > 255.9
    assert not drawn.weights[32:].any()  # looked at after every 32 Gaussians
    gaussians.opacity_logits[:] = -2.0  # at the cap no gradient of the opacity is left
    assert_agree(both(gaussians, view))


def test_a_block_of_pixels_ends_by_itself():
    """Two walls end the left column of blocks; what comes 32 Gaussians later is so bright that 1e-4 of it shows."""
    gaussians, view = scene(40, degree=0), camera(16, 16)
    depth = np.linspace(1, 1.5, 40)[:, None]
    gaussians.means[:] = view.centre + view.forward * depth
    gaussians.log_scales[:], gaussians.opacity_logits[:], gaussians.quaternions[:] = 5.0, -4.5, (1, 0, 0, 0)
    gaussians.means[:2] -= 9.3 / 14.4 * depth[:2] * view.camera_from_world[0, :3]
    gaussians.log_scales[:2], gaussians.opacity_logits[:2] = (1.0, 4.0, -3.0), 80.0
    gaussians.sh[33:] = 4e6
    found = both(gaussians, view)
    assert_agree(found)
    for drawn, _ in found:
        assert drawn.colour[:, :, :4].max() < 1
        assert drawn.colour[:, :, 4:].min() > 5


def degenerate() -> Gaussians:
    """Needles, discs, points and giants, behind, on and just before the camera's plane, saturated, far away, broken."""
    gaussians, view = scene(24, seed=4), camera(17, 17)
    gaussians.log_scales[0:2] = (-0.5, -7.0, -7.0)
    gaussians.log_scales[2:4] = (-1.5, -1.5, -9.0)
    gaussians.log_scales[4] = 20.0
    gaussians.log_scales[5] = -60.0
    gaussians.log_scales[6] = (12.0, -30.0, -30.0)
    gaussians.means[7] = view.centre - view.forward
    gaussians.means[8] = view.centre + view.forward * 1e-7
    gaussians.means[9] = view.centre + view.forward * 0.0501
    gaussians.means[10] *= 1e17
    gaussians.opacity_logits[11:13] = 80.0, -80.0
    gaussians.quaternions[::2] *= 1e-6
    gaussians.means[13, 1], gaussians.quaternions[14], gaussians.log_scales[15, 0] = np.nan, 0, np.inf
    gaussians.sh[16, 0, 0], gaussians.opacity_logits[17], gaussians.means[18, 0] = np.inf, np.nan, np.inf
    gaussians.means[19], gaussians.sh[19], gaussians.log_scales[20] = 0, 1e30, 90.0
    return gaussians


def test_degenerate_and_broken_gaussians():
    gaussians, view = degenerate(), camera(17, 17)
    endless = np.arange(24) == 6  # a needle of 160,000 units: rounding of float32 moments is all there is to its slopes
    found = both(gaussians, view, weights=True, rows=~endless)
    assert_agree(found, gradient_tolerance=1e-4)  # just before the camera all is magnified
    assert found[1][0].invalid_count == 8
    _, (_, got) = both(gaussians, view)
    assert all(np.isfinite(getattr(got, name)).all() for name in SLOPES)


@pytest.mark.filterwarnings("ignore:.*(overflow|invalid value) encountered:RuntimeWarning")  # numpy's, in the simulator
def test_overflowing_gradients_are_zero_and_counted():
    view = camera(16, 16)
    slopes = (np.full((3, 16, 16), 3e38, np.float32),)
    _, (_, got) = both(scene(6, seed=2), view, slopes=slopes)
    assert got.overflow_count > 0
    assert all(np.isfinite(getattr(got, name)).all() for name in SLOPES)


def test_nothing_to_draw():
    view, some = camera(20, 17), scene(5)
    background = np.broadcast_to(np.float32(BACKGROUND)[:, None, None], (3, 17, 20))
    behind = dataclasses.replace(some, means=(view.centre - (1 + np.arange(5)[:, None]) * view.forward).astype("f4"))
    for gaussians, tiles in ((scene(0), None), (some, np.zeros(tile_shape(view), bool)), (behind, None)):
        found = both(gaussians, view, tiles=tiles, weights=True)
        assert_agree(found)
        assert np.array_equal(found[1][0].colour, background)
        assert not found[1][0].alpha.any()


def test_the_near_plane_hides_what_is_nearer():
    gaussians, view = scene(10, seed=8), camera(17, 17)
    found = both(gaussians, view, near=float(np.median(view.project(gaussians.means)[1])))
    assert_agree(found)
    assert 0 < (found[1][0].visible > 0).sum() < 6


def test_over_a_layer():
    still, moving, view = scene(10), scene(6, seed=1, degree=1), camera(20, 20)
    moving.means[3, 1] = np.nan
    mine = np.array([[True, True], [True, False]])
    rows = np.array([True, True, False, True, True, True])
    given = {"still": still, "near": 4.0, "beneath": (3.5, mine), "rows": rows}
    for tiles in (None, np.array([[True, False], [True, False]])):
        assert_agree(both(moving, view, tiles=tiles, **given))


def test_a_layer_holds_what_shows_and_says_how_much():
    gaussians, view = scene(30), camera(16, 16)
    gaussians.means[::2] = view.centre - view.forward
    layer = compose(gaussians, view, options=RasterOptions(OPTIONS.near, device="cuda"))
    drawn = render(gaussians, view, options=OPTIONS)
    shown = int((drawn.visible > 0).sum())
    assert 0 < shown <= 15
    assert layer.nbytes == 64 * shown + 16 * drawn.pair_count + layer.view.nbytes + layer.active.nbytes


def test_at_equal_depth_the_layer_comes_first():
    view = camera(16, 16)
    still, moving = scene(3, degree=0), scene(3, degree=0, seed=1)
    for gaussians in (still, moving):
        gaussians.means[:], gaussians.log_scales[:], gaussians.opacity_logits[:] = 0, -1.5, 1.0
    assert_agree(both(moving, view, still=still))


def test_a_picture_and_its_gradients_are_the_same_every_time():
    """But in the simulator, whose threads add in no order."""
    (first, slopes), (second, again) = (both(scene(14, seed=3), camera(17, 17), weights=True)[1] for _ in range(2))
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in (*PICTURES, "visible"))
    same = [np.array_equal(getattr(slopes, name), getattr(again, name)) for name in SLOPES]
    assert SIMULATED or all(same)


def test_wrong_input_is_refused_with_what_came():
    gaussians, view, options = scene(3), camera(16, 16), RasterOptions(0.05, device="cuda")
    with pytest.raises(ValueError, match=r"means must be C-contiguous float32 \(3, 3\), but is float64"):
        render(dataclasses.replace(gaussians, means=gaussians.means.astype(float)), view, options=options)
    with pytest.raises(ValueError, match="SH degree 4"):
        render(gaussians, view, options=options, sh_degree=4)
    rendering = render(gaussians, view, options=options)
    with pytest.raises(ValueError, match=r"rows must be bool \(3,\)"):
        gradients(rendering, *upstream(view), rows=np.ones(4, bool))
    with pytest.raises(ValueError, match="must have its shape"):
        gradients(rendering, np.zeros((3, 5, 5), np.float32))
