"""Memory that renderings share."""

from __future__ import annotations

import math
import weakref

import numpy as np


class _Lease:
    """Memory on loan; numpy arrays made from it keep it alive."""

    def __init__(self, memory: np.ndarray, dtype: np.dtype, shape: tuple[int, ...]):
        address, read_only = memory.__array_interface__["data"]
        data = address, read_only
        self.__array_interface__ = {"version": 3, "typestr": dtype.str, "shape": shape, "data": data}


class Arena:
    """Memory for pictures and gradients, used again as soon as no array refers to it: a fit's memory stays flat.

    Serves one thread at a time. An array that it handed out stays valid as long as anyone holds it or a view of it.
    """

    def __init__(self) -> None:
        self._free: list[np.ndarray] = []

    def take(self, shape: int | tuple[int, ...], dtype: type) -> np.ndarray:
        """An array, aligned to cache lines, whose content is undefined. O(number of free pieces)."""
        shape = (shape,) if isinstance(shape, int) else shape
        kind = np.dtype(dtype)
        memory = self._memory(math.prod(shape) * kind.itemsize)
        lease = _Lease(memory, kind, shape)
        weakref.finalize(lease, self._free.append, memory).atexit = False
        return np.asarray(lease)

    @property
    def free_bytes(self) -> int:
        """Memory that waits for its next use."""
        return sum(piece.size for piece in self._free)

    def _memory(self, size: int) -> np.ndarray:
        fitting = [i for i, piece in enumerate(self._free) if piece.size >= size]
        if fitting:
            return self._free.pop(min(fitting, key=lambda i: self._free[i].size))
        if self._free:  # the largest is too small, and would only lie about
            self._free.pop(max(range(len(self._free)), key=lambda i: self._free[i].size))
        return _aligned(size + size // 4 + 64)


def _aligned(size: int) -> np.ndarray:
    raw = np.empty(size + 64, np.uint8)
    skip = -raw.ctypes.data % 64
    return raw[skip : skip + size]
