"""A batch whose sequences go to a Prefect work pool: what becomes of them, whoever is killed meanwhile."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipelines.batch.left import error_left, run_left
from pipelines.batch.pace import Headway, Pace
from pipelines.batch.watch import Watch
from pipelines.cli import WRONG, main
from pipelines.events import Journal
from pipelines.register import RUNNING, SILENT_SECONDS, Found, Place, find_runs, registered
from tasks.artefacts.recipe import plain, write_json
from tests.support.compose import service
from tests.support.places import ROOT
from tests.support.pool import Cluster, needs_postgres, running_cluster, wait_for

CAPTURE = ROOT / "tests" / "golden" / "capture"
TINY = {"cameras": 4, "frames": 4, "size": "80x48", "set": "clock.max_late_frames=1"}
DRAFT = ["--preset", "draft", "--stop-after", "encode"]
QUICK = {"iterations": 20, "key_iterations": 8, "frame_iterations": 4, "start.count": 300, "density.cap": 400}
LONG = QUICK | {"iterations": 100_000}
FACTS = {"sequence": "dance", "capture": "/data/dance", "preset": "draft"}
ENGINE = Place("http://127.0.0.1:1/api", "11111111-1111-1111-1111-111111111111")


def settings(values: dict[str, Any]) -> list[str]:
    return [word for name, value in values.items() for word in ("--set", f"fit.{name}={value}")]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with running_cluster() as running:
        yield running


@pytest.fixture(scope="module")
def manifest(tmp_path_factory) -> Path:
    """Of two tiny captures."""
    folder = tmp_path_factory.mktemp("data")
    for seed in range(2):
        size = [word for name, value in TINY.items() for word in (f"--{name}", str(value))]
        assert main(["simulate", str(folder / "shoot" / f"take{seed}"), *size, "--seed", str(seed)]) == 0
    assert main(["manifest", str(folder / "shoot"), "-o", str(folder / "shoot.parquet")]) == 0
    return folder / "shoot.parquet"


def start(manifest: Path, out: Path, cluster: Cluster, *more: str) -> subprocess.Popen[str]:
    """The batch of docker/compose.yaml, of these captures and into this folder."""
    given = service("packuv").placed({"/captures": str(manifest), "/runs": str(out)})
    pipe = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([*given.command, *DRAFT, *more], env=cluster.client, text=True, **pipe)


def said(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and words of a command that comes to its end."""
    output, errors = process.communicate(timeout=500)
    return process.returncode, output + errors


def under_way(out: Path) -> list[Found]:
    """Sequences that workers process, and that are past the preparations."""
    found = [run for folder in out.glob("take*") for run in find_runs(folder) if run.alive]
    return [run for run in found if run.record.stages]


