"""Running a batch: some sequences at a time, each in a thread of its own, none of which harms another."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import packuv
from packuv.files import whole_file
from pipelines.batch.notify import notify
from pipelines.batch.pace import Headway, Pace
from pipelines.batch.plan import Fingerprint, Plan, Step, look_again, plan_batch, with_result
from pipelines.batch.request import BatchRequest
from pipelines.batch.resources import default_at_once
from pipelines.batch.summary import Summary, of_result
from pipelines.batch.table import Result, ResultTable, Status
from pipelines.events import Event, Forecast, Journal
from pipelines.process import Outcome, cores_of, jobs_of, process_directly
from pipelines.register import Place, bury, registered
from pipelines.request import BAD_INPUT, STAGES, RunRequest
from pipelines.results import check_whole, ending_of
from pipelines.words import percent
from tasks.artefacts.jobs import CancelledError, Jobs
from tasks.artefacts.recipe import plain, write_json
from tasks.artefacts.retention import RUN
from tasks.report.dataset import Line, page_text

LABEL = "data set"
ON_RECORD = "(data set)"
"""In place of a sequence, for status and cancel"""
TELL_SECONDS = 1.0
"""Least time between two words on how far it is"""
MOST_NAMED = 3
"""Sequences under way that are named at a time"""


class KilledError(RuntimeError):
    """The process of a sequence was killed, as often as it was started."""


@dataclass(frozen=True)
class BatchEngine:
    """Who runs the sequences of a batch."""

    run: Callable[[RunRequest, Journal, Jobs], Outcome] = process_directly
    """Raises what `pipelines.process.process` raises"""
    place: Place | None = None
    """Where the workflow engine knows the batch"""
    crashed: Callable[[Place], None] = lambda place: None
    """Told of an earlier batch that was killed"""
    cancelled: Callable[[], bool] = lambda: False
    """Whether somebody ended the batch there; asked where `Batch.cancel` may come too late"""
    show: Callable[[Sequence[Result]], None] = lambda results: None
    """Told the results so far"""


@dataclass
class _Running:
    """A sequence under way."""

    step: Step
    jobs: Jobs
    began: float | None
    """None while it waits for a worker to take it"""
    stages: dict[str, Forecast] = field(default_factory=dict)

    @property
    def doing(self) -> str:
        label, forecast = next(reversed(self.stages.items()), ("", None))
        return " ".join(part for part in (self.step.name, label, forecast and percent(forecast).strip()) if part)


class Batch:
    """One run over a data set; raises what `plan_batch` raises, and ValueError where no result can be noted."""

    def __init__(self, request: BatchRequest, journal: Journal) -> None:
        self._request, self._journal = request, journal
        self._plan = plan_batch(request)
        self._table = ResultTable(request.table)
        self._table.check()
        steps = self._plan.to_run
        wide = request.at_once or (len(steps) if request.pool else default_at_once())
        self.at_once = min(wide, max(1, len(steps)))
        """Sequences at a time"""
        # With a time limit the cores decide what is fitted, so they must not depend on how many sequences are left.
        shared = max(1, cores_of() // max(1, self.at_once if request.max_minutes is None else wide))
        self._cores = None if request.pool else shared
        self._pace = Pace(_earlier(self._plan))
        self._headway = Headway(time.monotonic(), self._pace, 1 if request.pool else self.at_once)
        self._started = datetime.now(UTC)
        self._running: dict[str, _Running] = {}
        self._waiting = {step.name: step.frames for step in steps}
        self._results: dict[str, Result] = {}
        self._cancelled, self._told = "", 0.0
        self._lock = threading.RLock()

    def cancel(self, reason: str) -> None:
        """End the sequences that run, and start no more; the first reason counts."""
        with self._lock:
            self._cancelled = self._cancelled or reason
            for running in self._running.values():
                running.jobs.cancel(reason)

    def run(self, engine: BatchEngine) -> Summary:
        """Process what is not there; a sequence that fails ends itself only.

        Raises OSError where results cannot be noted, and CancelledError after `cancel`.
        """
        request, out = self._request, Path(self._request.out)
        out.mkdir(parents=True, exist_ok=True)
        bury(out, engine.crashed)
        on_record = registered(
            out, sequence=ON_RECORD, capture=request.manifest, preset=request.preset, engine=engine.place
        )
        with on_record as register, self._journal.heard_by(register):
            try:
                self._journal.started(LABEL, self._headway)
                self._note_what_is_known()
                self._run_all(engine)
                if any(result.status is Status.CANCELLED for result in self._known()) and engine.cancelled():
                    self.cancel("the run was cancelled")
                if self._cancelled:
                    raise CancelledError(f"{self._cancelled}; the same command goes on from here")
            except BaseException as error:
                self.cancel("the batch was ended")
                self._end_badly(error)
                raise
            self._journal.ended(LABEL)
            summary = self._summary()
            self._note_run("failed" if summary.failed else "finished", summary.verdict)
        self._notify("failed", summary) if summary.failed else None
        return summary

    def _run_all(self, engine: BatchEngine) -> None:
        with ThreadPoolExecutor(self.at_once) as pool:
            # The context of this thread is what makes the engine take the sequences for parts of this run.
            starts = ((step, copy_context()) for step in self._plan.to_run)
            futures: list[Future[None]] = [
                pool.submit(context.run, self._process, step, engine) for step, context in starts
            ]
            try:
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self.cancel("the batch was ended")
                raise

    def _process(self, step: Step, engine: BatchEngine) -> None:
        """One sequence, in its own thread; raises OSError where its result cannot be noted."""
        request = replace(step.request, cores=self._cores)
        with self._lock:
            if self._cancelled:
                return
            began = None if self._request.pool else time.monotonic()
            running = _Running(look_again(step), jobs_of(request), began)
            self._running[step.name] = running
            del self._waiting[step.name]
            self._write_page()
        journal, made, told = Journal(_Ear(running, self._began, self._tell)), False, None
        try:
            outcome = engine.run(request, journal, running.jobs)
            made = any(event.outcome == "made" and event.key for event in outcome.events)
            if request.stop_after == STAGES[-1]:
                check_whole(outcome.folder)
            result = _finished(running.step, outcome)
            told = outcome.figures["seconds"] if self._request.pool else None  # a batch may join in late
        except Exception as error:
            result = _ended(step, error)
        now, begun = datetime.now(UTC), time.monotonic() if running.began is None else running.began
        seconds = time.monotonic() - begun if told is None else told
        hours = seconds / 3600 if made or step.earlier is None else step.earlier.hours
        self._note(
            replace(
                result,
                seconds=round(seconds, 3),
                hours=hours if result.status is Status.FINISHED else None,
                started=(now - timedelta(seconds=seconds)).isoformat(timespec="seconds"),
                finished=now.isoformat(timespec="seconds"),
            ),
            step.frames if made else 0,
            engine,
        )

    def _note(self, result: Result, frames: int, engine: BatchEngine) -> None:
        with self._lock:
            del self._running[result.sequence]
            if result.status is Status.FINISHED:
                self._pace.ended(result.seconds, frames)
            self._results[result.sequence] = result
            self._table.put([result])
            self._write_page()
            self._journal.told(result.sequence, of_result(result))
            engine.show(self._known())
        self._tell(at_once=True)

    def _note_what_is_known(self) -> None:
        """Before anything runs: what is there already, what cannot run, and what was killed."""
        for step in self._plan.steps:
            if step.problem is not None:
                now = datetime.now(UTC).isoformat(timespec="seconds")
                blank = _row(step, Status.BAD_INPUT, step.problem)
                self._results[step.name] = replace(blank, started=now, finished=now)
                self._journal.told(step.name, of_result(self._results[step.name]))
            elif not step.runs and step.earlier is not None:
                self._results[step.name] = replace(step.earlier, reused=True, seconds=0.0)
        reused = sum(result.reused for result in self._results.values())
        if reused:
            self._journal.told("there already", f"{reused} of {len(self._plan.steps)} sequences")
        self._table.put([*self._plan.killed, *self._results.values()])
        self._write_page()
        self._tell(at_once=True)

    def _tell(self, *, at_once: bool = False) -> None:
        """Say how far the batch is; threads of all sequences come by here."""
        with self._lock:
            now = time.monotonic()
            if not at_once and now - self._told < TELL_SECONDS:
                return
            self._told = now
            under_way = self._running.values()
            running = [(now - one.began, one.step.frames) for one in under_way if one.began is not None]
            waiting = [*self._waiting.values(), *(one.step.frames for one in under_way if one.began is None)]
            done = self._headway.look(waiting, running)
            frames = sum(step.frames for step in self._plan.to_run)
            left = sum(waiting) + sum(count for _, count in running)
            self._journal.moved(LABEL, frames - left + done, frames, self._words())

    def _words(self) -> str:
        doing = [one.doing for one in self._running.values() if one.began is not None]
        more = f" and {len(doing) - MOST_NAMED} more" if len(doing) > MOST_NAMED else ""
        parts = [f"{len(self._results)} of {len(self._plan.steps)} sequences"]
        if doing:
            parts.append(f"{len(doing)} running: {', '.join(doing[:MOST_NAMED])}{more}")
        if left := len(self._running) - len(doing):
            parts.append(f"{left} handed out")
        return ", ".join(parts)

    def _began(self, running: _Running) -> None:
        """A worker took the sequence."""
        with self._lock:
            running.began = time.monotonic()
            self._write_page()

    def _known(self) -> list[Result]:
        """Results of this batch, in the order of the manifest."""
        return [self._results[step.name] for step in self._plan.steps if step.name in self._results]

    def _summary(self) -> Summary:
        seconds = (datetime.now(UTC) - self._started).total_seconds()
        return Summary(self._request.manifest, self._request.page, self._request.table, tuple(self._known()), seconds)

    def _write_page(self) -> None:
        lines = [_line(result, self._request) for result in [*self._known(), *self._plan.others]]
        waiting = [*(name for name, one in self._running.items() if one.began is None), *self._waiting]
        lines += [Line(name, "running") for name in self._running if name not in waiting]
        lines += [Line(name, "waiting") for name in waiting]
        manifest = Path(self._request.manifest)
        text = page_text(
            manifest.stem,
            lines,
            subtitle=f"{manifest} · {self._request.preset} · {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
            goes_on=bool(self._running or self._waiting) and not self._cancelled,
        )
        with whole_file(self._request.page) as part:
            part.write_text(text, encoding="utf-8")

    def _end_badly(self, error: BaseException) -> None:
        ending = ending_of(error)
        self._journal.failed(LABEL, error)
        with contextlib.suppress(OSError):  # the first fault counts
            self._note_run(ending.outcome, ending.reason)
            self._write_page()
        if ending.outcome == "failed":
            self._notify("aborted", self._summary(), ending.reason)

    def _note_run(self, outcome: str, reason: str) -> None:
        """What `packuv status` tells of the batch when it has ended."""
        write_json(
            Path(self._request.out) / RUN,
            {
                "sequence": ON_RECORD,
                "outcome": outcome,
                "reason": reason,
                "packuv": packuv.__version__,
                "started": self._started.isoformat(timespec="seconds"),
                "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                "request": plain(self._request),
                "stages": [],
            },
        )

    def _notify(self, status: str, summary: Summary, reason: str = "") -> None:
        if self._request.notify is None:
            return
        text = reason or "\n".join(summary.lines())
        names = [result.sequence for result in summary.failed]
        problem = notify(self._request.notify, status=status, failed=names, summary=text, page=summary.page)
        self._journal.told("notify", problem or "somebody was told")


def run_directly(request: BatchRequest, journal: Journal) -> Summary:
    """Process a data set without the workflow engine; raises what `Batch` and its `run` raise."""
    return Batch(request, journal).run(BatchEngine())


class _Ear:
    """A `pipelines.events.Audience` of one sequence."""

    def __init__(self, running: _Running, took: Callable[[_Running], None], tell: Callable[[], None]) -> None:
        self._running, self._took, self._tell = running, took, tell

    def began(self, label: str, forecast: Forecast) -> None:
        self._running.stages[label] = forecast
        if self._running.began is None:
            self._took(self._running)
        self._tell()

    def moved(self, label: str, forecast: Forecast) -> None:
        self._tell()

    def ended(self, event: Event) -> None:
        self._running.stages.pop(event.label, None)
        self._tell()

    def told(self, label: str, text: str) -> None: ...


def _earlier(plan: Plan) -> Iterator[tuple[float, int]]:
    """Seconds and frames of sequences that were made with what is asked for now."""
    asked = {step.fingerprint.asked for step in plan.steps}
    for result in [*plan.others, *(step.earlier for step in plan.steps if step.earlier)]:
        if result.hours and result.frames and Fingerprint.parse(result.fingerprint).asked in asked:
            yield result.hours * 3600, result.frames


def _row(step: Step, status: Status, reason: str = "") -> Result:
    return Result(
        step.name,
        step.request.out,
        status,
        reason=" ".join(reason.split()),
        preset=step.request.preset,
        packuv=packuv.__version__,
    )


def _ended(step: Step, error: Exception) -> Result:
    """Of a sequence that did not come to its end."""
    status = Status.BAD_INPUT if isinstance(error, BAD_INPUT) else Status.FAILED
    if isinstance(error, CancelledError):
        status = Status.CANCELLED
    if isinstance(error, KilledError):
        status = Status.KILLED
    return _row(step, status, str(error) or type(error).__name__)


def _finished(step: Step, outcome: Outcome) -> Result:
    figures, size = outcome.figures, outcome.figures["mb_per_30_frames"]
    return replace(
        _row(step, Status.FAILED, outcome.missed) if outcome.missed else _row(step, Status.FINISHED),
        psnr_db=figures["psnr_db"],
        ssim=figures["ssim"],
        unseen=bool(figures["held_out"]) and figures["psnr_db"] is not None,
        mb_per_frame=None if size is None else size / 30,
        frames=figures["frames"],
        findings=len(outcome.findings),
        report=str(outcome.report),
        scene=str(outcome.scene) if outcome.scene else None,
        fingerprint=str(with_result(step.fingerprint, outcome.scene, outcome.report)),
    )


def _line(result: Result, request: BatchRequest) -> Line:
    return Line(
        name=result.sequence,
        status=str(result.status),
        reused=result.reused,
        psnr_db=result.psnr_db,
        ssim=result.ssim,
        unseen=result.unseen,
        mb_per_frame=result.mb_per_frame,
        frames=result.frames,
        hours=result.hours,
        findings=result.findings,
        preset=result.preset,
        finished=result.finished,
        reason=result.reason,
        report=result.report and os.path.relpath(result.report, request.out),
        scene=result.scene and os.path.relpath(result.scene, request.out),
    )
