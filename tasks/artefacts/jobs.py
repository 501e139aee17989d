"""Heavy work in processes of their own.

A job is something that can be pickled and called, in a fresh interpreter. It dies with the thread that started it, also
by kill -9; it can be ended from outside at any moment; its memory is its own; and what it prints goes to a log file.
Run as `python -m tasks.artefacts.jobs SPEC.json`.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import os
import pickle
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from packuv.budget import USUAL_BYTES
from packuv.progress import Progress, no_progress
from tasks.artefacts.recipe import plain
from tasks.artefacts.store import peak_memory_bytes

Job = Callable[[Progress], Any]
"""Work for a process of its own: something that can be pickled, called with whom to tell; returns plain values"""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
ONE_BLAS_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""NumPy's BLAS waits for ever for its own threads where cores are busy (13 of 36 processes that only solved small least
squares, three at a time on two cores); nothing here needs them"""
RAISED_AS = (FileNotFoundError, NotADirectoryError, PermissionError, OSError, ValueError, MemoryError)
"""Kinds of exception that keep their kind on the way out of a job, the particular before the general"""
CHECK_SECONDS = 0.5
"""Between two looks at whether a job is still wanted"""
PIPE_BYTES = 65_536
PR_SET_PDEATHSIG = 1
JOB_FILE = "job.pickle"
FULL_BYTES = 1_000_000
"""Where less is free, a full disk is taken for the cause of what went wrong without saying why"""
MARK = "PACKUV_JOB"
"""Environment variable of a job and all that it starts: the folder it works for"""


class JobError(RuntimeError):
    """A job met a fault of the program. `log` holds the traceback."""

    def __init__(self, message: str, log: Path) -> None:
        super().__init__(message)
        self.log = log


class JobDiedError(JobError):
    """A job ended without a word: killed, or crashed in native code. Trying again may help."""


class CancelledError(RuntimeError):
    """The jobs are being ended; the message says why."""


@dataclass(frozen=True)
class Done:
    """What a job left."""

    value: Any
    """What it returned, as plain values"""
    peak_memory_bytes: int
    cpu_seconds: float
    """Of all its threads, and of the processes that it started and waited for"""
    cpu: str
    """Processor and instructions, see `packuv.kernels.simd.cpu_description`"""


