"""Deployments: what can be started from the dashboard, by a schedule or by a script.

Importing this imports Prefect: have its settings in the environment before. prefect.yaml has the same deployments for a
server and workers of one's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect import serve
from prefect.client.schemas.schedules import CronSchedule
from prefect.deployments.runner import RunnerDeployment
from prefect.types.entrypoint import EntrypointType

from pipelines.batch.flow import process_dataset
from pipelines.sequence import process_sequence


@dataclass(frozen=True)
class ServeOptions:
    """What is served, and when it runs by itself."""

    out: Path
    """Results go to OUT/<sequence>/"""
    data: Path | None = None
    """Manifest, or folder of captures, that the data set deployment processes; None for no such deployment"""
    cron: str | None = None
    """When it runs, as cron says it; None for only when somebody asks"""
    timezone: str = "UTC"
    """That `cron` means"""
    preset: str = "standard"
    at_once: int = 1
    """Runs at a time; others wait"""

    def __post_init__(self) -> None:
        if self.cron is not None and self.data is None:
            raise ValueError("a schedule needs a data set: name a manifest, or a folder of captures, with --data")
        if self.cron is not None:
            CronSchedule(cron=self.cron, timezone=self.timezone)  # raises ValueError for what is none


def serve_deployments(options: ServeOptions) -> None:
    """Wait for runs and start them, each in a process of its own, until the process is asked to end."""
    serve(*deployments(options), limit=options.at_once, print_starting_message=False)


def deployments(options: ServeOptions) -> list[RunnerDeployment]:
    """Of the sequence flow, and of the data set flow where there is a data set."""
    common: dict[str, Any] = {"out": str(options.out), "preset": options.preset}
    made = [
        RunnerDeployment.from_flow(
            process_sequence,
            "on-demand",
            description="One capture. Fill in its folder; everything else has a default.",
            parameters={"request": common},
            entrypoint_type=EntrypointType.MODULE_PATH,
            tags=["packuv"],
        )
    ]
    if options.data is not None:
        made.append(
            RunnerDeployment.from_flow(
                process_dataset,
                "nightly",
                description=f"All captures of {options.data}: those that are new, changed or failed.",
                parameters={"request": {"manifest": str(options.data), **common}},
                schedules=[CronSchedule(cron=options.cron, timezone=options.timezone)] if options.cron else None,
                entrypoint_type=EntrypointType.MODULE_PATH,
                concurrency_limit=1,
                tags=["packuv"],
            )
        )
    return made
