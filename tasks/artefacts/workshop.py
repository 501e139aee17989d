"""What every stage is given: a store to put artefacts in, jobs to do the work, somebody to tell about it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from tasks.artefacts.digests import FileDigests
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.store import Key, Store, Workspace


class Listener(Protocol):
    """Hears what happens to stages; called from several threads."""

    def started(self, label: str) -> None: ...

    def moved(self, label: str, done: float, total: float, note: str) -> None: ...

    def waiting(self, label: str) -> None:
        """Another process builds the same artefact."""

    def finished(self, label: str, key: Key, seconds: float) -> None: ...

    def failed(self, label: str, error: BaseException) -> None: ...

    def skipped(self, label: str, reason: str) -> None:
        """Work that this sequence does not need."""


@dataclass(frozen=True)
class Workshop:
    """Where the stages of one sequence run."""

    store: Store
    jobs: Jobs
    listener: Listener

    def digests(self, files: Mapping[str, Path], label: str) -> dict[str, str]:
        """Content digests of raw files by name, remembered beside the store.

        Raises FileNotFoundError that names a missing file.
        """
        remembered = FileDigests(self.store.root.parent / "file_digests.json")
        return remembered(files, progress=partial(self.listener.moved, label))

    def make(
        self,
        stage: str,
        version: int,
        options: Any,
        inputs: Mapping[str, Any],
        function: str,
        arguments: Mapping[str, Any],
        *,
        label: str = "",
    ) -> Key:
        """The artefact of this recipe, by the job `function` if it is not there.

        The job gets `arguments`, and where its signature asks for them `out`, `scratch` and `progress`. What it returns
        becomes the notes of the receipt. Raises what `Jobs.run` raises.
        """
        label = label or stage
        start = time.monotonic()
        self.listener.started(label)
        build = partial(self._build, function=function, arguments=arguments, label=label)
        try:
            key = self.store.make(stage, version, options, inputs, build, waiting=partial(self._wait, label))
        except BaseException as error:
            self.listener.failed(label, error)
            raise
        self.listener.finished(label, key, time.monotonic() - start)
        return key

    def path(self, key: Key) -> Path:
        """Folder of a complete artefact."""
        return self.store.path(key)

    def _wait(self, label: str) -> None:
        self.jobs.check()
        self.listener.waiting(label)

    def _build(
        self, workspace: Workspace, *, function: str, arguments: Mapping[str, Any], label: str
    ) -> Mapping[str, Any]:
        done = self.jobs.run(
            function,
            {**arguments, "out": workspace.out, "scratch": workspace.scratch},
            folder=workspace.out.parent,
            progress=partial(self.listener.moved, label),
            keep_open=[workspace.lock],
        )
        return {**(done.value or {}), "peak_memory_bytes": done.peak_memory_bytes}
