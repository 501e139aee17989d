"""`packuv worker`: this machine makes stages for runs that name the same scheduler."""

from __future__ import annotations

import argparse
import os

from pipelines.batch.resources import available_memory_bytes
from pipelines.crew import LACKING
from tasks.artefacts.stage import Needs

FAILED = 1


def worker(arguments: argparse.Namespace) -> int:
    """Until Ctrl-C or SIGTERM; exit code 1 once the scheduler has gone."""
    try:
        from tasks.cluster.worker import serve
    except ImportError as error:
        raise ValueError(f"{LACKING} ({error})") from error
    memory = arguments.memory_gb * 1e9 if arguments.memory_gb else available_memory_bytes() or 0
    offer = Needs(arguments.cores or len(os.sched_getaffinity(0)), int(memory), arguments.gpus)
    where = arguments.scheduler

    def ready(address: str) -> None:
        print(f"worker     {address} offers {offer} to {where}; Ctrl-C ends it", flush=True)

    if serve(where, offer, host=arguments.host, name=arguments.name, ready=ready):
        return 0
    print(f"packuv: the scheduler {where} has gone", flush=True)
    return FAILED
