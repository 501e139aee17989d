"""Where arrays of the CUDA rasterizer lie, how its kernels are run, and what they share with the CPU's.

Arrays are torch tensors. In numba's simulator (NUMBA_ENABLE_CUDASIM=1), which runs kernels as Python, they lie in the
CPU's memory, and everything else is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any

import numba
import numba.cuda
import numpy as np
import torch
from torch import Tensor

cuda: Any = numba.cuda
config: Any = numba.config
SIMULATED = bool(config.ENABLE_CUDASIM)
_SEEN = "_seen_by_kernels"
MEMORY = torch.device("cpu" if SIMULATED else "cuda")
THREADS = 256
"""Of a block, in loops over Gaussians"""
SMALL_BYTES = 1 << 20
"""Of an array that goes up by way of memory which a GPU reads by itself"""


def run(kernel: Any, blocks: int, *given: Any) -> None:
    """Run `blocks` times THREADS threads of a kernel over tensors and numbers; where there are none, nothing."""
    _allow_small_grids()
    if blocks > 0:
        kernel[blocks, THREADS](*map(_as_kernels_see, given))


def run_rows(kernel: Any, count: int, *given: Any) -> None:
    """Run a thread for each of `count` rows."""
    run(kernel, -(-count // THREADS), *given)


def on_device(array: np.ndarray) -> Tensor:
    """A copy for kernels. For a small one the host does not wait until they have done what it asked for so far."""
    here = torch.tensor(array)
    if MEMORY.type == "cpu":
        return here
    small = here.nbytes <= SMALL_BYTES
    return (here.pin_memory() if small else here).to(MEMORY, non_blocking=small)


def send(array: np.ndarray) -> Callable[[], Tensor]:
    """Begin to copy an array for kernels, beside what they do; the function that it returns gives the copy, and has
    kernels from then on wait for it. Any thread may send."""
    if MEMORY.type == "cpu":
        there = on_device(array)
        return lambda: there
    here = torch.tensor(array).pin_memory()  # which torch leaves alone until it has been copied
    copy = torch.empty(here.shape, dtype=here.dtype, device=MEMORY)  # of the kernels' memory, see `gpu_memory.reserve`
    aside = _aside()
    aside.wait_stream(torch.cuda.current_stream())  # which may still use what that memory was before
    with torch.cuda.stream(aside):
        copy.copy_(here, non_blocking=True)
        arrived = aside.record_event()
    copy.record_stream(aside)

    def taken() -> Tensor:
        torch.cuda.current_stream().wait_event(arrived)
        return copy

    return taken


@cache
def _aside() -> torch.cuda.Stream:
    """Of copies. Threads that ask for it first at the same time may get one each."""
    return torch.cuda.Stream()


@cache
def _allow_small_grids() -> None:
    """Numba warns of what leaves a GPU idle, as pictures of a few tiles do."""
    config.CUDA_LOW_OCCUPANCY_WARNINGS = 0


def _as_kernels_see(value: Any) -> Any:
    """A tensor as numba's array, which stays with the tensor: to make one takes the host as long as a small kernel. It
    does not hold the tensor, or none would ever be freed."""
    if not isinstance(value, Tensor):
        return value
    if SIMULATED:
        return value.numpy()
    seen = value.__dict__.get(_SEEN)
    if seen is None:
        seen = value.__dict__[_SEEN] = cuda.from_cuda_array_interface(value.__cuda_array_interface__, sync=False)
    return seen


def shared(function: Any) -> Any:
    """A scalar function of the CPU's kernels, and those that it calls, for kernels of the GPU.

    Numba would take the function by itself, but its `fastmath` as all or nothing: tests for infinity would be gone.
    """
    plain = getattr(function, "py_func", function)
    names = {name: plain.__globals__.get(name) for name in plain.__code__.co_names}
    called = {name: shared(value) for name, value in names.items() if hasattr(value, "py_func")}
    again = FunctionType(plain.__code__, plain.__globals__ | called, plain.__name__)
    return cuda.jit(device=True)(again)
