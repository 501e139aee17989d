"""Runs that a dashboard, a script or a schedule starts: a real server, its form, a real worker; and how they end."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest

from pipelines.deploy import ServeOptions
from pipelines.register import find_runs
from tests.support.places import ROOT
from tests.support.pool import wait_for

CAPTURE = ROOT / "tests" / "golden" / "capture"
PREFECT = Path(sys.executable).with_name("prefect")
LONG = {"fit": {"iterations": 100_000, "start": {"count": 300}, "density": {"cap": 400}}}


def environment(**more: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT")}
    return {**kept, "PYTHONPATH": str(ROOT), **more}


class Api:
    """The server's API, as a script would call it."""

    def __init__(self, url: str) -> None:
        self.url = url

    def __call__(self, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.url}{path}", data, {"Content-Type": "application/json"})
        return wait_for(lambda: self._answer(request), seconds=60)[0]

    def _answer(self, request: urllib.request.Request) -> list[Any]:
        """Nothing from a busy server: its own clients ask again, too."""
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return [json.load(answer)]
        except urllib.error.HTTPError as error:
            if error.code != 503:
                raise
            return []

    def deployment(self, name: str) -> dict[str, Any]:
        (found,) = [item for item in self("/deployments/filter", {}) if item["name"] == name]
        return found

    def start(self, deployment: str, **request: Any) -> str:
        path = f"/deployments/{self.deployment(deployment)['id']}/create_flow_run"
        return self(path, {"parameters": {"request": request}})["id"]

    def run(self, run: str) -> dict[str, Any]:
        return self(f"/flow_runs/{run}")

    def ended(self, run: str) -> Callable[[], bool]:
        return lambda: self.run(run)["state"]["type"] in ("COMPLETED", "FAILED", "CANCELLED", "CRASHED")


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[tuple[Api, Path]]:
    """`packuv serve`, and its output folder."""
    out = tmp_path_factory.mktemp("served")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "pipelines.cli", "serve", "--out", str(out), "--port", str(port)]
    command += ["--preset", "draft", "--data", str(CAPTURE.parent), "--cron", "0 2 * * *"]
    command += ["--timezone", "Europe/Berlin"]
    log = out / "serve.log"
    with (
        open(log, "w") as output,
        subprocess.Popen(command, env=environment(), stdout=output, stderr=output) as process,
    ):
        api = Api(f"http://127.0.0.1:{port}/api")

        def ready() -> bool:
            assert process.poll() is None, log.read_text()
            try:
                return bool(api("/deployments/filter", {}))
            except OSError:
                return False

        wait_for(ready, seconds=180)
        yield api, out
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            raise


@pytest.mark.slow
def test_the_form_documents_every_field_and_refuses_what_is_wrong(served):
    api, out = served
    deployment = api.deployment("on-demand")
    form = deployment["parameter_openapi_schema"]["definitions"]["RunRequest"]
    assert list(deployment["parameter_openapi_schema"]["properties"]) == ["request"]
    assert deployment["parameters"]["request"] == {"out": str(out), "preset": "draft"}
    assert all(field.get("description") for field in form["properties"].values())
    assert form["properties"]["preset"]["enum"] == ["draft", "standard", "high"]
    assert form["required"] == ["capture", "out"]
    for wrong in ({"preset": "best"}, {"precet": "draft"}):
        with pytest.raises(urllib.error.HTTPError, match=r"409|422"):
            api.start("on-demand", capture=str(CAPTURE), out=str(out), **wrong)


