"""What the workflow engine's dashboard shows of a run, while it runs: log lines, progress with the time that is left,
tables, pictures.

Everything goes through `pipelines.link`, so that a slow server costs the run nothing.
"""

from __future__ import annotations

import base64
import json
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient
from prefect.client.schemas.actions import ArtifactCreate, ArtifactUpdate
from prefect.client.schemas.objects import FlowRun
from prefect.context import TaskRunContext
from prefect.exceptions import MissingContextError
from prefect.logging import get_run_logger

from pipelines.events import Event, Forecast
from pipelines.link import Link
from pipelines.process import Outcome
from pipelines.request import RunRequest
from pipelines.server import results_url
from pipelines.words import duration, outcome, state
from sync.align import SyncReport
from sync.capture import Capture
from tasks.artefacts.store import Store
from tasks.report.plots import Series, line_chart
from tasks.stages.calibrate import CHECK
from tasks.stages.preview import FIGURES, PICTURE
from tasks.stages.track import read_curve, read_keyframes

PROGRESS_SECONDS = 5.0
"""Least time between two posts of a stage's progress"""
LOG_SECONDS = 60.0
"""Least time between two log lines of a stage under way"""
LAST_PREVIEWS = 50
"""Segments in the table of their PSNR: the table is posted anew after each"""
CHART_STYLE = (
    "<style>svg{background:#fff;font:12px sans-serif}text{fill:#555}text.title{font-weight:600}.grid{stroke:#ddd}"
    ".axis{stroke:#555;fill:none}.line{fill:none;stroke:#1f6feb;stroke-width:1.5}.mark{stroke:#d29922}</style>"
)

Row = dict[str, Any]


class Board:
    """The artefacts of a flow run on the dashboard, named after a sequence or data set."""

    def __init__(self, link: Link, flow_run: UUID, name: str) -> None:
        self._link, self._flow_run, self._name = link, flow_run, name
        self._known: dict[str, UUID] = {}

    def put(
        self, name: str, kind: str, data: Any, description: str, *, task_run: UUID | None = None, changing: str = ""
    ) -> None:
        """Show something soon; with `changing`, in place of what was put under that word before."""

        def post(client: SyncPrefectClient) -> None:
            if changing in self._known:
                client.update_artifact(self._known[changing], ArtifactUpdate(data=data, description=description))
                return
            artefact = ArtifactCreate(
                key=slug(f"{self._name}-{name}"),
                type=kind,
                data=data,
                description=description,
                flow_run_id=self._flow_run,
                task_run_id=task_run,
            )
            made = client.create_artifact(artefact).id
            if changing:
                self._known[changing] = made

        self._link.post(post, instead_of=changing or None)

    def progress(self, share: float, text: str, *, of: str, task_run: UUID | None = None) -> None:
        """A bar, one for each word in `of`."""
        percent = round(100 * min(1.0, share), 1)
        self.put("progress", "progress", percent, text, task_run=task_run, changing=f"progress of {of}")

    def summary(self, what: str, page: Path, text: str, description: str) -> None:
        """How it ended, with a link to the page about it."""
        lines = [f"# {self._name}", f"[Open the {what}]({results_url(page)}) ({page})", "```", text, "```"]
        self.put("summary", "markdown", "\n\n".join(lines), description)


