"""What the workflow engine's dashboard shows of a batch while it runs: progress, a table of results, a log line for
each sequence that ends."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from uuid import UUID

from prefect.logging import get_run_logger

from pipelines.dashboard import PROGRESS_SECONDS, Board
from pipelines.events import Event, Forecast
from pipelines.link import Link
from pipelines.words import outcome, state

LOG_SECONDS = 600.0
"""Least time between two log lines on how far it is"""


class BatchDashboard:
    """A `pipelines.events.Audience` of the batch. Each of its artefacts is one that changes."""

    def __init__(self, link: Link, flow_run: UUID, name: str) -> None:
        self._board = Board(link, flow_run, name)
        self._log = get_run_logger()
        self._posted = self._logged = 0.0

    def began(self, label: str, forecast: Forecast) -> None:
        self._posted = self._logged = time.monotonic()

    def moved(self, label: str, forecast: Forecast) -> None:
        now = time.monotonic()
        if now - self._posted >= PROGRESS_SECONDS:
            self._posted = now
            self._progress(forecast.done / (forecast.total or 1), state(forecast))
        if now - self._logged >= LOG_SECONDS:
            self._logged = now
            self._log.info("%s: %s", label, state(forecast))

    def ended(self, event: Event) -> None:
        self._log.info("%s: %s", event.label, outcome(event))
        if event.outcome == "made":
            self._progress(1.0, "done")

    def told(self, label: str, text: str) -> None:
        self._log.info("%s: %s", label, text)

    def results(self, rows: Iterable[dict[str, Any]]) -> None:
        """The table of results so far."""
        description = "Results so far, those that need a look first"
        self._board.put("results", "table", json.dumps(list(rows)), description, changing="results")

    def summarize(self, lines: Iterable[str], page: Path) -> None:
        """Where the page is, and how the batch ended."""
        text = "\n".join(lines)
        self._board.summary("page", page, text, "What came out of the batch")
        self._log.info("%s", text)

    def _progress(self, share: float, text: str) -> None:
        self._board.progress(share, text, of="all")
