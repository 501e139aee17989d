"""How well segment jobs spread over the workers of a cluster, with jobs that only sleep.

    packuv bench scaling --out bench/results/scaling.json --job-seconds 60
    packuv bench scaling --out scaling.json --job-seconds 5 --workers 1 2 --rounds 2

For each number of workers, a scheduler and so many workers start as processes of their own on this machine, and each
worker gets `--rounds` jobs one after the other, as stages of a store that all of them share. Efficiency is the time
that jobs slept over the time that workers were there; what is missing is overhead: to send an order, start a process
with the libraries, write the receipt, and say so. CPU seconds are given for each side, since a sleeping job takes none.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench import command
from bench.cluster import LocalCluster, cpu_seconds, local_cluster
from bench.naps import Nap
from packuv.files import whole_file
from pipelines.events import Journal
from sync.capture import find_capture
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.store import Store
from tasks.artefacts.workshop import Workshop
from tasks.cluster.client import connected


def measure(folder: Path, workers: int, rounds: int, job_seconds: float) -> dict[str, Any]:
    """One number of workers."""
    with local_cluster(folder / "cluster", workers) as cluster, connected(cluster.address) as maker:
        workshop = Workshop(Store(folder / "store"), _originals(folder), Jobs(threads=1), Journal(), maker)
        _nap_all(workshop, workers, 1, 0.0)  # which loads libraries into the page cache, and opens connections
        before, start, own = _cpu(cluster), time.monotonic(), time.process_time()
        _nap_all(workshop, workers, rounds, job_seconds)
        seconds = time.monotonic() - start
        spent = {"client": time.process_time() - own}
        after = _cpu(cluster)
    spent |= {side: after[side] - before[side] for side in after}
    jobs = workers * rounds
    return {
        "workers": workers,
        "jobs": jobs,
        "job_seconds": job_seconds,
        "seconds": round(seconds, 3),
        "efficiency": round(rounds * job_seconds / seconds, 4),
        "overhead_ms_per_job": round(1000 * (seconds / rounds - job_seconds)),
        "cpu_ms_per_job": {side: round(1000 * value / jobs, 1) for side, value in spent.items()},
    }


def _originals(folder: Path) -> Originals:
    for camera in ("cam00", "cam01"):
        video = folder / "capture" / "videos" / f"{camera}.mp4"
        video.parent.mkdir(parents=True, exist_ok=True)
        video.touch()
    return Originals(find_capture(folder / "capture"), folder / "file_digests.json")


def _nap_all(workshop: Workshop, workers: int, rounds: int, seconds: float) -> None:
    naps = [Nap(number=number, seconds=seconds) for number in range(workers * rounds)]
    with ThreadPoolExecutor(workers) as pool:
        for key in pool.map(workshop.make, naps):
            workshop.path(key)


def _cpu(cluster: LocalCluster) -> dict[str, float]:
    """CPU seconds so far, by side: processes of jobs are the workers' children."""
    own, jobs = zip(*map(cpu_seconds, cluster.workers), strict=True)
    return {"scheduler": cpu_seconds(cluster.scheduler)[0], "workers": sum(own), "job_processes": sum(jobs)}


def told(row: Mapping[str, Any]) -> str:
    """A row for people."""
    cpu = ", ".join(f"{side.replace('_', ' ')} {value:.0f}" for side, value in row["cpu_ms_per_job"].items())
    return (
        f"{row['workers']} workers, {row['jobs']} jobs of {row['job_seconds']:g} s: {row['seconds']:.1f} s, efficiency "
        f"{row['efficiency']:.3f}, overhead {row['overhead_ms_per_job']} ms a job; CPU ms a job: {cpu}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("scaling", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file; rows of other job times in it stay")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--rounds", type=int, default=3, help="jobs of each worker")
    parser.add_argument("--job-seconds", type=float, default=60.0)
    given = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = json.loads(given.out.read_text())["rows"] if given.out.exists() else []
    for workers in given.workers:
        with tempfile.TemporaryDirectory(prefix="packuv-scaling-") as folder:
            row = measure(Path(folder), workers, given.rounds, given.job_seconds)
        row["load"] = round(os.getloadavg()[0], 1)
        print(told(row), flush=True)
        same = (row["workers"], row["job_seconds"])
        rows = [one for one in rows if (one["workers"], one["job_seconds"]) != same] + [row]
        with whole_file(given.out) as part:
            part.write_text(json.dumps({"cpus": os.cpu_count(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
