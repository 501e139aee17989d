"""Who makes the stages of a run: this machine, or the workers of a cluster; and how a run is spread over them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from pipelines.request import RunRequest
from tasks.artefacts.stage import BASE_BYTES, Needs
from tasks.artefacts.workshop import Maker, make_here

CORES_PER_JOB = 4
"""A fit's threads wait for each other often enough that a big machine is better used by several fits side by side"""
LACKING = "the cluster needs Dask, which is not installed: pip install -c constraints.txt -e '.[cluster]'"


@dataclass(frozen=True)
class Crew:
    """A request, with `jobs` and `cores` that fit who works, and who that is."""

    request: RunRequest
    maker: Maker = make_here
    told: str = ""
    """For people"""


@contextlib.contextmanager
def crew_of(request: RunRequest) -> Iterator[Crew]:
    """Have who makes the stages of a run while the block runs.

    Raises ValueError where a cluster is asked for and no scheduler answers, no worker joined, or none could do a fit.
    """
    if request.cluster is None:
        yield Crew(request)
        return
    with contextlib.ExitStack() as stack:
        try:
            from tasks.cluster.client import connected
        except ImportError as error:
            raise ValueError(f"{LACKING} ({error})") from error
        cluster = stack.enter_context(connected(request.cluster))
        offers = cluster.offers()
        spread = spread_over(offers, request)
        at_once, threads = spread.jobs or 1, (spread.cores or 1) // (spread.jobs or 1)
        cores = sum(offer.cores for offer in offers)
        told = (
            f"{len(offers)} workers with {cores} cores at {request.cluster}, jobs at once: {at_once}, threads of each: "
            f"{threads}"
        )
        yield Crew(spread, cluster, told)


def spread_over(offers: Sequence[Needs], request: RunRequest) -> RunRequest:
    """The request with as many jobs at once as the workers take, unless it says how many, and the cores for these.

    Jobs get as many threads, up to CORES_PER_JOB, as keep the most cores busy. Raises ValueError where no worker could
    do a fit.
    """
    memory = round(1e9 * request.memory_gb) + BASE_BYTES
    threads = max(range(1, CORES_PER_JOB + 1), key=lambda count: (count * _places(offers, count, memory), count))
    places = _places(offers, threads, memory)
    if not places:
        largest = max(offers, key=lambda offer: (offer.memory_bytes, offer.cores))
        raise ValueError(
            f"a fit needs {Needs(1, memory)}, and none of {len(offers)} workers offers that (the largest: {largest}); "
            "start larger ones, see packuv worker -h, or run with less --memory-gb"
        )
    if request.cores:
        places = max(1, min(places, request.cores // threads))
    at_once = request.jobs or places
    if request.jobs and request.cores:
        threads = max(1, min(threads, request.cores // request.jobs))
    return replace(request, jobs=at_once, cores=at_once * threads)


def _places(offers: Sequence[Needs], threads: int, memory_bytes: int) -> int:
    """Jobs that run at once."""
    return sum(min(offer.cores // threads, offer.memory_bytes // memory_bytes) for offer in offers)
