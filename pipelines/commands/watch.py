"""`packuv status` and `packuv cancel`: what runs, what failed, what is done; and how to end what runs.

Both read the records that runs keep in the folders of their results, so they need no server.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.table import Table

from pipelines.commands.terminal import print_facts, print_table
from pipelines.register import Found, Place, bury, find_runs
from pipelines.words import duration
from tasks.artefacts.retention import RUN

ENDING_SECONDS = 25.0
"""For a cancelled run to end by itself; then its process is killed"""
REQUEST_SECONDS = 5.0


@dataclass(frozen=True)
class Standing:
    """How a sequence stands."""

    sequence: str
    state: str
    """running, finished, failed, cancelled, stopped or killed"""
    preset: str = ""
    doing: str = ""
    """Stages under way, or why the run ended"""
    seconds: float | None = None
    """Since its start, or that it took"""
    left_seconds: float | None = None
    """Of the stages under way"""
    psnr_db: float | None = None
    mb_per_30_frames: float | None = None
    host: str = ""
    folder: str = ""


def status(arguments: argparse.Namespace) -> int:
    """`packuv status`: exit code 0, whatever it finds."""
    folders = sequence_folders(arguments.folder)
    for folder in folders:
        bury(folder, _tell_crashed)
    found = [standing for folder in folders for standing in standings(folder)]
    facts = {"folder": str(arguments.folder), "sequences": [asdict(standing) for standing in found]}
    if arguments.json:
        print_facts(facts, True, str)
    else:
        print_table(_table(found))
    return 0


def cancel(arguments: argparse.Namespace) -> int:
    """`packuv cancel`: exit code 0 if everything that ran has ended."""
    found = [run for folder in sequence_folders(arguments.folder) for run in find_runs(folder) if run.alive]
    if arguments.sequence:
        found = [run for run in found if run.record.sequence in arguments.sequence]
    if not found:
        raise ValueError(f"nothing runs in {arguments.folder}; packuv status tells what there is")
    parts = {run.path for run in found if _batch_of(run, found)}
    for run in found:
        if run.path in parts and run.record.engine is None:
            whole = f"which ends as a whole: packuv cancel {run.folder.parent}"
            raise ValueError(f"{run.record.sequence} is part of a batch without the workflow engine, {whole}")
    _ask_to_end(found)
    ended = [_wait_for(run, kill=run.path not in parts) for run in found]
    for run, how in zip(found, ended, strict=True):
        print(f"{run.record.sequence}: {how or 'does not end; it runs on ' + run.record.host}")
    return 0 if all(ended) else 1


def sequence_folders(folder: Path) -> list[Path]:
    """The folder itself if it is a sequence's, and those of the sequences in it; raises FileNotFoundError for none."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}; name the one that packuv run --out wrote")
    places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    found = [path for path in places if (path / RUN).exists() or find_runs(path)]
    if not found:
        raise FileNotFoundError(f"{folder} holds no runs; name the folder that packuv run --out wrote")
    return found


def standings(folder: Path) -> Iterator[Standing]:
    """Runs under way in the folder of a sequence; where there is none, how the last one ended."""
    running = [run for run in find_runs(folder) if run.alive]
    if running:
        yield from map(_running, running)
        return
    with contextlib.suppress(OSError, ValueError):
        yield _ended(folder, json.loads((folder / RUN).read_text()))


def _running(run: Found) -> Standing:
    record = run.record
    shares = [
        f"{stage.label}{'' if stage.done_share is None else f' {stage.done_share:.0%}'}" for stage in record.stages
    ]
    left = [stage.left_seconds for stage in record.stages if stage.left_seconds is not None]
    return Standing(
        sequence=record.sequence,
        state="running",
        preset=record.preset,
        doing=", ".join(shares) or "between two stages",
        seconds=_seconds(record.started, datetime.now(UTC).isoformat()),
        left_seconds=max(left, default=None),
        host=f"{record.host}, process {record.pid}",
        folder=str(run.folder),
    )


def _ended(folder: Path, run: Mapping[str, Any]) -> Standing:
    figures: Mapping[str, Any] = {}
    if run["outcome"] == "finished":
        with contextlib.suppress(OSError, ValueError, KeyError):
            figures = json.loads((folder / "report.json").read_text())["summary"]
    return Standing(
        sequence=run["sequence"],
        state=run["outcome"],
        preset=(run.get("choice") or {}).get("point") or run["request"]["preset"],
        doing=run["reason"],
        seconds=_seconds(run["started"], run["finished"]),
        psnr_db=figures.get("psnr_db"),
        mb_per_30_frames=figures.get("mb_per_30_frames"),
        folder=str(folder),
    )


def _seconds(start: str, stop: str) -> float:
    return (datetime.fromisoformat(stop) - datetime.fromisoformat(start)).total_seconds()


def _table(found: Sequence[Standing]) -> Table:
    table = Table("sequence", "state", "preset", "time", "left", "PSNR", "MB/30 frames", "what")
    styles = {"running": "cyan", "finished": "green", "failed": "bold red", "killed": "bold red"}
    for one in found:
        table.add_row(
            one.sequence,
            f"[{styles.get(one.state, 'yellow')}]{one.state}[/]",
            one.preset,
            "" if one.seconds is None else duration(one.seconds),
            "" if one.left_seconds is None else f"{duration(one.left_seconds)} (stage)",
            "" if one.psnr_db is None else f"{one.psnr_db:.2f} dB",
            "" if one.mb_per_30_frames is None else f"{one.mb_per_30_frames:.2f}",
            one.doing,
        )
    return table


def _batch_of(run: Found, asked: Sequence[Found]) -> bool:
    """Whether its process has a batch to process that nobody asked to end."""
    paths, who = [other.path for other in asked], (run.record.host, run.record.pid)
    around = [other for other in find_runs(run.folder.parent) if other.alive and other.path not in paths]
    return who in [(other.record.host, other.record.pid) for other in around]


def _ask_to_end(runs: Sequence[Found]) -> None:
    """The engine is told, so that its dashboard says Cancelled; the process is, once, in case there is no engine."""
    records = [run.record for run in runs]
    untold = [one for one in records if not (one.engine and _set_state(one.engine, "CANCELLING", "Cancelling"))]
    for pid in {one.pid for one in untold if one.here}:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)


def _wait_for(run: Found, *, kill: bool) -> str:
    """How the run ended; empty if it goes on."""
    if _ends_within(run, ENDING_SECONDS):
        return "cancelled"
    if kill and run.record.here:
        with contextlib.suppress(ProcessLookupError):
            os.kill(run.record.pid, signal.SIGKILL)
        if _ends_within(run, ENDING_SECONDS):
            bury(run.folder, _tell_crashed)
            return "killed, since it did not end by itself"
    return ""


def _ends_within(run: Found, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if run.path not in [other.path for other in find_runs(run.folder) if other.alive]:
            return True
        time.sleep(0.2)
    return False


def _tell_crashed(place: Place) -> None:
    _set_state(place, "CRASHED", "Crashed")


def _set_state(place: Place, kind: str, name: str) -> bool:
    """Set the state of a flow run by the server's API; false where there is no server any more."""
    body = json.dumps({"state": {"type": kind, "name": name}, "force": kind == "CRASHED"}).encode()
    url = f"{place.api}/flow_runs/{place.flow_run}/set_state"
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"}, method="POST")
    try:
        with urllib.request.urlopen(request, timeout=REQUEST_SECONDS):
            return True
    except (urllib.error.URLError, OSError, ValueError):
        return False
