"""The host's side of a fit on a GPU, in numba's simulator, with kernels that do nothing: what it allocates and launches
at any size, in the time that its Python takes.

NUMBA_ENABLE_CUDASIM=1 must be set before numba is imported.
"""

from __future__ import annotations

import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from packuv.fit import losses_cuda
from packuv.raster.cuda import launch, render
from packuv.raster.cuda.project import count_tiles, list_tiles

Launch = tuple[str, int, int]
"""Name of a kernel, how many tensors it is given, and how many of these no kernel was given before"""


@contextmanager
def idle(hits: Callable[[int], np.ndarray]) -> Iterator[list[Launch]]:
    """Kernels do nothing, but of N Gaussians are said to have `hits(N)` pairs each, int [N]. Lists the launches."""
    launches: list[Launch] = []

    def run(kernel: Any, blocks: int, *given: Any) -> None:
        if kernel is count_tiles:
            given[-1].numpy()[:] = hits(len(given[-1]))
        elif kernel is list_tiles:
            given[-3].numpy()[:] = 0  # keys: memory as it was found has no tiles
        if blocks > 0:
            tensors = [value for value in given if isinstance(value, Tensor)]
            new = sum("known" not in vars(tensor) for tensor in tensors)
            launches.append((kernel.fn.__name__, len(tensors), new))
            for tensor in tensors:
                vars(tensor)["known"] = True

    with ExitStack() as stack:
        for place in (launch, render, losses_cuda):
            stack.enter_context(patch.object(place, "run", run))
        yield launches


class Watch(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch types none of it
    """What torch does meanwhile: operations by name and bytes that they read and write, but for those that only look at
    memory in another way; bytes of tensors that are alive, now and at most; and copies to the GPU."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # likewise
        self.operations: Counter[str] = Counter()
        self.alive_bytes = self.most_bytes = self.moved_bytes = self.uploads = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = operation(*args, **(kwargs or {}))
        made = [value for value in tree_leaves(found) if isinstance(value, Tensor)]
        for tensor in made:
            self._see(tensor.untyped_storage())
        self.uploads += operation.overloadpacket.__name__ == "lift_fresh"  # with which `torch.tensor` ends
        if not operation.is_view:
            self.operations[operation.overloadpacket.__name__] += 1
            given = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
            self.moved_bytes += sum(tensor.nbytes for tensor in (*given, *made))
        return found

    def _see(self, storage: Any) -> None:
        place, size = storage._cdata, storage.nbytes()
        if place in self._known:
            return
        self._known.add(place)
        self.alive_bytes += size
        self.most_bytes = max(self.most_bytes, self.alive_bytes)
        weakref.finalize(storage, self._forget, place, size)

    def _forget(self, place: int, size: int) -> None:
        self._known.discard(place)
        self.alive_bytes -= size
