"""Adam, guard and quantizer on a GPU, or in numba's simulator, against the CPU's.

See `tests/packuv/raster/test_cuda.py`. Both run the same functions of one row, so what differs is rounding alone.
"""

from __future__ import annotations

import logging

import numba
import numpy as np
import pytest
import torch

from packuv.fit.guard import GRADIENT_LIMIT, Guard
from packuv.fit.keyframe import choose_quantizer
from packuv.fit.model import Model, Rates
from packuv.fit.rows_cuda import RowsOnGpu, rates_of
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.codes import Quantizer
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, arrays
from packuv.raster.cuda.launch import on_device
from tests.support.dense_raster import scene
from tests.support.needs import needs

pytestmark = needs("cuda", numba.config.ENABLE_CUDASIM or torch.cuda.is_available(), "no CUDA device")

COUNT, STEPS = 40, 6
BOUNDS = Bounds(np.zeros(3), 2.0, 0.05)
GIVEN = {"radius": 2.0, "progress": 0.25}
RATES = Rates(means=3e-3)
ROWS = np.arange(COUNT) % 3 != 0
TOLERANCE = 2e-6
"""Of values and moments, relative to the largest; a GPU fuses products and sums"""


def tables(degree: int) -> Quantizer:
    return choose_quantizer(scene(COUNT, degree=degree), BOUNDS, degree)


def slopes(gaussians: Gaussians, number: int) -> list[np.ndarray]:
    """Gradients of very different size."""
    rng = np.random.default_rng(number)
    size = 10.0 ** rng.integers(-7, 1, COUNT)
    return [
        (rng.normal(size=a.shape) * size.reshape(-1, *[1] * (a.ndim - 1))).astype(np.float32) for a in arrays(gaussians)
    ]


def moving(number: int) -> np.ndarray:
    return np.asarray(ROWS & (np.random.default_rng([number, 1]).random(COUNT) < 0.7))


def walked(degree: int, quantizer: Quantizer | None, spoil=lambda number, gradients: None):
    """A model after some steps on the CPU, another with the rows it had on the GPU, and both counts of faults."""
    here, there = Model(scene(COUNT, degree=degree)), Model(scene(COUNT, degree=degree))
    guard, rows = Guard(here, BOUNDS), RowsOnGpu(there, ROWS, BOUNDS, quantizer)
    for number in range(STEPS):
        gradients, chosen = slopes(here.gaussians, number), moving(number)
        spoil(number, gradients)
        named = dict(zip(ATTRIBUTES, gradients, strict=True))
        here.step(named, RATES, rows=chosen, **GIVEN)
        guard.check(here, named, chosen, f"iteration {number}")
        rates = rates_of(RATES, there.gaussians, **GIVEN)
        rows.step([*map(on_device, gradients)], rates, on_device(chosen.view(np.uint8)), number)
    return here, guard.count, there, rows


def assert_alike(here: Model, there: Model) -> None:
    for name in ATTRIBUTES:
        pairs = [(getattr(m.gaussians, name), m.moments[name].first, m.moments[name].second) for m in (here, there)]
        for truth, found in zip(*pairs, strict=True):
            assert np.abs(found - truth).max() <= TOLERANCE * max(1.0, np.abs(truth).max()), name
        assert np.array_equal(here.moments[name].steps, there.moments[name].steps)


@pytest.mark.parametrize("degree", [0, 2])
def test_steps_are_the_cpus_and_other_rows_keep_everything(degree):
    here, _, there, rows = walked(degree, None)
    assert rows.drawn is rows.masters
    assert rows.bring_home(there) == 0
    assert_alike(here, there)
    first = scene(COUNT, degree=degree)
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(there.gaussians, name)[~ROWS], getattr(first, name)[~ROWS])
        assert not there.moments[name].steps[~ROWS].any()
        assert not np.array_equal(getattr(there.gaussians, name)[ROWS], getattr(first, name)[ROWS])


