"""The line between a run and the server of the workflow engine.

One thread posts what the dashboard shows, hears when somebody cancels the run there, and notices when the server has
gone. Nothing that happens to the server may hold up the run: what a busy server does not take is sent again with the
next posts, what it refuses is lost, and a run whose server has gone ends by itself.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Protocol
from uuid import UUID

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.settings import PREFECT_API_REQUEST_TIMEOUT, PREFECT_CLIENT_MAX_RETRIES, temporary_settings

LISTEN_SECONDS = 2.0
"""Between two looks at the state of the run"""
PATIENCE_SECONDS = 30.0
"""A server that is silent for this long has gone; until then it may be restarting"""
ENDING_SECONDS = 12.0
"""For the run to write down how far it came, once its server has gone"""
FLUSH_SECONDS = 10.0
"""For the last posts, when the run is over"""
REQUEST_SECONDS = 10.0
BUSY = (429, 503)
"""Answers of a server that asks to be asked again, as when its database is locked"""
LAST_TRIES = 5
"""To send the last posts"""

Post = Callable[[SyncPrefectClient], object]


class Cancellable(Protocol):
    """What ends when its run is cancelled, as `Jobs` do."""

    def cancel(self, reason: str) -> None: ...


class Link:
    """See above: `start` before the work of a flow run, `finish` after it, `close` once the engine is done as well."""

    def __init__(
        self, *, died: Callable[[], bool] = lambda: False, last_word: Callable[[str], object] | None = None
    ) -> None:
        """`died` tells sooner than silence does that the server has gone; `last_word` then ends the process."""
        self._died = died
        self._last_word = last_word or end_process
        self._posts: dict[object, Post] = {}
        self._guard = threading.Lock()
        self._finished, self._closed, self._wake = threading.Event(), threading.Event(), threading.Event()
        self._flushed = threading.Event()
        self._thread: threading.Thread | None = None
        self._heard = time.monotonic()

    def start(self, flow_run: UUID, jobs: Cancellable) -> None:
        """Listen to what happens to the flow run, whose jobs these are."""
        self._heard = time.monotonic()
        self._thread = threading.Thread(target=self._listen, args=(flow_run, jobs), name="link", daemon=True)
        self._thread.start()

    def post(self, post: Post, *, instead_of: object = None) -> None:
        """Have something posted soon; it takes the place of an unsent post with the same name."""
        with self._guard:
            self._posts[object() if instead_of is None else instead_of] = post

    def finish(self) -> None:
        """The work is over, in whichever way: send what is left before the engine says so, if that is soon."""
        self._finished.set()
        self._wake.set()
        if self._thread:
            self._flushed.wait(FLUSH_SECONDS)

    def close(self) -> None:
        """Stop listening."""
        self._finished.set()
        self._closed.set()
        self._wake.set()
        if self._thread:
            self._thread.join(FLUSH_SECONDS)

    def _listen(self, flow_run: UUID, jobs: Cancellable) -> None:
        try:
            self._serve(flow_run, jobs)
        finally:
            self._flushed.set()

    def _serve(self, flow_run: UUID, jobs: Cancellable) -> None:
        with (
            temporary_settings({PREFECT_CLIENT_MAX_RETRIES: 0, PREFECT_API_REQUEST_TIMEOUT: REQUEST_SECONDS}),
            get_client(sync_client=True) as client,
        ):
            while not self._closed.is_set():
                self._wake.wait(LISTEN_SECONDS)
                self._wake.clear()
                finished = self._finished.is_set()
                if self._taken(client, lambda client: _hear(client, flow_run, jobs)):
                    sent = self._send(client)
                    if sent and finished:
                        self._flushed.set()
                elif not self._closed.is_set() and self._has_gone():
                    self._leave(str(client.api_url), jobs)
                    return
            for _ in range(LAST_TRIES):
                if self._send(client) or self._died():
                    return
                time.sleep(LISTEN_SECONDS / 2)

    def _send(self, client: SyncPrefectClient) -> bool:
        """Whether nothing is left to be sent."""
        with self._guard:
            posts, self._posts = self._posts, {}
        while posts:
            name = next(iter(posts))
            if not self._taken(client, posts[name]):
                with self._guard:
                    self._posts = {**posts, **self._posts}
                return False
            del posts[name]
        return True

    def _taken(self, client: SyncPrefectClient, post: Post) -> bool:
        """Whether the server took it, or refused it for good."""
        try:
            post(client)
        except Exception as error:  # whatever a server or the way to it may do
            response = getattr(error, "response", None)
            if response is None:
                return False
            self._heard = time.monotonic()
            return response.status_code not in BUSY
        self._heard = time.monotonic()
        return True

    def _has_gone(self) -> bool:
        return self._died() or time.monotonic() - self._heard > PATIENCE_SECONDS

    def _leave(self, server: str, jobs: Cancellable) -> None:
        sentence = f"the workflow server at {server} has gone"
        jobs.cancel(sentence)
        self._finished.wait(ENDING_SECONDS)
        self._last_word(f"{sentence}; what is made is safe, and the same command goes on from here")


def _hear(client: SyncPrefectClient, flow_run: UUID, jobs: Cancellable) -> None:
    state = client.read_flow_run(flow_run).state
    if state is not None and (state.is_cancelling() or state.is_cancelled()):
        jobs.cancel("the run was cancelled")
    elif state is not None and state.is_crashed():  # somebody took it for dead, and may have started another
        jobs.cancel("the run was given up")


def end_process(sentence: str) -> None:
    """The engine would wait for its server, deaf to signals: leave without it."""
    print(f"packuv: {sentence}", file=sys.stderr, flush=True)
    os._exit(1)
