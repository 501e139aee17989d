"""The server of the workflow engine: the user's own, that of `packuv serve`, or one that a run brings along.

Prefect can start a server for a run itself, but that one outlives a kill -9 of the run, gives up after 20 seconds on a
busy machine, and prints tracebacks when it stops. This one dies with the run by the kernel's hand, is waited for as
long as it takes, and writes to a log file. It has the dashboard, and hands out the reports under it. Run as
`python -m pipelines.server PARENT SOCKET OUT`.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import socket
import sqlite3
import subprocess
import sys
import tomllib
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

from packuv.partial import partial_path
from tasks.artefacts.jobs import die_with_parent
from tasks.artefacts.recipe import write_json
from tasks.artefacts.store import try_lock

START_SECONDS = 300
ANSWER_SECONDS = 60
"""For a server that was there before to answer"""
DATABASE = "prefect.db"
DATABASE_VARIABLE = "PREFECT_SERVER_DATABASE_CONNECTION_URL"
MEMORY = Path("/dev/shm")
RESULTS = "/results"
"""Path under which our servers hand out the output folder"""
RESULTS_VARIABLE = "PACKUV_RESULTS"
"""Environment variable: URL and folder of what our server hands out, with a blank between them"""

QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
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
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
}
"""Defaults of every run; a variable that the user has set wins"""

EMBEDDED = {
    "PREFECT__SERVER_EPHEMERAL": "1",  # nothing is scheduled and nothing is late: no services for that
    "PREFECT__SERVER_FINAL": "1",
}
"""Defaults where the run brings its own server"""


@dataclass(frozen=True)
class Server:
    """A workflow server that is running or about to."""

    address: str
    """URL of its API"""
    log: Path | None = None
    """What it says; None for a server that was there before"""
    process: subprocess.Popen[bytes] | None = None
    """Likewise"""
    fresh: Path | None = None
    """Its database, where that had to be set up"""

    @property
    def dashboard(self) -> str:
        """URL for a browser."""
        return self.address.removesuffix("/api")

    def wait_ready(self) -> None:
        """Return when the server answers; raises RuntimeError that says where to look if it does not."""
        try:
            patience = START_SECONDS if self.process else ANSWER_SECONDS
            with urllib.request.urlopen(f"{self.address}/health", timeout=patience) as answer:
                answer.read()
        except (urllib.error.URLError, OSError) as problem:
            where = f"; see {self.log}" if self.log else " (PREFECT_API_URL)"
            raise RuntimeError(f"no workflow server at {self.address}{where}: {problem}; --direct needs none") from None
        if self.fresh:
            _keep_empty(self.fresh)

    def died(self) -> bool:
        """Whether a server that the run brought along has ended."""
        return self.process is not None and self.process.poll() is not None


@contextlib.contextmanager
def workflow_server(out: Path) -> Iterator[Server]:
    """Have Prefect's settings in the environment and its server running, or starting.

    Enter before anything imports prefect. A server that the user names, in PREFECT_API_URL or in Prefect's profile, is
    taken as it is, then that of a `packuv serve` for this output folder. Else one is started that keeps its log in
    PREFECT_HOME or, without that, under `out`/.prefect, and its database in memory, for that is of no use afterwards.
    """
    with override(QUIET, keep=True):
        if named := named_server():
            with override({"PREFECT_API_URL": named.address}):
                yield named
            return
        if served := find_served(out):
            with override({"PREFECT_API_URL": served, **_results(served, out)}):
                yield Server(served)
            return
        with (
            _home(out) as (home, lock),
            _passing(home) as database,
            running_server(home, lock, out, database=database, settings=EMBEDDED) as server,
        ):
            yield server


@contextlib.contextmanager
def running_server(
    home: Path,
    lock: BinaryIO,
    out: Path,
    *,
    database: Path | None,
    settings: Mapping[str, str],
    host: str = "127.0.0.1",
    port: int = 0,
) -> Iterator[Server]:
    """Have a server that dies with this process; raises OSError for a port in use.

    Without a database it uses the one that the user names.
    """
    fresh, log = database and _take_empty(database), home / "server.log"
    if database:
        settings = {**settings, DATABASE_VARIABLE: f"sqlite+aiosqlite:///{database}"}
    # The kernel queues what comes before the server accepts, and refuses what comes after the server has died.
    with socket.create_server((host, port)) as listener, open(log, "wb") as output:
        address = f"http://{host}:{listener.getsockname()[1]}/api"
        ours = {"PREFECT_HOME": str(home), "PREFECT_API_URL": address, "PREFECT_UI_API_URL": address}
        with override({**settings, **_results(address, out)}, keep=True), override(ours):
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__, str(os.getpid()), str(listener.fileno()), str(out.absolute())],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,  # Ctrl-C is for the run, which then ends the server
                pass_fds=[listener.fileno(), lock.fileno()],
            )
            listener.close()
            try:
                yield Server(address, log, process, database if fresh else None)
            finally:
                process.kill()  # nothing in its database is needed again, and its own shutdown takes seconds
                process.wait()


def named_server() -> Server | None:
    """The server that the user names, in PREFECT_API_URL or in Prefect's profile."""
    address = os.environ.get("PREFECT_API_URL") or _profile_address()
    return Server(address.rstrip("/")) if address else None


