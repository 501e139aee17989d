import numpy as np
import pytest
import torch

from packuv.adam import AdamOptions, AdamState, adam_step


def test_all_rows_move_as_torch_moves_them():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(40, 3)).astype(np.float32)
    reference = torch.nn.Parameter(torch.from_numpy(values.copy()))
    optimizer = torch.optim.Adam([reference], lr=1e-2, eps=1e-15)
    state = AdamState.zeros(values)
    for _ in range(20):
        gradient = rng.normal(size=values.shape).astype(np.float32)
        reference.grad = torch.from_numpy(gradient.copy())
        optimizer.step()
        adam_step(values, gradient, state, rate=1e-2, options=AdamOptions())
    np.testing.assert_allclose(values, reference.detach().numpy(), atol=2e-6)  # float32, 20 steps of 0.01


def test_rows_that_are_not_chosen_keep_values_and_moments_bit_for_bit():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(30, 4)).astype(np.float32)
    state = AdamState.zeros(values)
    adam_step(values, values.copy(), state, rate=1e-2)
    frozen = np.arange(30) % 2 == 0
    before = [a[frozen].copy() for a in (values, state.first, state.second, state.steps)]
    for _ in range(5):
        adam_step(values, rng.normal(size=values.shape).astype(np.float32), state, rate=1e-2, rows=~frozen)
    after = [a[frozen] for a in (values, state.first, state.second, state.steps)]
    assert all(x.tobytes() == y.tobytes() for x, y in zip(before, after, strict=True))
    assert (state.steps[~frozen] == 6).all()


def test_a_late_row_moves_as_if_it_were_alone():
    gradient = np.full((2, 1), 0.3, np.float32)
    values = np.zeros((2, 1), np.float32)
    state = AdamState.zeros(values)
    for _ in range(7):
        adam_step(values, gradient, state, rate=0.1, rows=np.array([True, False]))
    alone = np.zeros((1, 1), np.float32)
    adam_step(alone, gradient[:1], AdamState.zeros(alone), rate=0.1)
    adam_step(values, gradient, state, rate=0.1, rows=np.array([False, True]))
    assert values[1] == alone[0]


def test_rates_per_column():
    values = np.zeros((3, 2), np.float32)
    adam_step(values, np.ones((3, 2), np.float32), AdamState.zeros(values), rate=np.array([0.0, 0.5]))
    assert not values[:, 0].any()
    np.testing.assert_allclose(values[:, 1], -0.5, rtol=1e-5)


def test_wrong_types_and_shapes_are_refused():
    values = np.zeros((3, 2), np.float32)
    state = AdamState.zeros(values)
    with pytest.raises(ValueError, match="do not belong together"):
        adam_step(values, np.zeros((4, 2), np.float32), state, rate=0.1)
    with pytest.raises(ValueError, match="float32"):
        adam_step(values.astype(np.float64), values.astype(np.float64), state, rate=0.1)
    with pytest.raises(ValueError, match="rows must be bool"):
        adam_step(values, values, state, rate=0.1, rows=np.ones(2, bool))
