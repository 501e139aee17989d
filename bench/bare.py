"""Stand-ins for packages that a bare machine lacks, so that what needs none of them can be imported and measured.

    python -m bench.bare MODULE ...          # as python -m MODULE ...

A GPU may be lent with torch, numba, numba-cuda and numpy alone. What calls a missing package ends, and says so.
"""

from __future__ import annotations

import importlib
import runpy
import sys
from types import ModuleType
from typing import Any

import numpy as np

NAMES = (
    "av",
    "av.video",
    "av.video.plane",
    "cv2",
    "prefect",
    "pyarrow",
    "pycolmap",
    "sortedcontainers",
    "torchcodec",
    "torchcodec.decoders",
)


class _StandIn(ModuleType):
    """A module of which everything can be named and nothing used."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Lacking(f"{self.__name__}.{name}")


class _Lacking:
    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Lacking(f"{self._name}.{name}")

    def __call__(self, *given: Any, **named: Any) -> Any:
        package = self._name.split(".")[0]
        raise RuntimeError(f"{self._name} is called, but this machine lacks the package {package}; install it")


def stand_in() -> None:
    """Put stand-ins where packages are missing."""
    for name in [name for name in NAMES if not _there(name)]:
        sys.modules[name] = _StandIn(name)
    if "cv2" in missing():
        vars(sys.modules["cv2"])["integral"] = _integral  # the one function of OpenCV that frames need


def missing() -> list[str]:
    """The modules that have stand-ins."""
    return [name for name in NAMES if isinstance(sys.modules.get(name), _StandIn)]


def _there(name: str) -> bool:
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def _integral(mask: np.ndarray, **_: Any) -> np.ndarray:
    """Sums over all above and to the left, int32 [H + 1, W + 1]."""
    sums = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), np.int32)
    np.cumsum(np.cumsum(mask, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
    return sums


if __name__ == "__main__":
    from bench import bare  # not this one, which is called __main__: what is run looks there

    bare.stand_in()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