def brings_server(out: Path) -> bool:
    """Whether a run into this folder has no server to tell, and would start one."""
    return named_server() is None and find_served(out) is None


def results_url(path: Path) -> str:
    """A link to a file of results that a dashboard can show: by our server, where it hands out that folder."""
    url, _, root = os.environ.get(RESULTS_VARIABLE, "").partition(" ")
    if root and path.is_relative_to(root):
        return f"{url}/{urllib.request.pathname2url(str(path.relative_to(root)))}"
    return path.as_uri()


def _results(address: str, out: Path) -> dict[str, str]:
    return {RESULTS_VARIABLE: f"{address.removesuffix('/api')}{RESULTS} {out.absolute()}"}


@contextlib.contextmanager
def serving(out: Path, address: str) -> Iterator[None]:
    """Have runs under this output folder find the server; raises ValueError where another one serves it."""
    place = out.absolute() / ".prefect"
    place.mkdir(parents=True, exist_ok=True)
    with open(place / "serving.lock", "ab") as lock:
        if not try_lock(lock.fileno()):
            raise ValueError(f"a packuv serve for {out} is running already: {find_served(out)}; end that one first")
        write_json(place / "serving.json", {"api": address})
        try:
            yield
        finally:
            (place / "serving.json").unlink(missing_ok=True)


def find_served(out: Path) -> str | None:
    """URL of the API of the `packuv serve` for this output folder, or None where none runs."""
    place = out.absolute() / ".prefect"
    with contextlib.suppress(OSError, ValueError), open(place / "serving.lock", "rb") as lock:
        if not try_lock(lock.fileno(), shared=True):
            return str(json.loads((place / "serving.json").read_text())["api"])
    return None


def _profile_address() -> str | None:
    """PREFECT_API_URL of the profile that Prefect would use."""
    home = Path(os.environ.get("PREFECT_HOME", "~/.prefect")).expanduser()
    path = Path(os.environ.get("PREFECT_PROFILES_PATH", home / "profiles.toml")).expanduser()
    with contextlib.suppress(OSError, tomllib.TOMLDecodeError, UnicodeDecodeError):
        profiles = tomllib.loads(path.read_text())
        name = os.environ.get("PREFECT_PROFILE", profiles.get("active"))
        address = profiles.get("profiles", {}).get(name, {}).get("PREFECT_API_URL")
        return str(address) if address else None
    return None


