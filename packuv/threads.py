"""How many threads a library may use while ours run side by side, and how these are scheduled."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Where cores are busy, torch's threads wait for each other: 642 ms of CPU an LPIPS instead of 134 (640x360)."""
    import torch  # takes a second, which only those who compute with it should wait

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def ordinary_schedule() -> Iterator[None]:
    """Open an encoder so that all threads of the process are scheduled as before.

    SVT-AV1 gives itself, its caller, and so all that this one starts later, real-time priority (SCHED_FIFO, 99) where
    it runs as root. Two such processes that wait for a third then leave the machine to nobody.
    """
    if not hasattr(os, "sched_getscheduler"):  # Linux alone has it
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        for thread in map(int, os.listdir("/proc/self/task")):
            with suppress(ProcessLookupError):  # it has ended
                if os.sched_getscheduler(thread) != policy:
                    os.sched_setscheduler(thread, policy, parameters)