@pytest.mark.slow
def test_json_starts_a_run_that_bears_its_name_and_leaves_its_tables(served):
    api, out = served
    run = api.start("on-demand", capture=str(CAPTURE), out=str(out), preset="draft", stop_after="sync")
    wait_for(api.ended(run), seconds=180)
    found = api.run(run)
    assert found["state"]["type"] == "COMPLETED", found["state"]["message"]
    name = json.loads((next(out.glob("*/run.json"))).read_text())["sequence"]
    assert found["name"] == f"{name} draft"
    assert {"packuv", f"seq:{name}", "preset:draft"} <= set(found["tags"])

    def shown() -> dict[str, str]:
        return {item["key"]: item["data"] for item in api("/artifacts/filter", {})}

    wait_for(lambda: {f"{name}-sync", f"{name}-summary"} <= set(shown()), seconds=30)  # a busy server takes them later
    assert "/results/" in shown()[f"{name}-summary"]
    with urllib.request.urlopen(f"{api.url.removesuffix('/api')}/results/{name}/report.html") as page:
        assert b"Synchronization" in page.read()

    def logged() -> bool:
        lines = api("/logs/filter", {"logs": {"flow_run_id": {"any_": [run]}}})
        return any(line["message"].startswith("sync: ") for line in lines)

    wait_for(logged, seconds=30)  # the last lines are sent when the process ends


@pytest.mark.slow
def test_cancel_on_the_dashboard_ends_the_work_within_seconds(served):
    api, out = served
    request = {"capture": str(CAPTURE), "out": str(out), "name": "cancelled", "preset": "draft", "settings": LONG}
    run = api.start("on-demand", **request)
    folder = out / "cancelled"

    def fitting() -> bool:
        stages = [stage.label for found in find_runs(folder) for stage in found.record.stages]
        return any(label.startswith("fit") for label in stages)

    wait_for(fitting, seconds=180)
    api(f"/flow_runs/{run}/set_state", {"state": {"type": "CANCELLING", "name": "Cancelling"}})
    wait_for(lambda: not [found for found in find_runs(folder) if found.alive], seconds=20)
    wait_for(api.ended(run), seconds=20)
    assert api.run(run)["state"]["type"] == "CANCELLED"
    assert json.loads((folder / "run.json").read_text())["outcome"] in ("cancelled", "stopped")
    assert not (folder / "scene.mkv").exists()


@pytest.mark.slow
def test_a_schedule_plans_runs_for_its_time(served):
    api, _ = served
    nightly = api.deployment("nightly")["id"]
    asked = {"flow_runs": {"deployment_id": {"any_": [nightly]}}}
    runs = wait_for(lambda: api("/flow_runs/filter", asked), seconds=90)
    assert {run["state"]["type"] for run in runs} == {"SCHEDULED"}
    times = [datetime.fromisoformat(run["expected_start_time"]).astimezone(ZoneInfo("Europe/Berlin")) for run in runs]
    assert {(time.hour, time.minute) for time in times} == {(2, 0)}


@pytest.mark.slow
def test_a_worker_runs_what_prefect_yaml_deploys(served, tmp_path):
    api, out = served
    settings = environment(PREFECT_API_URL=api.url, PREFECT_HOME=str(tmp_path), DO_NOT_TRACK="1")

    def prefect(*words: str) -> None:
        done = subprocess.run([PREFECT, *words], cwd=ROOT, env=settings, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr

    prefect("work-pool", "create", "packuv", "--type", "process")
    prefect("--no-prompt", "deploy", "--name", "from-yaml")
    with subprocess.Popen(
        [PREFECT, "worker", "start", "--pool", "packuv"],
        env=settings,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as worker:
        try:
            run = api.start("from-yaml", capture=str(CAPTURE), out=str(out), name="worked", stop_after="sync")
            wait_for(api.ended(run), seconds=180)
        finally:
            worker.kill()  # asked gently, it may take minutes
    assert api.run(run)["state"]["type"] == "COMPLETED"
    assert (out / "worked" / "report.html").is_file()


def test_a_schedule_needs_a_data_set_and_must_be_one(tmp_path):
    with pytest.raises(ValueError, match="a schedule needs a data set"):
        ServeOptions(out=tmp_path, cron="0 2 * * *")
    with pytest.raises(ValueError, match="cron"):
        ServeOptions(out=tmp_path, data=tmp_path, cron="at night")
