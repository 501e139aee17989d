"""What tests share: the real captures, where they are, and one workflow server per session."""

from __future__ import annotations

import os
from pathlib import Path
from signal import SIG_IGN, SIGHUP, SIGINT, getsignal, signal

import pytest

from tests.support.needs import need, need_data, promised
from tests.support.places import DATA


def pytest_configure(config: pytest.Config) -> None:
    """A misspelt promise must not pass for none; what tests start must hear signals, also in a session that does not.

    A session in the background or under nohup ignores them, and hands that on; handlers are not handed on.
    """
    for number in (SIGHUP, SIGINT):
        if getsignal(number) is SIG_IGN:
            signal(number, lambda *_: None)
    try:
        promised()
    except ValueError as error:
        raise pytest.UsageError(error) from None
    if config.pluginmanager.hasplugin("hypothesispytest"):  # not on a bare machine with a GPU
        _leave_properties_untimed()


def _leave_properties_untimed() -> None:
    """No test is right or wrong by how busy the machine is."""
    from hypothesis import settings

    settings.register_profile("untimed", deadline=None)
    settings.load_profile("untimed")


@pytest.hookimpl(tryfirst=True)  # before fixtures that only work where the need is met
def pytest_runtest_setup(item: pytest.Item) -> None:
    for mark in item.iter_markers("need"):
        need(*mark.args)


@pytest.fixture(autouse=True)
def schedule():
    """No test leaves real-time priority behind, in which all that is started later would starve the machine."""
    yield
    if hasattr(os, "sched_getscheduler"):  # Linux alone has it
        assert os.sched_getscheduler(0) == os.SCHED_OTHER, "an encoder changed how this process is scheduled"


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder with recorded captures; tests that need them skip where it is absent."""
    return need_data(DATA)


@pytest.fixture(scope="session")
def workflow(tmp_path_factory: pytest.TempPathFactory):
    """The embedded workflow server, started once; flows of the test process use it."""
    from pipelines.server import workflow_server

    with workflow_server(tmp_path_factory.mktemp("workflow")) as server:
        # Another test module may have imported Prefect, which then has read its settings already.
        from prefect.settings import PREFECT_API_URL, PREFECT_LOGGING_LEVEL, temporary_settings

        server.wait_ready()
        with temporary_settings({PREFECT_API_URL: server.address, PREFECT_LOGGING_LEVEL: "CRITICAL"}):
            yield server


@pytest.fixture(scope="session")
def ring():
    """Builds cameras that look at a point from a circle: ring(6, width=64) -> list of PinholeCamera."""
    import numpy as np

    from packuv.camera import PinholeCamera

    def build(count: int, *, width: int = 96, height: int = 64, radius: float = 4.0, centre=(0.0, 0.0, 0.0)):
        cameras = []
        for index in range(count):
            angle = 2 * np.pi * index / count
            origin = np.asarray(centre) + radius * np.array([np.cos(angle), np.sin(angle), 0.35 * (-1) ** index])
            forward = (np.asarray(centre) - origin) / np.linalg.norm(np.asarray(centre) - origin)
            right = np.cross(forward, [0, 0, 1.0])
            right /= np.linalg.norm(right)
            rotation = np.stack([right, np.cross(forward, right), forward])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation, -rotation @ origin
            cameras.append(
                PinholeCamera(f"cam{index}", width, height, width * 1.1, width * 1.1, width / 2, height / 2, pose)
            )
        return cameras

    return build
