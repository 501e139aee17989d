"""Sparse Adam against torch's, and what it promises to rows that are left alone."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from packuv.fit.adam import AdamOptions, AdamState, adam_step

TOLERANCE = 2e-6
"""Float32, tens of steps, parameters of order 1; torch forms the same products in another order."""
OPTIONS = AdamOptions(epsilon=1e-8)  # torch's default, so that the two can be compared


def torch_path(start: np.ndarray, gradients: list[np.ndarray], rate: float) -> np.ndarray:
    """Where torch.optim.Adam takes an array."""
    variable = torch.from_numpy(start.copy()).requires_grad_()
    optimizer = torch.optim.Adam([variable], lr=rate, betas=(OPTIONS.beta1, OPTIONS.beta2), eps=OPTIONS.epsilon)
    for gradient in gradients:
        variable.grad = torch.from_numpy(gradient.copy())
        optimizer.step()
    return variable.detach().numpy()


def problem(shape: tuple[int, ...], steps: int, seed: int = 0) -> tuple[np.ndarray, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    start = rng.normal(size=shape).astype(np.float32)
    return start, [(rng.normal(size=shape) * 10.0 ** rng.integers(-6, 3)).astype(np.float32) for _ in range(steps)]


@pytest.mark.parametrize("shape", [(50,), (33, 3), (20, 16, 3), (1, 4)])
def test_matches_torch_on_all_rows(shape):
    start, steps = problem(shape, 60)
    parameters, state = start.copy(), AdamState.zeros(start)
    for gradient in steps:
        adam_step(parameters, gradient, state, rate=0.01, options=OPTIONS)
    assert np.abs(parameters - torch_path(start, steps, 0.01)).max() < TOLERANCE * 60


def test_a_row_moves_as_if_it_were_optimized_alone():
    start, steps = problem((40, 3), 50, seed=1)
    parameters, state, rng = start.copy(), AdamState.zeros(start), np.random.default_rng(2)
    chosen = [rng.random(40) < 0.3 for _ in steps]
    for gradient, rows in zip(steps, chosen, strict=True):
        adam_step(parameters, gradient, state, rate=0.01, rows=rows, options=OPTIONS)
    for row in range(40):
        own = [g[row : row + 1] for g, rows in zip(steps, chosen, strict=True) if rows[row]]
        assert state.steps[row] == len(own)
        assert np.abs(parameters[row] - torch_path(start[row : row + 1], own, 0.01)[0]).max() < TOLERANCE * 50


def test_frozen_rows_keep_every_bit():
    start, steps = problem((100, 4), 20, seed=3)
    parameters, state = start.copy(), AdamState.zeros(start)
    adam_step(parameters, steps[0], state, rate=0.1)
    before = [a.copy() for a in (parameters, state.first, state.second, state.steps)]
    rows = np.random.default_rng(4).random(100) < 0.5
    for gradient in steps:
        adam_step(parameters, gradient, state, rate=0.1, rows=rows)
    for old, new in zip(before, (parameters, state.first, state.second, state.steps), strict=True):
        assert old[~rows].tobytes() == new[~rows].tobytes()
        assert (old[rows] != new[rows]).any()


def test_a_frozen_row_may_have_any_gradient():
    start, (gradient,) = problem((10, 3), 1)
    gradient[3] = np.nan
    parameters, state, rows = start.copy(), AdamState.zeros(start), np.arange(10) != 3
    adam_step(parameters, gradient, state, rate=0.1, rows=rows)
    assert parameters[3].tobytes() == start[3].tobytes()
    assert np.isfinite(parameters).all()
    assert np.isfinite(state.first).all()


def test_zero_gradients_move_nothing():
    start, _ = problem((10, 3), 1)
    parameters, state = start.copy(), AdamState.zeros(start)
    for _ in range(3):
        adam_step(parameters, np.zeros_like(start), state, rate=0.1)
    assert np.array_equal(parameters, start)


def test_rates_go_by_column():
    start, steps = problem((30, 2, 3), 10)
    parameters, state = start.copy(), AdamState.zeros(start)
    for gradient in steps:
        adam_step(parameters, gradient, state, rate=np.array([0.01, 0.01, 0.01, 0, 0, 0.02]), options=OPTIONS)
    assert np.array_equal(parameters[:, 1, :2], start[:, 1, :2])
    assert np.abs(parameters[:, 0] - torch_path(start, steps, 0.01)[:, 0]).max() < TOLERANCE * 10
    assert np.abs(parameters[:, 1, 2] - torch_path(start, steps, 0.02)[:, 1, 2]).max() < TOLERANCE * 10


def test_corrections_fade_after_thousands_of_steps():
    """Beyond the table of corrections the last of them, one, serves."""
    start, (gradient,) = problem((5, 2), 1)
    parameters, state = start.copy(), AdamState.zeros(start)
    steps = 20_000  # the table ends at 18,412
    for _ in range(steps):
        adam_step(parameters, gradient, state, rate=1e-6)
    # A constant gradient moves every parameter by one rate per step, against its sign; float32 adds some rounding.
    assert np.abs(parameters - start + np.sign(gradient) * steps * 1e-6).max() < 1e-3


def test_state_follows_its_rows():
    start, (gradient,) = problem((10, 3), 1)
    state = AdamState.zeros(start)
    adam_step(start.copy(), gradient, state, rate=0.1)
    kept = state.take(np.array([4, 2]))
    assert np.array_equal(kept.first, state.first[[4, 2]])
    grown = kept.grown(3)
    assert len(grown) == 5
    assert np.array_equal(grown.second[:2], kept.second)
    assert not grown.first[2:].any()
    assert not grown.steps[2:].any()


def test_bytes_do_not_depend_on_threads():
    start, steps = problem((500, 3), 5)
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            parameters, state = start.copy(), AdamState.zeros(start)
            for gradient in steps:
                adam_step(parameters, gradient, state, rate=0.1)
            results.append(parameters.tobytes() + state.second.tobytes())
    finally:
        numba.set_num_threads(before)
    assert results[0] == results[1]


def test_wrong_input_is_refused_with_what_came():
    start, (gradient,) = problem((5, 3), 1)
    state = AdamState.zeros(start)
    with pytest.raises(ValueError, match="do not belong together"):
        adam_step(start, gradient[:4], state, rate=0.1)
    with pytest.raises(ValueError, match="gradient must be C-contiguous float32, but is float64"):
        adam_step(start, gradient.astype(np.float64), state, rate=0.1)
    with pytest.raises(ValueError, match=r"rows must be bool \(5,\)"):
        adam_step(start, gradient, state, rate=0.1, rows=np.ones(5, np.int8))
    with pytest.raises(ValueError, match="betas must lie"):
        AdamOptions(beta1=1.0)


def test_nothing_to_do():
    empty = np.zeros((0, 3), np.float32)
    adam_step(empty, empty.copy(), AdamState.zeros(empty), rate=0.1)
