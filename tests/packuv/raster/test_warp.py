"""Sums over a warp, which numba's simulator lacks, by 32 threads that exchange values as a warp does."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from packuv.raster.cuda import blend
from packuv.raster.cuda.project import SUMS
from tests.support.needs import needs

pytestmark = needs("cuda", not blend.SIMULATED, "the simulator has other functions in their place")
LANES = 32


class Warp:
    """What a lane calls; all 32 must call the same in the same order."""

    def __init__(self) -> None:
        self._values, self._barrier = [np.float32(0)] * LANES, Barrier(LANES, timeout=20)

    def of(self, lane: int) -> Any:
        return SimpleNamespace(
            shfl_xor_sync=lambda everyone, value, mask: self._exchange(everyone, value, lane, lane ^ mask),
            shfl_down_sync=lambda everyone, value, step: self._exchange(everyone, value, lane, min(lane + step, 31)),
        )

    def _exchange(self, everyone: int, value: np.float32, lane: int, other: int) -> np.float32:
        assert everyone == 0xFFFFFFFF
        self._values[lane] = value
        self._barrier.wait()
        found = self._values[other]
        self._barrier.wait()
        return found


def as_python(function: Any, cuda: Any) -> FunctionType:
    """A device function and those of its module that it calls, with other lanes to exchange values with."""
    plain = function.py_func
    names = {name: plain.__globals__.get(name) for name in plain.__code__.co_names}
    called = {name: as_python(value, cuda) for name, value in names.items() if hasattr(value, "py_func")}
    return FunctionType(plain.__code__, plain.__globals__ | called | {"cuda": cuda})


def over_warp(function: Any, values: np.ndarray, *which: int) -> np.ndarray:
    """What a function that adds values [32, n] of the lanes leaves, float32 [2, 3, SUMS], beside 1 that was there."""
    sums, warp = np.ones((2, 3, SUMS), np.float32), Warp()

    def run(lane: int) -> None:
        as_python(function, warp.of(lane))(sums, 1, 2, lane, *which, *values[lane])

    with ThreadPoolExecutor(LANES) as pool:
        list(pool.map(run, range(LANES)))
    return sums


@pytest.mark.parametrize("seed", range(5))
def test_ten_sums_over_a_warp_come_to_their_places_and_to_no_other(seed):
    values = np.random.default_rng(seed).integers(-1000, 1000, (LANES, SUMS)).astype(np.float32)
    wanted = np.ones((2, 3, SUMS), np.float32)
    wanted[1, 2] += values.sum(axis=0)  # whole numbers, so exact in any order
    assert np.array_equal(over_warp(blend._add_ten_over_warp, values), wanted)


def test_one_sum_over_a_warp_comes_to_its_place():
    values = np.random.default_rng(9).integers(-1000, 1000, (LANES, 1)).astype(np.float32)
    wanted = np.ones((2, 3, SUMS), np.float32)
    wanted[1, 2, 4] += values.sum()
    assert np.array_equal(over_warp(blend._add_over_warp, values, 4), wanted)


def test_every_run_has_one_order():
    values = np.random.default_rng(3).normal(size=(LANES, SUMS)).astype(np.float32)
    first, again = (over_warp(blend._add_ten_over_warp, values) for _ in range(2))
    assert np.array_equal(first, again)
    assert first[1, 2] == pytest.approx(1 + values.sum(axis=0), abs=1e-5)
