"""What the workflow engine's dashboard shows of a batch while it runs: progress, a table of results, a log line for
each sequence that ends."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.actions import ArtifactCreate, ArtifactUpdate
from prefect.logging import get_run_logger

from pipelines.dashboard import PROGRESS_SECONDS, slug
from pipelines.events import Event, Forecast
from pipelines.link import Link
from pipelines.server import results_url
from pipelines.words import outcome, state

LOG_SECONDS = 600.0
"""Least time between two log lines on how far it is"""


class BatchDashboard:
    """A `pipelines.events.Audience` of the batch. Each of its artefacts is one that changes."""

    def __init__(self, link: Link, flow_run: UUID, name: str) -> None:
        self._link, self._flow_run, self._name = link, flow_run, name
        self._log = get_run_logger()
        self._artefacts: dict[str, UUID] = {}
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
        self._put("results", "table", json.dumps(list(rows)), "Results so far, those that need a look first")

    def summarize(self, lines: Iterable[str], page: Path) -> None:
        """Where the page is, and how the batch ended."""
        text = "\n".join(lines)
        body = [f"# {self._name}", f"[Open the page]({results_url(page)}) ({page})", "```", text, "```"]
        self._put("summary", "markdown", "\n\n".join(body), "What came out of the batch")
        self._log.info("%s", text)

    def _progress(self, share: float, text: str) -> None:
        self._put("progress", "progress", round(100 * min(1.0, share), 1), text)

    def _put(self, name: str, kind: str, data: Any, description: str) -> None:
        def post(client: SyncPrefectClient) -> None:
            if name in self._artefacts:
                client.update_artifact(self._artefacts[name], ArtifactUpdate(data=data, description=description))
                return
            key = slug(f"{self._name}-{name}")
            artefact = ArtifactCreate(
                key=key, type=kind, data=data, description=description, flow_run_id=self._flow_run
            )
            self._artefacts[name] = client.create_artifact(artefact).id

        self._link.post(post, instead_of=name)