@contextlib.contextmanager
def override(values: Mapping[str, str], *, keep: bool = False) -> Iterator[None]:
    """Set environment variables, with `keep` only those that are not set; undo it afterwards."""
    values = {name: value for name, value in values.items() if not keep or name not in os.environ}
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextlib.contextmanager
def own_home(out: Path, name: str) -> Iterator[tuple[Path, BinaryIO]]:
    """The one folder of a server that stays; raises ValueError where it is in use."""
    home = out.absolute() / ".prefect" / name
    home.mkdir(parents=True, exist_ok=True)
    with open(home / "in_use.lock", "ab") as lock:
        if not try_lock(lock.fileno()):
            raise ValueError(f"{home} is in use: a packuv serve for {out} is running already; end that one first")
        yield home, lock


@contextlib.contextmanager
def _home(out: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """The first folder that no other run uses: two servers on one SQLite file get in each other's way."""
    for home in _homes(out):
        home.mkdir(parents=True, exist_ok=True)
        with open(home / "in_use.lock", "ab") as lock:
            if try_lock(lock.fileno()):
                yield home, lock
                return


def _homes(out: Path) -> Iterator[Path]:
    base = out.absolute() / ".prefect"
    if "PREFECT_HOME" in os.environ:
        base = Path(os.environ["PREFECT_HOME"]).absolute()
        yield base
    yield from (base / str(number) for number in itertools.count())


@contextlib.contextmanager
def _passing(home: Path) -> Iterator[Path | None]:
    """A database that goes with the run, in memory where the system has a place for that: a full disk is no matter of
    the engine. Its name follows from the folder, so that what a killed run left is taken away by the next one. None
    where the user names a database."""
    if DATABASE_VARIABLE in os.environ:
        yield None
        return
    name = hashlib.sha256(f"{os.getuid()} {home}".encode()).hexdigest()[:16]
    path = MEMORY / f"packuv-{name}.db" if os.access(MEMORY, os.W_OK) else home / DATABASE
    _remove(path)
    try:
        yield path
    finally:
        _remove(path)


def _remove(database: Path) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        with contextlib.suppress(OSError):
            database.with_name(f"{database.name}{suffix}").unlink()


def _template() -> Path:
    """An empty database of this version of the engine, which takes seconds to set up."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
    return cache / "packuv" / f"prefect-{version('prefect')}.db"


def _take_empty(database: Path) -> bool:
    """Start a database that is not there with the empty one; whether there was none."""
    if database.exists():
        return False
    try:
        empty = _template().read_bytes()
    except OSError:
        return True
    with open(os.open(database, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(empty)
    return False


def _keep_empty(database: Path) -> None:
    """Keep a new database, without what runs may have put there, for the next folder."""
    with contextlib.suppress(OSError, sqlite3.Error):
        template = _template()
        template.parent.mkdir(parents=True, exist_ok=True)
        part = partial_path(template)
        part.unlink(missing_ok=True)
        with contextlib.closing(sqlite3.connect(database)) as source, contextlib.closing(sqlite3.connect(part)) as copy:
            source.backup(copy)
            for (table,) in copy.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
                if table != "alembic_version" and not table.startswith("sqlite_"):
                    copy.execute(f'DELETE FROM "{table}"')
            copy.commit()
        os.replace(part, template)


def main(parent: int, descriptor: int, out: Path) -> None:
    """Serve Prefect's API, its dashboard and the results on a listening socket that the parent made."""
    die_with_parent(parent)
    import uvicorn
    from prefect.server.api.server import create_app, create_ui_app
    from starlette.routing import Mount
    from starlette.staticfiles import StaticFiles

    app = create_app()
    app.router.routes.insert(0, Mount(RESULTS, StaticFiles(directory=out, html=True, check_dir=False)))
    app.router.routes[-1] = Mount("/", create_ui_app(ephemeral=False))  # an ephemeral server would have none
    config = uvicorn.Config(app, log_level="error", lifespan="on")
    uvicorn.Server(config).run(sockets=[socket.socket(fileno=descriptor)])


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
