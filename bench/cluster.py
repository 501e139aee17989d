"""A cluster on one machine: a scheduler and workers in processes of their own, each at an address of its own."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

START_SECONDS = 120.0


@dataclass
class LocalCluster:
    """Processes that end with the block."""

    folder: Path
    """For logs, and what workers keep for themselves"""
    cores: int = 1
    """Of each worker"""
    memory_gb: float = 4.0
    environment: Mapping[str, str] = field(default_factory=dict)
    """Beside that of this process"""
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)
    address: str = ""
    scheduler: subprocess.Popen[bytes] = field(init=False)

    def __enter__(self) -> LocalCluster:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.start_scheduler()
        return self

    def __exit__(self, *_: object) -> None:
        every = [*self.workers, self.scheduler]
        for process in every:
            process.terminate()
        for process in every:
            end(process)

    def start_scheduler(self) -> None:
        """A new one, which knows nothing, at the address of the last one."""
        if self.address:
            end(self.scheduler)
        port = self.address.rpartition(":")[2] or "0"
        told = self.folder / "scheduler.json"
        told.unlink(missing_ok=True)
        words = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"]
        self.scheduler = self._start("scheduler", [*words, "--dashboard-address", ":0", "--scheduler-file", str(told)])
        deadline = time.monotonic() + START_SECONDS
        while not self.address or not told.exists():
            with contextlib.suppress(OSError, ValueError):
                self.address = json.loads(told.read_text())["address"]
            if time.monotonic() > deadline or self.scheduler.poll() is not None:
                raise RuntimeError(f"the scheduler does not start; see {self.folder / 'scheduler.log'}")
            time.sleep(0.1)

    def start_worker(self) -> subprocess.Popen[bytes]:
        """One more, with a home and a cache of kernels of its own unless the environment names one."""
        number = len(self.workers) + 2
        name = f"worker{number}"
        home = self.folder / name
        home.mkdir(exist_ok=True)
        own = {"HOME": str(home), "NUMBA_CACHE_DIR": str(home / "kernels"), **self.environment}
        words = ["-m", "pipelines.cli", "worker", self.address, "--host", f"127.0.0.{number}"]
        words += ["--cores", str(self.cores), "--memory-gb", str(self.memory_gb)]
        self.workers.append(self._start(name, words, own))
        return self.workers[-1]

    def await_workers(self) -> None:
        """Until all of them have said that they are ready."""
        deadline = time.monotonic() + START_SECONDS
        for number in range(2, len(self.workers) + 2):
            log = self.folder / f"worker{number}.log"
            while b" offers " not in log.read_bytes():
                if time.monotonic() > deadline:
                    raise RuntimeError(f"the worker does not start; see {log}")
                time.sleep(0.1)

    def _start(self, name: str, words: list[str], own: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
        with open(self.folder / f"{name}.log", "wb") as log:
            command = [sys.executable, *words]
            return subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **(own or {})})


def end(process: subprocess.Popen[bytes]) -> None:
    """In peace, or by force."""
    process.terminate()
    try:
        process.wait(15)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def cpu_seconds(process: subprocess.Popen[bytes]) -> tuple[float, float]:
    """Of a process itself, and of its children that ended."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    tick = os.sysconf("SC_CLK_TCK")
    own, children = (sum(map(int, fields[at : at + 2])) / tick for at in (11, 13))
    return own, children


@contextlib.contextmanager
def local_cluster(folder: Path, workers: int, **settings: object) -> Iterator[LocalCluster]:
    """A scheduler with so many workers, all ready."""
    with LocalCluster(folder, **settings) as cluster:  # type: ignore[arg-type]  # they are its fields
        for _ in range(workers):
            cluster.start_worker()
        cluster.await_workers()
        yield cluster
