"""A run over a cluster: client, scheduler and worker are killed midway, and the same command makes the same bytes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.cluster import LocalCluster, end
from studio.capture import SimulateOptions, simulate
from tasks.artefacts.store import Store
from tests.support.places import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
WORKERS = 3
SECONDS = 240.0
"""For a stage to come to pass, on a machine that is busy"""
SETTINGS_TEXT = (
    "[keyframes]\nseparation = 2\nmax_segment = 3\nseam = 100.0\n[points]\nmore_instants = [3]\n"
    "[fit]\niterations = 20\nkey_iterations = 8\nframe_iterations = 4\nstart.count = 300\n"
    "shell.columns = 128\nshell.steps = 24\ndensity.cap = 400\n"
)


class Run:
    """A `packuv run` in a process of its own."""

    def __init__(self, folder: Path, out: Path, *words: str) -> None:
        self.out, self.log = out, folder / f"{time.time_ns()}.log"
        settings = folder / "settings.toml"
        settings.write_text(SETTINGS_TEXT)
        command = [sys.executable, "-m", "pipelines.cli", "run", str(folder / "capture"), "--out", str(out)]
        command += ["--name", "tiny", "--preset", "draft", "--config", str(settings), *words]
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=environment())

    def until(self, label: str) -> None:
        """Until a stage that begins with this has come to its end."""
        deadline = time.monotonic() + SECONDS
        while not any(line.startswith(label) for line in self.log.read_text().splitlines()):
            assert self.process.poll() is None, self.log.read_text()
            assert time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.1)

    def code(self) -> int:
        return self.process.wait(SECONDS)

    @property
    def scene(self) -> bytes:
        return (self.out / "tiny/scene.mkv").read_bytes()


def environment() -> dict[str, str]:
    threads = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    return {**os.environ, **threads, "PYTHONPATH": str(ROOT)}


def jobs_in(store: Path) -> list[int]:
    """Processes of this machine that work for a store."""
    found = []
    for place in Path("/proc").glob("[0-9]*/environ"):
        try:
            if os.fsencode(f"PACKUV_JOB={store}") in place.read_bytes():
                found.append(int(place.parent.name))
        except OSError:
            continue
    return found


@pytest.fixture
def folder(tmp_path) -> Path:
    simulate(tmp_path / "capture", SimulateOptions(5, 12, "96x64", seed=3, name="tiny"))
    return tmp_path


@pytest.fixture
def machines(folder):
    with LocalCluster(folder / "cluster", environment=environment()) as found:
        yield found


def start_workers(machines: LocalCluster) -> None:
    """Each with a home of its own, and a copy of what is compiled."""
    first = len(machines.workers)
    for number in range(first, first + WORKERS):
        kernels = machines.folder / f"worker{number + 2}" / "kernels"
        for cache in (ROOT / "packuv/__pycache__").glob("kernels-*"):
            shutil.copytree(cache, kernels / cache.name, dirs_exist_ok=True)
        machines.start_worker()


def test_kills_of_client_scheduler_and_worker_leave_the_same_bytes(folder, machines):
    alone = Run(folder, folder / "alone", "--direct", "--jobs", "2")
    assert alone.code() == 0, alone.log.read_text()
    start_workers(machines)
    machines.await_workers()
    store = folder / "shared/tiny/store"

    def run(*words: str) -> Run:
        return Run(folder, folder / "shared", "--cluster", machines.address, *words)

    client = run("--direct")
    client.until("fit backdrop")
    deadline = time.monotonic() + SECONDS
    while not jobs_in(store):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    client.process.kill()
    client.code()
    deadline = time.monotonic() + 20
    while jobs_in(store):
        assert time.monotonic() < deadline, "jobs go on without anybody who wants them"
        time.sleep(0.1)

    orphan = run("--direct")
    orphan.until("fit keyframe")
    machines.scheduler.kill()
    assert orphan.code() == 1
    (*_, sentence) = orphan.log.read_text().splitlines()
    assert sentence.startswith(f"packuv: the scheduler {machines.address} has gone")
    assert sentence.endswith("the same command goes on from here")
    for worker in machines.workers:
        assert worker.wait(60) == 1
    assert not jobs_in(store)

    machines.start_scheduler()
    start_workers(machines)
    machines.await_workers()
    whole = run()  # with the workflow engine
    whole.until("fit segment")
    busy = {int(place.name.rsplit("-", 4)[2]) for place in (store / ".work").glob("*/*-*-*-*-*/")}
    victim = next((worker for worker in machines.workers[WORKERS:] if worker.pid in busy), machines.workers[-1])
    victim.kill()
    assert whole.code() == 0, whole.log.read_text()
    assert whole.scene == alone.scene
    assert Store(store).verify() == []
    hosts = {json.loads(path.read_text())["cpu"] for path in store.glob("*/*/receipt.json")}
    assert len(hosts) == 1
    assert not list((store / ".work").glob("*/"))


def test_ctrl_c_ends_the_jobs_of_all_workers(folder, machines):
    start_workers(machines)
    machines.await_workers()
    run = Run(folder, folder / "shared", "--cluster", machines.address, "--direct")
    run.until("motion")
    run.process.send_signal(signal.SIGINT)
    assert run.code() == 130
    deadline = time.monotonic() + 20
    while jobs_in(folder / "shared/tiny/store"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    for worker in machines.workers:  # ... which are there for the next run
        assert worker.poll() is None
        end(worker)
        assert worker.returncode == 0
