"""Drawing over a layer: the same picture and gradients as of all Gaussians in one set."""

from __future__ import annotations

import dataclasses
import hashlib

import numba
import numpy as np
import pytest

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians, arrays, rows_of
from packuv.kernels.simd import ALL, HALF
from packuv.raster import Arena, RasterOptions, compose, gradients, merge, render, tile_shape
from packuv.raster.cpu import backward, forward
from packuv.raster.layer import compose as compose_with
from tests.support.dense_raster import BACKGROUND, FIELDS, OPTIONS, camera, scene, upstream

TOLERANCE = 2e-5
"""Of colour and alpha; measured 1e-6."""
FARTHEST = 15
"""Depth of no Gaussian is more: what colour's tolerance is times for depth"""
GRADIENT_TOLERANCE = 1e-4
"""Relative, per array; measured 6e-6."""
OPAQUE_TOLERANCE = 2e-4
"""Both ways end at a transmittance of 1e-4, but look for it at other places."""
OPAQUE_GRADIENT_TOLERANCE = 3e-2
"""The same cause, worst where what changes shows little; there both ways are up to 1.6e-2 off the dense reference."""


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(*(np.concatenate(fields) for fields in zip(*map(arrays, parts), strict=True)))


def faint(gaussians: Gaussians) -> Gaussians:
    """Nothing ends the blending of some hundred of these."""
    gaussians.opacity_logits[:] -= 3
    return gaussians


def placed(gaussians: Gaussians, view: PinholeCamera, offset: float, thickness: float) -> Gaussians:
    """As if squeezed to a slab that is `offset` behind the origin along the viewing direction."""
    depth = gaussians.means @ view.forward
    moved = gaussians.means + np.outer(depth * (thickness - 1) + offset, view.forward)
    return dataclasses.replace(gaussians, means=moved.astype(np.float32))


def assert_same_as_in_one_set(still, moving, view, *, near=OPTIONS.near, tiles=None, layer=None, opaque=False):
    options, tolerance = RasterOptions(near=near), OPAQUE_TOLERANCE if opaque else TOLERANCE
    layer = compose(still, view, options=options, tiles=tiles) if layer is None else layer
    whole = render(joined(still, moving), view, options=options, tiles=tiles, background=BACKGROUND)
    found = render(moving, view, options=options, tiles=tiles, background=BACKGROUND, over=layer)
    assert np.abs(found.colour - whole.colour).max() < tolerance
    assert np.abs(found.alpha - whole.alpha).max() < tolerance
    assert np.abs(found.depth - whole.depth).max() < tolerance * FARTHEST
    assert np.array_equal(found.visible, whole.visible[len(still) :])
    assert found.invalid_count + layer.invalid_count == whole.invalid_count
    expected, got = gradients(whole, *upstream(view)), gradients(found, *upstream(view))
    for field in (*FIELDS, "means2d"):
        truth = getattr(expected, field)[len(still) :]
        bound = (OPAQUE_GRADIENT_TOLERANCE if opaque else GRADIENT_TOLERANCE) * max(np.linalg.norm(truth), 1e-6)
        assert np.linalg.norm(getattr(got, field) - truth) <= bound, field
    assert got.overflow_count == 0


# -- the same picture -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_a_layer_and_what_changes_are_one_set(seed):
    rng = np.random.default_rng(seed)
    view = camera(int(rng.integers(3, 120)), int(rng.integers(2, 90)))
    still = faint(scene(int(rng.integers(1, 900)), seed=seed, degree=int(rng.integers(0, 4)), size=rng.uniform(0.3, 2)))
    moving = faint(scene(int(rng.integers(1, 200)), seed=seed + 100, degree=still.sh_degree))
    moving = placed(moving, view, rng.uniform(-2, 2), rng.uniform(0.01, 1))
    assert_same_as_in_one_set(still, moving, view, tiles=rng.random(tile_shape(view)) < rng.choice([0.5, 1.1]))


@pytest.mark.parametrize("offset", [-3.0, -0.5, 0.0, 0.5, 6.0], ids=["before", "front", "within", "back", "behind"])
def test_wherever_what_changes_stands(offset):
    view, still = camera(), faint(scene(700, seed=1))
    assert_same_as_in_one_set(still, placed(faint(scene(60, seed=2)), view, offset, 0.05), view)


def test_what_changes_may_go_anywhere_over_the_same_layer():
    view, still = camera(), faint(scene(700, seed=1))
    layer, rng = compose(still, view, options=OPTIONS), np.random.default_rng(0)
    for _ in range(6):
        moving = placed(faint(scene(30, seed=2)), view, rng.uniform(-3.5, 4), rng.uniform(0.01, 1.5))
        assert_same_as_in_one_set(still, moving, view, layer=layer)


