"""Sequences handed to a work pool: flow runs of a deployment, which workers on any machine take.

What becomes of a sequence is read from its folder, which all machines see under the same path: the record that its
run keeps there says how far it is and whether it lives, run.json how it ended. The server knows only who took it: a
process that was killed leaves its flow run "Running" there for ever, so the record decides, and the sequence is handed
out again.

Importing this imports Prefect: have its settings in the environment before.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    FlowRunFilter,
    FlowRunFilterDeploymentId,
    FlowRunFilterId,
    FlowRunFilterState,
    FlowRunFilterStateType,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, State, StateType, WorkerStatus
from prefect.deployments import run_deployment
from prefect.exceptions import ObjectNotFound
from prefect.settings import PREFECT_CLIENT_MAX_RETRIES, temporary_settings
from prefect.states import Cancelled, Cancelling, Crashed, Pending
from prefect.utilities.callables import parameter_schema

import packuv
from pipelines.batch.left import error_left, outcome_left, run_left
from pipelines.batch.run import KilledError
from pipelines.batch.watch import Watch
from pipelines.events import Journal
from pipelines.process import Outcome
from pipelines.request import RunRequest
from pipelines.sequence import process_sequence
from tasks.artefacts.jobs import CancelledError, Jobs
from tasks.artefacts.recipe import plain

POLL_SECONDS = 2.0
"""Between two questions to the server, which are about all sequences together"""
LOOK_SECONDS = 1.0
"""Between two looks into the folder of a sequence"""
WORKERS_SECONDS = 30.0
"""Between two looks for workers, while sequences wait for one"""
START_SECONDS = 300.0
"""For a worker that took a sequence to begin it"""
CANCEL_SECONDS = 25.0
"""For a flow run to end that is asked to"""
LATE_SECONDS = 60.0
"""For a shared folder to show what another machine wrote"""
REQUEST_SECONDS = 10.0
MOST_ASKED = 200
"""Flow runs in one question, the most that the server answers"""
TRIES = 3
"""Runs of a sequence whose processes get killed"""
NAME = "pool-{}"
"""Of the deployment"""
UNFINISHED = [StateType.SCHEDULED, StateType.PENDING, StateType.RUNNING]
PULL = [{"prefect.deployments.steps.set_working_directory": {"directory": "/"}}]
"""Workers find PackUV installed in their own environment"""


def check_pool(client: SyncPrefectClient, name: str) -> None:
    """Raise ValueError where nobody would take anything: the pool is not there, is paused, or has no worker."""
    start = f"prefect worker start --pool {name} --type process"
    try:
        pool = client.read_work_pool(name)
    except ObjectNotFound:
        there = ", ".join(other.name for other in client.read_work_pools()) or "none"
        raise ValueError(f"no work pool {name} at {client.api_url}, which has {there}; make it with: {start}") from None
    if pool.is_paused:
        raise ValueError(f"the work pool {name} is paused; let it go on with: prefect work-pool resume {name}")
    if not online(client, name):
        raise ValueError(f"no worker of the work pool {name} is online; start one with: {start}")


def online(client: SyncPrefectClient, name: str) -> list[str]:
    """Names of the pool's workers that the server hears from."""
    workers = client.read_workers_for_work_pool(name)
    return [worker.name for worker in workers if worker.status is WorkerStatus.ONLINE]


def deployed(client: SyncPrefectClient, pool: str) -> UUID:
    """The deployment by which the pool gets sequences, made or brought up to date."""
    return client.create_deployment(
        client.create_flow(process_sequence),
        NAME.format(pool),
        description="Sequences of packuv batch --pool",
        entrypoint="pipelines.sequence.process_sequence",
        work_pool_name=pool,
        pull_steps=PULL,
        parameter_openapi_schema=parameter_schema(process_sequence).model_dump_for_openapi(),
        enforce_parameter_schema=True,
        tags=["packuv"],
    )


