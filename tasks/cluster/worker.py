"""A worker of the cluster: what it offers, how it does an order, and how it learns that nobody wants the work."""

from __future__ import annotations

import asyncio
import logging
import signal
import tempfile
import time
from typing import Any

import dask.config
from distributed import Worker, get_worker
from distributed.core import Status

from tasks.artefacts.stage import Needs
from tasks.cluster.orders import Answer, Order, fulfil, resources

TELL_SECONDS = 1.0
"""Least time between two notes of progress"""
JOIN_SECONDS = 30.0
"""To find the scheduler"""
CLOSE_SECONDS = 10.0
"""For jobs to end"""


class UnwantedError(RuntimeError):
    """Whoever asked has gone or asks no more, or this worker is closing."""


def work(asked: Order, topic: str, ticket: str) -> Answer:
    """What Dask calls, in a thread of the worker. The topic's subscribers hear of progress under the ticket."""
    worker = get_worker()
    return fulfil(asked, _Telling(worker, topic, ticket), _Wanted(worker).check)


class _Wanted:
    """Whether the task that this thread works on is still wanted."""

    def __init__(self, worker: Worker) -> None:
        self._worker, self._key = worker, worker.get_current_task()

    def check(self) -> None:
        """Raise UnwantedError where it is not."""
        task = self._worker.state.tasks.get(self._key)
        if self._worker.status not in (Status.running, Status.paused, Status.closing_gracefully):
            raise UnwantedError("the worker closes")
        if task is None or task.state in ("cancelled", "released", "forgotten", "error"):
            raise UnwantedError("the task was cancelled")


class _Telling:
    """A `packuv.progress.Progress` that is heard where the run is."""

    def __init__(self, worker: Worker, topic: str, ticket: str) -> None:
        self._worker, self._topic, self._ticket = worker, topic, ticket
        self._due = 0.0

    def __call__(self, done: float, total: float, note: str = "") -> None:
        if time.monotonic() >= self._due or 0 < total <= done:
            self._due = time.monotonic() + TELL_SECONDS
            told = {"ticket": self._ticket, "done": float(done), "total": float(total), "note": note}
            self._worker.log_event(self._topic, told)


def serve(address: str, offer: Needs, *, host: str | None, name: str | None, ready: Any = print) -> bool:
    """Work for a scheduler until a signal asks for an end; False where the scheduler has gone.

    Raises OSError or TimeoutError where none answers.
    """
    for logger in ("distributed", "distributed.worker", "distributed.core"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    # What its threads do is to wait for processes, which needs no profile.
    with (
        dask.config.set({"distributed.worker.profile.enabled": False}),
        tempfile.TemporaryDirectory(prefix="packuv-worker-") as folder,
    ):
        return asyncio.run(_serve(address, offer, host, name, folder, ready))


async def _serve(address: str, offer: Needs, host: str | None, name: str | None, folder: str, ready: Any) -> bool:
    worker = Worker(
        address,
        nthreads=offer.cores,
        resources=resources(offer),
        memory_limit=0,  # jobs have processes of their own
        host=host,
        name=name,
        local_directory=folder,
        dashboard=False,
        death_timeout=JOIN_SECONDS,
    )
    asked = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, asked.set)
    await worker
    ready(worker.address)
    ends = [asyncio.create_task(asked.wait()), asyncio.create_task(worker.finished())]
    await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    if asked.is_set():
        await worker.close(timeout=CLOSE_SECONDS, reason="asked to end")
    for end in ends:
        end.cancel()
    return asked.is_set()
