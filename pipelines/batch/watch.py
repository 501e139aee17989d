"""Following a run in another process, by the record that it keeps in the folder of its sequence."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path

from pipelines.events import Journal
from pipelines.register import SILENT_SECONDS, Found, RunRecord, find_runs

SURE_LOOKS = 2
"""That must find a run dead: one may come between the last two steps of a run that ends well"""


class Watch:
    """Looks at the record of a flow run, and tells a journal what it says."""

    def __init__(
        self, folder: Path, flow_run: str, journal: Journal, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._folder, self._flow_run, self._journal, self._clock = folder, flow_run, journal, clock
        self._updated, self._ending, self._host, self._state = "", "", "", ""
        self._heard = self._since = clock()
        self._dead_looks = 0
        self._active: list[str] = []

    @property
    def is_dead(self) -> bool:
        """Whether it was killed: nobody holds its lock, and on another machine nothing has been written for long."""
        return self._dead_looks >= SURE_LOOKS

    def killed(self, otherwise: str) -> str:
        """How it ended without a word, as far as its record tells."""
        return f"{self._ending} on {self._host}" if self._ending else otherwise

    def quiet_seconds(self, state: str) -> float:
        """Since there is no word of it: no record, and no new state of the flow run."""
        if state != self._state:
            self._state, self._since = state, self._clock()
        return self._clock() - max(self._heard, self._since)

    def look(self) -> None:
        """Look once."""
        found = self._found()
        self._dead_looks = self._dead_looks + 1 if found and self._seems_dead(found) else 0
        if found is None:
            return
        self._ending = found.ending
        if found.record.updated != self._updated:
            self._tell(found.record)
        if found.held or found.record.updated != self._updated:
            self._heard = self._clock()
        self._updated = found.record.updated

    def close(self) -> None:
        """It came to an end."""
        self._to(())

    def _found(self) -> Found | None:
        found = find_runs(self._folder)
        return next((one for one in found if one.record.engine and one.record.engine.flow_run == self._flow_run), None)

    def _seems_dead(self, found: Found) -> bool:
        """By our own clock: that of another machine may be wrong."""
        if found.held or found.record.updated != self._updated:
            return False
        return found.record.host == socket.gethostname() or self._clock() - self._heard > SILENT_SECONDS

    def _tell(self, record: RunRecord) -> None:
        self._host = record.host
        self._to((f"on {record.host}", *(stage.label for stage in record.stages)))
        for stage in record.stages:
            if stage.done_share is not None:
                self._journal.moved(stage.label, stage.done_share, 1.0, stage.note)

    def _to(self, labels: tuple[str, ...]) -> None:
        for label in [label for label in self._active if label not in labels]:
            self._journal.ended(label)
        for label in [label for label in labels if label not in self._active]:
            self._journal.started(label)
        self._active = list(labels)
