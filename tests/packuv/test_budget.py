from collections.abc import Iterator

import numpy as np
import pytest

from packuv.budget import Budget
from packuv.each import Each, as_bits


def test_who_comes_first_is_served_and_no_byte_is_given_twice() -> None:
    rng, budget, held = np.random.default_rng(0), Budget(1000), list[int]()
    for _ in range(500):
        size = int(rng.integers(0, 400))
        assert budget.take(size) == (sum(held) + size <= 1000)
        if sum(held) + size <= 1000:
            held.append(size)
        if held and rng.random() < 0.4:
            budget.give(held.pop(int(rng.integers(len(held)))))
        assert budget.free_bytes == 1000 - sum(held)


def test_a_budget_of_less_than_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="0 bytes or more, but is given -1"):
        Budget(-1)


def test_each_is_a_sequence_of_what_is_made_on_demand() -> None:
    made = list[int]()

    def make(index: int) -> int:
        made.append(index)
        return 10 * index

    things = Each(make, 5)
    assert not made
    assert things[-1] == 40
    assert list(things[1:4:2]) == [10, 30]
    assert things.chosen([2, 0])[0] == 20
    assert made == [4, 1, 3, 2]
    with pytest.raises(IndexError):
        things[5]


def test_masks_survive_as_bits() -> None:
    rng = np.random.default_rng(1)
    masks = [rng.random((7, 13)) < 0.5, None, np.ones((1, 1), bool), np.zeros((5, 8), bool)]

    def once() -> Iterator[np.ndarray | None]:
        yield from masks

    for mask, again in zip(masks, as_bits(once()), strict=True):
        assert (mask is None and again is None) or np.array_equal(mask, again)
