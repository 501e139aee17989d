"""Jobs: arguments and results, exceptions, death in both directions."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from sync.capture import find_capture
from tasks.artefacts.jobs import CancelledError, JobDiedError, JobError, Jobs, end_leftovers
from tasks.artefacts.originals import Originals
from tasks.artefacts.store import Store
from tasks.artefacts.workshop import Workshop

WORK = """
from __future__ import annotations
import os, signal, subprocess, sys, time
from dataclasses import dataclass
from pathlib import Path
from tasks.artefacts.stage import Stage

@dataclass(frozen=True)
class Size:
    width: int
    height: int = 2

class CaptureError(ValueError):
    pass

def area(progress, size: Size, names: tuple[str, ...], out: Path):
    progress(1, 2, "half")
    (out / "area.txt").write_text(str(size.width * size.height))
    threads = {name: os.environ[name] for name in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    return {"names": list(names), "threads": threads, "pid": os.getpid()}

def bad_input(progress): raise CaptureError("cam03 has no frames")
def missing(progress): raise FileNotFoundError(2, "no such thing", "cam03.mp4")
def wordy(progress): raise OSError("the store is another machine's")
def full(progress): raise OSError(28, "No space left on device")
def full_here(progress): raise OSError(28, "No space left on device", Path("/runs/a.npz"))
def full_hidden(progress): raise RuntimeError("could not write")
def full_mapped(progress): os.kill(os.getpid(), signal.SIGBUS)
def bug(progress): return {}["key"]
def dies(progress): os.kill(os.getpid(), signal.SIGKILL)
def says(progress): print("said by the job"); sys.stdout.flush(); sys.exit(3)

@dataclass(frozen=True, kw_only=True)
class Area(Stage):
    name, version = "area", 1
    size: Size
    fails: bool = False

    def build(self, work):
        return bad_input(work.progress) if self.fails else area(work.progress, self.size, ("cam00",), work.out)

def sleeps(progress, mark: Path):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    mark.write_text(f"{os.getpid()} {child.pid}")
    time.sleep(60)
"""


class Quiet:
    """Remembers what a workshop told."""

    def __init__(self) -> None:
        self.events: list[tuple] = []

    def __getattr__(self, name: str):
        return lambda *values: self.events.append((name, *values))


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    (tmp_path / "packuv_test_work.py").write_text(WORK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "packuv_test_work", raising=False)
    return Jobs(threads=3)


@pytest.fixture
def work(jobs):
    """The module that jobs are taken from."""
    return importlib.import_module("packuv_test_work")


def gone(pid: int, *, seconds: float = 5) -> bool:
    """True once the process has ended; a zombie whose new parent has not looked yet counts as ended."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        with contextlib.suppress(FileNotFoundError):
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                time.sleep(0.02)
                continue
        return True
    return False


def read_pids(mark: Path) -> list[int]:
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        if mark.exists() and len(mark.read_text().split()) == 2:
            return [int(pid) for pid in mark.read_text().split()]
        time.sleep(0.02)
    raise AssertionError("the job did not start")


def test_arguments_results_and_progress_cross_over(jobs, work, tmp_path):
    seen = []
    job = partial(work.area, size=work.Size(3), names=("cam00", "cam01"), out=tmp_path)
    done = jobs.run(job, folder=tmp_path, progress=lambda *values: seen.append(values))
    assert (tmp_path / "area.txt").read_text() == "6"
    assert seen == [(1.0, 2.0, "half")]
    assert done.value["names"] == ["cam00", "cam01"]
    assert done.value["threads"] == {"NUMBA_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "1"}
    assert done.value["pid"] != os.getpid()
    assert done.peak_memory_bytes > 1 << 20
    assert done.cpu_seconds > 0
    assert done.cpu.endswith(" lanes")


@pytest.mark.parametrize(
    ("function", "kind", "message"),
    [
        ("bad_input", ValueError, r"^cam03 has no frames(\n|$)"),
        ("missing", FileNotFoundError, r"no such thing: 'cam03\.mp4'"),
        ("full", OSError, "No space left on device"),
        ("wordy", OSError, "^the store is another machine's"),
        ("bug", JobError, r"^KeyError: key; the traceback is in .*job\.log$"),
        ("dies", JobDiedError, r"ended without a result \(killed by signal 9, as happens when memory runs out\)"),
        ("says", JobDiedError, r"ended without a result \(exit code 3\)"),
    ],
)
def test_failures_keep_their_kind_and_words(jobs, work, tmp_path, function, kind, message):
    with pytest.raises(kind, match=message) as caught:
        jobs.run(getattr(work, function), folder=tmp_path)
    assert isinstance(caught.value, JobDiedError) == (kind is JobDiedError)
    log = (tmp_path / "job.log").read_text()
    assert {"bug": "Traceback", "says": "said by the job"}.get(function, "") in log


@pytest.mark.parametrize("function", ["full", "full_here", "bad_input"])
def test_a_full_disk_takes_no_log_but_the_error_arrives(jobs, work, tmp_path, function):
    (tmp_path / "job.log").symlink_to("/dev/full")
    with pytest.raises((OSError, ValueError)) as caught:
        jobs.run(getattr(work, function), folder=tmp_path)
    if function != "bad_input":
        error = caught.value
        named = {"full_here": "/runs/a.npz"}.get(function)
        assert (error.errno, error.strerror, error.filename) == (28, "No space left on device", named)


@pytest.mark.parametrize(
    ("function", "free", "kind"),
    [
        ("full_hidden", 0, OSError),
        ("full_mapped", 0, OSError),
        ("full_hidden", 10**9, JobError),
        ("full_mapped", 10**9, JobDiedError),
        ("bad_input", 0, ValueError),
        ("missing", 0, FileNotFoundError),
    ],
)
def test_what_gives_no_reason_on_a_full_disk_failed_of_that(jobs, work, tmp_path, monkeypatch, function, free, kind):
    # What the system says of the disk is all that is not real here: a disk of one's own needs root.
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**12, 10**12 - free, free))
    with pytest.raises(kind) as caught:
        jobs.run(getattr(work, function), folder=tmp_path)
    assert type(caught.value) is kind
    if kind is OSError:
        assert (caught.value.errno, caught.value.filename) == (28, str(tmp_path))


