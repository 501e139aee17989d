"""What the stages of one sequence are made with: a store for artefacts, jobs to do the work, somebody to tell."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from packuv.progress import Progress, no_progress
from sync.capture import Capture
from tasks.artefacts.jobs import Jobs, end_leftovers
from tasks.artefacts.originals import Originals
from tasks.artefacts.stage import LESS_GPU, NO_GPU, Files, Notes, Site, Stage, StageJob
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


Maker = Callable[["Workshop", Stage], Key]
"""Makes the artefact of a stage unless it is there, and tells the workshop's listener how far it is"""


def make_here(workshop: Workshop, stage: Stage) -> Key:
    """A `Maker`: by a job on this machine."""
    return make_by_job(
        stage,
        workshop.site,
        workshop.jobs,
        originals=workshop.originals.look,
        progress=partial(workshop.listener.moved, stage.label),
        waiting=partial(workshop.listener.waiting, stage.label),
    )


@dataclass(frozen=True)
class Workshop:
    """Where the stages of one sequence are made."""

    store: Store
    originals: Originals
    """The capture"""
    jobs: Jobs
    """Those of the run; once they are cancelled, nothing more is made"""
    listener: Listener
    maker: Maker = make_here

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
        try:
            key = self.maker(self, stage)
        except BaseException as error:
            self.listener.failed(stage.label, error)
            raise
        self.listener.finished(stage.label, key, time.monotonic() - start)
        notes = self.store.receipt(key).notes
        for what, why in stage.spared(self.path(key), notes):
            self.listener.skipped(what, why)
        if NO_GPU in notes:
            self.listener.skipped(f"GPU for {stage.label}", notes[NO_GPU])
        if LESS_GPU in notes:
            self.listener.skipped(f"keeping layers on the GPU for {stage.label}", notes[LESS_GPU])
        return key

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact."""
        return self.store.path(key)


def make_by_job(
    stage: Stage,
    site: Site,
    jobs: Jobs,
    *,
    originals: Callable[[], Mapping[str, Any]],
    progress: Progress = no_progress,
    waiting: Callable[[], None] = lambda: None,
    check: Callable[[], None] = lambda: None,
) -> Key:
    """The artefact of a stage, by a process on this machine if it is not there.

    Raises what `Store.make` and `Jobs.run` raise. `check` is called twice a second while the job runs; what it raises
    ends the job.
    """
    store = Store(site.store)

    def build(building: Building) -> dict[str, Any]:
        end_leftovers(building.out.parents[1])

        def still() -> None:
            building.check()
            check()

        done = jobs.run(
            StageJob(stage, site, building.out, building.scratch),
            folder=building.out.parent,
            progress=progress,
            keep_open=[building.lock],
            check=still,
        )
        notes: Notes = done.value or {}
        measured = {"peak_memory_bytes": done.peak_memory_bytes, "cpu_seconds": done.cpu_seconds, "cpu": done.cpu}
        return {**notes, **measured}

    def wait() -> None:
        jobs.check()
        check()
        waiting()

    return store.make(
        stage.name, stage.version, stage.settings, stage.sources, build, originals=originals, waiting=wait
    )