@pytest.mark.parametrize("count", [1, merge.EVERY - 1, merge.EVERY, merge.EVERY + 1, 3 * merge.EVERY])
def test_whole_and_broken_runs(count):
    view = camera(16, 16)
    still, moving = faint(scene(count, seed=3, size=4)), faint(scene(5, seed=4, size=4))
    for offset in (-2, 0, 2):
        assert_same_as_in_one_set(still, placed(moving, view, offset, 0.1), view)


def test_at_equal_depth_the_layer_comes_first():
    view, copies = camera(), scene(1, degree=0)
    copies = rows_of(copies, np.zeros(200, int))
    copies.means[:], copies.sh[:, 0] = 0, np.random.default_rng(0).normal(size=(200, 3))
    copies.opacity_logits[:] = -3
    for k in (0, 1, 100, 199, 200):
        assert_same_as_in_one_set(rows_of(copies, slice(0, k)), rows_of(copies, slice(k, 200)), view)


def test_nothing_changes_and_nothing_stays():
    view, some, none = camera(), faint(scene(400)), scene(0)
    assert_same_as_in_one_set(some, none, view)
    assert_same_as_in_one_set(none, some, view)
    assert_same_as_in_one_set(none, none, view)


def test_opaque_walls():
    view = camera(60, 40)
    still, moving = scene(900, seed=5, size=3), scene(60, seed=6, size=2)
    still.opacity_logits[:] += 3
    for offset in (-3.0, -1.0, 0.0, 6.0):
        assert_same_as_in_one_set(still, placed(moving, view, offset, 0.1), view, opaque=True)


def test_light_through_many_walls_is_not_lost_to_rounding():
    """Where next to nothing comes through, a jump divides by next to nothing."""
    view, count = camera(16, 16), 400
    still = scene(count, degree=0)
    still.means[:] = view.centre + np.linspace(1, 9, count)[:, None] * view.forward
    still.log_scales[:], still.opacity_logits[:] = 5.0, 80.0
    moving = rows_of(still, slice(100, 110))
    assert_same_as_in_one_set(still, moving, view, opaque=True)
    still.opacity_logits[:] = -3.0
    still.opacity_logits[5:] = -1.0  # alpha 0.27: every run takes away what the limit of 1e-4 leaves
    assert_same_as_in_one_set(still, moving, view, opaque=True)


def test_the_near_plane_is_of_both():
    view, still, moving = camera(), faint(scene(500, seed=7)), faint(scene(100, seed=8))
    assert_same_as_in_one_set(still, moving, view, near=4.0)
    layer = compose(still, view, options=OPTIONS)
    far = RasterOptions(near=4.0)
    found = render(moving, view, options=far, over=layer)
    beyond = rows_of(moving, view.project(moving.means)[1] >= 4.0)
    whole = render(joined(still, beyond), view, options=OPTIONS)
    assert np.abs(found.colour - whole.colour).max() < TOLERANCE


def test_a_layer_may_be_drawn_over_in_some_of_its_tiles():
    view, still, moving = camera(100, 70), faint(scene(600, seed=1)), faint(scene(80, seed=2))
    rng = np.random.default_rng(0)
    mine = rng.random(tile_shape(view)) < 0.7
    layer = compose(still, view, options=OPTIONS, tiles=mine)
    assert_same_as_in_one_set(still, moving, view, tiles=mine & (rng.random(mine.shape) < 0.5), layer=layer)
    own = render(moving, view, options=OPTIONS, over=layer)
    assert own.colour.tobytes() == render(moving, view, options=OPTIONS, over=layer, tiles=mine).colour.tobytes()


def test_degrees_are_of_both():
    view, still, moving = camera(), faint(scene(400, seed=1)), faint(scene(50, seed=2))
    low, flat = (dataclasses.replace(g, sh=g.sh.copy()) for g in (still, moving))
    low.sh[:, 4:], flat.sh[:, 1:] = 0, 0
    layer = compose(still, view, options=OPTIONS, sh_degree=1)
    found = render(moving, view, options=OPTIONS, sh_degree=0, over=layer)
    assert np.abs(found.colour - render(joined(low, flat), view, options=OPTIONS).colour).max() < TOLERANCE
    assert not gradients(found, *upstream(view)).sh[:, 1:].any()


def test_invalid_gaussians_are_skipped_and_counted():
    view, still, moving = camera(), faint(scene(200, seed=1)), faint(scene(50, seed=2))
    still.means[3, 0], moving.sh[7, 0, 0], moving.opacity_logits[9] = np.nan, np.inf, np.nan
    assert_same_as_in_one_set(still, moving, view)


