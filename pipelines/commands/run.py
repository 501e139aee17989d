"""`packuv run`: one run from the command line, with or without the workflow engine."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.commands.output import answer
from pipelines.commands.preview import previewing
from pipelines.commands.progress import TerminalProgress
from pipelines.events import Journal
from pipelines.request import PRESETS, STAGES, RunRequest, read_settings
from pipelines.server import brings_server, workflow_server
from sync.capture import CaptureSettings
from tasks.artefacts.recipe import plain

if TYPE_CHECKING:
    from pipelines.process import Outcome


MISSED = 1
"""Exit code of a run that is whole, but does not reach the error that was asked for"""


def command(arguments: argparse.Namespace) -> int:
    """`packuv run` and the commands for its first stages."""
    request = request_from(arguments)
    progress = TerminalProgress(sys.stderr if arguments.json else sys.stdout)
    journal = Journal(progress)
    shown = previewing(request, journal) if arguments.preview else contextlib.nullcontext()
    with contextlib.closing(progress), shown:
        outcome = run(request, journal, direct=arguments.direct)
    if request.stop_after == STAGES[-1]:
        from pipelines.results import check_whole  # takes seconds, as what runs

        check_whole(outcome.folder)
    answer(json.dumps(outcome.to_json(), indent=1)) if arguments.json else print(outcome.farewell())
    return MISSED if outcome.missed else 0


def request_from(arguments: argparse.Namespace) -> RunRequest:
    """What the arguments of `packuv run`, or of a command for one stage, ask for."""
    return RunRequest(
        capture=os.path.abspath(arguments.capture),
        out=os.path.abspath(arguments.out),
        name=arguments.name,
        hold_out=arguments.hold_out,
        stop_after=arguments.stop_after if arguments.command == "run" else arguments.command,
        jobs=arguments.jobs,
        cluster=arguments.cluster,
        **asked_for(arguments),
    )


def asked_for(arguments: argparse.Namespace) -> dict[str, Any]:
    """How to process, be it one sequence or many: fields that both requests have."""
    names = ("quality", "frames", "device", "seed", "memory_gb", "max_minutes", "target_psnr")
    named = {name: getattr(arguments, name) for name in names}
    chosen = arguments.max_minutes is not None or arguments.target_psnr is not None
    # Who names a time or an error, and no preset, sets no bound.
    preset = arguments.preset or (PRESETS[-1] if chosen else RunRequest.preset)
    pairs = [*([f"sync.clock={arguments.clock}"] if arguments.clock else []), *arguments.set]
    return {**named, "preset": preset, "settings": read_settings(arguments.config, pairs)}


def run(request: RunRequest, journal: Journal, *, direct: bool) -> Outcome:
    """Process one sequence; raises ValueError or FileNotFoundError for bad input, whatever failed otherwise."""
    if not Path(request.capture).is_dir():  # before anything starts; the rest of the capture is checked in its time
        raise FileNotFoundError(f"no capture folder {request.capture}")
    if direct or (_came_to_its_end(request) and brings_server(Path(request.out)) and _is_made(request)):
        from pipelines.process import process_directly

        return process_directly(request, journal)
    with workflow_server(Path(request.out)) as server:
        journal.started("workflow engine")
        from pipelines.link import Link
        from pipelines.options import check_raft, compose  # takes seconds, in which the server starts
        from pipelines.sequence import log_to_the_server_only, run_flow

        # A misspelt setting, or a missing file of weights, need not wait for the server.
        check_raft(compose(request.preset, CaptureSettings(), request.settings))
        server.wait_ready()
        journal.ended("workflow engine")
        journal.told("dashboard", server.dashboard)
        log_to_the_server_only()
        return run_flow(request, journal, Link(died=server.died))


def _came_to_its_end(request: RunRequest) -> bool:
    """Whether the last run into one of the folders was this one, and finished; cost: reading a small file for each.

    False with a cluster, whose workers decide on what is made.
    """
    if request.cluster:
        return False
    for path in Path(request.out).glob("*/run.json"):
        with contextlib.suppress(OSError, ValueError, KeyError):  # of another version
            last = json.loads(path.read_text())
            if last["request"] == plain(request) and last["outcome"] == "finished":
                return True
    return False


def _is_made(request: RunRequest) -> bool:
    from pipelines.process import is_made  # takes a second, which a run that has work to do need not wait for

    return is_made(request)
