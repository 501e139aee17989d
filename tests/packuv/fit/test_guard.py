"""The guard: what is broken goes back to its last good state, by name, and nothing else changes."""

import dataclasses
import logging

import numpy as np
import pytest

from packuv.fit import solver as solver_module
from packuv.fit.guard import GRADIENT_LIMIT, LIMITS, Guard
from packuv.fit.model import Model
from packuv.fit.options import FitOptions
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.first import round_gaussians
from packuv.gaussians.codes import OPACITY_RANGE
from packuv.gaussians.floats import ATTRIBUTES, opacity, rows_of
from packuv.raster import RasterOptions, render

BOUNDS = Bounds(np.zeros(3), 4.0, 0.1)
BROKEN = (np.nan, np.inf, -np.inf)


def cloud(count: int = 50, *, sh_degree: int = 1):
    rng = np.random.default_rng(0)
    xyz, rgb = rng.uniform(-1, 1, (count, 3)), rng.random((count, 3))
    return round_gaussians(xyz, rgb, np.full(count, 0.1), opacity=0.5, sh_degree=sh_degree)


def state(model: Model) -> list[np.ndarray]:
    arrays = [getattr(model.gaussians, name).copy() for name in ATTRIBUTES]
    for name in ATTRIBUTES:
        moments = model.moments[name]
        arrays += [moments.first.copy(), moments.second.copy(), moments.steps.copy()]
    return arrays


def slopes(model: Model) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {
        name: rng.normal(size=getattr(model.gaussians, name).shape).astype(np.float32) * 1e-3 for name in ATTRIBUTES
    }


def step(model: Model, gradients: dict[str, np.ndarray], rows: np.ndarray) -> None:
    model.step(gradients, FitOptions().rates, radius=1.0, progress=0.0, rows=rows)


def test_a_sound_model_is_left_bit_for_bit():
    model = Model(cloud())
    guard, rows = Guard(model, BOUNDS), np.ones(50, bool)
    step(model, slopes(model), rows)
    before = state(model)
    guard.check(model, slopes(model), rows, "now")
    assert all(np.array_equal(a, b) for a, b in zip(state(model), before, strict=True))
    assert guard.count == 0


@pytest.mark.parametrize("value", [*BROKEN, 10 * GRADIENT_LIMIT])
@pytest.mark.parametrize("name", ATTRIBUTES)
def test_a_broken_gradient_costs_one_gaussian_its_step(name, value, caplog):
    model, rows = Model(cloud()), np.ones(50, bool)
    guard, gradients = Guard(model, BOUNDS), slopes(model)
    step(model, gradients, rows)
    guard.check(model, gradients, rows, "iteration 1")
    good = rows_of(model.gaussians, slice(None))
    gradients[name][17] = value
    step(model, gradients, rows)
    stepped = rows_of(model.gaussians, slice(None))
    with caplog.at_level(logging.WARNING):
        guard.check(model, gradients, rows, "iteration 2")
    others = np.arange(50) != 17
    for attribute in ATTRIBUTES:
        now = getattr(model.gaussians, attribute)
        assert np.array_equal(now[17], getattr(good, attribute)[17])
        assert np.array_equal(now[others], getattr(stepped, attribute)[others])
        moments = model.moments[attribute]
        assert not moments.first[17].any()
        assert not moments.second[17].any()
        assert moments.steps[17] == 0
        assert moments.steps[others].all()
    assert guard.count == 1
    assert f"iteration 2, the gradient of {name} of Gaussian 17 is not finite or absurd" in caplog.text
    assert "goes back to its last good state" in caplog.text


@pytest.mark.parametrize("name", ATTRIBUTES)
@pytest.mark.parametrize("share", [np.nan, np.inf, 2.0])
def test_a_broken_value_goes_back(name, share, caplog):
    model, rows = Model(cloud()), np.ones(50, bool)
    guard, before = Guard(model, BOUNDS), state(model)
    getattr(model.gaussians, name)[3:5] = share * LIMITS[name]
    guard.check(model, None, rows, "after the lift")
    assert all(np.array_equal(a, b) for a, b in zip(state(model), before, strict=True))
    assert guard.count == 2
    assert f"{name} of Gaussian 3 is not finite or absurd" in caplog.text
    assert "and so are 1 more" in caplog.text


