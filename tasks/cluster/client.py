"""The cluster as a run sees it: what it offers, and a `tasks.artefacts.workshop.Maker` whose work is done there.

Each stage is one Dask task. The thread that asks for it waits for its end; then the store says whether it is there.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError as FutureCancelledError
from functools import partial
from typing import Any, NoReturn

from distributed import Client, Future
from distributed.scheduler import KilledWorker

from tasks.artefacts.jobs import JobDiedError
from tasks.artefacts.stage import Needs, Stage
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import Workshop
from tasks.cluster.orders import Answer, offered, order, read, resources
from tasks.cluster.worker import work

CONNECT_SECONDS = 10.0
"""To find the scheduler"""
FIRST_WORKER_SECONDS = 60.0
"""For a first worker to join"""
POLL_SECONDS = 0.5
LOOK_SECONDS = 5.0
"""Between two looks at who is in the cluster"""
PATIENCE_SECONDS = 120.0
"""Without a worker that could do a job: one may be starting again"""
APPEAR_SECONDS = 70.0
"""For what a worker published to be seen here: an NFS client may tell for a minute what it knew"""
CLOSE_SECONDS = 3.0
DASK_RETRIES = 1
"""Of what goes wrong in Dask itself; what goes wrong in a job comes back as an answer"""

GONE = (OSError, TimeoutError, FutureCancelledError, RuntimeError)
"""What Dask raises in its several places once the scheduler does not answer"""
Heard = Callable[[float, float, str], None]


class Cluster:
    """Safe to use from several threads."""

    def __init__(self, address: str, client: Client) -> None:
        self.address = address
        self._client = client
        self._topic = f"packuv-{uuid.uuid4().hex}"
        self._hears: dict[str, Heard] = {}
        self._looked, self._seen = -LOOK_SECONDS, list[Needs]()
        self._lock = threading.Lock()
        client.subscribe_topic(self._topic, self._hear)

    def offers(self) -> list[Needs]:
        """What each worker has, at most some seconds ago."""
        with self._lock:
            if time.monotonic() - self._looked >= LOOK_SECONDS:
                found = self._client.scheduler_info(n_workers=-1)["workers"].values()
                self._seen = [offered(worker["resources"]) for worker in found]
                self._looked = time.monotonic()
            return self._seen

    def __call__(self, workshop: Workshop, stage: Stage) -> Key:
        """The artefact of a stage, by a worker unless it is there; raises what `make_here` raises.

        Raises ValueError where no worker that there is can do it, or a worker is not fit to, and CancelledError where
        the scheduler or all such workers have gone, after it cancelled the jobs of the run.
        """
        workshop.jobs.check()
        store = workshop.store
        key = store.key(stage.name, stage.version, stage.settings, stage.sources)
        if store.holds(key):
            return store.reuse(key)
        site, seen = workshop.site, workshop.originals.look()
        needs = stage.needs(site)
        check_able(self._offers(workshop), needs, stage.label)
        with store.in_use() as present, self._heard(partial(workshop.listener.moved, stage.label)) as ticket:
            asked = order(stage, site, seen, present)
            future = self._submit(asked, ticket, needs, stage)
            try:
                answer = self._answer(future, workshop, stage, needs)
            finally:
                self._forget(future)
        made = read(answer, key, store.work_folder(key))
        self._check_there(store, made, answer["host"])
        workshop.originals.look()
        return made

    def _submit(self, asked: Any, ticket: str, needs: Needs, stage: Stage) -> Future:
        name = f"{stage.label.replace(' ', '-')}-{ticket}"
        return self._client.submit(
            work, asked, self._topic, ticket, key=name, resources=resources(needs), retries=DASK_RETRIES, pure=False
        )

    def _answer(self, future: Future, workshop: Workshop, stage: Stage, needs: Needs) -> Answer:
        """What the worker says; raises CancelledError once the run's jobs are cancelled."""
        ended, able = threading.Event(), time.monotonic()
        future.add_done_callback(lambda _: ended.set())
        while not ended.wait(POLL_SECONDS):
            workshop.jobs.check()
            if any(map(needs.fits, self._offers(workshop))):
                able = time.monotonic()
            if time.monotonic() - able > PATIENCE_SECONDS:
                self._leave(workshop, f"no worker that could {stage.label} is left at {self.address}")
        workshop.jobs.check()
        try:
            found: Answer = future.result(timeout=CONNECT_SECONDS)
            return found
        except KilledWorker as error:
            key = workshop.store.key(stage.name, stage.version, stage.settings, stage.sources)
            died = f"the workers that did {stage.label!r} died one after the other"
            raise JobDiedError(died, workshop.store.work_folder(key)) from error
        except ImportError as error:
            raise ValueError(f"a worker at {self.address} has no PackUV ({error}); install it there") from error
        except FutureCancelledError as error:  # not by us
            lost = getattr(error, "reason", "") == "scheduler-connection-lost"
            cancelled = f"somebody cancelled {stage.label!r} at the scheduler {self.address}"
            self._leave(workshop, f"the scheduler {self.address} has gone" if lost else cancelled)
        except GONE as error:
            self._leave(workshop, f"the scheduler {self.address} has gone ({type(error).__name__})")

    def _offers(self, workshop: Workshop) -> Sequence[Needs]:
        try:
            return self.offers()
        except GONE as error:
            self._leave(workshop, f"the scheduler {self.address} has gone ({type(error).__name__})")

    def _leave(self, workshop: Workshop, sentence: str) -> NoReturn:
        """End all of the run: what is wrong is wrong for each of its stages."""
        workshop.jobs.cancel(sentence)
        workshop.jobs.check()
        raise AssertionError("cancelled jobs let nobody pass")

    def _check_there(self, store: Store, key: Key, host: str) -> None:
        """The store says what is there; on a network file system perhaps some seconds later."""
        deadline = time.monotonic() + APPEAR_SECONDS
        while not store.appeared(key):
            if time.monotonic() > deadline:
                raise ValueError(
                    f"{host} made {key}, but {store.root} does not show it here; --out must be a folder that all "
                    "machines share, under the same path"
                )
            time.sleep(1)

    def _forget(self, future: Future) -> None:
        """Nobody here waits any more: a worker that is at it stops."""
        with contextlib.suppress(*GONE):
            future.release() if future.done() else future.cancel()

    @contextlib.contextmanager
    def _heard(self, hears: Heard) -> Iterator[str]:
        """A ticket under which `hears` is told of progress while the block runs."""
        ticket = uuid.uuid4().hex[:16]
        self._hears[ticket] = hears
        try:
            yield ticket
        finally:
            del self._hears[ticket]

    def _hear(self, event: tuple[float, Mapping[str, Any]]) -> None:
        told = event[1]
        if hears := self._hears.get(told["ticket"]):
            hears(told["done"], told["total"], told["note"])


