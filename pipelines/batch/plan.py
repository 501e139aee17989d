"""What is to do for a data set: which sequences run, and why. Opens no video and no store."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import packuv
from pipelines.batch.choice import choose, frames_of, problem_of, read_sequences
from pipelines.batch.request import BatchRequest
from pipelines.batch.table import Result, ResultTable, Rows, Status
from pipelines.dataset import survey
from pipelines.manifest import update
from pipelines.options import compose
from pipelines.register import find_runs
from pipelines.request import RunRequest
from pipelines.stages import Sequence  # which imports every stage
from sync.capture import SETTINGS, Capture, CaptureSettings, find_capture, find_lender, find_plate
from sync.masks import find_masks
from tasks.artefacts.digests import signature
from tasks.artefacts.recipe import digest, plain
from tasks.artefacts.retention import RUN
from tasks.artefacts.stage import Stage

SHORT = 16
"""Hex digits of each part of a fingerprint"""
OF_THE_MACHINE = ("out", "cores", "memory_gb")
"""Fields of a request that change no result"""


@dataclass(frozen=True)
class Fingerprint:
    """By which is known whether a sequence has to run again."""

    asked: str
    """Digest of the request and the settings that follow from it"""
    program: str
    """Digest of the package's version and those of all stages"""
    capture: str
    """Digest of sizes, times and inodes of the raw files; empty where they cannot be listed"""
    result: str = ""
    """Likewise of size and time of what came out"""

    @classmethod
    def parse(cls, text: str) -> Fingerprint:
        """Of a row."""
        return cls(*(text.split("-") + [""] * 4)[:4])

    def __str__(self) -> str:
        return "-".join((self.asked, self.program, self.capture, self.result))


@dataclass(frozen=True)
class Step:
    """One sequence of a batch."""

    request: RunRequest
    frames: int
    """To process, as far as the manifest tells"""
    fingerprint: Fingerprint
    """Of what is asked, without a result"""
    why: str
    """It runs; empty: it is there already"""
    problem: str | None
    """Why it cannot run, as the manifest tells"""
    earlier: Result | None

    @property
    def name(self) -> str:
        assert self.request.name is not None
        return self.request.name

    @property
    def runs(self) -> bool:
        return bool(self.why) and self.problem is None

    @property
    def does(self) -> str:
        """For people."""
        return "bad input" if self.problem is not None else "runs" if self.runs else "there already"


@dataclass(frozen=True)
class Plan:
    """What is to do."""

    steps: tuple[Step, ...]
    """Every sequence that was asked for"""
    others: tuple[Result, ...]
    """Of the same output folder, not asked for this time"""
    killed: tuple[Result, ...]
    """Sequences whose last run was killed, asked for or not"""

    @property
    def to_run(self) -> tuple[Step, ...]:
        return tuple(step for step in self.steps if step.runs)


def with_manifest(request: BatchRequest) -> BatchRequest:
    """The request, with a manifest in place of a folder: `out`/<folder>.parquet, brought up to date."""
    folder = Path(request.manifest)
    if not folder.is_dir():
        return request
    path = Path(request.out) / f"{folder.name}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    update(path, survey(folder))
    return replace(request, manifest=str(path))


def plan_batch(request: BatchRequest) -> Plan:
    """What the request means now.

    Raises FileNotFoundError or ValueError without a manifest, for settings that do not exist, for filters that leave
    nothing, and where the same manifest is being processed into the same folder.
    """
    out = Path(request.out)
    sequences = read_sequences(Path(request.manifest))
    chosen = choose(sequences, request)
    asked = _asked(request)
    _check_alone(out, request)
    rows = ResultTable(request.table).read()
    killed = {result.sequence: result for result in _killed([entry.sequence for entry in sequences], rows, request)}
    rows |= {(result.sequence, result.out): result for result in killed.values()}
    steps = []
    for entry in chosen:
        single, earlier = request.of_sequence(entry.sequence, str(entry.capture)), rows.get((entry.sequence, str(out)))
        seen = Fingerprint(asked, program_digest(), _capture_digest(entry.capture))
        frames, problem = frames_of(entry, single.instants), problem_of(entry)
        steps.append(Step(single, frames, seen, problem or _why(seen, earlier), problem, earlier))
    return Plan(tuple(steps), tuple(_others(rows, request, {step.name for step in steps})), tuple(killed.values()))


def look_again(step: Step) -> Step:
    """The step with the raw files as they are now, since hours may have passed."""
    now = replace(step.fingerprint, capture=_capture_digest(Path(step.request.capture)))
    return replace(step, fingerprint=now)


