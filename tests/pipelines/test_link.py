"""The line between a run and the workflow engine's server, with servers that are busy, refuse, or are gone."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from types import SimpleNamespace
from uuid import uuid4

import httpx
import pytest
from prefect.states import Cancelled, Cancelling, Crashed, Running

import pipelines.link
from pipelines.link import Link


class Server:
    """What it takes and what it answers; a stand-in, since no real server is busy on demand."""

    api_url = "http://127.0.0.1:1/api"

    def __init__(self, *answers: int) -> None:
        self.answers, self.taken = list(answers), []

    def read_flow_run(self, _):
        return SimpleNamespace(state=None)

    def take(self, what: str) -> None:
        answer = self.answers.pop(0) if self.answers else 200
        if answer == 0:
            raise httpx.ConnectError("refused")
        if answer != 200:
            request = httpx.Request("POST", self.api_url)
            raise httpx.HTTPStatusError("", request=request, response=httpx.Response(answer, request=request))
        self.taken.append(what)


@pytest.fixture
def post(monkeypatch) -> Callable[[Server], None]:
    """Three posts, two of them of one name, through a link that opens and closes at once."""
    monkeypatch.setattr(pipelines.link, "LISTEN_SECONDS", 0.02)
    monkeypatch.setattr(pipelines.link, "FLUSH_SECONDS", 2.0)

    def send(server: Server) -> None:
        monkeypatch.setattr(pipelines.link, "get_client", lambda **_: contextlib.nullcontext(server))
        link = Link(last_word=pytest.fail)
        link.post(lambda client: client.take("progress 1"), instead_of="progress")
        link.post(lambda client: client.take("progress 2"), instead_of="progress")
        link.post(lambda client: client.take("summary"))
        link.start(uuid4(), SimpleNamespace(cancel=pytest.fail))
        link.finish()
        at_the_end = list(server.taken)
        link.close()
        assert server.taken == at_the_end

    return send


@pytest.mark.parametrize(
    ("answers", "taken"),
    [
        ([], ["progress 2", "summary"]),
        ([503], ["progress 2", "summary"]),
        ([200, 503, 429], ["progress 2", "summary"]),
        ([0, 200, 0], ["progress 2", "summary"]),
        ([422], ["summary"]),
        ([200, 404], ["progress 2"]),
    ],
    ids=["takes", "busy", "busy twice", "restarts", "refuses one", "refuses the other"],
)
def test_what_a_busy_server_does_not_take_is_sent_again(post, answers, taken):
    server = Server(*answers)
    post(server)
    assert server.taken == taken


def test_a_server_that_stays_away_holds_up_nothing(post):
    server = Server(*[0] * 1000)
    post(server)
    assert server.taken == []


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (Running(), None),
        (Cancelling(), "the run was cancelled"),
        (Cancelled(), "the run was cancelled"),
        (Crashed(), "the run was given up"),
    ],
)
def test_a_run_ends_when_its_server_says_so(state, reason):
    server, told = Server(), list[str]()
    server.read_flow_run = lambda _: SimpleNamespace(state=state)
    pipelines.link._hear(server, uuid4(), SimpleNamespace(cancel=told.append))
    assert told == ([reason] if reason else [])
