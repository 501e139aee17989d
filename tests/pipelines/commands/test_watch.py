"""What runs, what failed, what is done; and ending what runs."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pipelines.cli import FAILED, OK, WRONG, main
from pipelines.events import Journal
from pipelines.register import find_runs, registered
from tasks.artefacts.recipe import write_json
from tests.support.places import ROOT

CAPTURE = ROOT / "tests" / "golden" / "capture"
LONG = ("fit.iterations=100000", "fit.start.count=300", "fit.density.cap=400")


def status(folder: Path, capsys) -> dict[str, dict]:
    assert main(["status", str(folder), "--json"]) == OK
    return {one["sequence"]: one for one in json.loads(capsys.readouterr().out)["sequences"]}


def ended(folder: Path, outcome: str, reason: str = "") -> None:
    folder.mkdir()
    times = {"started": "2026-01-01T00:00:00+00:00", "finished": "2026-01-01T01:02:00+00:00"}
    request = {"preset": "draft"}
    write_json(
        folder / "run.json",
        {"sequence": folder.name, "outcome": outcome, "reason": reason, "request": request, "stages": [], **times},
    )


def test_status_tells_running_failed_and_finished_sequences(tmp_path, capsys):
    ended(tmp_path / "done", "finished")
    write_json(tmp_path / "done" / "report.json", {"summary": {"psnr_db": 28.5, "mb_per_30_frames": 1.25}})
    ended(tmp_path / "broken", "failed", "cam02.mp4 is cut short")
    (tmp_path / "unrelated").mkdir()
    journal = Journal()
    with (
        registered(tmp_path / "under_way", sequence="under_way", capture="/data/x", preset="standard") as register,
        journal.heard_by(register),
    ):
        journal.started("fit segment 3 (frames 60-89)")
        journal.moved("fit segment 3 (frames 60-89)", 12, 30)
        register.save()
        found = status(tmp_path, capsys)
        assert main(["status", str(tmp_path)]) == OK
        table = capsys.readouterr().out
    assert {name: one["state"] for name, one in found.items()} == {
        "done": "finished",
        "broken": "failed",
        "under_way": "running",
    }
    assert (found["done"]["psnr_db"], found["done"]["seconds"]) == (28.5, 3720)
    assert found["broken"]["doing"] == "cam02.mp4 is cut short"
    assert found["under_way"]["doing"] == "fit segment 3 (frames 60-89) 40%"
    for text in ("fit segment 3 (frames 60-89) 40%", "cam02.mp4 is cut short", "28.50 dB", "1 h 02 min"):
        assert text in table


@pytest.mark.parametrize("words", [["status", "nowhere"], ["cancel", "nowhere"], ["status", "."], ["cancel", "."]])
def test_a_folder_without_runs_is_refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == WRONG
    assert "packuv run --out" in capsys.readouterr().err


def test_there_is_nothing_to_cancel_where_nothing_runs(tmp_path, capsys):
    ended(tmp_path / "done", "finished")
    assert main(["cancel", str(tmp_path)]) == WRONG
    assert "nothing runs in" in capsys.readouterr().err


@contextlib.contextmanager
def fitting(out: Path, *words: str) -> Iterator[subprocess.Popen]:
    """A long run that has come to its first fit."""
    settings = [word for setting in LONG for word in ("--set", setting)]
    command = [sys.executable, "-m", "pipelines.cli", "run", str(CAPTURE), "--out", str(out), "--name", "dance"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT")}
    with subprocess.Popen(
        [*command, "--preset", "draft", *settings, *words],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            wait_for(lambda: any("fit" in label for label in under_way(out / "dance")) or process.poll() is not None)
            yield process
        finally:
            process.kill()


def under_way(folder: Path) -> list[str]:
    return [stage.label for found in find_runs(folder) if found.alive for stage in found.record.stages]


def wait_for(what: Callable[[], object], seconds: float = 540) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline, "it takes too long"
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [[], ["--direct"]], ids=["prefect", "direct"])
def test_cancel_ends_a_run_within_seconds(tmp_path, mode, capsys):
    with fitting(tmp_path, *mode) as process:
        start = time.monotonic()
        assert main(["cancel", str(tmp_path), "dance"]) == OK
        assert time.monotonic() - start < 20
        assert capsys.readouterr().out == "dance: cancelled\n"
        process.wait(30)
    assert status(tmp_path, capsys)["dance"]["state"] in ("cancelled", "stopped")


@pytest.mark.slow
def test_a_run_whose_server_dies_ends_by_itself_with_one_sentence(tmp_path, capsys):
    with fitting(tmp_path) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        (server,) = [pid for pid in children if "pipelines.server" in Path(f"/proc/{pid}/cmdline").read_text()]
        os.kill(int(server), signal.SIGKILL)
        assert process.wait(60) == FAILED
        said = process.stderr.read()
    assert said.count("\n") == 1
    assert "the workflow server at http://127.0.0.1:" in said
    assert "has gone; what is made is safe, and the same command goes on from here" in said
    assert status(tmp_path, capsys)["dance"]["state"] == "cancelled"
    assert not under_way(tmp_path / "dance")


@pytest.mark.slow
def test_a_killed_run_does_not_stay_running(tmp_path, capsys):
    with fitting(tmp_path, "--direct") as process:
        assert status(tmp_path, capsys)["dance"]["state"] == "running"
        process.kill()
        process.wait()
    found = status(tmp_path, capsys)["dance"]
    assert found["state"] == "killed"
    assert found["doing"].startswith("killed at fit backdrop")
