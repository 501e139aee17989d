"""The workflow server that a run brings along: local, quiet, offline, and gone when the run is.

Prefect can start such a server itself, but that one outlives a kill -9 of the run, gives up after 20 seconds on a
busy machine, and prints tracebacks when it stops. This one dies with the run by the kernel's hand, is waited for as
long as it takes, and writes to a log file. Run as `python -m pipelines.server PARENT SOCKET`.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from tasks.artefacts.jobs import die_with_parent
from tasks.artefacts.store import try_lock

START_SECONDS = 300
HOMES = 16
"""Most runs under one output folder at a time, each with a server of its own"""

QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",  # the run reports its failures itself, once
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",  # or it says that the server is gone, which the run has ended
    "PREFECT_SERVER_LOGGING_LEVEL": "WARNING",  # into the server's log file
    "PREFECT_CLI_COLORS": "false",
    # Slow machines and shared disks: wait rather than fail.
    "PREFECT_CLIENT_MAX_RETRIES": "20",
    "PREFECT_API_REQUEST_TIMEOUT": "120",
    "PREFECT_SERVER_DATABASE_TIMEOUT": "60",
    "PREFECT_SERVER_DATABASE_CONNECTION_TIMEOUT": "60",
    "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": str(START_SECONDS),
    "PREFECT_EVENTS_WORKER_MAX_QUEUE_SIZE": "10000",
}
"""Defaults of every run; a variable that the user has set wins"""

EMBEDDED = {
    "PREFECT_LOGGING_TO_API_ENABLED": "false",  # no dashboard shows them
    "PREFECT_SERVER_UI_ENABLED": "false",
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    "PREFECT_SERVER_DATABASE_CONNECTION_URL": "sqlite+aiosqlite:///:memory:",  # a full disk is no matter of the engine
    "PREFECT__SERVER_EPHEMERAL": "1",
    "PREFECT__SERVER_FINAL": "1",
}
"""Defaults where the run brings its own server"""


@dataclass(frozen=True)
class Server:
    """A workflow server that is running or about to."""

    address: str
    """URL of its API"""
    log: Path | None
    """What it says; None for a server that was there before"""

    def wait_ready(self) -> None:
        """Return when the server answers; raises RuntimeError that says where to look if it does not."""
        try:
            with urllib.request.urlopen(f"{self.address}/health", timeout=START_SECONDS) as answer:
                answer.read()
        except (urllib.error.URLError, OSError) as problem:
            where = f"; see {self.log}" if self.log else " (PREFECT_API_URL)"
            raise RuntimeError(f"no workflow server at {self.address}{where}: {problem}; --direct needs none") from None


@contextlib.contextmanager
def workflow_server(out: Path) -> Iterator[Server]:
    """Have Prefect's settings in the environment and its server running, or starting.

    Enter before anything imports prefect. A server that the user names in PREFECT_API_URL is taken as it is; otherwise
    one is started that keeps its database in memory and its log in PREFECT_HOME or, without that, under `out`/.prefect.
    """
    with _environment(QUIET):
        if "PREFECT_API_URL" in os.environ:
            yield Server(os.environ["PREFECT_API_URL"].rstrip("/"), None)
            return
        with _home(out) as (home, lock), _environment({**EMBEDDED, "PREFECT_HOME": str(home)}):
            log = home / "server.log"
            with _running(log, lock) as address, _environment({"PREFECT_API_URL": address}):
                yield Server(address, log)


@contextlib.contextmanager
def _environment(defaults: Mapping[str, str]) -> Iterator[None]:
    """Set variables that are not set; undo it afterwards."""
    added = {name: value for name, value in defaults.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextlib.contextmanager
def _home(out: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """The first folder that no other run uses: two servers would write over each other's log."""
    if "PREFECT_HOME" in os.environ:
        homes = [Path(os.environ["PREFECT_HOME"])]
    else:
        homes = [out.absolute() / ".prefect" / str(number) for number in range(HOMES)]
    for home in homes:
        home.mkdir(parents=True, exist_ok=True)
        with open(home / "in_use.lock", "ab") as lock:
            if try_lock(lock.fileno()):
                yield home, lock
                return
    raise RuntimeError(f"{len(homes)} packuv runs already use {homes[0].parent}; wait for one, or use --direct")


@contextlib.contextmanager
def _running(log: Path, lock: BinaryIO) -> Iterator[str]:
    # The kernel queues what comes before the server accepts, and refuses what comes after the server has died.
    with socket.create_server(("127.0.0.1", 0)) as listener, open(log, "wb") as output:
        port = listener.getsockname()[1]
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "pipelines.server", str(os.getpid()), str(listener.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,  # Ctrl-C is for the run, which then ends the server
            pass_fds=[listener.fileno(), lock.fileno()],
        )
    try:
        yield f"http://127.0.0.1:{port}/api"
    finally:
        process.kill()  # nothing in its database is needed again, and its own shutdown takes seconds
        process.wait()


def main(parent: int, descriptor: int) -> None:
    """Serve Prefect's API on a listening socket that the parent made."""
    die_with_parent(parent)
    import uvicorn
    from prefect.server.api.server import create_app

    config = uvicorn.Config(create_app, factory=True, log_level="error", lifespan="on")
    uvicorn.Server(config).run(sockets=[socket.socket(fileno=descriptor)])


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
