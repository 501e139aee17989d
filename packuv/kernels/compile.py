"""The decorator that compiles this package's kernels and keeps the machine code."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numba

PACKAGE = Path(__file__).parents[1]
COMMENT = re.compile(r"#.*")
IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+(\S+)[ \t]+import[ \t]+(\([^)]*\)|.*)|import[ \t]+(.*))$", re.MULTILINE)


def kernel(
    *, parallel: bool = False, inner: bool = False, inline: bool = False, fastmath: frozenset[str] = frozenset()
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function with Numba, once per machine and version of its sources.

    An `inner` kernel is called by kernels only: it gets no wrapper for Python, which saves compile time. One to
    `inline` is so small, or called so often, that passing seven arguments per array would cost more than its work.

    Numba's cache looks only at the file that holds a function, not at those that it takes functions and constants
    from: after an update it would run a mixture of old and new. So the cache lies in a folder named after the content
    of the function's module and of all modules of this package that it imports, directly or not.
    """
    inner = inner or inline
    options: dict[str, Any] = {"cache": not inner, "parallel": parallel, "forceinline": inline}
    options |= {"error_model": "numpy", "nogil": True, "no_cpython_wrapper": inner, "no_cfunc_wrapper": inner}

    def decorate(function: Callable[..., Any]) -> Any:
        with _cache_folder(function.__module__):
            return numba.njit(fastmath=set(fastmath), **options)(function)

    return decorate


@contextmanager
def _cache_folder(module: str) -> Iterator[None]:
    # Numba reads this setting when it decorates a function; other packages keep theirs.
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(Path(before or _cache_root()) / f"kernels-{sources_digest(module)}")
    try:
        yield
    finally:
        config.CACHE_DIR = before


@cache
def _cache_root() -> Path:
    """Beside the sources; in the user's cache where those are read-only, as numba's own place there has no digest."""
    beside = PACKAGE / "__pycache__"
    if os.access(beside if beside.exists() else PACKAGE, os.W_OK):
        return beside
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / PACKAGE.name


@cache
def sources_digest(module: str) -> str:
    """Of the sources that a kernel of this module may be made of, 12 hex digits."""
    digest = hashlib.sha256()
    for path in sorted(_closure(module)):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _closure(module: str) -> set[Path]:
    """Files of a module and of all of this package that it imports, directly or not."""
    start = _source(module)
    if start is None:
        raise ValueError(f"kernels are compiled for modules of {PACKAGE.name}, not for {module}")
    found, waiting = set[Path](), [start]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting.extend(_imported(path))
    return found


@cache
def _imported(path: Path) -> frozenset[Path]:
    """Files of this package that a file imports.

    By its text, since each process asks this of some forty files when it starts, and parsing them takes 0.4 s. A
    docstring with a line like an import adds a file to the digest, and does no harm.
    """
    names: list[str] = []
    for found in IMPORT.finditer(COMMENT.sub("", path.read_text("utf-8"))):
        module, imported, plain = found.groups()
        if plain is not None:
            names += [part.split()[0] for part in plain.split(",") if part.strip()]
            continue
        if module.startswith("."):
            raise ValueError(f"{path}: {found[0].strip()!r}: relative imports hide what a kernel is made of")
        inside = [f"{module}.{part.split()[0]}" for part in imported.strip("()").split(",") if part.strip()]
        names += [name if _source(name) else module for name in inside]
    return frozenset(source for name in names if (source := _source(name)))


@cache
def _source(module: str) -> Path | None:
    """File of a module of this package; None for a name that is none. By place, since asking Python would import."""
    if module.split(".")[0] != PACKAGE.name:
        return None
    place = PACKAGE.parent.joinpath(*module.split("."))
    candidates = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in candidates if path.is_file()), None)


@cache
def prefer_tbb() -> None:
    """Load the environment's tbb, which numba does not find by itself, before numba chooses a threading layer.

    Of numba's layers only tbb survives fork, spawn and several Python threads. Without it numba takes another.
    """
    library = Path(sys.prefix) / "lib" / "libtbb.so.12"
    if library.exists():
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
