"""Which points of the ladder a run may take that is given a time, an error or both instead of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.forecast import Machine, Size, forecast, pilot_minutes
from pipelines.options import SequenceOptions
from pipelines.request import RunRequest
from tasks.report.facts import Choice

PILOT_FRAMES = 6
"""Frames of a pilot, the first of the sequence. They are no better than later ones, so that a pilot does not flatter"""


@dataclass(frozen=True)
class Priced:
    """A point of the ladder and what it will take."""

    name: str
    minutes: float
    """Of the whole run, without pilots"""
    pilot_minutes: float


Affordable = tuple[Priced, ...]
"""From fast to fine"""


def check_judges(request: RunRequest, held_out: tuple[str, ...]) -> None:
    """Raises ValueError where an error is asked for and no camera is held out."""
    if request.target_psnr is not None and not held_out:
        raise ValueError(
            "a target for PSNR needs cameras that are never fitted, but none is held out; name some with --hold-out, "
            "or as held_out in capture.toml"
        )


def affordable(request: RunRequest, points: Mapping[str, SequenceOptions], size: Size, machine: Machine) -> Affordable:
    """The points that fit into the time, all of them without one; for an error with the pilots of those before.

    `points` run from fast to fine. Raises ValueError where not even the fastest fits.
    """
    found: list[Priced] = []
    spent = 0.0
    for name, options in points.items():
        minutes = forecast(size, options, machine, request.stop_after).minutes
        pilot = pilot_minutes(size, options, machine, PILOT_FRAMES) if request.target_psnr is not None else 0.0
        spent += pilot
        if request.max_minutes is not None and spent + minutes > request.max_minutes:
            break
        found.append(Priced(name, minutes, pilot))
    if not found:
        raise ValueError(
            f"even the fastest settings ({name}) are forecast to take {spent + minutes:.3g} minutes here, "
            f"but {request.max_minutes:g} are allowed; allow more, or process fewer --frames"
        )
    return tuple(found)


def chosen_of(request: RunRequest, point: Priced) -> Choice:
    """The choice of this point, before the run."""
    return Choice(point.name, point.minutes, request.max_minutes, request.target_psnr)