@contextlib.contextmanager
def opened_pool(name: str, tell: Callable[[str, str], object]) -> Iterator[WorkPool]:
    """The pool for one batch; raises what `check_pool` raises. `tell` hears what people should know, by sequence."""
    with get_client(sync_client=True, httpx_settings={"timeout": REQUEST_SECONDS}) as client:
        check_pool(client, name)
        yield WorkPool(client, name, deployed(client, name), tell)


class WorkPool:
    """Hands out sequences, and follows them; safe to use from the threads of a batch."""

    def __init__(
        self, client: SyncPrefectClient, name: str, deployment: UUID, tell: Callable[[str, str], object]
    ) -> None:
        self._client, self._name, self._deployment, self._tell = client, name, deployment, tell
        self._states: dict[UUID, State[Any] | None] = {}
        self._asked = self._sought = time.monotonic()
        self._alone = False
        self._asking, self._starting = threading.Lock(), threading.Lock()

    def run(self, request: RunRequest, journal: Journal, jobs: Jobs) -> Outcome:
        """Have a worker process a sequence; the journal hears how far it is there.

        Raises what `pipelines.process.process` raises, and KilledError where its processes get killed again and again.
        """
        assert request.name is not None
        folder, given = Path(request.out) / request.name, self._found(request)
        if given:
            self._tell(request.name, f"goes on as {given.name}, which an earlier batch began")
        killed = ""
        for _ in range(TRIES):
            jobs.check()
            one = given or self._given(request)
            given = None
            state, killed = self._follow(one, Watch(folder, str(one.id), journal), jobs)
            if not killed:
                return self._outcome(one.id, folder, state)
            self._tell(request.name, f"{killed}; it is handed out again")
        raise KilledError(f"{killed}, as {TRIES - 1} times before")

    def _found(self, request: RunRequest) -> FlowRun | None:
        """A run of the sequence that an earlier batch left behind; raises ValueError for one with other settings."""
        found = self._client.read_flow_runs(
            flow_run_filter=FlowRunFilter(
                deployment_id=FlowRunFilterDeploymentId(any_=[self._deployment]),
                tags=FlowRunFilterTags(all_=_tags(request)),
                state=FlowRunFilterState(type=FlowRunFilterStateType(any_=UNFINISHED)),
            )
        )
        for run in found:
            if run.parameters.get("request") != plain(request):
                end = f"packuv cancel {request.out} {request.name}, or prefect flow-run cancel {run.id}"
                raise ValueError(f"{run.name} goes on with other settings; end it first: {end}")
        return next(iter(sorted(found, key=lambda run: run.state_type is not StateType.RUNNING)), None)

    def _given(self, request: RunRequest) -> FlowRun:
        """A new flow run, part of this thread's."""
        with self._starting:  # the engine numbers the parts of a run without a lock
            run = run_deployment(
                self._deployment,
                parameters={"request": plain(request)},
                flow_run_name=f"{request.name} {request.preset}",
                timeout=0,
                tags=_tags(request),
                idempotency_key=str(uuid4()),  # an answer that was lost starts nothing twice
            )
        assert isinstance(run, FlowRun), "which would wait for an event loop"
        return run

    def _follow(self, run: FlowRun, watch: Watch, jobs: Jobs) -> tuple[State[Any] | None, str]:
        """The last state of a flow run, and how it was killed, if it was."""
        with self._asking:
            self._states[run.id] = run.state or Pending()
        try:
            while True:
                state = self._state(run.id)
                if state is None or not state.is_scheduled():
                    watch.look()
                if state is None or state.is_crashed():
                    return state, watch.killed((state.message or "crashed") if state else "its flow run was deleted")
                if state.is_final():
                    return state, ""
                if dead := self._dead(state, watch):
                    self._set(run.id, Crashed(message=dead))
                    return state, dead
                self._end_if_asked(run.id, jobs)
                time.sleep(LOOK_SECONDS)
        finally:
            watch.close()
            with self._asking:
                del self._states[run.id]

    def _dead(self, state: State[Any], watch: Watch) -> str:
        """How its process ended without a word, if it did."""
        if watch.is_dead:
            return watch.killed("killed")
        if state.is_scheduled() or watch.quiet_seconds(state.type.value) < START_SECONDS:
            return ""
        return f"no process began it within {START_SECONDS:.0f} s after a worker took it"

    def _end_if_asked(self, run: UUID, jobs: Jobs) -> None:
        try:
            jobs.check()
        except CancelledError:
            self._cancel(run)
            raise

    def _cancel(self, run: UUID) -> None:
        """End a flow run, whoever has it, and whether or not that one answers."""
        deadline = time.monotonic() + CANCEL_SECONDS
        with contextlib.suppress(Exception):  # whatever a server or the way to it may do
            state = self._client.read_flow_run(run).state
            asked = state is not None and state.is_running() and self._set(run, Cancelling())
            while asked and time.monotonic() < deadline:
                state = self._client.read_flow_run(run).state
                if state is None or state.is_final():
                    return
                time.sleep(LOOK_SECONDS)
            self._set(run, Cancelled(message="the batch was ended"))

    def _set(self, run: UUID, state: State[Any]) -> bool:
        """Whether the server took it."""
        with contextlib.suppress(Exception):
            self._client.set_flow_run_state(run, state, force=not state.is_cancelling())
            return True
        return False

    def _outcome(self, run: UUID, folder: Path, state: State[Any] | None) -> Outcome:
        """Raises what the run raised."""
        message = (state and state.message) or ""
        if state is not None and state.is_cancelled():
            raise CancelledError(message or "the run was cancelled")
        completed, deadline = state is not None and state.is_completed(), time.monotonic() + LATE_SECONDS
        while (left := run_left(folder, str(run))) is None and completed and time.monotonic() < deadline:
            time.sleep(LOOK_SECONDS)
        if left is not None and left["outcome"] == "finished":
            if left["packuv"] != packuv.__version__:
                versions = f"packuv {left['packuv']}, and this is {packuv.__version__}"
                raise RuntimeError(f"a worker made it with {versions}; install the same everywhere")
            return outcome_left(folder, left)
        if completed:
            raise RuntimeError(f"a worker says that it is done, but {folder} here does not show it; share that folder")
        raise error_left(left, message)

    def _state(self, run: UUID) -> State[Any] | None:
        """Not older than POLL_SECONDS where the server answers; None for a flow run that it has no more."""
        with self._asking:
            if time.monotonic() - self._asked >= POLL_SECONDS:
                # Busy or gone: what was known stands, and the link of the batch decides when it is enough.
                with contextlib.suppress(Exception), temporary_settings({PREFECT_CLIENT_MAX_RETRIES: 0}):
                    self._ask()
                    self._look_for_workers()
                self._asked = time.monotonic()
            return self._states[run]

    def _ask(self) -> None:
        ids = list(self._states)
        for begin in range(0, len(ids), MOST_ASKED):
            part = ids[begin : begin + MOST_ASKED]
            found = self._client.read_flow_runs(flow_run_filter=FlowRunFilter(id=FlowRunFilterId(any_=part)))
            states = {run.id: run.state for run in found}
            self._states |= {id: states.get(id) for id in part}

    def _look_for_workers(self) -> None:
        """Say once when those that wait have nobody to wait for."""
        waiting = sum(state is not None and state.is_scheduled() for state in self._states.values())
        if not waiting or time.monotonic() - self._sought < WORKERS_SECONDS:
            return
        self._sought = time.monotonic()
        alone = not online(self._client, self._name)
        if alone and not self._alone:
            self._tell("work pool", f"no worker of {self._name} is online any more; {waiting} sequences wait for one")
        self._alone = alone


def _tags(request: RunRequest) -> list[str]:
    """By which a run of the sequence is found."""
    return ["packuv", f"seq:{request.name}", f"into:{request.out}"]
