"""Stages on workers that are processes of their own: they tell, fail as they do here, end when nobody wants them."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bench.cluster import LocalCluster
from sync.capture import find_capture
from tasks.artefacts.jobs import CancelledError, JobDiedError, JobError, Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.store import Store
from tasks.artefacts.workshop import Workshop
from tasks.cluster.client import Cluster, check_able, connected
from tests.support.naps import Fails, Nap, Sleeps
from tests.support.places import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # Dask leaves sockets to the collector when a peer has gone
]
SECONDS = 20.0
"""For what should take one or two, on a machine that is busy"""


class Heard:
    """A listener that remembers."""

    def __init__(self) -> None:
        self.moves: list[tuple[str, float, float, str]] = []
        self.events: list[tuple[str, str]] = []

    def moved(self, label: str, done: float, total: float, note: str = "") -> None:
        self.moves.append((label, done, total, note))

    def __getattr__(self, name: str):
        return lambda label, *_: self.events.append((name, label))


@pytest.fixture
def machines(tmp_path) -> Iterator[LocalCluster]:
    with LocalCluster(tmp_path / "cluster", environment={"PYTHONPATH": str(ROOT)}) as found:
        for _ in range(2):
            found.start_worker()
        found.await_workers()
        yield found


@pytest.fixture
def cluster(machines) -> Iterator[Cluster]:
    with connected(machines.address) as found:
        yield found


@pytest.fixture
def workshop(tmp_path, cluster) -> Workshop:
    for camera in ("cam00", "cam01"):
        (tmp_path / "capture/videos").mkdir(parents=True, exist_ok=True)
        (tmp_path / f"capture/videos/{camera}.mp4").touch()
    originals = Originals(find_capture(tmp_path / "capture"), tmp_path / "file_digests.json")
    return Workshop(Store(tmp_path / "shared/store"), originals, Jobs(threads=1), Heard(), cluster)


def pids(mark: Path) -> list[int]:
    within(lambda: mark.exists() and len(mark.read_text().split()) == 2)
    return [int(pid) for pid in mark.read_text().split()]


def within(holds) -> None:
    deadline = time.monotonic() + SECONDS
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def gone(pid: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True


def test_workers_make_what_is_asked_side_by_side_and_tell_as_a_job_here_does(workshop):
    naps = [Nap(number=number, seconds=2) for number in range(4)]
    with ThreadPoolExecutor(4) as pool:
        keys = list(pool.map(workshop.make, naps))
        again = list(pool.map(workshop.make, naps))
    assert [key.reused for key in keys] == [False] * 4
    assert [key.reused for key in again] == [True] * 4
    assert workshop.store.verify() == []
    for nap in naps:
        dones = [done for label, done, total, _ in workshop.listener.moves if label == nap.label and total == 2]
        assert dones == sorted(dones)
        assert dones
    receipt = workshop.store.receipt(keys[0])
    assert receipt.cpu.endswith(" lanes")
    assert receipt.cpu_seconds > 0
    assert not (workshop.store.root / ".work").exists() or not list((workshop.store.root / ".work").glob("*/"))


def test_failures_keep_their_kinds(workshop):
    kinds = {"bad input": ValueError, "missing": FileNotFoundError, "bug": JobError, "died": JobDiedError}
    for kind, raised in kinds.items():
        with pytest.raises(raised) as caught:
            workshop.make(Fails(kind=kind))
        assert type(caught.value) is raised
        if isinstance(caught.value, JobError):
            assert caught.value.log.exists()
    assert "cam03 has no frames" not in str(caught.value)


def test_what_no_worker_offers_is_refused_at_once(workshop, cluster, monkeypatch):
    monkeypatch.setattr(Nap, "small", False)
    for threads, gigabytes, what in [(9, 1, "9 cores, 2.0 GB"), (1, 900, "1 core, 901.0 GB")]:
        large = Workshop(
            workshop.store, workshop.originals, Jobs(threads=threads, memory_bytes=gigabytes * 10**9), Heard(), cluster
        )
        with pytest.raises(ValueError, match=f"'nap 1' needs {what}, and none of the 2 workers offers .* 2 x 1 core"):
            large.make(Nap(number=1, seconds=0))
    check_able([], Nap(number=1, seconds=0).needs(workshop.site), "nap")  # one may join


def test_jobs_that_are_cancelled_end_on_the_worker(workshop, tmp_path):
    caught = []

    def make() -> None:
        with pytest.raises(CancelledError, match="ended by the user; the same command goes on") as error:
            workshop.make(Sleeps(mark=str(tmp_path / "mark")))
        caught.append(error)

    thread = threading.Thread(target=make)
    thread.start()
    found = pids(tmp_path / "mark")
    workshop.jobs.cancel()
    thread.join(SECONDS)
    assert caught
    within(lambda: all(map(gone, found)))


def test_a_killed_workers_job_runs_elsewhere(workshop, machines, tmp_path):
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(workshop.make, Nap(number=1, seconds=5))
        within(lambda: workshop.listener.moves)
        (begun,) = (workshop.store.root / ".work").glob("*/*/begun.json")
        pid = int(begun.parent.name.rsplit("-", 4)[2])
        (busy,) = [worker for worker in machines.workers if worker.pid == pid]
        busy.kill()
        key = made.result(60)
    assert not key.reused
    assert workshop.store.verify() == []


def test_a_scheduler_that_goes_ends_the_run_in_one_sentence_and_its_jobs(workshop, machines, tmp_path):
    with ThreadPoolExecutor(2) as pool:
        stages = [Sleeps(mark=str(tmp_path / f"mark{number}")) for number in range(2)]
        made = [pool.submit(workshop.make, stage) for stage in stages]
        found = [pid for number in range(2) for pid in pids(tmp_path / f"mark{number}")]
        machines.scheduler.kill()
        for one in made:
            with pytest.raises(CancelledError, match=rf"the scheduler {machines.address} has gone.*the same command"):
                one.result(60)
    within(lambda: all(map(gone, found)))
    within(lambda: all(worker.poll() == 1 for worker in machines.workers))


def test_a_cluster_without_scheduler_or_worker_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tasks.cluster.client.CONNECT_SECONDS", 1.0)
    monkeypatch.setattr("tasks.cluster.client.FIRST_WORKER_SECONDS", 1.0)
    with (
        pytest.raises(ValueError, match=r"no scheduler answers at tcp://127\.0\.0\.1:9; start one"),
        connected("tcp://127.0.0.1:9"),
    ):
        pass
    with (
        LocalCluster(tmp_path / "cluster") as machines,
        pytest.raises(ValueError, match=r"no worker has joined tcp://.*; start some"),
        connected(machines.address),
    ):
        pass
