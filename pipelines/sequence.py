"""The per-sequence flow. Importing it imports Prefect: have its settings in the environment before."""

from __future__ import annotations

from typing import Any

from prefect import flow
from prefect.task_runners import ThreadPoolTaskRunner

from pipelines.events import Journal
from pipelines.process import Outcome, jobs_at_once, process
from pipelines.request import RunRequest
from tasks.engine import submitter


@flow(name="sequence", persist_result=False, validate_parameters=False)
def process_sequence(request: RunRequest, journal: Journal | None = None) -> Outcome:
    """From a capture folder to a scene file, with report."""
    return process(request, journal or Journal(), submitter)


def run_flow(request: RunRequest, journal: Journal) -> Outcome:
    """Run the flow here, with as many tasks at a time as the machine bears."""
    runner: ThreadPoolTaskRunner[Any] = ThreadPoolTaskRunner(max_workers=jobs_at_once(request))
    return process_sequence.with_options(task_runner=runner)(request, journal)  # type: ignore[arg-type]  # with_options forgets the types
