"""What some tests need and a machine may lack: they skip there, and fail where PACKUV_REQUIRE promises it.

    PACKUV_REQUIRE=cuda,ffmpeg,chromium,data python -m pytest

Nothing else in the tests skips.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

KINDS = ("avx2", "cuda", "nvvm", "ffmpeg", "chromium", "data", "postgres", "shm", "weights", "usd", "fourdgs")
VARIABLE = "PACKUV_REQUIRE"


def promised() -> frozenset[str]:
    """The kinds that PACKUV_REQUIRE names. Raises ValueError for one that no test knows."""
    names = frozenset(name.strip() for name in os.environ.get(VARIABLE, "").split(",") if name.strip())
    if unknown := sorted(names - set(KINDS)):
        raise ValueError(f"{VARIABLE} names some of {', '.join(KINDS)}, but also {', '.join(unknown)}")
    return names


def need(kind: str, found: object, reason: str) -> None:
    """Skip the running test if what it needs was not found, or fail it where that is promised."""
    if kind not in KINDS:
        raise ValueError(f"a test needs one of {', '.join(KINDS)}, but not {kind}")
    if found:
        return
    if kind in promised():
        pytest.fail(f"{VARIABLE} promises {kind}, but: {reason}", pytrace=False)
    pytest.skip(reason)


def needs(kind: str, found: object, reason: str) -> pytest.MarkDecorator:
    """The same as a decorator; `conftest.pytest_runtest_setup` reads it."""
    return pytest.mark.need(kind, found, reason)


def need_data(folder: Path) -> Path:
    """The folder of recordings, if it is there."""
    need("data", folder.is_dir(), _absent(folder))
    return folder


def needs_data(folder: Path) -> pytest.MarkDecorator:
    return needs("data", folder.is_dir(), _absent(folder))


def _absent(folder: Path) -> str:
    return f"no recordings at {folder}; set PACKUV_DATA"


needs_ffmpeg = needs("ffmpeg", shutil.which("ffmpeg"), "no program ffmpeg on the PATH")
