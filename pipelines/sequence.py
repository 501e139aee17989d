"""The per-sequence flow. Importing it imports Prefect: have its settings in the environment before."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from uuid import UUID

from prefect import flow
from prefect.client.schemas.objects import State
from prefect.context import FlowRunContext
from prefect.events.worker import EventsWorker
from prefect.exceptions import ObjectNotFound
from prefect.flows import Flow
from prefect.logging.handlers import APILogWorker, PrefectConsoleHandler
from prefect.runtime import flow_run
from prefect.settings import PREFECT_API_URL
from prefect.states import Cancelled, Crashed, Failed
from prefect.task_runners import ThreadPoolTaskRunner

from pipelines.crew import Crew, crew_of
from pipelines.dashboard import Dashboard, run_tags
from pipelines.events import Journal
from pipelines.link import FLUSH_SECONDS, Link
from pipelines.process import Engine, Outcome, find_sequence, jobs_at_once, jobs_of, process
from pipelines.register import Place
from pipelines.request import RunRequest
from tasks.artefacts.jobs import CancelledError, Jobs
from tasks.artefacts.store import Store
from tasks.engine import submitter

SequenceFlow = Flow[[RunRequest], Outcome]


def sequence_flow(
    journal: Callable[[], Journal],
    link: Callable[[], Link],
    jobs: Callable[[RunRequest], Jobs] = jobs_of,
    ended: Callable[[Outcome], object] = lambda outcome: None,
) -> SequenceFlow:
    """The flow; each of its runs has a journal, a link to the server and jobs of its own. `ended` hears what came out,
    also of a run that counts as failed because it misses what was asked for."""

    @flow(name="sequence", flow_run_name=_run_name, persist_result=False)
    def process_sequence(request: RunRequest) -> Any:
        """From a capture folder to a scene file, with report.

        Args:
            request: Which capture, where to, and how.
        """
        with crew_of(request) as crew:
            outcome = _process(crew, journal(), link(), jobs(crew.request))
        if isinstance(outcome, State):
            return outcome
        ended(outcome)
        return Failed(message=outcome.missed) if outcome.missed else outcome

    return process_sequence


def run_flow(request: RunRequest, journal: Journal, link: Link) -> Outcome:
    """Run the flow here. Raises what `process` raises."""
    ended = list[Outcome]()
    sequence = sequence_flow(lambda: journal, lambda: link, ended=ended.append)
    try:
        state: State[Outcome] = sequence(request, return_state=True)
    finally:  # else, after Ctrl-C, the link would take the end of our own server for a fault
        send_what_is_left()
        link.close()
    if state.is_cancelled():
        raise CancelledError(state.message)
    return ended[0] if ended else state.result()


def send_what_is_left() -> None:
    """Have the server hear the last events and log lines while it is there; at exit the engine would wait for it."""
    for service in (EventsWorker, APILogWorker):
        service.drain_all(timeout=FLUSH_SECONDS)


def log_to_the_server_only() -> None:
    """The terminal shows the journal; what the engine logs is for its dashboard."""
    logging.raiseExceptions = False  # nor does it show that a line could not be sent
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if isinstance(handler, PrefectConsoleHandler):
            root.removeHandler(handler)
    root.addHandler(logging.NullHandler())  # with none at all, Python would write warnings to the terminal


def _process(crew: Crew, journal: Journal, link: Link, jobs: Jobs) -> Outcome | State[Any]:
    request = crew.request
    context = FlowRunContext.get()
    assert context is not None
    assert context.flow_run is not None
    run_id = context.flow_run.id
    link.start(run_id, jobs)
    try:
        capture = find_sequence(request)
        store = Store(Path(request.out) / capture.name / "store")
        link.post(lambda client: client.update_flow_run(run_id, tags=run_tags(context.flow_run, request, capture)))
        dashboard = Dashboard(link, run_id, capture.name, store)
        place = Place(PREFECT_API_URL.value() or "", str(run_id))
        with journal.heard_by(dashboard), _runner(request) as runner:
            if crew.told:
                journal.told("cluster", crew.told)
            crashed = partial(set_crashed, link)
            engine = Engine(lambda make: submitter(make, runner), crew.maker, place, crashed, watched=True)
            outcome = process(request, journal, engine, jobs)
            dashboard.summarize(outcome)
            return outcome
    except CancelledError as error:
        return Cancelled(message=str(error))
    finally:
        link.finish()


def _runner(request: RunRequest) -> ThreadPoolTaskRunner[Any]:
    """Not the flow's own runner, which would be as wide for every request."""
    return ThreadPoolTaskRunner(max_workers=jobs_at_once(request))


def _run_name() -> str:
    """Sequence and preset, for lists of runs."""
    request = flow_run.parameters["request"]
    asked = request if isinstance(request, RunRequest) else RunRequest(**request)
    with suppress(ValueError, OSError):  # the run itself says what is wrong
        return f"{find_sequence(asked).name} {asked.preset}"
    return f"{Path(asked.capture).name} {asked.preset}"


def set_crashed(link: Link, place: Place) -> None:
    """Tell the engine of a run whose process was killed."""

    def post(client: Any) -> None:
        with suppress(ObjectNotFound):  # another server's
            client.set_flow_run_state(UUID(place.flow_run), Crashed(message="its process was killed"), force=True)

    link.post(post)


process_sequence = sequence_flow(Journal, Link)
"""What deployments run"""
