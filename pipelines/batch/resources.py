"""How many sequences a machine takes at a time."""

from __future__ import annotations

from pathlib import Path

from pipelines.crew import CORES_PER_JOB
from pipelines.process import cores_of

BYTES_PER_SEQUENCE = 3_000_000_000
"""A fit with 80,000 Gaussians and its pictures takes 2.3 GB"""
PROC, CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def sequences_at_once(cores: int, memory_bytes: int | None) -> int:
    """As many as keep the cores busy and fit into memory, at least one.

    >>> sequences_at_once(64, 20_000_000_000), sequences_at_once(64, None), sequences_at_once(2, 1)
    (6, 16, 1)
    """
    by_memory = cores if memory_bytes is None else memory_bytes // BYTES_PER_SEQUENCE
    return max(1, min(cores // CORES_PER_JOB, by_memory))


def default_at_once() -> int:
    """Sequences at a time on this machine as it is now."""
    return sequences_at_once(cores_of(), available_memory_bytes())


def available_memory_bytes(*, proc: Path = PROC, cgroup: Path = CGROUP) -> int | None:
    """That programs may take now, in this container; None where the system does not tell."""
    known = [free for free in (_free(proc), _free_in_container(cgroup)) if free is not None]
    return min(known, default=None)


def _free(proc: Path) -> int | None:
    lines = proc.read_text().splitlines() if proc.exists() else []
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)


def _free_in_container(cgroup: Path) -> int | None:
    try:
        return max(0, int((cgroup / "memory.max").read_text()) - int((cgroup / "memory.current").read_text()))
    except (OSError, ValueError):  # not in a container, or "max"
        return None