def flow_runs(cluster: Cluster) -> list[dict[str, Any]]:
    asked = json.dumps({"flow_runs": {"tags": {"any_": ["seq:take0", "seq:take1"]}}}).encode()
    request = urllib.request.Request(f"{cluster.api}/flow_runs/filter", asked, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        found: list[dict[str, Any]] = json.load(answer)
        return found


def parents(pid: int) -> Iterator[int]:
    with contextlib.suppress(OSError):
        while pid > 1:
            pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
            yield pid


@pytest.mark.slow
@pytest.mark.timeout(1500)  # on a busy machine
@needs_postgres
def test_batch_and_worker_are_killed_and_all_is_as_without_a_pool(cluster, manifest, tmp_path):
    out, direct = tmp_path / "out", tmp_path / "direct"
    here = ["batch", str(manifest), "--out", str(direct), "--direct", "--at-once", "1", *DRAFT, *settings(QUICK)]
    assert main(here) == 0
    code, words = said(start(manifest, out, cluster))
    assert (code, "no work pool packuv at" in words) == (WRONG, True), words
    for _ in range(3):
        cluster.add_worker()

    with start(manifest, out, cluster, *settings(QUICK)) as batch:
        wait_for(lambda: under_way(out))
        batch.kill()
    again = start(manifest, out, cluster, *settings(QUICK), "--json")
    victim = wait_for(lambda: under_way(out))[0]
    above = set(parents(victim.record.pid))
    (worker,) = [worker for worker in cluster.workers if worker.process.pid in above]
    os.kill(worker.process.pid, signal.SIGKILL)
    os.kill(victim.record.pid, signal.SIGKILL)

    code, words = said(again)
    assert code == 0, words
    assert f"{victim.record.sequence}" in words
    assert "is handed out again" in words
    for number in range(2):
        name = f"take{number}"
        assert (out / name / "scene.mkv").read_bytes() == (direct / name / "scene.mkv").read_bytes()
    states = [run["state_type"] for run in flow_runs(cluster)]
    assert sorted(states) == ["COMPLETED"] * 2 + ["CRASHED"], "nothing was started twice but what was killed"
    assert "there already" in said(start(manifest, out, cluster, *settings(QUICK)))[1]


@pytest.mark.slow
@pytest.mark.timeout(1500)  # on a busy machine
@needs_postgres
def test_ctrl_c_ends_what_the_workers_do(cluster, manifest, tmp_path):
    if not [worker for worker in cluster.workers if worker.process.poll() is None]:
        cluster.add_worker()
    out = tmp_path / "out"
    with start(manifest, out, cluster, "--names", "take0", *settings(LONG)) as batch:
        wait_for(lambda: under_way(out))
        batch.send_signal(signal.SIGINT)
        code, words = said(batch)
    assert code == 130, words
    assert not under_way(out)
    assert json.loads((out / "take0" / "run.json").read_text())["outcome"] in ("cancelled", "stopped")
    assert json.loads((out / "run.json").read_text())["outcome"] == "stopped"
    assert "RUNNING" not in {run["state_type"] for run in flow_runs(cluster)}


@pytest.mark.parametrize(
    ("more", "server", "message"),
    [
        ((), None, "workers of the pool boxes need a server that stays"),
        (("--direct",), None, "leave out --direct or --pool"),
        ((), "http://127.0.0.1:1/api", "no workflow server at http://127.0.0.1:1/api"),
    ],
)
def test_a_pool_that_cannot_be_reached_is_told_before_anything_starts(
    tmp_path, capsys, monkeypatch, more, server, message
):
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))  # whose profile names no server
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    if server:
        monkeypatch.setenv("PREFECT_API_URL", server)
    out = tmp_path / "out"
    assert main(["batch", str(CAPTURE.parent), "--out", str(out), "--pool", "boxes", *more]) == WRONG
    assert message in capsys.readouterr().err
    assert not (out / "tiny").exists()


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_run_elsewhere_is_followed_by_its_record(tmp_path):
    journal, clock = Journal(), Clock()
    watch = Watch(tmp_path, ENGINE.flow_run, journal, clock=clock)
    watch.look()
    assert not watch.is_dead
    clock.now = 50
    assert watch.quiet_seconds("RUNNING") == 0
    clock.now = 80
    assert watch.quiet_seconds("RUNNING") == 30
    heard = Journal()
    with registered(tmp_path, engine=ENGINE, **FACTS) as register, heard.heard_by(register):
        heard.started("motion")
        heard.moved("motion", 3, 12)
        register.save()
        watch.look()
        assert watch.quiet_seconds("RUNNING") == 0
        assert [watch.killed("nothing known"), watch.is_dead] == [f"killed at motion on {socket.gethostname()}", False]
    watch.close()
    assert {event.label for event in journal.events} == {f"on {socket.gethostname()}", "motion"}


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_run_is_dead_when_its_lock_is_free_and_another_machine_is_silent(tmp_path, elsewhere):
    clock = Clock()
    with registered(tmp_path, engine=ENGINE, **FACTS):
        (found,) = find_runs(tmp_path)
    host = "elsewhere" if elsewhere else found.record.host
    path = tmp_path / RUNNING / "left.json"
    write_json(path, plain(replace(found.record, host=host)))
    watch = Watch(tmp_path, ENGINE.flow_run, Journal(), clock=clock)
    watch.look()
    assert not watch.is_dead, "it may just be ending"
    watch.look()
    watch.look()
    assert watch.is_dead is not elsewhere
    clock.now += SILENT_SECONDS + 1
    watch.look()
    watch.look()
    assert watch.is_dead
    assert watch.killed("") == f"killed at between two stages on {host}"
    other = Watch(tmp_path, "of another flow run", Journal(), clock=clock)
    other.look()
    other.look()
    assert not other.is_dead


def test_run_json_counts_for_its_own_flow_run_only(tmp_path):
    assert run_left(tmp_path, ENGINE.flow_run) is None
    write_json(tmp_path / "run.json", {"flow_run": None, "outcome": "finished"})
    assert run_left(tmp_path, ENGINE.flow_run) is None
    write_json(tmp_path / "run.json", {"flow_run": ENGINE.flow_run, "outcome": "finished"})
    assert run_left(tmp_path, ENGINE.flow_run) == {"flow_run": ENGINE.flow_run, "outcome": "finished"}


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        ("Flow run encountered an exception: ValueError: no camera", ValueError),
        ("Flow run encountered an exception: OptionError: no camera", ValueError),
        ("Flow run encountered an exception: FileNotFoundError: no camera", ValueError),
        ("Flow run encountered an exception: JobError: no camera", RuntimeError),
        ("no camera", RuntimeError),
    ],
)
def test_what_a_worker_raised_keeps_its_kind_and_words(message, kind):
    error = error_left(None, message)
    assert type(error) is kind
    assert str(error) == "no camera"
    assert str(error_left({"reason": "the disk is full"}, message)) == "the disk is full"


def test_a_forecast_counts_the_sequences_that_workers_have():
    headway = Headway(0.0, Pace([(10.0, 10)]), at_once=8)
    headway.look([10, 10], [(0.0, 10), (5.0, 10)])
    assert headway.remaining_seconds() == (20 + 10 + 5) / 2
