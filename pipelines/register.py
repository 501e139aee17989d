"""Runs that are under way, on record where everybody can read them: <out>/<sequence>/.running/<id>.json.

A run holds a lock as long as it lives, and the kernel frees it however the run ends. A record whose lock is free is
that of a run which was killed; whoever finds it closes it. No server is needed for that. Locks may not reach other
machines, so a run also renews the time of the lock's file, see `tasks.artefacts.presence`.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from pipelines.events import Event, Forecast
from tasks.artefacts.presence import LEASE_SECONDS, Beat, is_alive, is_here, machine, own_name
from tasks.artefacts.recipe import restore, write_json
from tasks.artefacts.retention import RUN
from tasks.artefacts.store import try_lock

RUNNING = ".running"
FITTED = ("backdrop", "key", "segment")
"""Stages whose artefacts can be looked at while a run goes on"""
SAVE_SECONDS = 2.0
"""Least time between two notes of progress"""
KILLED = "fitted"
"""In the run.json of a run that was killed: what it had fitted"""
HEARTBEAT_SECONDS = 20.0
"""Between two notes at the latest, for those who do not see the lock"""
SILENT_SECONDS = LEASE_SECONDS
"""A run on another machine, whose lock this one may not see, counts as killed after such a silence"""


@dataclass(frozen=True)
class Place:
    """Where the workflow engine knows a run."""

    api: str
    """URL of the server's API"""
    flow_run: str
    """UUID"""


@dataclass(frozen=True)
class Moving:
    """A stage under way."""

    label: str
    done_share: float | None
    """Of the stage, 0 to 1; None where it does not say"""
    left_seconds: float | None
    note: str = ""


@dataclass(frozen=True)
class RunRecord:
    """A run under way, as others see it."""

    sequence: str
    capture: str
    preset: str
    host: str
    pid: int
    started: str
    """UTC, ISO 8601"""
    updated: str
    """Likewise, of this record"""
    engine: Place | None = None
    """None for a run without the workflow engine"""
    stages: tuple[Moving, ...] = ()
    ended: int = 0
    """Stages that came to an end"""
    process: str = ""
    """Name of the process for all machines, see `tasks.artefacts.presence.own_name`"""
    fitted: tuple[str, ...] = ()
    """Artefacts of the fit so far, in the order in which they were made"""

    @property
    def here(self) -> bool:
        """Whether `pid` means a process of this machine."""
        return is_here(self.process)


@dataclass(frozen=True)
class Found:
    """A record that lies in the folder of a sequence."""

    path: Path
    record: RunRecord
    alive: bool
    held: bool = False
    """Its lock is, as far as this machine sees locks"""

    @property
    def folder(self) -> Path:
        """Of the sequence."""
        return self.path.parent.parent

    @property
    def ending(self) -> str:
        """What to say of a run that was killed."""
        at = ", ".join(stage.label for stage in self.record.stages) or "between two stages"
        return f"killed at {at}"

    def close(self) -> None:
        """Take the record away."""
        self.path.unlink(missing_ok=True)
        _lock_of(self.path).unlink(missing_ok=True)


class Register:
    """A `pipelines.events.Audience` that keeps the record of a run while it is open."""

    def __init__(self, path: Path, record: RunRecord) -> None:
        self._path = path
        self._record = record
        self._active: dict[str, Forecast] = {}
        self._ended = 0
        self._fitted: list[str] = []
        self._saved = 0.0
        self._guard = threading.Lock()
        self.save()

    def began(self, label: str, forecast: Forecast) -> None:
        with self._guard:
            self._active[label] = forecast
        self.save()

    def moved(self, label: str, forecast: Forecast) -> None:
        if time.monotonic() - self._saved >= SAVE_SECONDS:
            self.save()

    def ended(self, event: Event) -> None:
        with self._guard:
            self._active.pop(event.label, None)
            self._ended += 1
            if event.key and event.key.stage in FITTED:
                self._fitted.append(str(event.key))
        self.save()

    def told(self, label: str, text: str) -> None: ...

    def save(self) -> None:
        """Write the record; a disk that is full must not end the run for it."""
        with self._guard, contextlib.suppress(OSError):
            self._saved = time.monotonic()
            stages = tuple(_moving(label, forecast) for label, forecast in self._active.items())
            now = replace(self._record, updated=_now(), stages=stages, ended=self._ended, fitted=tuple(self._fitted))
            write_json(self._path, now)

    @contextlib.contextmanager
    def beating(self) -> Iterator[None]:
        """Write it now and then while the block runs, also through a stage that says nothing for long."""
        over = threading.Event()

        def beat() -> None:
            while not over.wait(HEARTBEAT_SECONDS):
                self.save()

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


@contextlib.contextmanager
def registered(
    folder: Path, *, sequence: str, capture: str, preset: str, engine: Place | None = None
) -> Iterator[Register]:
    """Have a run on record while the block runs.

    Raises OSError where nothing can be written.
    """
    place = folder / RUNNING
    place.mkdir(parents=True, exist_ok=True)
    started, host = datetime.now(UTC), socket.gethostname()
    path = place / f"{started:%Y%m%dT%H%M%S%f}-{os.getpid()}-{machine()}.json"
    when = started.isoformat(timespec="seconds")
    record = RunRecord(sequence, capture, preset, host, os.getpid(), when, when, engine, process=own_name())
    with open(_lock_of(path), "ab") as lock:
        try_lock(lock.fileno())
        try:
            register = Register(path, record)
            with Beat(_lock_of(path), again=True), register.beating():
                yield register
        finally:
            Found(path, record, alive=False).close()


def bury(folder: Path, crashed: Callable[[Place], None]) -> None:
    """Close the records of runs that were killed: run.json and, by `crashed`, the workflow engine hear of it."""
    for found in find_runs(folder):
        if not found.alive:
            _note_killed(found)
            if found.record.engine:
                crashed(found.record.engine)
            found.close()


def _note_killed(found: Found) -> None:
    """What an earlier run made stays named, for it is still there."""
    record, path = found.record, found.folder / RUN
    with contextlib.suppress(OSError, ValueError):
        earlier = json.loads(path.read_text()) if path.exists() else {}
        if earlier.get("started", "") <= record.started:
            asked = {"capture": record.capture, "preset": record.preset}
            facts = {"outcome": "killed", "reason": found.ending, "started": record.started, "finished": record.updated}
            kept = {name: earlier[name] for name in ("artefacts",) if name in earlier}
            kept[KILLED] = list(record.fitted)
            write_json(path, {"sequence": record.sequence, **facts, "request": asked, "stages": [], **kept})


def find_runs(folder: Path) -> list[Found]:
    """Runs on record in the folder of a sequence, oldest first; those that were killed, too."""
    found = []
    for path in sorted((folder / RUNNING).glob("*.json")):
        with contextlib.suppress(OSError, ValueError):  # it ended meanwhile
            record = restore(RunRecord, json.loads(path.read_text()))
            held = _held(path)
            found.append(Found(path, record, held or is_alive(_lock_of(path), record.process), held))
    return found


def goes_on(folder: Path) -> bool:
    """Whether a run is under way in the folder of a sequence."""
    return any(run.alive for run in find_runs(folder))


def _held(path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError), open(_lock_of(path), "rb") as lock:
        return not try_lock(lock.fileno(), shared=True)
    return False


def _lock_of(path: Path) -> Path:
    return path.with_suffix(".lock")


def _moving(label: str, forecast: Forecast) -> Moving:
    share = forecast.done / forecast.total if forecast.total > 0 else None
    return Moving(label, share, forecast.remaining_seconds(), forecast.note)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