def with_result(fingerprint: Fingerprint, scene: Path | None, report: Path) -> Fingerprint:
    """The fingerprint of a finished sequence, which names what came out."""
    return replace(fingerprint, result=_result_digest(report if scene is None else scene))


def _asked(request: BatchRequest) -> str:
    """Not only what is asked, but what it means: presets may change."""
    single = plain(request.of_sequence("any", "/"))
    options = compose(request.preset, CaptureSettings(), request.settings, seed=request.seed, quality=request.quality)
    kept = {name: value for name, value in single.items() if name not in OF_THE_MACHINE}
    return digest([kept, plain(options)])[:SHORT]


@cache
def program_digest() -> str:
    """Changes with the package's version and with that of any stage."""
    assert Sequence.__module__, "every stage is imported with it"
    kinds = sorted((kind.__name__, kind.name, kind.version) for kind in _stages(Stage))  # type: ignore[type-abstract]
    return digest([packuv.__version__, kinds])[:SHORT]


def _stages(kind: type[Stage]) -> Iterator[type[Stage]]:
    for inner in kind.__subclasses__():
        if inner.__module__.startswith("tasks.stages."):
            yield inner
        yield from _stages(inner)


def _capture_digest(folder: Path) -> str:
    try:
        capture = find_capture(folder)
        seen = {os.path.relpath(path, folder): signature(path) for path in _raw_files(capture)}
    except (OSError, ValueError):  # which the run itself will say
        return ""
    return digest([str(folder), seen])[:SHORT]


def _raw_files(capture: Capture) -> Iterator[Path]:
    """All that a run of it reads, of the take whose rig it uses, too; raises as `find_lender` and `find_masks` do."""
    for by_camera in (capture.videos, capture.timecodes, find_masks(capture), find_plate(capture)):
        yield from by_camera.values()
    if (capture.folder / SETTINGS).is_file():
        yield capture.folder / SETTINGS
    if capture.calibration is not None:
        yield from [path for path in capture.calibration.rglob("*") if path.is_file()]
        yield capture.calibration
    if capture.offsets is not None:
        yield capture.offsets
    if (lender := find_lender(capture)) is not None:
        yield from _raw_files(lender)


def _result_digest(path: Path) -> str:
    """Not the inode: results may be copied to another disk."""
    try:
        return digest(signature(path)[:2])[:SHORT]
    except OSError:
        return ""


def _why(now: Fingerprint, earlier: Result | None) -> str:
    if earlier is None:
        return "new"
    if earlier.status is Status.KILLED:
        return earlier.reason
    if earlier.status is not Status.FINISHED:
        return f"{earlier.status} before: {earlier.reason}" if earlier.reason else f"{earlier.status} before"
    then = Fingerprint.parse(earlier.fingerprint)
    if then.asked != now.asked:
        return "other settings than before"
    if then.program != now.program:
        return f"made by another packuv ({earlier.packuv})"
    if then.capture != now.capture or not now.capture:
        return "the capture changed"
    result = Path(earlier.scene or earlier.report or "")
    if _result_digest(result) != then.result or not then.result:
        return f"{result.name} is {'another' if result.is_file() else 'gone'}"
    return ""


def _check_alone(out: Path, request: BatchRequest) -> None:
    for found in find_runs(out):
        if found.alive and found.record.capture == request.manifest:
            record = found.record
            raise ValueError(
                f"a batch of {request.manifest} runs in {out} since {record.started} ({record.host}, process "
                f"{record.pid}); packuv status tells how far it is, packuv cancel ends it"
            )


def _killed(names: list[str], rows: Rows, request: BatchRequest) -> Iterator[Result]:
    """Of sequences whose last run left its record behind, or that somebody has found since."""
    for name in names:
        folder, row = Path(request.out) / name, rows.get((name, request.out))
        runs = find_runs(folder)
        if runs and not any(run.alive for run in runs):
            last = runs[-1]
            yield _killed_row(name, request, last.ending, last.record.started, last.record.updated)
        elif not runs and (row is None or row.status is not Status.FINISHED):
            with contextlib.suppress(OSError, ValueError):
                run = json.loads((folder / RUN).read_text())
                if run["outcome"] == Status.KILLED and (row is None or row.started < run["started"]):
                    yield _killed_row(name, request, run["reason"], run["started"], run["finished"])


def _killed_row(name: str, request: BatchRequest, reason: str, started: str, finished: str) -> Result:
    result = Result(name, request.out, Status.KILLED, reason=reason, preset=request.preset)
    return replace(result, started=started, finished=finished)


def _others(rows: Rows, request: BatchRequest, chosen: set[str]) -> Iterator[Result]:
    for (name, out), result in rows.items():
        if out == request.out and name not in chosen:
            yield result
