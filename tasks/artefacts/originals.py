"""The raw files of a run, watched: what a stage reads today must be what the recipe of its artefact says.

Content digests of raw files enter the recipe of the first stage only, while later ones decode the videos again. So all
raw files are looked at before and after each stage that is built, by size, times and inode; the content is read again
only where one of these moved. It cannot be seen that a file was replaced and put back between two looks with its inode
and its time of change, which takes a clock that is set back; and a network file system may tell what it knew some
seconds ago (NFS: up to a minute, `acregmax`).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from sync.capture import SETTINGS, Capture, find_capture
from sync.masks import find_masks
from tasks.artefacts.digests import FileDigests, Signature, signature

ADVICE = "put back what was there, or run the same command again to process what is there now"


class Originals:
    """Raw files of one capture, which must stay what they are while a run goes on. Safe to use from several threads."""

    def __init__(self, capture: Capture, memory: Path) -> None:
        """Raises ValueError for masks of what is no camera."""
        self.capture = capture
        """As it was when the run began"""
        self._files = _files(capture)
        self._digests = FileDigests(memory)
        self._sha256: dict[Path, str] = {}
        self._lock = threading.Lock()

    def digests(
        self, files: Mapping[str, Path], progress: Callable[[float, float, str], None] = lambda *_: None
    ) -> dict[str, str]:
        """SHA-256 by name; `look` watches these files from now on. Raises FileNotFoundError for a missing one."""
        with self._lock:
            found = self._digests(files, progress=progress)
            for name, path in files.items():
                self._sha256.setdefault(path, found[name])
            return found

    def look(self) -> dict[str, Signature]:
        """What moves when a file does, by its place in the capture; raises ValueError if one is not what it was."""
        settings = self.capture.folder / SETTINGS
        if settings not in self._sha256 and settings.is_file():
            self.digests({SETTINGS: settings})
        with self._lock:
            # Before contents are compared: what moves during that shows at the next look.
            seen = {self._place(path): _signature(path) for path in self._sha256}
            now = self._digests({str(path): path for path in self._sha256})
            for path, sha256 in self._sha256.items():
                if now[str(path)] != sha256:
                    raise ValueError(f"{path} has another content than when this run began; {ADVICE}")
            self._check_list()
            return seen

    def _check_list(self) -> None:
        now = find_capture(self.capture.folder)
        if now.settings != self.capture.settings:
            raise ValueError(f"{now.folder / SETTINGS} says something else than when this run began; {ADVICE}")
        there = _files(now)
        for path in sorted(there ^ self._files):
            what = "was added" if path in there else "has gone"
            raise ValueError(f"{path} {what} since this run began; {ADVICE}")
        if replace(now, name=self.capture.name) != self.capture:  # a run may give it another name
            raise ValueError(f"{now.folder} has another calibration than when this run began; {ADVICE}")

    def _place(self, path: Path) -> str:
        return os.path.relpath(path, self.capture.folder)


def _files(capture: Capture) -> set[Path]:
    """Those by camera, as they are now; raises ValueError for masks of what is no camera."""
    return {*capture.videos.values(), *capture.timecodes.values(), *find_masks(capture).values()}


def _signature(path: Path) -> Signature:
    try:
        return signature(path)
    except FileNotFoundError:
        raise ValueError(f"{path} has gone since this run began; {ADVICE}") from None