class Jobs:
    """Starts jobs and can end them all; safe to use from several threads."""

    def __init__(self, *, threads: int, memory_bytes: int = USUAL_BYTES) -> None:
        self.threads = threads
        """Threads that each job may use"""
        self.memory_bytes = memory_bytes
        """For what each job could make again, see `packuv.budget`"""
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._cancelled = ""

    def run(
        self,
        job: Job,
        *,
        folder: Path,
        progress: Progress = no_progress,
        keep_open: Sequence[int] = (),
        check: Callable[[], None] = lambda: None,
    ) -> Done:
        """Call the job in a process of its own, with whom to tell, and wait for it.

        The job is pickled, so what it refers to must be importable by name. It returns plain values. `folder` receives
        spec.json, job.pickle and job.log. The process inherits the descriptors in `keep_open`. `check` is called twice
        a second; what it raises ends the job, and is raised here.

        Raises what the job raised if that is ValueError, OSError or MemoryError (a subclass counts as these), JobError
        for any other exception, JobDiedError if the process ended without a word, CancelledError after `cancel`.
        """
        end_leftovers(folder)
        spec = folder / "spec.json"
        (folder / JOB_FILE).write_bytes(pickle.dumps(job))
        reader, writer = os.pipe()
        with open(reader, "rb", buffering=0) as messages:
            try:
                spec.write_text(json.dumps({"job": repr(job), "parent": os.getpid(), "pipe": writer}, indent=1))
                process = self._start(spec, folder / "job.log", [writer, *keep_open])
            finally:
                os.close(writer)
            with self._watched(process):
                last = _follow(messages, progress, check)
                process.wait()
        return self._outcome(last, process.returncode, job, folder / "job.log")

    def cancel(self, reason: str = "ended by the user") -> None:
        """End all jobs and let no new one start; the first reason counts."""
        with self._lock:
            self._cancelled = self._cancelled or reason
            for process in self._running:
                _kill(process)

    def check(self) -> None:
        """Raise CancelledError after `cancel`."""
        if self._cancelled:
            raise CancelledError(f"{self._cancelled}; the same command goes on from here")

    def _start(self, spec: Path, log: Path, descriptors: Sequence[int]) -> subprocess.Popen[bytes]:
        self.check()
        threads = {name: str(self.threads) for name in THREAD_VARIABLES}
        mark = {MARK: str(spec.parent.absolute())}
        with open(log, "ab") as output:
            return subprocess.Popen(
                # -P: a folder named tasks where the user stands must not win over ours
                [sys.executable, "-P", "-m", "tasks.artefacts.jobs", str(spec)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env={**os.environ, **threads, **ONE_BLAS_THREAD, **mark},
                start_new_session=True,
                pass_fds=descriptors,
            )

    @contextlib.contextmanager
    def _watched(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        with self._lock:
            self._running.add(process)
            if self._cancelled:
                _kill(process)
        try:
            yield
        finally:
            with self._lock:
                self._running.discard(process)
                if process.poll() is None:  # this thread was interrupted
                    _kill(process)
            process.wait()

    def _outcome(self, last: Mapping[str, Any] | None, code: int, job: Job, log: Path) -> Done:
        self.check()
        if last is None:
            _blame_disk(log.parent)
            raise JobDiedError(
                f"the job {job} ended without a result ({_described(code)}); its output is in {log}", log
            )
        if "error" in last:
            error = raised(last["error"], log)
            if isinstance(error, JobError) or (type(error) is OSError and not error.errno):
                _blame_disk(log.parent)
            raise error
        return Done(last["result"], last["peak_memory_bytes"], last["cpu_seconds"], last["cpu"])


def _follow(messages: BinaryIO, progress: Progress, check: Callable[[], None]) -> dict[str, Any] | None:
    """Pass progress on until the job closes its end; its last word, or None."""
    last = None
    for line in _lines(messages, check):
        with contextlib.suppress(ValueError):  # a line cut short by a kill
            message = json.loads(line)
            if "done" in message:
                progress(message["done"], message["total"], message["note"])
            else:
                last = message
    return last


def _lines(messages: BinaryIO, check: Callable[[], None]) -> Iterator[bytes]:
    """What comes through an unbuffered pipe; while nothing does, and between, `check` is called now and then."""
    rest, due = b"", time.monotonic() + CHECK_SECONDS
    while True:
        if time.monotonic() >= due:
            check()
            due = time.monotonic() + CHECK_SECONDS
        if not _readable(messages):
            continue
        if not (found := messages.read(PIPE_BYTES)):
            yield rest
            return
        *lines, rest = (rest + found).split(b"\n")
        yield from lines


def _readable(messages: BinaryIO) -> bool:
    """Whether something is there, or comes soon; `select` takes no descriptor beyond 1023."""
    poll = select.poll()
    poll.register(messages.fileno(), select.POLLIN)
    return bool(poll.poll(1000 * CHECK_SECONDS))


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End the job and what it started: it leads a session, and so a process group, of its own."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def end_leftovers(folder: Path) -> None:
    """End processes that an earlier job in this folder, or in one in it, started and that outlived it, as after a
    kill -9.

    Linux only, and on this machine. The caller knows that no job that is still wanted works there.
    """
    mark = os.fsencode(f"{MARK}={folder.absolute()}")
    for environment in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # ended meanwhile, or somebody else's
            words = environment.read_bytes().split(b"\0")
            if any(word == mark or word.startswith(mark + b"/") for word in words):
                os.kill(int(environment.parent.name), signal.SIGKILL)


def _described(code: int) -> str:
    if code == -signal.SIGKILL:
        return "killed by signal 9, as happens when memory runs out"
    return f"killed by signal {-code}" if code < 0 else f"exit code {code}"


def _blame_disk(folder: Path) -> None:
    """Raise OSError (no space) where the disk is full: libraries hide it, and a mapped file dies of it by SIGBUS."""
    if shutil.disk_usage(folder).free < FULL_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def raised(error: Mapping[str, Any], log: Path) -> Exception:
    """What `told` told, of a kind that callers know; else a JobError."""
    for kind in RAISED_AS:
        if kind.__name__ in error["kinds"]:
            found = kind(error["message"])
            if isinstance(found, OSError) and error["errno"] is not None:  # without a number its text is the message
                found.errno, found.strerror, found.filename = error["errno"], error["strerror"], error["filename"]
            found.add_note(f"the job's own traceback is in {log}")
            return found
    return JobError(f"{error['kinds'][0]}: {error['message']}; the traceback is in {log}", log)


def main(argv: Sequence[str]) -> int:
    """Run the job that a spec file describes; 0 if it delivered a result or an exception."""
    spec = json.loads(Path(argv[0]).read_text())
    die_with_parent(spec["parent"])
    os.set_inheritable(spec["pipe"], False)
    with open(spec["pipe"], "w", buffering=1) as pipe:
        pipe.write(json.dumps(_result(Path(argv[0]).with_name(JOB_FILE), _reporter(pipe))) + "\n")
    return 0


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when the thread that started it ends; `parent` is that thread's process.

    Linux only; elsewhere a job outlives a kill -9 of its parent, but holds its artefact's lock as long as it lives.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the kernel knew
        os._exit(1)


def _reporter(pipe: Any) -> Progress:
    lock = threading.Lock()

    def progress(done: float, total: float, note: str = "") -> None:
        with lock:
            pipe.write(json.dumps({"done": float(done), "total": float(total), "note": note}) + "\n")

    return progress


def _result(job: Path, progress: Progress) -> dict[str, Any]:
    from packuv.kernels.simd import (
        cpu_description,  # here, since it loads the compiler, which those who start jobs lack
    )

    try:
        value = pickle.loads(job.read_bytes())(progress)
        return {
            "result": plain(value, where="result"),
            "peak_memory_bytes": peak_memory_bytes(),
            "cpu_seconds": round(sum(os.times()[:4]), 3),  # own and children's, in the program and in the system
            "cpu": cpu_description(),
        }
    except Exception as error:
        with contextlib.suppress(OSError):  # a full disk has no room for the log either
            traceback.print_exc()
        return {"error": told(error)}


def told(error: Exception) -> dict[str, Any]:
    """An exception as plain values, which `raised` takes back."""
    system = error if isinstance(error, OSError) else OSError()
    return {
        "kinds": [kind.__name__ for kind in type(error).__mro__],
        "message": _message(error),
        "errno": system.errno,
        "strerror": system.strerror,
        "filename": None if system.filename is None else str(system.filename),
    }


def _message(error: Exception) -> str:
    """What was said; KeyError would show it in quotes."""
    return str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
