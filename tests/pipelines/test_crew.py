"""How a run is spread over the workers of a cluster."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.crew import CORES_PER_JOB, Crew, crew_of, spread_over
from pipelines.request import RunRequest
from tasks.artefacts.stage import Needs
from tasks.artefacts.workshop import make_here

offers = st.builds(Needs, st.integers(1, 128), st.integers(3, 512).map(lambda gigabytes: gigabytes * 10**9))


def request(**changes):
    return RunRequest("/capture", "/out", **changes)


def test_without_a_cluster_nothing_changes():
    with crew_of(request()) as crew:
        assert crew == Crew(request(), make_here, "")


@pytest.mark.parametrize(
    ("found", "changes", "jobs", "cores"),
    [
        ([Needs(16, 64 * 10**9)], {}, 4, 16),
        ([Needs(2, 8 * 10**9)] * 3, {}, 3, 6),
        ([Needs(16, 7 * 10**9)], {}, 2, 8),  # memory for two
        ([Needs(16, 64 * 10**9)], {"memory_gb": 20}, 3, 12),
        ([Needs(6, 64 * 10**9)], {}, 2, 6),  # threes fill six cores
        ([Needs(16, 64 * 10**9)] * 10, {"cores": 12}, 3, 12),
        ([Needs(16, 64 * 10**9)] * 10, {"jobs": 5}, 5, 20),
        ([Needs(16, 64 * 10**9)] * 10, {"jobs": 5, "cores": 10}, 5, 10),
    ],
)
def test_jobs_fill_the_workers(found, changes, jobs, cores):
    spread = spread_over(found, request(cluster="tcp://a:1", **changes))
    assert (spread.jobs, spread.cores) == (jobs, cores)


@given(st.lists(offers, min_size=1, max_size=8))
def test_every_job_fits_on_a_worker_and_no_worker_has_more_than_it_offers(found):
    spread = spread_over(found, request())
    threads = spread.cores // spread.jobs
    assert spread.cores == threads * spread.jobs
    assert 1 <= threads <= CORES_PER_JOB
    assert spread.cores <= sum(offer.cores for offer in found)
    assert any(Needs(threads, 3 * 10**9).fits(offer) for offer in found)


def test_workers_that_could_never_do_a_fit_are_refused():
    with pytest.raises(ValueError, match=r"a fit needs 1 core, 3\.0 GB, and none of 2 workers .*largest: 8 cores"):
        spread_over([Needs(8, 2 * 10**9), Needs(8, 10**9)], request())


@pytest.mark.parametrize("address", ["10.0.0.5:8786", "tcp://host", "http://host:1", "tcp://a b:1", ""])
def test_what_is_no_address_is_refused(address):
    with pytest.raises(ValueError, match="a cluster is named by its scheduler, as tcp://"):
        request(cluster=address)