@contextlib.contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """The cluster of a scheduler while the block runs; whatever is under way at its end is cancelled.

    Raises ValueError where no scheduler answers, or no worker has joined within a minute.
    """
    for logger in ("distributed", "distributed.client", "distributed.core", "distributed.comm", "distributed.batched"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False, name="packuv")
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(f"no scheduler answers at {address}; start one with: dask scheduler --host HOST") from error
    try:
        cluster = Cluster(address, client)
        _await_worker(cluster)
        yield cluster
    finally:
        with contextlib.suppress(Exception):  # the scheduler may have gone, and what is made is safe
            client.close(timeout=CLOSE_SECONDS)


def _await_worker(cluster: Cluster) -> None:
    deadline = time.monotonic() + FIRST_WORKER_SECONDS
    while not cluster.offers():
        if time.monotonic() > deadline:
            raise ValueError(
                f"no worker has joined {cluster.address}; start some with: packuv worker {cluster.address}"
            )
        time.sleep(LOOK_SECONDS / 5)


def check_able(offers: Sequence[Needs], needs: Needs, label: str) -> None:
    """Raise ValueError unless one of these workers could do the job: Dask would wait for ever, and not say so."""
    if offers and not any(map(needs.fits, offers)):
        raise ValueError(
            f"{label!r} needs {needs}, and none of the {len(offers)} workers offers that: {_listed(offers)}; start one "
            "that does (packuv worker --cores --memory-gb --gpus), or run with less --memory-gb or fewer --cores"
        )


def _listed(offers: Sequence[Needs]) -> str:
    kinds = [str(offer) if offer.cores else "none declared" for offer in offers]
    return "; ".join(f"{kinds.count(kind)} x {kind}" for kind in dict.fromkeys(kinds))
