"""What the stages of one sequence are made with: a store for artefacts, jobs to do the work, somebody to tell."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from sync.capture import Capture
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.stage import Files, Notes, Site, Stage, StageJob
from tasks.artefacts.store import Building, Key, Store


class Listener(Protocol):
    """Hears what happens to stages; called from several threads."""

    def started(self, label: str) -> None: ...

    def moved(self, label: str, done: float, total: float, note: str = "") -> None: ...

    def waiting(self, label: str) -> None:
        """Another process builds the same artefact."""

    def finished(self, label: str, key: Key, seconds: float) -> None: ...

    def failed(self, label: str, error: BaseException) -> None: ...

    def skipped(self, label: str, reason: str) -> None:
        """Work that this sequence does not need."""


@dataclass(frozen=True)
class Workshop:
    """Where the stages of one sequence are made."""

    store: Store
    originals: Originals
    """The capture"""
    jobs: Jobs
    listener: Listener

    @property
    def capture(self) -> Capture:
        """As it was when the run began."""
        return self.originals.capture

    @property
    def site(self) -> Site:
        """What jobs are told of it."""
        return Site(self.store.root, self.capture.folder, self.jobs.threads, self.jobs.memory_bytes)

    def files(self, paths: Mapping[str, Path], label: str) -> Files:
        """Raw files by name, with their digests; no stage is made any more once one of them is another.

        Raises FileNotFoundError that names a missing file.
        """
        return Files(self.originals.digests(paths, partial(self.listener.moved, label)))

    def make(self, stage: Stage) -> Key:
        """The artefact of a stage, by its job if it is not there.

        What the job returns becomes the notes of the receipt. Raises what `Jobs.run` raises, and ValueError when a raw
        file is not what it was.
        """
        start = time.monotonic()
        self.listener.started(stage.label)
        build = partial(self._build, stage)
        waiting = partial(self._wait, stage.label)
        originals = self.originals.look
        try:
            key = self.store.make(
                stage.name, stage.version, stage.settings, stage.sources, build, originals=originals, waiting=waiting
            )
        except BaseException as error:
            self.listener.failed(stage.label, error)
            raise
        self.listener.finished(stage.label, key, time.monotonic() - start)
        for what, why in stage.spared(self.path(key), self.store.receipt(key).notes):
            self.listener.skipped(what, why)
        return key

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact."""
        return self.store.path(key)

    def _wait(self, label: str) -> None:
        self.jobs.check()
        self.listener.waiting(label)

    def _build(self, stage: Stage, building: Building) -> dict[str, Any]:
        done = self.jobs.run(
            StageJob(stage, self.site, building.out, building.scratch),
            folder=building.out.parent,
            progress=partial(self.listener.moved, stage.label),
            keep_open=[building.lock],
        )
        notes: Notes = done.value or {}
        return {
            **notes,
            "peak_memory_bytes": done.peak_memory_bytes,
            "cpu_seconds": done.cpu_seconds,
            "cpu": done.cpu,
        }