def test_cancel_ends_jobs_and_what_they_started(jobs, work, tmp_path):
    mark, caught = tmp_path / "mark", []

    def run():
        with pytest.raises(CancelledError, match="the same command goes on from here"):
            jobs.run(partial(work.sleeps, mark=mark), folder=tmp_path)
        caught.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    pids = read_pids(mark)
    jobs.cancel()
    thread.join(timeout=10)
    assert caught == [True]
    assert all(gone(pid) for pid in pids)
    with pytest.raises(CancelledError):
        jobs.run(work.dies, folder=tmp_path)


def test_job_dies_with_its_parent(jobs, tmp_path):
    mark = tmp_path / "mark"
    code = (
        "import sys; from functools import partial; from pathlib import Path; from tasks.artefacts.jobs import Jobs\n"
        "import packuv_test_work; folder = Path(sys.argv[1])\n"
        "Jobs(threads=1).run(partial(packuv_test_work.sleeps, mark=folder / 'mark'), folder=folder)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) as parent:
        job, grandchild = read_pids(mark)
        parent.send_signal(signal.SIGKILL)
    assert gone(job)
    assert not gone(grandchild, seconds=0.2)  # the kernel's help does not reach further than the job ...
    end_leftovers(tmp_path)
    assert gone(grandchild)  # ... but the next job in this folder begins alone


def test_workshop_makes_an_artefact_by_a_job_and_tells(jobs, work, tmp_path):
    listener = Quiet()
    for camera in ("cam00", "cam01"):
        (tmp_path / "capture/videos").mkdir(parents=True, exist_ok=True)
        (tmp_path / f"capture/videos/{camera}.mp4").touch()
    originals = Originals(find_capture(tmp_path / "capture"), tmp_path / "file_digests.json")
    workshop = Workshop(Store(tmp_path / "store"), originals, jobs, listener)
    stage = work.Area(size=work.Size(3))
    for _ in range(2):
        key = workshop.make(stage)
    assert key.reused
    assert (workshop.path(key) / "area.txt").read_text() == "6"
    receipt = workshop.store.receipt(key)
    assert receipt.notes["names"] == ["cam00"]
    assert receipt.cpu.endswith(" lanes")
    assert receipt.versions["packuv"]
    names = [event[0] for event in listener.events]
    assert names == ["started", "moved", "finished", "started", "finished"]
    with pytest.raises(ValueError, match="no frames"):
        workshop.make(replace(stage, fails=True))
    assert listener.events[-1][:2] == ("failed", "area")
    (spec,) = (tmp_path / "store" / ".work").glob("*/*/spec.json")
    assert "fails=True" in json.loads(spec.read_text())["job"]
