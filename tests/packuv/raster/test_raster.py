"""The CPU rasterizer against a dense float64 reference, and what it promises besides: determinism, tiles, rows."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians
from packuv.kernels.simd import ALL, HALF
from packuv.raster import Arena, RasterOptions, gradients, render, tile_shape
from packuv.raster.cpu import Rendering, backward, forward
from tests.support.dense_raster import BACKGROUND, FIELDS, OPTIONS, camera, reference, scene, upstream

IMAGE_TOLERANCE = 1e-5
"""Float32 sums of some hundred terms below 1; measured 2.5e-6."""
GRADIENT_TOLERANCE = 2e-5
"""Relative, per array; measured 6e-6."""
OCCLUDED_IMAGE_TOLERANCE = 2e-4
"""Blending ends at a transmittance of 1e-4, the reference never ends."""
OCCLUDED_GRADIENT_TOLERANCE = 2e-3
"""The same cause; measured 3e-4."""


def fields64(gaussians: Gaussians) -> list[torch.Tensor]:
    return [torch.from_numpy(getattr(gaussians, name)).double().requires_grad_() for name in FIELDS]


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / max(np.linalg.norm(truth), 1e-30))


def changed(gaussians: Gaussians, name: str, row: int, value: object) -> Gaussians:
    array = getattr(gaussians, name).copy()
    array[row] = value
    return dataclasses.replace(gaussians, **{name: array})


def same_bytes(a: Rendering, b: Rendering) -> bool:
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in ("colour", "depth", "alpha"))


def assert_matches_reference(gaussians, view, degree, image_tolerance, gradient_tolerance, sums=None, options=OPTIONS):
    d_colour, d_depth, d_alpha = upstream(view)
    fields = fields64(gaussians)
    truth = reference(fields, view, degree, options)
    scalar = sum((p * torch.from_numpy(d)).sum() for p, d in zip(truth, (d_colour, d_depth, d_alpha), strict=False))
    expected = torch.autograd.grad(scalar, fields)
    found = forward(gaussians, view, options=options, sh_degree=degree, background=BACKGROUND, weights=True, sums=sums)
    colour, depth, alpha, weights = (picture.detach().numpy() for picture in truth)
    assert np.abs(found.colour - colour).max() < image_tolerance
    assert np.abs(found.depth - depth).max() < image_tolerance * max(1.0, depth.max())
    assert np.abs(found.alpha - alpha).max() < image_tolerance
    assert relative(found.weights, weights) < gradient_tolerance
    result = backward(found, d_colour, d_depth, d_alpha)
    for name, value in zip(FIELDS, expected, strict=True):
        assert relative(getattr(result, name), value.numpy()) < gradient_tolerance, name
    assert result.overflow_count == found.invalid_count == 0


# -- correctness ------------------------------------------------------------------------------------------------------

WIDTHS = pytest.mark.parametrize("sums", [HALF, ALL], ids=["sums of 8", "sums of 16"])


@WIDTHS
@pytest.mark.parametrize(
    ("count", "width", "height", "degree", "size", "spread"),
    [
        (60, 40, 37, 3, 1, 1),
        (150, 70, 50, 2, 1, 1),
        (300, 48, 48, 3, 0.4, 2),
        (100, 61, 48, 1, 1, 1),
        (9, 3, 2, 0, 3, 1),
    ],
)
def test_matches_the_dense_reference(sums, count, width, height, degree, size, spread):
    gaussians = scene(count, seed=count, size=size, spread=spread)
    view = camera(width, height)
    assert_matches_reference(gaussians, view, degree, IMAGE_TOLERANCE, GRADIENT_TOLERANCE, sums)


@WIDTHS
def test_matches_under_heavy_occlusion(sums):
    gaussians = scene(300, seed=5, size=3)
    assert_matches_reference(gaussians, camera(48, 40), 0, OCCLUDED_IMAGE_TOLERANCE, OCCLUDED_GRADIENT_TOLERANCE, sums)


@WIDTHS
def test_matches_on_needles_discs_and_ellipses_beyond_the_picture(sums):
    gaussians = scene(200, seed=3)
    gaussians.log_scales[:60] = (-0.5, -7.0, -7.0)
    gaussians.log_scales[60:120] = (-1.5, -1.5, -9.0)
    gaussians.means[::3, 0] *= 2.5  # partly or wholly outside, where the linear map is clamped
    assert_matches_reference(gaussians, camera(64, 50), 1, IMAGE_TOLERANCE, GRADIENT_TOLERANCE, sums)


def test_coefficients_above_the_rendered_degree_get_no_gradient():
    gaussians, view = scene(50), camera()
    result = backward(forward(gaussians, view, options=OPTIONS, sh_degree=1), upstream(view)[0])
    assert np.any(result.sh[:, :4])
    assert not result.sh[:, 4:].any()


def test_gradient_of_the_position_in_the_picture():
    gaussians, view = scene(80, size=0.7, degree=0), camera()
    d_colour = upstream(view)[0]
    shift = torch.zeros(80, 2, dtype=torch.float64, requires_grad=True)
    picture = reference(fields64(gaussians), view, 0, shift=shift)[0]
    (expected,) = torch.autograd.grad((picture * torch.from_numpy(d_colour)).sum(), shift)
    found = backward(forward(gaussians, view, options=OPTIONS, background=BACKGROUND), d_colour)
    assert relative(found.means2d, expected.numpy()) < GRADIENT_TOLERANCE


def test_near_plane_hides_what_is_nearer():
    gaussians, view = scene(100, seed=8), camera()
    depth = view.project(gaussians.means)[1]
    near = float(np.median(depth))
    assert_matches_reference(gaussians, view, 3, IMAGE_TOLERANCE, GRADIENT_TOLERANCE, options=RasterOptions(near=near))
    rendering = forward(gaussians, view, options=RasterOptions(near=near))
    assert not rendering.visible[depth < near].any()


def test_no_gaussians_show_the_background():
    view = camera()
    rendering = forward(scene(0), view, options=OPTIONS, background=BACKGROUND)
    assert np.array_equal(rendering.colour, np.broadcast_to(np.float32(BACKGROUND)[:, None, None], (3, 50, 70)))
    assert not rendering.alpha.any()
    assert not rendering.depth.any()
    assert backward(rendering, upstream(view)[0]).means.shape == (0, 3)


# -- degenerate input -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", np.nan),
        ("means", (0, np.inf, 0)),
        ("means", 1e30),
        ("log_scales", np.nan),
        ("log_scales", -np.inf),
        ("log_scales", (90.0, 0, 0)),
        ("quaternions", 0.0),
        ("quaternions", 1e-20),
        ("quaternions", np.nan),
        ("opacity_logits", np.nan),
        ("opacity_logits", np.inf),
        ("sh", np.nan),
        ("sh", 1e30),
    ],
)
def test_invalid_gaussian_is_skipped_and_counted(name, value):
    view, row = camera(), 7
    gaussians = scene(40)
    gaussians.means[row] = 0
    broken = forward(changed(gaussians, name, row, value), view, options=OPTIONS)
    assert broken.invalid_count == 1
    assert same_bytes(broken, forward(changed(gaussians, "opacity_logits", row, -20.0), view, options=OPTIONS))
    result = backward(broken, *upstream(view))
    for field in (*FIELDS, "means2d"):
        assert np.isfinite(getattr(result, field)).all()
        assert not getattr(result, field)[row].any()


def extreme_scene() -> Gaussians:
    """Huge and tiny, behind, on and just before the camera plane, saturated, far away: all valid."""
    gaussians = scene(240, seed=4)
    view = camera()
    groups = np.array_split(np.arange(240), 9)
    gaussians.log_scales[groups[0]] = 20.0
    gaussians.log_scales[groups[1]] = -60.0
    gaussians.log_scales[groups[2]] = (12.0, -30.0, -30.0)
    plane = view.centre + np.random.default_rng(0).normal(size=(len(groups[3]), 3)) @ np.diag([1, 1, 0])
    gaussians.means[groups[3]] = plane + view.forward * 1e-7
    gaussians.means[groups[4]] = view.centre - view.forward
    gaussians.opacity_logits[groups[5]] = 80.0
    gaussians.opacity_logits[groups[6]] = -80.0
    gaussians.means[groups[7]] *= 1e6
    gaussians.means[groups[8]] *= 1e17
    gaussians.quaternions[::2] *= 1e-6
    gaussians.quaternions[1::2] *= 1e6
    return gaussians


@pytest.mark.parametrize("near", [0.05, 1e-9])
def test_extreme_gaussians_leave_everything_finite(near):
    view = camera()
    rendering = forward(extreme_scene(), view, options=RasterOptions(near=near), weights=True)
    result = backward(rendering, *upstream(view))
    assert rendering.invalid_count == 0
    for picture in (rendering.colour, rendering.depth, rendering.alpha, rendering.weights):
        assert np.isfinite(picture).all()
    assert rendering.alpha.min() >= 0
    assert rendering.alpha.max() <= 1
    for field in (*FIELDS, "means2d"):
        assert np.isfinite(getattr(result, field)).all(), field


def test_overflowing_gradients_are_zero_and_counted():
    gaussians, view = scene(40, seed=2), camera()
    rendering = forward(gaussians, view, options=OPTIONS)
    result = backward(rendering, np.full((3, 50, 70), 3e38, np.float32))
    assert result.overflow_count > 0
    for field in (*FIELDS, "means2d"):
        assert np.isfinite(getattr(result, field)).all()


def test_a_sub_pixel_gaussian_is_still_seen():
    gaussians = changed(scene(1), "log_scales", 0, -30.0)
    gaussians.means[0] = 0
    gaussians.opacity_logits[0] = 5.0
    assert forward(gaussians, camera(), options=OPTIONS).alpha.max() > 0.5


def test_alpha_ends_at_99_percent_and_two_such_layers_end_the_blending():
    gaussians, view = scene(200, degree=0), camera(16, 16)
    gaussians.means[:] = view.centre + view.forward * np.linspace(1, 2, 200)[:, None]
    gaussians.log_scales[:] = 5.0
    gaussians.opacity_logits[:] = 80.0
    one = forward(changed(gaussians, "opacity_logits", slice(1, None), -80.0), view, options=OPTIONS)
    assert np.abs(one.alpha - 0.99).max() < 1e-6
    many = forward(gaussians, view, options=OPTIONS)
    assert many.pair_count == 200
    assert many.evaluation_count == 32 * 256  # looked at after every 32 Gaussians
    two = forward(changed(gaussians, "opacity_logits", slice(2, None), -80.0), view, options=OPTIONS)
    assert two.alpha.min() >= 1 - 1e-4


# -- tiles and rows ---------------------------------------------------------------------------------------------------


def pixels(tiles: np.ndarray, view: PinholeCamera) -> np.ndarray:
    return np.kron(tiles, np.ones((16, 16), bool))[: view.height, : view.width]


def test_active_tiles_are_those_of_the_whole_picture_and_the_rest_is_background():
    gaussians, view = scene(300, seed=6), camera(100, 70)
    tiles = np.random.default_rng(0).random(tile_shape(view)) < 0.4
    mask = pixels(tiles, view)
    whole = forward(gaussians, view, options=OPTIONS, background=BACKGROUND)
    part = forward(gaussians, view, options=OPTIONS, background=BACKGROUND, tiles=tiles)
    assert np.array_equal(part.colour[:, mask], whole.colour[:, mask])
    assert np.array_equal(part.depth, np.where(mask, whole.depth, 0))
    assert np.array_equal(part.alpha, np.where(mask, whole.alpha, 0))
    assert np.array_equal(part.colour[:, ~mask], np.broadcast_to(np.float32(BACKGROUND)[:, None], (3, (~mask).sum())))
    assert (part.visible <= whole.visible).all()


def test_gradients_of_active_tiles_are_those_of_a_masked_loss():
    gaussians, view = scene(300, seed=6), camera(100, 70)
    tiles = np.random.default_rng(1).random(tile_shape(view)) < 0.4
    mask = pixels(tiles, view)
    d = upstream(view)
    whole = backward(forward(gaussians, view, options=OPTIONS), *(g * mask for g in d))
    part = backward(forward(gaussians, view, options=OPTIONS, tiles=tiles), *d)
    for field in (*FIELDS, "means2d"):
        # Tiles without gradient add zeros, so even the bits agree.
        assert np.array_equal(getattr(part, field), getattr(whole, field)), field


def test_no_active_tile_costs_nothing():
    gaussians, view = scene(50), camera()
    rendering = forward(gaussians, view, options=OPTIONS, tiles=np.zeros(tile_shape(view), bool))
    assert rendering.pair_count == rendering.evaluation_count == 0
    assert not rendering.alpha.any()


def test_work_falls_with_the_share_of_active_tiles():
    gaussians, view = scene(2000, seed=1, size=0.3), camera(320, 240)
    half = np.zeros(tile_shape(view), bool)
    half[:, : half.shape[1] // 2] = True
    other = ~half
    counts = [forward(gaussians, view, options=OPTIONS, tiles=t).evaluation_count for t in (half, other, half | other)]
    assert counts[0] + counts[1] == counts[2]


def test_chosen_rows_have_the_gradients_of_all_and_the_rest_has_none():
    gaussians, view = scene(300, seed=9, size=1.5), camera(100, 70)
    rows = np.random.default_rng(2).random(300) < 0.15
    rendering = forward(gaussians, view, options=OPTIONS)
    whole, part = backward(rendering, *upstream(view)), backward(rendering, *upstream(view), rows=rows)
    for field in (*FIELDS, "means2d"):
        assert np.array_equal(getattr(part, field)[rows], getattr(whole, field)[rows]), field
        assert not getattr(part, field)[~rows].any()


def test_no_chosen_row():
    gaussians, view = scene(40), camera()
    result = backward(forward(gaussians, view, options=OPTIONS), *upstream(view), rows=np.zeros(40, bool))
    assert not any(getattr(result, field).any() for field in FIELDS)


# -- promises ---------------------------------------------------------------------------------------------------------

DIGEST = """
import hashlib, sys
import numba, numpy as np
from packuv.gaussians.floats import Gaussians
from packuv.camera import PinholeCamera
from packuv.raster import RasterOptions, gradients, render
numba.set_num_threads(int(sys.argv[2]))
data = np.load(sys.argv[1])
view = PinholeCamera("a", 160, 120, 150, 150, 80, 60, data["pose"])
drawn = render(Gaussians(*(data[f"f{k}"] for k in range(5))), view, options=RasterOptions(near=0.05), weights=True)
back = gradients(drawn, data["d0"], data["d1"], data["d2"])
arrays = [drawn.colour, drawn.depth, drawn.alpha, drawn.visible, drawn.weights, back.means, back.log_scales]
arrays += [back.quaternions, back.opacity_logits, back.sh, back.means2d]
print(hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest())
"""


def digest(path: Path, threads: int) -> str:
    command = [sys.executable, "-c", DIGEST, str(path), str(threads)]
    environment = {**os.environ, "NUMBA_NUM_THREADS": "4"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


def test_bytes_depend_neither_on_the_run_nor_on_the_threads(tmp_path):
    gaussians, view, path = scene(1500, seed=3), camera(160, 120), tmp_path / "scene.npz"
    arrays = {f"f{k}": getattr(gaussians, name) for k, name in enumerate(FIELDS)}
    derivatives = {f"d{k}": d for k, d in enumerate(upstream(view))}
    np.savez(path, pose=view.camera_from_world, **arrays, **derivatives)
    found = {digest(path, threads) for threads in (1, 3)} | {digest(path, 3)}
    assert len(found) == 1
    assert len(found.pop()) == 64


def test_a_rendering_stays_valid_while_others_are_made():
    gaussians, view, arena = scene(200), camera(), Arena()
    first = forward(gaussians, view, options=OPTIONS, arena=arena)
    colour, expected = first.colour.copy(), backward(first, *upstream(view)).means.copy()
    for seed in range(3):
        other = forward(scene(300, seed=seed), view, options=OPTIONS, arena=arena)
        backward(other, *upstream(view))
    assert np.array_equal(first.colour, colour)
    assert np.array_equal(backward(first, *upstream(view)).means, expected)


def test_a_picture_outlives_its_rendering():
    gaussians, view, arena = scene(200), camera(), Arena()
    colour = forward(gaussians, view, options=OPTIONS, arena=arena).colour
    row, copy = colour[1, 10:20], colour.copy()
    for seed in range(3):
        forward(scene(200, seed=seed), view, options=OPTIONS, arena=arena)
    assert np.array_equal(colour, copy)
    assert np.array_equal(row, copy[1, 10:20])


def test_a_workspace_stops_growing():
    view, arena = camera(), Arena()
    sizes = []
    for step in range(12):
        rendering = forward(scene(200 + 40 * (step % 3)), view, options=OPTIONS, arena=arena, weights=True)
        backward(rendering, *upstream(view))
        del rendering
        sizes.append(arena.free_bytes)
    assert sizes[5] == sizes[-1]


def test_threads_are_left_as_they_were():
    before = numba.get_num_threads()
    forward(scene(10), camera(), options=OPTIONS)
    assert numba.get_num_threads() == before


def test_render_and_gradients_take_the_cpu_path_for_arrays():
    gaussians, view = scene(60), camera()
    rendering = render(gaussians, view, options=OPTIONS)
    assert same_bytes(rendering, forward(gaussians, view, options=OPTIONS))
    found = gradients(rendering, upstream(view)[0])
    assert np.array_equal(found.sh, backward(rendering, upstream(view)[0]).sh)


# -- wrong input ------------------------------------------------------------------------------------------------------


def test_wrong_input_is_refused_with_what_came():
    gaussians, view = scene(5), camera()
    with pytest.raises(ValueError, match=r"means must be C-contiguous float32 \(5, 3\), but is float64"):
        forward(dataclasses.replace(gaussians, means=gaussians.means.astype(np.float64)), view, options=OPTIONS)
    with pytest.raises(ValueError, match=r"tiles must be bool \(4, 5\)"):
        forward(gaussians, view, options=OPTIONS, tiles=np.ones((5, 4), bool))
    with pytest.raises(ValueError, match="SH degree 4"):
        forward(gaussians, view, options=OPTIONS, sh_degree=4)
    with pytest.raises(ValueError, match="must be positive"):
        RasterOptions(near=0.0)
    rendering = forward(gaussians, view, options=OPTIONS)
    with pytest.raises(ValueError, match=r"rows must be bool \(5,\)"):
        backward(rendering, *upstream(view), rows=np.ones(4, bool))
    with pytest.raises(ValueError, match="must have its shape"):
        backward(rendering, np.zeros((3, 5, 5), np.float32))