def test_codes_are_the_cpus_and_frozen_rows_keep_theirs():
    quantizer = tables(1)
    here, _, there, rows = walked(1, quantizer)
    codes, before, after = rows.codes, *map(quantizer.encode, (scene(COUNT, degree=1), here.gaussians))
    for name in ("xyz", "attributes"):
        found, truth = (getattr(part, name).astype(int) for part in (codes, after))
        assert np.abs(found - truth).max() <= 1
        assert (found != truth).mean() < 0.01
        assert np.array_equal(found[~ROWS], getattr(before, name)[~ROWS])
        assert (found[ROWS] != getattr(before, name)[ROWS]).any()
    drawn = quantizer.decode(codes)
    assert all(np.array_equal(a.cpu().numpy(), b) for a, b in zip(rows.drawn, arrays(drawn), strict=True))
    rows.bring_home(there)
    assert_alike(here, there)
    assert np.array_equal(quantizer.encode(there.gaussians).xyz, codes.xyz)
    assert np.array_equal(quantizer.encode(there.gaussians).attributes, codes.attributes)


@pytest.mark.filterwarnings("ignore:.*(overflow|invalid value) encountered:RuntimeWarning")  # numpy's, in the simulator
@pytest.mark.parametrize("value", [np.nan, np.inf, 10 * GRADIENT_LIMIT])
@pytest.mark.parametrize("place", range(len(ATTRIBUTES)))
def test_a_broken_gradient_costs_a_gaussian_its_step_as_on_the_cpu(place, value, caplog):
    row = int(np.flatnonzero(moving(2) & moving(4))[1])

    def spoil(number: int, gradients: list[np.ndarray]) -> None:
        if number in (2, 4):
            gradients[place][row] = value

    here, count, there, rows = walked(1, None, spoil)
    with caplog.at_level(logging.WARNING):
        assert rows.bring_home(there) == count == 2
    wanted = f"iteration 2, the gradient of {ATTRIBUTES[place]} of Gaussian {row} is not finite or absurd, the first of"
    assert caplog.messages[-1].startswith(f"{wanted} 2 times")
    assert_alike(here, there)


def test_what_was_drawn_otherwise_than_it_is_stored_stops_the_run():
    quantizer = tables(2)
    _, _, there, rows = walked(2, quantizer)
    rows.drawn[2][5, 1] += 1e-3
    with pytest.raises(RuntimeError, match=r"quaternions of 1 of 40 Gaussians were drawn otherwise .*--device cpu"):
        rows.bring_home(there)


def test_codes_more_than_a_step_from_the_cpus_stop_the_run():
    quantizer = tables(2)
    _, _, there, rows = walked(2, quantizer)
    rows.masters[0][7, 0] += 0.1
    with pytest.raises(RuntimeError, match="codes of 1 of 40 Gaussians are more than one step"):
        rows.bring_home(there)


def test_masters_between_two_codes_take_the_value_that_was_drawn():
    """As if the GPU had rounded the other way."""
    quantizer = tables(2)
    _, _, there, rows = walked(2, quantizer)
    border = quantizer.attribute_table[6, 100:102].mean()
    codes = rows.codes
    codes.attributes[9, 6] = 101 if quantizer.encode(_with_logit(rows, 9, border)).attributes[9, 6] == 100 else 100
    rows._draw_codes(quantizer, codes)
    rows.masters[3][9] = float(border)
    rows.bring_home(there)
    assert there.gaussians.opacity_logits[9] == quantizer.attribute_table[6, codes.attributes[9, 6]]
    assert np.array_equal(quantizer.encode(there.gaussians).attributes, codes.attributes)


def _with_logit(rows: RowsOnGpu, row: int, value: float) -> Gaussians:
    gaussians = Gaussians(*(field.cpu().numpy().copy() for field in rows.masters))
    gaussians.opacity_logits[row] = value
    return gaussians


def test_no_rows():
    model = Model(scene(0, degree=1))
    rows = RowsOnGpu(model, np.zeros(0, bool), BOUNDS, tables(1))
    rows.step(rows.masters, rates_of(RATES, model.gaussians, **GIVEN), rows.rows, 1)
    assert rows.bring_home(model) == 0
    assert len(model) == 0
