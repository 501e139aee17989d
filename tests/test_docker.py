"""docker/: what the files promise; tests/pipelines/test_pool.py runs the commands of compose.yaml as processes."""

from __future__ import annotations

import re

import pytest

from packuv import __version__
from tests.support.compose import read, service
from tests.support.places import ROOT

DOCKERFILE = (ROOT / "docker" / "Dockerfile").read_text()
SERVICES = {"postgres", "server", "worker", "worker-gpu", "packuv"}


def test_every_service_is_pinned_checked_and_not_root():
    parsed = read()
    assert set(parsed["services"]) == SERVICES
    for name, one in parsed["services"].items():
        tag = one["image"].partition(":")[2]
        assert tag, name
        assert tag != "latest", name
        assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", one["user"]), f"{name} must not run as root"
        assert not one.get("privileged"), name
        check = one["healthcheck"]
        assert check.get("disable") or {"test", "interval", "timeout", "retries"} <= set(check), name
        assert "curl" not in str(check), name
        if one["image"].startswith("packuv:"):
            assert one["image"].startswith(f"packuv:{__version__}-"), name
            assert f"AS {one['build']['target']}\n" in DOCKERFILE


def test_volumes_are_declared_and_runs_are_shared():
    parsed = read()
    named = {
        volume.partition(":")[0]
        for one in parsed["services"].values()
        for volume in one.get("volumes", [])
        if not volume.startswith((".", "/"))
    }
    assert named == set(parsed["volumes"])
    for name in ("worker", "worker-gpu", "packuv"):
        inside = {volume.split(":")[1] for volume in parsed["services"][name]["volumes"]}
        assert inside == {"/captures", "/runs", "/var/cache/packuv"}


def test_whoever_needs_another_service_waits_until_it_is_healthy():
    parsed = read()["services"]
    waits = {name: set(one.get("depends_on", {})) for name, one in parsed.items()}
    assert waits == {"postgres": set(), "server": {"postgres"}} | {
        name: {"server"} for name in SERVICES - {"postgres", "server"}
    }
    assert all(
        how == {"condition": "service_healthy"} for one in parsed.values() for how in one.get("depends_on", {}).values()
    )


def test_the_pool_of_the_batch_is_that_of_the_workers():
    def pool(name: str) -> str:
        words = service(name).command
        return words[words.index("--pool") + 1]

    assert pool("packuv") == pool("worker") == "packuv"


def test_the_database_takes_all_connections_that_the_server_opens():
    (most,) = [int(word.partition("=")[2]) for word in service("postgres").command if "max_connections" in word]
    settings = service("server").environment
    opened = [int(settings[f"PREFECT_SERVER_DATABASE_SQLALCHEMY_{name}"]) for name in ("POOL_SIZE", "MAX_OVERFLOW")]
    assert sum(opened) < most - 10


@pytest.mark.parametrize("target", ["cpu", "gpu"])
def test_each_image_runs_as_a_user_and_says_how_it_is(target):
    stage = re.search(rf"^FROM base AS {target}$(.*?)(?=^FROM |\Z)", DOCKERFILE, re.DOTALL | re.MULTILINE)
    assert stage is not None
    assert stage[1].rstrip().endswith("USER 1000:1000")
    assert 'HEALTHCHECK --interval=10m --timeout=2m --start-period=2m CMD ["packuv", "doctor"]' in DOCKERFILE
    assert ":latest" not in DOCKERFILE


def test_the_context_leaves_out_what_no_image_needs():
    left_out = (ROOT / ".dockerignore").read_text().split()
    assert {".*", "runs", "tests", "**/__pycache__"} <= set(left_out)
