"""What a batch would do, and what it takes, before anything is done."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from packuv.progress import Progress, no_progress
from pipelines.ahead import Ahead, look_ahead
from pipelines.batch.plan import Step, plan_batch, with_manifest
from pipelines.batch.request import BatchRequest
from pipelines.batch.resources import default_at_once
from pipelines.process import cores_of


@dataclass(frozen=True)
class Whole:
    """All sequences that a batch was asked for."""

    rows: tuple[tuple[Step, Ahead | None], ...]
    """In the order of the manifest, with what is ahead of those that run"""
    at_once: int
    """Sequences at a time"""
    out: Path

    @property
    def minutes(self) -> float:
        """Of the batch, with sequences side by side all the time."""
        return sum(ahead.minutes for ahead in self._ahead) / self.at_once

    @property
    def missing_bytes(self) -> float:
        """On the disk, for all of them."""
        return sum(ahead.missing_bytes for ahead in self._ahead)

    @property
    def memory_bytes(self) -> float:
        """Of the largest jobs that may run at a time."""
        return sum(sorted((ahead.forecast.memory_bytes for ahead in self._ahead), reverse=True)[: self.at_once])

    @property
    def _ahead(self) -> list[Ahead]:
        return [ahead for _, ahead in self.rows if ahead is not None]


def look_over(request: BatchRequest, *, progress: Progress = no_progress) -> Whole:
    """What the batch would do now. Raises what `plan_batch` raises.

    Every sequence that would run is looked at, which takes seconds each. One that its run would refuse has that as its
    problem, and the others go on, as in the batch.
    """
    steps = plan_batch(with_manifest(request)).steps
    run = sum(step.runs for step in steps)
    at_once = min(request.at_once or default_at_once(), max(1, run))
    cores, rows = max(1, cores_of() // at_once), list[tuple[Step, Ahead | None]]()
    for step in steps:
        if step.runs:
            progress(sum(ahead is not None for _, ahead in rows), run, step.name)
        rows.append(_looked_at(step, cores) if step.runs else (step, None))
    return Whole(tuple(rows), at_once, Path(request.out))


def _looked_at(step: Step, cores: int) -> tuple[Step, Ahead | None]:
    try:
        return step, look_ahead(replace(step.request, cores=cores))
    except (ValueError, FileNotFoundError) as error:
        return replace(step, why=str(error), problem=str(error)), None