class Dashboard:
    """A `pipelines.events.Audience`; called in the threads of the tasks, whose runs it knows by their context."""

    def __init__(self, link: Link, flow_run: UUID, sequence: str, store: Store) -> None:
        self._board = Board(link, flow_run, sequence)
        self._store = store
        self._log = get_run_logger()
        self._posted: dict[str, float] = {}
        self._logged: dict[str, float] = {}
        self._barred: set[str] = set()
        """Stages whose progress is shown"""
        self._previews = deque[Row](maxlen=LAST_PREVIEWS)

    def began(self, label: str, forecast: Forecast) -> None:
        self._posted[label] = self._logged[label] = time.monotonic()

    def moved(self, label: str, forecast: Forecast) -> None:
        now = time.monotonic()
        if now - self._posted.get(label, now) >= PROGRESS_SECONDS:
            self._posted[label] = now
            self._bar(label, forecast.done / (forecast.total or 1), state(forecast))
        if now - self._logged.get(label, now) >= LOG_SECONDS:
            self._logged[label] = now
            self._logger().info("%s: %s", label, state(forecast))

    def ended(self, event: Event) -> None:
        level = logging.ERROR if event.outcome == "failed" and not event.stopped else logging.INFO
        self._logger().log(level, "%s: %s", event.label, outcome(event))
        if event.label in self._barred and event.outcome == "made":
            self._bar(event.label, 1.0, f"done in {duration(event.seconds)}")
        if event.key is not None and event.key.stage in SHOWN and self._store.holds(event.key):  # not a lender's
            SHOWN[event.key.stage](self, self._store.path(event.key))

    def told(self, label: str, text: str) -> None:
        self._log.info("%s: %s", label, text)

    def summarize(self, results: Outcome) -> None:
        """Where the results are, and how good."""
        self._board.summary("report", results.report, results.farewell(), "What came out of the run")
        self._log.info("%s", results.farewell())

    def sync(self, folder: Path) -> None:
        report = SyncReport.load(folder)
        rows = [
            {
                "camera": row.camera,
                "matched": f"{row.matched} of {report.instants}",
                "offset ms": round(row.clock.offset_ns / 1e6, 3),
                "drift ppm": round(row.clock.drift_ppm, 2),
                "drops": row.drops,
                "residual ms (19 of 20)": round(row.residual_p95_ns / 1e6, 3),
            }
            for row in report.cameras
        ]
        what = f"{report.complete} of {report.instants} instants have a frame of every camera"
        self._table("sync", rows, f"Synchronization: {what}")

    def rig(self, folder: Path) -> None:
        check = json.loads((folder / CHECK).read_text())
        odd: Mapping[str, str] = check["suspicious"]
        facts = {"cameras": check["cameras"], "see the centre": f"{check['seen_share']:.0%}"}
        facts |= {camera: what for camera, what in odd.items()}
        rows = [{"what": what, "value": value} for what, value in facts.items()]
        self._table("calibration", rows, f"Calibration: {len(odd) or 'no'} cameras look odd")

    def keyframes(self, folder: Path) -> None:
        curve, chosen = read_curve(folder), read_keyframes(folder)
        series = [Series("M(t)", range(len(curve)), curve)]
        drawn = line_chart(
            series, title="Motion", x_label="instant", y_label="optical flow, px", marks=chosen, from_zero=True
        )
        svg = (
            str(drawn)
            .replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
            .replace(">", f">{CHART_STYLE}", 1)
        )
        self._image("motion", _data_url("image/svg+xml", svg.encode()), f"Motion, and {len(chosen)} keyframes")

    def preview(self, folder: Path) -> None:
        facts = json.loads((folder / FIGURES).read_text())
        first, last = facts["frames"]
        levels = {name: level for name, level in facts["psnr_db"].items() if level is not None}
        if not levels:
            return
        mean = sum(levels.values()) / len(levels)
        cells = {name: f"{level:.2f} dB" for name, level in levels.items()}
        self._previews.append({"frames": f"{first}-{last}", "mean": f"{mean:.2f} dB", **cells})
        self._table("psnr", self._previews, "PSNR at the last frame of each segment", changing=True)
        url = _data_url("image/jpeg", (folder / PICTURE).read_bytes())
        what = f"Frame {last} of {next(iter(levels))}: filmed at the left, rendered at the right"
        self._image("preview", url, what, changing=True)

    def _bar(self, label: str, share: float, text: str) -> None:
        self._barred.add(label)
        self._board.progress(share, f"{label}: {text}", of=label, task_run=_task_run())

    def _table(self, name: str, rows: Iterable[Row], description: str, *, changing: bool = False) -> None:
        """With `changing`, one table for the whole run, so that the server's database does not grow with it."""
        self._put(name, "table", json.dumps(list(rows)), description, changing)

    def _image(self, name: str, url: str, description: str, *, changing: bool = False) -> None:
        """Likewise."""
        self._put(name, "image", url, description, changing)

    def _put(self, name: str, kind: str, data: str, description: str, changing: bool) -> None:
        of_the_run = None if changing else _task_run()
        self._board.put(name, kind, data, description, task_run=of_the_run, changing=name if changing else "")

    def _logger(self) -> Any:
        """That of the task where there is one, so that the dashboard shows the line there."""
        try:
            return get_run_logger()
        except MissingContextError:
            return self._log


SHOWN: Mapping[str, Callable[[Dashboard, Path], None]] = {
    "sync": Dashboard.sync,
    "rig": Dashboard.rig,
    "keyframes": Dashboard.keyframes,
    "preview": Dashboard.preview,
}
"""By kind of artefact"""


def run_tags(run: FlowRun | None, request: RunRequest, capture: Capture) -> list[str]:
    """By which runs are found: those that the run has, the sequence, the preset, and the capture's own."""
    own = [f"seq:{capture.name}", f"preset:{request.preset}", *capture.settings.tags]
    return list(dict.fromkeys([*(run.tags if run else ()), "packuv", *own]))


def _task_run() -> UUID | None:
    """Of the thread's task, where it has one."""
    context = TaskRunContext.get()
    return context.task_run.id if context else None


def slug(text: str) -> str:
    """A key of the engine: small letters, digits and dashes.

    >>> slug("Dance 2-fit segment 3 (frames 60-89)")
    'dance-2-fit-segment-3-frames-60-89'
    """
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "run"


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
