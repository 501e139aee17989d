"""Stages as Prefect tasks: what is retried, what is skipped, and that the server goes with the run."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from packuv.progress import no_progress
from pipelines.server import workflow_server
from tasks.artefacts.jobs import JobDiedError, JobError
from tasks.artefacts.stage import Notes, Site, Stage, Work
from tasks.artefacts.store import Building, Key, Store


@pytest.mark.parametrize(
    ("error", "retried"),
    [
        (ValueError("bad"), False),
        (FileNotFoundError("gone"), False),
        (PermissionError(13, "denied"), False),
        (OSError(28, "no space left"), False),
        (JobError("a bug", Path("log")), False),
        (TypeError("a bug"), False),
        (OSError(5, "input/output error"), True),
        (JobDiedError("killed", Path("log")), True),
        (MemoryError(), True),
    ],
)
def test_only_what_may_pass_is_retried(error, retried):
    from tasks.engine import may_pass

    assert may_pass(error) is retried


@pytest.mark.slow
def test_flow_skips_retries_and_gives_up(workflow, tmp_path, monkeypatch):
    from prefect import flow
    from prefect.task_runners import ThreadPoolTaskRunner

    from tasks import engine

    attempts: list[str] = []
    store = Store(tmp_path)
    monkeypatch.setattr(engine, "BACKOFF_SECONDS", 0.01)

    failing: dict[str, tuple[int, Exception]] = {}

    @dataclass(frozen=True, kw_only=True)
    class Flaky(Stage):
        """Fails as often as asked."""

        name, version = "flaky", 1
        call: str

        def build(self, work: Work) -> Notes:
            attempts.append(self.call)
            failures, error = failing[self.call]
            if attempts.count(self.call) <= failures:
                raise error
            return {}

    def make(stage: Stage) -> Key:
        def build(building: Building) -> None:
            stage.build(Work(Site(tmp_path, tmp_path, 1), building.out, building.scratch, no_progress))
            (building.out / "done").write_text("yes")

        return store.make(stage.name, stage.version, stage.settings, stage.sources, build)

    @flow(persist_result=False)
    def run(call: str, failures: int, error: Exception):
        failing[call] = failures, error
        with ThreadPoolTaskRunner(max_workers=1) as runner:
            future = engine.submitter(make, runner)(Flaky(call=call))
            future.wait()
        return future.state.name, future.state.result(raise_on_failure=False)

    hiccup = OSError(5, "input/output error")
    assert run("good", 0, hiccup) == ("Completed", store.key("flaky", 1, {"call": "good"}, {}))
    assert run("good", 0, hiccup)[0] == "Skipped"
    assert attempts == ["good"]
    assert run("flaky", 2, hiccup)[0] == "Completed"
    assert attempts.count("flaky") == 3
    with pytest.raises(OSError, match="input/output error"):
        raise run("hopeless", 9, hiccup)[1]
    assert attempts.count("hopeless") == 1 + engine.RETRIES
    with pytest.raises(ValueError, match="ends early"):
        raise run("wrong", 9, ValueError("the video ends early"))[1]
    assert attempts.count("wrong") == 1


HOLDS_SERVER = """
import sys, time
from pathlib import Path
from pipelines.server import workflow_server
with workflow_server(Path(sys.argv[1])) as server:
    print(server.address, flush=True)
    time.sleep(60)
"""


def _server_pids(parent: int) -> list[int]:
    """Processes whose parent is this one."""
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return [int(pid) for pid in children]


def test_server_dies_with_a_killed_run_and_its_folder_is_free_again(tmp_path, monkeypatch):
    for name in ("PREFECT_API_URL", "PREFECT_HOME"):  # the session's server may be running
        monkeypatch.delenv(name, raising=False)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS_SERVER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout.readline().startswith("http://127.0.0.1:")
        (server,) = _server_pids(run.pid)
        run.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        with contextlib.suppress(FileNotFoundError):
            if Path(f"/proc/{server}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                time.sleep(0.05)
                continue
        break
    else:
        os.kill(server, signal.SIGKILL)
        pytest.fail("the workflow server outlived its run")
    with workflow_server(tmp_path):
        for name in ("PREFECT_API_URL", "PREFECT_HOME"):
            monkeypatch.delenv(name)
        with workflow_server(tmp_path):
            homes = sorted(path.name for path in (tmp_path / ".prefect").iterdir())
    assert homes == ["0", "1"]  # the first one was free again; a second run beside it takes its own


def test_a_named_server_is_taken_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api/")
    monkeypatch.delenv("DO_NOT_TRACK", raising=False)
    with workflow_server(tmp_path) as server:
        assert server.address == "http://127.0.0.1:9/api"
        assert os.environ["DO_NOT_TRACK"] == "1"
        with pytest.raises(RuntimeError, match=r"no workflow server at .* \(PREFECT_API_URL\).*--direct needs none"):
            server.wait_ready()
    assert "DO_NOT_TRACK" not in os.environ
    assert not list(tmp_path.iterdir())