# -- gradients --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sums", [HALF, ALL], ids=["sums of 8", "sums of 16"])
def test_chosen_rows_have_the_gradients_of_all_and_the_rest_has_none(sums):
    view, still, moving = camera(), faint(scene(500, seed=1)), faint(scene(100, seed=2))
    layer = compose_with(still, view, options=OPTIONS, sums=sums)
    rows = np.random.default_rng(2).random(100) < 0.3
    found = forward(moving, view, options=OPTIONS, over=layer, sums=sums)
    whole, part = backward(found, *upstream(view)), backward(found, *upstream(view), rows=rows)
    for field in (*FIELDS, "means2d"):
        assert np.array_equal(getattr(part, field)[rows], getattr(whole, field)[rows]), field
        assert not getattr(part, field)[~rows].any()


# -- promises ---------------------------------------------------------------------------------------------------------


def digest(threads: int) -> str:
    view, before = camera(160, 120), numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        layer = compose(scene(1500, seed=3), view, options=OPTIONS)
        drawn = render(scene(300, seed=4), view, options=OPTIONS, over=layer)
        found = gradients(drawn, *upstream(view))
    finally:
        numba.set_num_threads(before)
    kept = (layer.pairs, layer.checkpoints, drawn.colour, drawn.depth, drawn.alpha, drawn.visible)
    shown = [*kept, *(getattr(found, name) for name in (*FIELDS, "means2d"))]
    return hashlib.sha256(b"".join(array.tobytes() for array in shown)).hexdigest()


def test_bytes_depend_neither_on_the_run_nor_on_the_threads():
    most = numba.get_num_threads()
    assert len({digest(1), digest(most), digest(most)}) == 1


def test_renderings_over_one_layer_stay_valid_while_others_are_made():
    view, arena, still = camera(), Arena(), scene(500, seed=1)
    layer, first_set = compose(still, view, options=OPTIONS), scene(50, seed=2)
    before = layer.checkpoints.copy()
    first = render(first_set, view, options=OPTIONS, over=layer, arena=arena)
    colour, means = first.colour.copy(), gradients(first, *upstream(view)).means.copy()
    for seed in range(3):
        gradients(render(scene(80, seed=seed), view, options=OPTIONS, over=layer, arena=arena), *upstream(view))
    assert np.array_equal(first.colour, colour)
    assert np.array_equal(gradients(first, *upstream(view)).means, means)
    assert np.array_equal(layer.checkpoints, before)


def test_only_what_lies_between_is_walked():
    view, still = camera(64, 64), faint(scene(4000, seed=1))
    layer = compose(still, view, options=OPTIONS)
    moving = placed(faint(scene(20, seed=2)), view, 0.0, 0.001)
    whole = render(joined(still, moving), view, options=OPTIONS)
    found = render(moving, view, options=OPTIONS, over=layer)
    assert found.evaluation_count < whole.evaluation_count / 5
    assert render(scene(0), view, options=OPTIONS, over=layer).evaluation_count == 0


def test_memory_is_what_the_layer_says():
    view = camera(100, 70)
    layer = compose(scene(3000, seed=1, size=2), view, options=OPTIONS)
    runs, tiles = len(layer.reach), layer.active.size
    shown = len(np.unique(layer.pairs[:, 0]))
    assert runs <= 1 + tiles + len(layer.pairs) / merge.EVERY
    assert layer.nbytes < 64 * shown + 12 * len(layer.pairs) + 5200 * runs + 20 * tiles + 1000
    opaque = scene(3000, seed=1, size=2)
    opaque.opacity_logits[:] += 5
    assert compose(opaque, view, options=OPTIONS).nbytes < 0.6 * layer.nbytes  # what is behind walls is not kept


# -- wrong input ------------------------------------------------------------------------------------------------------


def test_wrong_input_is_refused_with_what_came():
    view, still, moving = camera(), scene(50), scene(5)
    tiles = np.zeros(tile_shape(view), bool)
    tiles[1, :2] = True
    layer = compose(still, view, options=OPTIONS, tiles=tiles)
    with pytest.raises(ValueError, match="among the 2 that the layer was composed for, but 18 of 20 are not"):
        render(moving, view, options=OPTIONS, over=layer, tiles=np.ones(tile_shape(view), bool))
    with pytest.raises(ValueError, match="weights over a layer"):
        render(moving, view, options=OPTIONS, over=layer, weights=True)
    for options, other in ((OPTIONS, camera(71, 50)), (RasterOptions(near=0.05, low_pass_px2=0.1), view)):
        with pytest.raises(ValueError, match="the camera and the low-pass filter that it was composed with"):
            render(moving, other, options=options, over=layer)
