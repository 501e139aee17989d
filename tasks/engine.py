"""Stages as Prefect tasks: retried where that may help, shown as skipped where the artefact is there.

Prefect caches and stores nothing (see tasks/artefacts/store.py): tasks take and return keys, never arrays.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from functools import cache
from typing import Any

from prefect import Task, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.futures import PrefectFuture
from prefect.states import Completed
from prefect.tasks import exponential_backoff

from tasks.artefacts.jobs import JobDiedError
from tasks.artefacts.store import Key

RETRIES = 2
BACKOFF_SECONDS = 2
LASTING = frozenset(
    {errno.ENOENT, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EISDIR, errno.ENOSPC, errno.EROFS, errno.EDQUOT}
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


@cache
def as_task(stage: Callable[..., Key]) -> Task[..., Any]:
    """A stage as a Prefect task; an artefact that was there already shows as the state "Skipped"."""

    @task(
        name=stage.__name__,
        description=stage.__doc__,
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=RETRIES,
        retry_delay_seconds=exponential_backoff(BACKOFF_SECONDS),
        retry_jitter_factor=0.5,
        retry_condition_fn=worth_retrying,
    )
    def made(*arguments: Any) -> Any:
        key = stage(*arguments)
        return Completed(name="Skipped", message=f"{key} is there already", data=key) if key.reused else key

    return made


def submit(stage: Callable[..., Key], *arguments: Any) -> PrefectFuture[Key]:
    """Start a stage as a task of the current flow run.

    Always by `submit`: a direct call of a task that returns a state would hand back the state, not the key.
    """
    return as_task(stage).submit(*arguments)
