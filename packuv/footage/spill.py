"""Pictures that do not fit into memory: a file without a name, which goes with the process."""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Hashable
from pathlib import Path

import numpy as np


class Spill:
    """Pictures, uint8, by key, on disk. Serves one thread at a time."""

    def __init__(self, folder: Path) -> None:
        self._file, name = tempfile.mkstemp(dir=folder)
        os.unlink(name)
        weakref.finalize(self, os.close, self._file)
        self._places: dict[Hashable, tuple[int, tuple[int, ...]]] = {}
        self._end = 0

    def __contains__(self, key: Hashable) -> bool:
        return key in self._places

    def write(self, key: Hashable, pixels: np.ndarray) -> None:
        """Keep a picture, unless it is there."""
        if key in self._places:
            return
        memory = np.ascontiguousarray(pixels).reshape(-1).data
        at = self._end
        while memory:
            done = os.pwrite(self._file, memory, at)
            memory, at = memory[done:], at + done
        self._places[key] = self._end, pixels.shape
        self._end = at

    def read(self, key: Hashable) -> np.ndarray:
        """A picture that is there."""
        place, shape = self._places[key]
        pixels = np.empty(shape, np.uint8)
        memory = pixels.reshape(-1).data
        while memory:
            done = os.preadv(self._file, [memory], place)
            if not done:
                raise OSError("the file of pictures that did not fit into memory ends before its time")
            memory, place = memory[done:], place + done
        return pixels

    def clear(self) -> None:
        """Forget all of them."""
        self._places.clear()
        os.truncate(self._file, 0)
        self._end = 0
