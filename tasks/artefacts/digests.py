"""SHA-256 of files, remembered. A folder, as of pictures, is one: its names and contents."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tasks.artefacts.recipe import write_json

SETTLED_SECONDS = 2.0
"""A file changed this recently is not remembered: a second change could leave size and times as they are"""

Signature = list[int]
"""Size, time of modification and of change of state in nanoseconds, inode. Whoever writes to a file can set the first
time back, but not the second one. Of a folder: size of all files in it, latest times, and what names and inodes say"""
UNKNOWN: Signature = [-1, -1, -1, -1]


class FileDigests:
    """SHA-256 of files, remembered by size, times and inode, as git's index does."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __call__(
        self, files: Mapping[str, Path], *, progress: Callable[[float, float, str], None] = lambda *_: None
    ) -> dict[str, str]:
        """Digest per name; cost: reading the files that changed since the last time.

        Raises FileNotFoundError that names a missing file.
        """
        known = self._load()
        found = {}
        for number, path in enumerate(files.values()):
            progress(number, len(files), path.name)
            found[str(path.resolve())] = self._entry(path, known)
        if any(known.get(name) != entry for name, entry in found.items()):
            self._save({**known, **found})
        return {name: found[str(path.resolve())][-1] for name, path in files.items()}

    def _entry(self, path: Path, known: Mapping[str, list[Any]]) -> list[Any]:
        if not path.exists():
            raise FileNotFoundError(f"no file {path}")
        seen = signature(path)
        entry = known.get(str(path.resolve()))
        if entry and entry[:-1] == seen:
            return entry
        sha256 = file_digest(path)
        settled = time.time_ns() - seen[2] > SETTLED_SECONDS * 1e9 and signature(path) == seen
        return [*(seen if settled else UNKNOWN), sha256]

    def _load(self) -> dict[str, list[Any]]:
        with contextlib.suppress(OSError, ValueError):  # only a memory: without it the files are read again
            known: dict[str, list[Any]] = json.loads(self.path.read_text())
            return known
        return {}

    def _save(self, entries: Mapping[str, list[Any]]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, entries)


def signature(path: Path) -> Signature:
    """By which a change of a file shows, or of any file in a folder; raises FileNotFoundError without it."""
    stat = path.stat()
    if not path.is_dir():
        return [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
    files = {file.name: file.stat() for file in files_of(path)}
    names = hashlib.sha256()
    for name, own in files.items():
        told = f"\0{own.st_size} {own.st_mtime_ns} {own.st_ctime_ns} {own.st_ino}\n"
        names.update(os.fsencode(name) + told.encode())
    seen = files.values()
    return [
        sum(own.st_size for own in seen),
        max([stat.st_mtime_ns, *(own.st_mtime_ns for own in seen)]),
        max([stat.st_ctime_ns, *(own.st_ctime_ns for own in seen)]),
        int.from_bytes(names.digest()[:7]),
    ]


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of the names and contents of the files in a folder, 64 hex digits."""
    if path.is_dir():
        return folder_digest(path, file_digest)
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def folder_digest(folder: Path, digest: Callable[[Path], str]) -> str:
    """SHA-256 of names and contents, given that of a file."""
    whole = hashlib.sha256()
    for file in files_of(folder):
        whole.update(os.fsencode(file.name) + f"\0{digest(file)}\n".encode())
    return whole.hexdigest()


def files_of(folder: Path) -> list[Path]:
    """Files that lie in a folder, hidden ones passed over, by name."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith(".") and path.is_file())