def test_rows_that_were_not_asked_for_are_not_looked_at():
    model = Model(cloud())
    guard, rows = Guard(model, BOUNDS), np.ones(50, bool)
    rows[9] = False
    gradients = slopes(model)
    gradients["means"][9] = np.nan
    guard.check(model, gradients, rows, "now")
    assert guard.count == 0


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_what_is_broken_from_the_start_becomes_empty(name, caplog):
    gaussians = cloud()
    getattr(gaussians, name)[[2, 40]] = np.nan
    model = Model(gaussians)
    guard = Guard(model, BOUNDS)
    assert guard.count == 2
    assert all(np.isfinite(getattr(model.gaussians, attribute)).all() for attribute in ATTRIBUTES)
    assert (model.gaussians.opacity_logits[[2, 40]] == np.float32(OPACITY_RANGE[0])).all()
    assert (opacity(model.gaussians)[[2, 40]] < 1 / 255).all()
    assert "is emptied" in caplog.text


def test_what_is_emptied_is_good_from_then_on():
    gaussians = cloud()
    gaussians.means[7] = np.inf
    model = Model(gaussians)
    guard = Guard(model, BOUNDS)
    model.gaussians.means[7] = np.nan
    guard.check(model, None, np.ones(50, bool), "now")
    assert np.isfinite(model.gaussians.means).all()


def test_appended_and_kept_rows_are_watched_by_the_solver():
    solver = Solver(Model(cloud()), BOUNDS, FitOptions(sh_degree=1), np.random.default_rng(0))
    born = cloud(5)
    born.log_scales[1] = np.inf
    solver.append(born)
    assert solver.guarded == 1
    solver.keep(np.arange(55) % 2 == 0)
    assert len(solver.model) == 28
    solver.model.gaussians.means[27] = np.nan  # as a lift by broken flow does
    solver.free(np.ones(28, bool))
    assert solver.guarded == 2
    assert np.isfinite(solver.model.gaussians.means).all()


def _shots(ring, gaussians):
    return [Shot(camera, np.array(render(gaussians, camera, options=RasterOptions(0.1)).colour)) for camera in ring(4)]


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_a_run_goes_on_after_a_gradient_breaks(name, ring, monkeypatch, caplog):
    """A gradient that breaks in one iteration costs one Gaussian one step, and the fit still gets better."""
    shots, calls = _shots(ring, cloud()), []
    real = solver_module.gradients

    def breaking(*arguments, **options):
        found = real(*arguments, **options)
        calls.append(found)
        if len(calls) == 5:
            getattr(found, name)[11] = np.nan
        return found

    start = cloud()
    start.means[:] += 0.05
    solver = Solver(Model(start), BOUNDS, FitOptions(sh_degree=1, random_background=False), np.random.default_rng(0))
    first = solver.run(shots, 4, of=40)
    monkeypatch.setattr(solver_module, "gradients", breaking)
    last = solver.run(shots, 36, of=40)
    assert solver.guarded == 1
    assert last["photometric"] < 0.8 * first["photometric"]  # measured 0.4
    assert f"iteration 8, the gradient of {name} of Gaussian 11" in caplog.text
    assert all(np.isfinite(getattr(solver.model.gaussians, attribute)).all() for attribute in ATTRIBUTES)


def test_a_picture_that_is_not_finite_is_refused_with_its_camera(ring):
    shots = _shots(ring, cloud())
    shots[2].target[1, 5, 5] = np.nan
    solver = Solver(Model(cloud()), BOUNDS, FitOptions(sh_degree=1), np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"the photometric loss of camera 'cam2' is nan: its picture or"):
        solver.run(shots, 4, of=4)


def test_the_guard_changes_no_byte_of_a_sound_fit(ring, monkeypatch):
    shots = _shots(ring, cloud())
    start = dataclasses.replace(cloud(), sh=np.zeros_like(cloud().sh))

    def fitted():
        solver = Solver(Model(start), BOUNDS, FitOptions(sh_degree=1), np.random.default_rng(0))
        solver.run(shots, 12, of=12)
        assert solver.guarded == 0
        return state(solver.model)

    guarded = fitted()
    monkeypatch.setattr(Guard, "check", lambda *arguments: None)
    assert all(np.array_equal(a, b) for a, b in zip(fitted(), guarded, strict=True))
