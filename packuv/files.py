"""Files and folders that are whole or absent: written beside, synced, renamed."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from packuv.bounds import MOST_JSON_BYTES, MOST_JSON_VALUES, check_depth
from packuv.partial import partial_path


def parse_json(content: bytes, what: str) -> Any:
    """A JSON document of bounded size and depth; raises ValueError that names `what` for anything else.

    NaN and infinity pass, so that who reads a number can say which one is wrong.
    """
    if len(content) > MOST_JSON_BYTES:
        raise ValueError(f"{what} must be JSON of at most {MOST_JSON_BYTES} bytes, but has {len(content)}")
    values = sum(map(content.count, (b",", b"[", b"{")))
    if values > MOST_JSON_VALUES:
        raise ValueError(f"{what} must be JSON of at most {MOST_JSON_VALUES} values, but has about {values}")
    try:
        data = json.loads(content)
    except RecursionError:
        raise ValueError(f"{what} is nested too deep for JSON") from None
    except ValueError as error:  # not UTF-8, not JSON, or an integer of thousands of digits
        raise ValueError(f"{what} is no JSON: {error}") from None
    check_depth(data, what)
    return data


def load_json(path: Path) -> Any:
    """A JSON file of bounded size and depth; raises ValueError that names it, or what opening it raises."""
    with Path(path).open("rb") as file:
        return parse_json(file.read(MOST_JSON_BYTES + 1), str(path))


def save_json(path: Path, data: Mapping[str, Any]) -> None:
    """Readable JSON, keys in the given order."""
    with whole_file(path) as partial:
        partial.write_text(json.dumps(data, indent=1))


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Arrays by name, not compressed."""
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes them for allow_pickle


_HEADERS = RLock()
# NumPy parses headers by syntax trees. Where two threads of Python before 3.11.8 build some at once, one now and then
# fails with "AST constructor recursion depth mismatch" (CPython issue 106905).


def load_npy(path: Path) -> np.ndarray:
    """The array of a file; threads may read at once."""
    with _HEADERS:
        array: np.ndarray = np.load(path, allow_pickle=False)
        return array


def map_npy(path: Path) -> np.memmap[Any, Any]:
    """The array of a file, mapped into memory to be read; threads may map at once."""
    with _HEADERS:
        return np.lib.format.open_memmap(path, mode="r")


@contextmanager
def open_npz(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    """The arrays of a file by name, each read when it is asked for; one thread at a time."""
    with _HEADERS, np.load(path, allow_pickle=False) as arrays:
        yield arrays


def check_place(path: Path) -> None:
    """Raise FileNotFoundError where the folder of a file to write is missing, IsADirectoryError where that is one."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no folder {path.parent} to write {path.name} in; make it first")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file to write")


def check_apart(path: Path, sources: Iterable[Path]) -> None:
    """Raise ValueError where a file to write is one of those that are read: it would be gone."""
    for source in sources:
        if path.exists() and source.exists() and path.samefile(source):
            raise ValueError(f"{path} is read, so that nothing else may be written there; name another file to write")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside `path`, of the same suffix; its file gets the name `path` when the block ends well.

    The bytes are on the disk before the name is given; an error in the block leaves nothing behind. Raises
    what `check_place` raises.
    """
    path = Path(path)
    check_place(path)
    partial = partial_path(path, path.suffix)
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path`, which gets that name when the block ends well; an error leaves nothing behind.

    Raises FileExistsError where `path` is there and not an empty folder, FileNotFoundError where its parent is missing.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no folder {path.parent} to write {path.name} in; make it first")
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(f"{path} must be new or an empty folder; choose another, or remove it")
    partial = partial_path(path)
    try:
        partial.mkdir()
        yield partial
        os.replace(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
