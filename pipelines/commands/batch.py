"""`packuv batch`: a data set from the command line, with or without the workflow engine."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from pipelines.batch.request import BatchRequest
from pipelines.commands.output import answer
from pipelines.commands.progress import TerminalProgress
from pipelines.commands.run import asked_for
from pipelines.commands.terminal import print_table
from pipelines.events import Journal
from pipelines.server import Server, brings_server, workflow_server

if TYPE_CHECKING:
    from pipelines.batch.plan import Step
    from pipelines.batch.summary import Summary


def command(arguments: argparse.Namespace) -> int:
    """Exit code 0 if every sequence that was asked for is finished, else 1."""
    request = request_from(arguments)
    if arguments.dry_run:
        return _tell(request, as_json=arguments.json)
    progress = TerminalProgress(sys.stderr if arguments.json else sys.stdout)
    with contextlib.closing(progress):
        summary = run(request, Journal(progress), direct=arguments.direct)
    if arguments.json:
        answer(json.dumps(summary.to_json(), indent=1))
    else:
        print("\n".join(summary.lines()))
    return 1 if summary.failed else 0


def request_from(arguments: argparse.Namespace) -> BatchRequest:
    """What the arguments of `packuv batch` ask for."""
    return BatchRequest(
        manifest=os.path.abspath(arguments.manifest),
        out=os.path.abspath(arguments.out),
        names=arguments.names,
        tags=arguments.tags,
        jobs=arguments.jobs,
        at_once=arguments.at_once,
        pool=arguments.pool,
        stop_after=arguments.stop_after,
        notify=arguments.notify,
        **asked_for(arguments),
    )


def run(request: BatchRequest, journal: Journal, *, direct: bool) -> Summary:
    """Process a data set; raises ValueError or FileNotFoundError for bad input before anything starts."""
    from pipelines.batch.plan import plan_batch, with_manifest  # takes seconds, which a misspelt option need not wait
    from pipelines.batch.run import run_directly

    if direct and request.pool:
        raise ValueError("workers of a pool need the workflow engine; leave out --direct or --pool")
    request = with_manifest(request)
    if direct or not plan_batch(request).to_run:  # no engine for nothing
        return run_directly(request, journal)
    if request.pool and brings_server(Path(request.out)):
        stays = f"name it in PREFECT_API_URL, or have packuv serve --out {request.out} running"
        raise ValueError(f"workers of the pool {request.pool} need a server that stays; {stays}")
    with workflow_server(Path(request.out)) as server:
        journal.started("workflow engine")
        from pipelines.batch.flow import run_flow
        from pipelines.sequence import log_to_the_server_only

        _check(server, request.pool)
        journal.ended("workflow engine")
        journal.told("dashboard", server.dashboard)
        log_to_the_server_only()
        return run_flow(request, journal, server.died)


def _check(server: Server, pool: str | None) -> None:
    """Raise ValueError for a pool that would take nothing, also where its server does not answer."""
    if pool is None:
        server.wait_ready()
        return
    from prefect.client.orchestration import get_client

    from pipelines.batch.pool import check_pool

    try:
        server.wait_ready()
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    with get_client(sync_client=True) as client:
        check_pool(client, pool)


def _tell(request: BatchRequest, *, as_json: bool) -> int:
    """What would run, and why."""
    from pipelines.batch.plan import plan_batch, with_manifest

    steps = plan_batch(with_manifest(request)).steps
    if as_json:
        answer(json.dumps([{"sequence": step.name, "does": step.does, "why": step.why} for step in steps], indent=1))
        return 0
    print_table(_table(steps))
    print(f"{sum(step.runs for step in steps)} of {len(steps)} sequences would run")
    return 0


def _table(steps: Sequence[Step]) -> Table:
    table = Table("sequence", "frames", "does", "why")
    for step in steps:
        style = "yellow" if step.problem else "" if step.runs else "dim"
        cells = (step.name, str(step.frames), step.does, step.why)
        table.add_row(*(Text(cell) for cell in cells), style=style)
    return table
