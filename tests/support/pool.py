"""PostgreSQL, the workflow server and workers of docker/compose.yaml as processes on this machine."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numba
import pytest

from packuv.kernels import compile as kernels
from tests.support.compose import Service, own_environment, service
from tests.support.needs import needs
from tests.support.places import ROOT

BIN = str(Path(sys.executable).parent)
POSTGRES = next((str(path.parent) for path in sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))), None)
POSTGRES = POSTGRES or (shutil.which("initdb") and str(Path(str(shutil.which("initdb"))).parent))
needs_postgres = needs("postgres", POSTGRES, "no initdb, which the package postgresql brings")
OWNER = "postgres" if os.getuid() == 0 else None
"""PostgreSQL refuses to run as root"""


def wait_for(what: Callable[[], Any], seconds: float = 300) -> Any:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := what():
            return found
        time.sleep(0.5)
    pytest.fail(f"waited {seconds} s for {what}")


@dataclass
class Worker:
    """One process worker, with a home and a kernel cache of its own."""

    process: subprocess.Popen[bytes]
    home: Path


@dataclass
class Cluster:
    """What runs."""

    folder: Path
    places: dict[str, str]
    workers: list[Worker] = field(default_factory=list)

    @property
    def api(self) -> str:
        return f"http://{self.places['server:4200']}/api"

    @property
    def client(self) -> dict[str, str]:
        """Environment of a command on some other machine."""
        home = self.folder / "client"
        home.mkdir(exist_ok=True)
        given = service("packuv").placed(self.places)
        return own_environment([BIN], **{**given.environment, "HOME": str(home), "PYTHONPATH": str(ROOT)})

    def add_worker(self) -> Worker:
        home = self.folder / f"worker{len(self.workers)}"
        home.mkdir()
        _copy_kernels(home / "numba")
        given = service("worker").placed({**self.places, "8080": str(_free_port())})
        own = {"HOME": str(home), "NUMBA_CACHE_DIR": str(home / "numba"), "PYTHONPATH": str(ROOT)}
        worker = Worker(_start(given, home, own_environment([BIN], **{**given.environment, **own})), home)
        self.workers.append(worker)
        wait_for(lambda: _is_healthy(given, worker.process, home))
        return worker


@contextlib.contextmanager
def running_cluster() -> Iterator[Cluster]:
    """A server with its database; workers are the caller's to add. All are gone afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="packuv-pool-"))  # not below pytest's own, which only its user may enter
    folder.chmod(0o755)
    database, port = f"127.0.0.1:{_free_port()}", _free_port()
    places = {
        "postgres:5432": database,
        "5432": database.partition(":")[2],
        "server:4200": f"127.0.0.1:{port}",
        "4200": str(port),
        "0.0.0.0": "127.0.0.1",
    }
    cluster = Cluster(folder, places)
    with contextlib.ExitStack() as ends:
        ends.callback(shutil.rmtree, folder, ignore_errors=True)
        ends.callback(lambda: [_end(worker.process) for worker in cluster.workers])
        _start_postgres(folder / "postgres", service("postgres").placed(places), ends)
        home = folder / "server"
        home.mkdir()
        given = service("server").placed(places)
        process = _start(given, home, own_environment([BIN], **{**given.environment, "HOME": str(home)}))
        ends.callback(_end, process)
        wait_for(lambda: _is_healthy(given, process, home))
        yield cluster


def _start_postgres(folder: Path, given: Service, ends: contextlib.ExitStack) -> None:
    """As the image's entry point does it: set up, then the command."""
    assert POSTGRES is not None
    folder.mkdir()
    if OWNER:
        shutil.chown(folder, OWNER, OWNER)
    environment = own_environment([POSTGRES], PGPASSWORD=given.environment["POSTGRES_PASSWORD"])
    password = folder.with_name("password")
    password.write_text(given.environment["POSTGRES_PASSWORD"])
    user, port = given.environment["POSTGRES_USER"], given.health[given.health.index("-p") + 1]
    data = folder / "data"
    set_up = ["initdb", "-D", str(data), "-U", user, "--auth=scram-sha-256", f"--pwfile={password}", "--no-sync"]
    place = {"user": OWNER, "group": OWNER, "env": environment, "cwd": folder}
    subprocess.run(set_up, check=True, stdout=subprocess.DEVNULL, **place)
    here = ["-D", str(data), "-p", port, "-h", "127.0.0.1", "-k", str(folder)]
    with open(folder.with_name("postgres.log"), "wb") as log:
        process = subprocess.Popen([*given.command, *here], stdout=log, stderr=log, **place)
    ends.callback(process.wait)
    ends.callback(process.send_signal, signal.SIGINT)  # its fast way to shut down
    wait_for(lambda: subprocess.run(given.health, env=environment, stdout=subprocess.DEVNULL).returncode == 0)
    name = given.environment["POSTGRES_DB"]
    subprocess.run(
        ["createdb", "-h", "127.0.0.1", "-p", port, "-U", user, name], check=True, env=environment, cwd=folder
    )


def _start(given: Service, home: Path, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    with open(home / "log", "wb") as log:
        return subprocess.Popen(
            given.command, env=environment, cwd=home, stdin=subprocess.DEVNULL, stdout=log, stderr=log
        )


def _is_healthy(given: Service, process: subprocess.Popen[bytes], home: Path) -> bool:
    assert process.poll() is None, (home / "log").read_text()
    return subprocess.run(given.health, env=own_environment([BIN]), capture_output=True).returncode == 0


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()  # asked gently, it may take minutes
    process.wait()


def _copy_kernels(folder: Path) -> None:
    """What this session has compiled, as far as it has."""
    for compiled in Path(numba.config.CACHE_DIR or kernels._cache_root()).glob("kernels-*"):
        shutil.copytree(compiled, folder / compiled.name)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
        return port
