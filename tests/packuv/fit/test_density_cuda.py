"""Rows that come and go on a GPU, or in numba's simulator, as on the CPU: see `tests/packuv/raster/test_cuda.py`."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from packuv.fit import density, density_cuda
from packuv.fit.density import DensityOptions, Population, ScreenGradient, relocate
from packuv.fit.keyframe import choose_quantizer
from packuv.fit.model import Model
from packuv.fit.rows_cuda import RowsOnGpu
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.floats import ATTRIBUTES, DRAWN_LOGIT, arrays
from packuv.gaussians.uvsize import UvOptions
from packuv.raster import render
from packuv.raster.cuda.launch import on_device
from packuv.raster.cuda.render import draw
from tests.support.dense_raster import OPTIONS, camera, scene
from tests.support.needs import needs

pytestmark = needs("cuda", numba.config.ENABLE_CUDASIM or torch.cuda.is_available(), "no CUDA device")

BOUNDS = Bounds(np.zeros(3), 2.0, 0.05)
UV = UvOptions(rows=16, columns=8, layers=3)
COUNT = 60


def model(seed: int, degree: int = 1) -> Model:
    """With moments, as after some steps."""
    made, rng = Model(scene(COUNT, degree=degree, seed=seed)), np.random.default_rng(seed)
    for state in made.moments.values():
        state.first[:], state.second[:] = rng.normal(size=state.first.shape), rng.random(state.second.shape)
        state.steps[:] = rng.integers(1, 9, COUNT)
    return made


def assert_same(here: Model, there: Model) -> None:
    """To the bit."""
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(here.gaussians, name), getattr(there.gaussians, name)), name
        for part in ("first", "second", "steps"):
            assert np.array_equal(getattr(here.moments[name], part), getattr(there.moments[name], part)), name


def grown(population: Population, rng: np.random.Generator) -> None:
    density.grow(population, rng.random(len(population)), 7, bounds=BOUNDS, options=DensityOptions(), rng=rng)


def thinned(population: Population, rng: np.random.Generator) -> None:
    population.keep(rng.random(len(population)) < 0.8)


def picked(population: Population, rng: np.random.Generator) -> None:
    population.keep(np.sort(rng.choice(len(population), len(population) - 3, replace=False)))


def moved(population: Population, rng: np.random.Generator) -> None:
    """Two faint ones come back elsewhere."""
    population.put("opacity_logits", np.array([1, 5]), np.float32([-9, -8]))
    rows, score = np.arange(len(population)) < 40, rng.random(len(population))
    assert relocate(population, score, rows, bounds=BOUNDS, options=DensityOptions(), share=0.5, rng=rng) == 2


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("quantized", [False, True], ids=["masters are drawn", "codes are drawn"])
def test_any_changes_leave_what_they_leave_on_the_cpu(seed, quantized):
    """Rows, masters and moments to the bit; what is drawn is what all codes decode to."""
    here, there = model(seed), model(seed)
    quantizer = choose_quantizer(here.gaussians, BOUNDS, 1) if quantized else None
    rows = RowsOnGpu(there, np.ones(COUNT, bool), BOUNDS, quantizer)
    changes: list[Callable[[Population, np.random.Generator], None]] = [grown, thinned, moved, picked] * 2
    for number in np.random.default_rng(seed).permutation(len(changes)):
        for population in (here, rows):
            changes[number](population, np.random.default_rng([seed, number]))
        rows.renew()
        assert len(rows) == len(here)
        assert all(np.array_equal(rows.column(name), here.column(name)) for name in ATTRIBUTES)
    chosen = np.array([3, 9])
    assert all(np.array_equal(a, b) for a, b in zip(*(arrays(p.some(chosen)) for p in (here, rows)), strict=True))
    if quantizer is None:
        assert rows.drawn is rows.masters
    else:
        drawn = arrays(quantizer.decode(quantizer.encode(here.gaussians)))
        assert all(np.array_equal(a.cpu().numpy(), b) for a, b in zip(rows.drawn, drawn, strict=True))
    assert rows.bring_home(there) == 0
    assert_same(here, there)


def test_rows_that_are_born_may_change_and_those_that_may_not_stay_so():
    still = np.arange(COUNT) % 2 == 0
    rows = RowsOnGpu(model(0), ~still, BOUNDS, None)
    rows.append(scene(5, degree=1))
    rows.keep(np.arange(COUNT + 5) >= 3)
    assert rows.rows.cpu().numpy().tolist() == [*~still[3:], *[True] * 5]


def test_a_broken_one_that_is_born_is_emptied_as_on_the_cpu(caplog):
    born = scene(5, degree=1)
    born.means[2, 1] = np.nan
    rows, there = RowsOnGpu(model(0), np.ones(COUNT, bool), BOUNDS, None), model(0)
    with caplog.at_level(logging.WARNING):
        rows.append(born)
    rows.renew()
    assert "means of Gaussian 2 is not finite or absurd" in caplog.text
    assert rows.bring_home(there) == 1
    assert np.isfinite(there.gaussians.means).all()
    assert there.gaussians.opacity_logits[COUNT + 2] < DRAWN_LOGIT
    assert not there.moments["means"].steps[COUNT:].any()


@pytest.mark.parametrize("seed", range(4))
def test_pruning_is_the_cpus(seed):
    """Faint, huge, broken, equally opaque ones, and places that are taken."""
    here, rng = Model(scene(300, degree=0, seed=seed)), np.random.default_rng(seed)
    gaussians = here.gaussians
    gaussians.opacity_logits[:] = rng.integers(-6, 3, 300)
    gaussians.log_scales[rng.choice(300, 9)] = 1.5
    gaussians.means[rng.choice(300, 5)] = np.inf
    gaussians.means[7] = 0.0
    gradient = ScreenGradient(300)
    gradient.add(rng.exponential(1e-3, (300, 2)), rng.integers(0, 2, 300), 100, 100)
    taken = rng.normal(size=(20, 3)).astype(np.float32)
    for options in (DensityOptions(), DensityOptions(min_gradient=0.05)):
        kept = density.prune(here, gradient, taken, bounds=BOUNDS, options=options, uv=UV)
        given = {"bounds": BOUNDS, "options": options, "uv": UV}
        found = density_cuda.prune([*map(on_device, arrays(gaussians))], gradient, taken, **given)
        assert np.array_equal(found.cpu().numpy(), kept)
        assert 10 < kept.sum() < 250


def test_a_map_without_gaussians_keeps_none():
    nothing, empty = [*map(on_device, arrays(scene(0, degree=0)))], np.empty((0, 3), np.float32)
    found = density_cuda.prune(nothing, ScreenGradient(0), empty, bounds=BOUNDS, options=DensityOptions(), uv=UV)
    assert len(found) == 0


def test_views_that_show_a_gaussian_are_counted_as_on_the_cpu():
    gaussians, view = scene(30, degree=0), camera(24, 20)
    for changes in ({}, {"afar": 1.05}, {"least_shown": 0.2}):
        options = replace(DensityOptions(cap=60), **changes)
        rendering = render(gaussians, view, options=OPTIONS, weights=True)
        truth = density.views_showing(rendering, gaussians.means, view, options)
        fields = tuple(map(on_device, arrays(gaussians)))
        drawn = draw(fields, view, options=OPTIONS, sh_degree=0, weights=True)
        assert np.array_equal(density_cuda.views_showing(drawn, fields[0], view, options).cpu().numpy(), truth)
        assert len(set(truth)) > 1
