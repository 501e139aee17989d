"""Stages as Prefect tasks: retried where that may help, shown as skipped where the artefact is there.

Prefect caches and stores nothing (see tasks/artefacts/store.py): tasks take and return keys, never arrays.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

from prefect import Task, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.futures import PrefectFuture
from prefect.states import Completed
from prefect.task_runners import TaskRunner
from prefect.tasks import exponential_backoff

from tasks.artefacts.jobs import JobDiedError
from tasks.artefacts.stage import Stage
from tasks.artefacts.store import Key

RETRIES = 2
BACKOFF_SECONDS = 2
LASTING = frozenset(
    {errno.ENOENT, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG}
    | {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}
)
"""Errors of the system that stay until somebody does something"""


def may_pass(error: BaseException) -> bool:
    """Whether the same work may succeed when it is done again.

    A job that was killed, memory that ran out while others used it, a disk or network that hiccuped: yes. Bad input
    and faults of the program: no.
    """
    if isinstance(error, OSError):
        return error.errno not in LASTING and not isinstance(error, FileNotFoundError)
    return isinstance(error, (JobDiedError, MemoryError))


def worth_retrying(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Prefect's question after a failure."""
    try:
        state.result()
    except BaseException as error:
        return may_pass(error)
    return False


def submitter(make: Callable[[Stage], Key], runner: TaskRunner[Any]) -> Callable[[Stage], PrefectFuture[Key]]:
    """Starts stages as tasks of the current flow run, in this runner, each made by `make`.

    Always by `submit`: a direct call of a task that returns a state would hand back the state, not the key.
    """
    tasks: dict[type[Stage], Task[..., Any]] = {}

    def submit(stage: Stage) -> PrefectFuture[Key]:
        kind = type(stage)
        if kind not in tasks:
            tasks[kind] = as_task(kind, make)
        future: PrefectFuture[Key] = runner.submit(
            tasks[kind].with_options(task_run_name=stage.label), {"stage": stage}
        )
        return future

    return submit


def as_task(kind: type[Stage], make: Callable[[Stage], Key]) -> Task[..., Any]:
    """A kind of stage as a Prefect task; an artefact that was there already shows as the state "Skipped"."""

    @task(
        name=kind.__name__,
        description=kind.__doc__,
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=RETRIES,
        retry_delay_seconds=exponential_backoff(BACKOFF_SECONDS),
        retry_jitter_factor=0.5,
        retry_condition_fn=worth_retrying,
    )
    def made(stage: Stage) -> Any:
        key = make(stage)
        return Completed(name="Skipped", message=f"{key} is there already", data=key) if key.reused else key

    return made
