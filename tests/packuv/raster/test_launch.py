"""How arrays come to a GPU, with torch and numba replaced where they would need one."""

from __future__ import annotations

import gc
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from packuv.raster.cuda import launch
from packuv.raster.cuda.launch import SMALL_BYTES, on_device


@pytest.mark.parametrize(
    ("count", "asked"),
    [
        (5, ["pin", "copy to cuda, without waiting"]),
        (SMALL_BYTES, ["pin", "copy to cuda, without waiting"]),
        (SMALL_BYTES + 1, ["copy to cuda, with waiting"]),
    ],
)
def test_the_host_waits_for_large_copies_alone(count, asked, monkeypatch):
    """What is not pinned could change or go before it has been copied."""
    found = list[str]()

    def to(tensor, device, *, non_blocking):
        found.append(f"copy to {device}, {'without' if non_blocking else 'with'} waiting")
        return tensor.clone()

    monkeypatch.setattr(launch, "MEMORY", torch.device("cuda"))
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: found.append("pin") or tensor)
    monkeypatch.setattr(torch.Tensor, "to", to)
    array = (np.arange(count) % 251).astype(np.uint8)
    assert np.array_equal(on_device(array).numpy(), array)
    assert found == asked


@pytest.fixture
def made(monkeypatch):
    """Arrays that numba has made, of the memory that it was told."""
    found = list[int]()

    def wrapped(interface, owner=None, sync=True):
        assert owner is None
        assert not sync
        found.append(interface["data"][0])
        return SimpleNamespace(data=interface["data"][0])

    interface = property(lambda tensor: {"data": (tensor.data_ptr(), False)})
    monkeypatch.setattr(launch, "SIMULATED", False)
    monkeypatch.setattr(torch.Tensor, "__cuda_array_interface__", interface)
    monkeypatch.setattr(launch, "cuda", SimpleNamespace(from_cuda_array_interface=wrapped))
    return found


def test_a_tensor_is_wrapped_once_and_another_view_of_it_for_itself(made):
    tensor = torch.arange(6.0)
    seen = launch._as_kernels_see(tensor)
    tensor[2] = 7.0  # in place, as all that is written there
    assert launch._as_kernels_see(tensor) is seen
    assert seen.data == tensor.data_ptr()
    other = launch._as_kernels_see(tensor[1:])
    assert made == [tensor.data_ptr(), tensor[1:].data_ptr()]
    assert other.data == seen.data + 4
    assert launch._as_kernels_see(3) == 3


def test_what_kernels_saw_is_freed_as_soon_as_nobody_holds_it(made):
    """And not when rubbish is collected: that would be gigabytes later."""
    gc.disable()
    try:
        tensor = torch.arange(6.0)
        launch._as_kernels_see(tensor)
        gone = weakref.ref(tensor)
        del tensor
        assert gone() is None
    finally:
        gc.enable()
