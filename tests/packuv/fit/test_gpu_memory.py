"""Memory of a GPU, foreseen and reserved; what fits take there is in `test_memory_cuda.py`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from packuv.fit import gpu_memory
from packuv.fit.gpu_memory import (
    BASE_BYTES,
    HELD,
    FitLoad,
    GpuFullError,
    GpuMemory,
    alive_bytes,
    fit_memory,
    pairs_of,
    reserve,
)
from packuv.fit.pace import FitSize, made_up
from packuv.raster import RasterOptions, render

loads = st.builds(
    FitLoad,
    st.lists(st.tuples(st.integers(16, 2000), st.integers(16, 1200)), min_size=1, max_size=90),
    st.integers(0, 600_000),
    st.integers(0, 600_000),
    st.integers(0, 3),
    st.integers(0, 300_000),
    st.booleans(),
)


@given(loads)
def test_more_of_anything_never_takes_less_and_twice_of_it_twice_at_most(load):
    now = alive_bytes(load)
    more = [
        replace(load, sides=[*load.sides, load.sides[0]]),
        replace(load, sides=[(width + 1, height) for width, height in load.sides]),
        replace(load, gaussians=2 * load.gaussians),
        replace(load, backdrop=2 * load.backdrop),
        replace(load, sh_degree=min(3, load.sh_degree + 1)),
        replace(load, depths=load.depths + 100),
        replace(load, in_bytes=False),
    ]
    assert all(alive_bytes(other) >= now for other in more)
    assert all(alive_bytes(more[index]) <= 2 * now for index in (0, 2, 3))


@given(loads, st.integers(0, 10**11))
def test_layers_take_no_more_than_their_budget_and_nothing_without_a_backdrop(load, budget):
    found = fit_memory(load, budget_bytes=budget)
    assert found.layers_bytes <= budget
    assert found.needed_bytes == fit_memory(load, budget_bytes=0).needed_bytes > BASE_BYTES + alive_bytes(load)
    assert found.needed_bytes <= found.all_bytes <= found.needed_bytes + HELD * found.layers_bytes + 1
    assert fit_memory(replace(load, backdrop=0), budget_bytes=budget).layers_bytes == 0


@pytest.mark.parametrize(
    "size", [FitSize(320, 180, 60_000), FitSize(640, 360, 30_000), FitSize(480, 270, 20_000)], ids=str
)
def test_pairs_of_made_up_scenes_are_those_of_so_many_outlines(size):
    """From above, and within a fifth of the Gaussians that a picture shows."""
    solver, shots = made_up(size)
    options = RasterOptions(solver.bounds.near)
    for shot in shots[:2]:
        visible = render(solver.model.gaussians, shot.camera, options=options).visible
        found = pairs_of(int(np.count_nonzero(visible)), size.width, size.height)
        assert visible.sum() <= found <= 1.2 * visible.sum()
        assert found <= pairs_of(size.gaussians, size.width, size.height)


class Gpu:
    """One of which so many bytes are free, and all of those that are asked for can be held but the last few."""

    def __init__(self, free: int, held_by_others: int = 0) -> None:
        self.free, self.later, self.held = free, free - held_by_others, list[int]()

    def memory(self) -> tuple[int, int]:
        free, self.free = self.free, self.later
        return free, 80_000_000_000

    def hold(self, size: int) -> bool:
        self.held.append(size)
        return size <= self.later


@pytest.fixture
def gpu(monkeypatch):
    def given(*how: int) -> Gpu:
        found = Gpu(*how)
        monkeypatch.setattr(gpu_memory, "memory_of_gpu", found.memory)
        monkeypatch.setattr(gpu_memory, "_hold", found.hold)
        return found

    return given


@pytest.mark.parametrize(("free", "room"), [(9.0, 3), (8.6, 3), (6.2, 1), (5.0, 0)])
def test_layers_get_what_a_fit_leaves(gpu, free, room):
    """And with them what torch holds beside."""
    one = gpu(round(free * 1e9))
    assert reserve(GpuMemory(5 * 10**9, 3 * 10**9)) == room * 10**9
    assert one.held == [round((5 + HELD * room) * 1e9) - BASE_BYTES]


def test_a_fit_that_does_not_fit_is_refused_before_it_takes_anything(gpu):
    one = gpu(8 * 10**9)
    with pytest.raises(GpuFullError, match=r"^needs 12\.3 GB, 8\.0 GB are free$"):
        reserve(GpuMemory(12_300_000_000, 10**9))
    assert not one.held


def test_what_another_took_meanwhile_is_told_as_it_is(gpu):
    gpu(8 * 10**9, 5 * 10**9)
    with pytest.raises(GpuFullError, match=r"^needs 6\.0 GB, 3\.0 GB are free$"):
        reserve(GpuMemory(6 * 10**9))
