"""The decorator that compiles this package's kernels and keeps the machine code."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numba

_FOLDER = Path(__file__).parent
_SOURCES = ("bins", "blend", "kernel", "project", "sh", "simd")
"""Modules whose code ends up in kernels"""


def kernel(
    *, parallel: bool = False, inner: bool = False, inline: bool = False, fastmath: frozenset[str] = frozenset()
) -> Callable[[Callable], Any]:
    """Compile a function with Numba, once per machine and version of these sources.

    An `inner` kernel is called by kernels only: it gets no wrapper for Python, which saves compile time. One to
    `inline` is so small, or called so often, that passing seven arguments per array would cost more than its work.

    Numba's cache looks only at the file that holds a function, not at those it calls into: after an update it would
    run a mixture of old and new. So the cache lies in a folder named after the content of all sources.
    """
    inner = inner or inline
    options: dict[str, Any] = {"cache": not inner, "parallel": parallel, "forceinline": inline}
    options |= {"error_model": "numpy", "nogil": True, "no_cpython_wrapper": inner, "no_cfunc_wrapper": inner}

    def decorate(function: Callable) -> Any:
        with _cache_folder():
            return numba.njit(fastmath=set(fastmath), **options)(function)

    return decorate


@contextmanager
def _cache_folder() -> Iterator[None]:
    # Numba reads this setting when it decorates a function; other packages keep theirs.
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(Path(before or _FOLDER / "__pycache__") / f"kernels-{_sources_digest()}")
    try:
        yield
    finally:
        config.CACHE_DIR = before


@cache
def _sources_digest() -> str:
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update((_FOLDER / f"{name}.py").read_bytes())
    return digest.hexdigest()[:12]
