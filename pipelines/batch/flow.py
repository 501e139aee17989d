"""The data set flow, whose subflows are the flows of its sequences. Importing it imports Prefect: have its settings in
the environment before."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun, State
from prefect.context import FlowRunContext
from prefect.flows import Flow
from prefect.runtime import flow_run
from prefect.settings import PREFECT_API_URL
from prefect.states import Cancelled, Completed, Failed

from pipelines.batch.dashboard import BatchDashboard
from pipelines.batch.plan import with_manifest
from pipelines.batch.pool import opened_pool
from pipelines.batch.request import BatchRequest
from pipelines.batch.run import Batch, BatchEngine
from pipelines.batch.summary import Summary
from pipelines.batch.table import Result
from pipelines.events import Journal
from pipelines.link import Link
from pipelines.process import Outcome
from pipelines.register import Place
from pipelines.request import RunRequest
from pipelines.sequence import send_what_is_left, sequence_flow, set_crashed
from tasks.artefacts.jobs import CancelledError, Jobs

DatasetFlow = Flow[[BatchRequest], Summary]
Ended = Callable[[Summary], object]
Runner = Callable[[RunRequest, Journal, Jobs], Outcome]


def dataset_flow(
    journal: Callable[[], Journal],
    link: Callable[[], Link],
    died: Callable[[], bool] = lambda: False,
    ended: Ended = lambda summary: None,
) -> DatasetFlow:
    """The flow; each of its runs has a journal and a link to the server of its own.

    `died` tells whether the server has gone, `ended` hears what came out, whatever the state of the run says.
    """

    @flow(name="dataset", flow_run_name=_run_name, persist_result=False)
    def process_dataset(request: BatchRequest) -> Any:
        """From a manifest to a scene file with report for each of its sequences, and a page about all of them.

        Args:
            request: Which data set, where to, and how.
        """
        return _process(request, journal(), link(), died, ended)

    return process_dataset


def run_flow(request: BatchRequest, journal: Journal, died: Callable[[], bool]) -> Summary:
    """Run the flow here. Raises what `Batch` and its `run` raise."""
    summaries: list[Summary] = []
    link = Link(died=died)
    run = dataset_flow(lambda: journal, lambda: link, died, summaries.append)
    try:
        state: State[Summary] = run(request, return_state=True)
    finally:
        send_what_is_left()
        link.close()
    if state.is_cancelled():
        raise CancelledError(state.message)
    if not summaries:
        state.result()
    return summaries[0]


def _process(request: BatchRequest, journal: Journal, link: Link, died: Callable[[], bool], ended: Ended) -> State[Any]:
    context = FlowRunContext.get()
    assert context is not None
    assert context.flow_run is not None
    run = context.flow_run
    request = with_manifest(request)
    batch = Batch(request, journal)
    link.start(run.id, batch)
    try:
        link.post(lambda client: client.update_flow_run(run.id, tags=_tags(run, request)))
        dashboard = BatchDashboard(link, run.id, Path(request.manifest).stem)
        with _runner(request, journal, died) as runner, journal.heard_by(dashboard):
            summary = batch.run(_engine(runner, link, run, dashboard))
        dashboard.summarize(summary.lines(), summary.page)
    except CancelledError as error:
        return Cancelled(message=str(error))
    finally:
        link.finish()
    ended(summary)
    return Failed(message=summary.verdict) if summary.failed else Completed(message=summary.verdict)


@contextmanager
def _runner(request: BatchRequest, journal: Journal, died: Callable[[], bool]) -> Iterator[Runner]:
    """Who runs sequences: workers of a pool, or subflows here; raises ValueError for a pool without workers."""
    if request.pool is not None:
        with opened_pool(request.pool, journal.told) as pool:
            yield pool.run
        return
    starts = threading.Lock()

    def run_sequence(request: RunRequest, journal: Journal, jobs: Jobs) -> Outcome:
        return _run_sequence(request, journal, jobs, died, starts)

    yield run_sequence


def _engine(runner: Runner, link: Link, run: FlowRun, dashboard: BatchDashboard) -> BatchEngine:
    place = Place(PREFECT_API_URL.value() or "", str(run.id))
    return BatchEngine(
        run=runner,
        place=place,
        crashed=lambda old: set_crashed(link, old),
        cancelled=lambda: _is_cancelled(run),
        show=lambda results: dashboard.results(_cells(results)),
    )


def _is_cancelled(run: FlowRun) -> bool:
    with suppress(Exception), get_client(sync_client=True) as client:  # whatever a server or the way to it may do
        state = client.read_flow_run(run.id).state
        return state is not None and (state.is_cancelling() or state.is_cancelled())
    return False


def _run_sequence(
    request: RunRequest, journal: Journal, jobs: Jobs, died: Callable[[], bool], starts: threading.Lock
) -> Outcome:
    """Run the flow of a sequence as a subflow. Raises what `process` raises."""
    # When the server has gone, every sequence ends by itself, and the batch ends the process when all have.
    link, ended = Link(died=died, last_word=lambda sentence: None), list[Outcome]()
    with ExitStack() as starting:
        # One after another: the engine numbers subflows without a lock, and takes one number for one run.
        starting.enter_context(starts)

        def begun() -> Journal:
            starting.close()
            return journal

        try:
            sequence = sequence_flow(begun, lambda: link, lambda _: jobs, ended.append)
            state: State[Outcome] = sequence(request, return_state=True)
        finally:
            link.close()
    if state.is_cancelled():
        raise CancelledError(state.message)
    return ended[0] if ended else state.result()


def _run_name() -> str:
    """Manifest and preset, for lists of runs."""
    request = flow_run.parameters["request"]
    asked = request if isinstance(request, BatchRequest) else BatchRequest(**request)
    return f"{Path(asked.manifest).stem} {asked.preset}"


def _tags(run: FlowRun, request: BatchRequest) -> list[str]:
    own = ["packuv", f"dataset:{Path(request.manifest).stem}", f"preset:{request.preset}", *request.tags]
    return list(dict.fromkeys([*run.tags, *own]))


def _cells(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Rows of the dashboard's table, those that need a look first."""
    ordered = sorted(results, key=lambda one: (one.status == "finished", one.psnr_db or 0.0))
    return [
        {
            "sequence": one.sequence,
            "state": str(one.status),
            "PSNR dB": "" if one.psnr_db is None else round(one.psnr_db, 2),
            "MB/frame": "" if one.mb_per_frame is None else round(one.mb_per_frame, 3),
            "minutes": round(60 * (one.hours or 0.0), 1) if one.hours is not None else "",
            "why": one.reason,
        }
        for one in ordered
    ]


process_dataset = dataset_flow(Journal, Link)
"""What deployments run"""
