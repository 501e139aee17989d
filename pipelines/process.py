"""Processing one sequence: from what the user asks for to results where people find them."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from packuv.fit.device import choose_device
from packuv.partial import partial_path
from pipelines.chain import Submit
from pipelines.choice import PILOT_FRAMES, Affordable, Priced, affordable, check_judges, chosen_of
from pipelines.crew import CORES_PER_JOB, crew_of
from pipelines.events import Event, Journal
from pipelines.folder import claim
from pipelines.forecast import (
    Forecast,
    Guess,
    Machine,
    forecast,
    machine_of,
    question_of,
    size_of,
    size_told,
    with_rig,
)
from pipelines.ladder import up_to
from pipelines.lender import lender_of
from pipelines.options import SequenceOptions, check_raft, compose
from pipelines.probe import remembered
from pipelines.register import Place, bury, registered
from pipelines.request import RunRequest
from pipelines.results import REPORT, Ending, Run, collect, ending_of, remains, run_json
from pipelines.stages import Made, Sequence
from sync.capture import Capture, check_name, find_capture
from tasks.artefacts.jobs import CancelledError, JobError, Jobs
from tasks.artefacts.originals import Originals
from tasks.artefacts.recipe import plain, write_json
from tasks.artefacts.retention import RUN
from tasks.artefacts.stage import Stage
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import Maker, Workshop, make_here
from tasks.report.facts import Choice
from tasks.report.findings import Finding, findings
from tasks.report.summary import summary
from tasks.report.verdict import Verdict, verdict
from tasks.report.write import write_report
from tasks.stages.encode import SCENE
from tasks.stages.evaluate import METRICS
from tasks.stages.plan import Plan
from tasks.stages.scale import known_of
from tasks.stages.synchronize import read_videos

PARTIAL = "scene.partial.mkv"
FORECAST = "forecast"
IDLE_SECONDS = 5.0
"""For stages that are cut to say so"""
MOST_FINDINGS = 8
"""That the terminal shows"""
WORTH_MINUTES = 2.0
"""A run that seems to take less is not worth the seconds of a look at machine and capture"""


@dataclass(frozen=True)
class Outcome:
    """Where the results of a run are."""

    folder: Path
    """<out>/<sequence>"""
    scene: Path | None
    report: Path
    figures: Mapping[str, Any]
    """The report's summary: PSNR, SSIM, size, time; None where there is none"""
    events: tuple[Event, ...]
    findings: tuple[Finding, ...]
    """What in the results a person should look at, the worst first"""
    verdict: Verdict | None = None
    """Whether they may be delivered"""
    choice: Choice | None = None
    """Where a time or an error was asked for"""

    @property
    def missed(self) -> str:
        """By how much the error that was asked for is missed; empty where it is not."""
        return self.choice.missed if self.choice else ""

    def to_json(self) -> dict[str, Any]:
        """For `packuv run --json`."""
        return {
            "folder": str(self.folder),
            "scene": self.scene and str(self.scene),
            "report": str(self.report),
            "summary": dict(self.figures),
            "choice": plain(self.choice),
            "verdict": plain(self.verdict),
            "findings": [finding.text for finding in self.findings],
            "stages": [event.to_json() for event in self.events],
        }

    def farewell(self) -> str:
        """The last lines of a run."""
        lines = [*_doubts(self.findings), *_quality(self.figures), f"results    {self.folder}"]
        if self.verdict:
            lines.insert(0, f"verdict    {self.verdict.text}")
        if self.choice:
            lines.insert(0, f"chosen     {self.choice.told}")
        if self.scene:
            lines.append(f"scene      {self.scene}")
        lines.append(f"report     {self.report}")
        if self.scene:
            lines.append(f"view it    {shlex.join(['packuv', 'view', str(self.scene)])}")
        return "\n".join(lines)


def _doubts(findings: tuple[Finding, ...]) -> Iterator[str]:
    yield from (f"look at    {finding.text}" for finding in findings[:MOST_FINDINGS])
    if len(findings) > MOST_FINDINGS:
        yield f"look at    {len(findings) - MOST_FINDINGS} more findings in the report"


def _quality(figures: Mapping[str, Any]) -> Iterator[str]:
    if figures["psnr_db"] is not None:
        cameras = ", ".join(figures["scored_cameras"])
        unseen = "never fitted" if figures["held_out"] else "fitted"
        yield f"quality    {figures['psnr_db']:.2f} dB, SSIM {figures['ssim']:.4f} on {cameras} ({unseen})"
    if figures["fitted_psnr_db"] is not None:
        cameras, gap = ", ".join(figures["fitted_cameras"]), figures["fitted_gap_db"]
        yield f"fitted     {figures['fitted_psnr_db']:.2f} dB on {cameras}, {gap:+.2f} dB against unseen cameras"
    if figures["mb_per_30_frames"] is not None:
        yield f"size       {figures['mb_per_30_frames']:.2f} MB per 30 frames"


@dataclass(frozen=True)
class Engine:
    """Who starts the stages of a run."""

    submitter: Callable[[Callable[[Stage], Key]], Submit]
    """Given who makes stages, starts them"""
    maker: Maker = make_here
    """Who makes them"""
    place: Place | None = None
    """Where the workflow engine knows the run"""
    crashed: Callable[[Place], None] = lambda place: None
    """Told of an earlier run that was killed"""
    watched: bool = False
    """Somebody may look at pictures while the run goes on"""


def process_directly(request: RunRequest, journal: Journal, jobs: Jobs | None = None) -> Outcome:
    """Process a sequence in this process and its jobs, without the workflow engine."""
    with crew_of(request) as crew, ThreadPoolExecutor(max_workers=jobs_at_once(crew.request)) as pool:
        if crew.told:
            journal.told("cluster", crew.told)
        engine = Engine(lambda make: lambda stage: pool.submit(make, stage), crew.maker)
        return process(crew.request, journal, engine, jobs or jobs_of(crew.request))


def process(request: RunRequest, journal: Journal, engine: Engine, jobs: Jobs) -> Outcome:
    """Process a sequence by stages that the engine starts.

    Raises ValueError or FileNotFoundError for bad input, OSError when the disk cannot hold the results, CancelledError
    when the jobs are cancelled, and what a failing stage raises. Whatever ends the run, no job goes on after it.
    """
    capture = find_sequence(request)
    claim(Path(request.out) / capture.name, capture)
    affordable = affordable_points(request, jobs)
    sequence, run = prepare(request, journal, engine, jobs, affordable)
    folder, workshop = run.workshop.store.root.parent, run.workshop
    bury(folder, engine.crashed)
    on_record = registered(
        folder, sequence=run.name, capture=request.capture, preset=request.preset, engine=engine.place
    )
    flow_run = engine.place.flow_run if engine.place else None
    expected = list[Forecast]()
    with workshop.store.in_use(), on_record as register, journal.heard_by(register):
        try:
            sequence, run = settle(sequence, run, engine, affordable)
            whole = replace(sequence, synchronized=partial(foresee, run, journal, expected))
            whole.run(request.stop_after)
            run = replace(run, forecast=next(iter(expected), None))
            outcome = _publish(run, folder)
        except BaseException as error:
            jobs.cancel()
            journal.wait_until_idle(IDLE_SECONDS)
            with suppress(OSError):  # the first fault counts
                write_json(folder / RUN, run_json(run, ending_of(error), flow_run))
                if isinstance(error, (Exception, KeyboardInterrupt)) and not isinstance(error, CancelledError):
                    _leave_finished(sequence, folder)
            raise
        finished = Ending("finished", outcome.missed)
        write_json(folder / RUN, run_json(replace(run, choice=outcome.choice), finished, flow_run))
        return outcome


def foresee(run: Run, journal: Journal, expected: list[Forecast], groups: Key) -> None:
    """Add what the run will take, had nothing been there; nothing where that is not worth a look, or others do the
    work. A look that fails is told, and ends no run."""
    if run.request.cluster is not None:
        return
    jobs, folder = run.workshop.jobs, run.workshop.store.root.parent
    videos = read_videos(run.workshop.path(groups))
    told = {name: (video["width"], video["height"], video["frames"]) for name, video in videos.items()}
    size, at_once = with_rig(size_told(told, run.plan), run.workshop.capture), jobs_at_once(run.request)
    question = question_of(run.plan, size, (run.options,))
    rough = forecast(size, run.options, Machine(Guess(), at_once), run.request.stop_after)
    if rough.minutes < WORTH_MINUTES and remembered(folder, question, jobs) is None:
        return
    journal.started(FORECAST)
    try:
        machine = machine_of(folder, question, jobs, at_once, progress=partial(journal.moved, FORECAST))
        expected.append(forecast(size, run.options, machine, run.request.stop_after))
    except (ValueError, OSError, JobError) as error:
        journal.told(FORECAST, f"none: {error}")
    else:
        journal.told(FORECAST, expected[0].told)
    finally:
        journal.ended(FORECAST)


def is_made(request: RunRequest) -> bool:
    """Whether every artefact of the run is there, so that nobody is needed to make one."""
    jobs = jobs_of(request)
    jobs.cancel("only looking")
    try:
        return walk(request, affordable_points(request, jobs), Journal())[1]
    except Exception:  # whatever it is, the run itself meets it again
        return False


def walk(request: RunRequest, affordable: Affordable, journal: Journal) -> tuple[Made, bool]:
    """What of a run is there, up to the first artefact that is not, and whether that is all; makes nothing."""
    jobs = jobs_of(request)
    jobs.cancel("only looking")
    engine = Engine(lambda make: lambda stage: There(make(stage)))
    sequence, run = prepare(request, journal, engine, jobs, affordable)
    try:
        sequence, run = settle(sequence, run, engine, affordable)
        sequence.run(request.stop_after)
    except CancelledError:
        return run.made, False
    return run.made, True


@dataclass(frozen=True)
class There:
    """A `pipelines.chain.Future` of what is there."""

    key: Key

    def result(self) -> Key:
        return self.key


def affordable_points(request: RunRequest, jobs: Jobs) -> Affordable:
    """Points that may be chosen, from fast to fine; none where no time and no error is asked for.

    Raises ValueError where not even the fastest fits into the time, or an error is asked for and no camera held out.
    """
    capture = find_sequence(request)
    points = points_of(request, capture)
    if not points:
        return ()
    plan = plan_of(request, capture)
    check_judges(request, plan.held_out)
    folder, size = Path(request.out) / capture.name, size_of(capture, plan)
    machine = machine_of(folder, question_of(plan, size, tuple(points.values())), jobs, jobs_at_once(request))
    return affordable(request, points, size, machine)


def points_of(request: RunRequest, capture: Capture) -> dict[str, SequenceOptions]:
    """Points among which a time or an error that is asked for chooses, from fast to fine; none where neither is."""
    if request.max_minutes is None and request.target_psnr is None:
        return {}
    return {point: options_of(request, capture, point) for point in up_to(request.preset)}


def options_of(request: RunRequest, capture: Capture, point: str) -> SequenceOptions:
    """Of a run with the settings of this point of the ladder.

    Raises OptionError, or ValueError for weights that RAFT cannot work with.
    """
    options = compose(point, capture.settings, request.settings, seed=request.seed, quality=request.quality)
    check_raft(options)
    return options


def settle(sequence: Sequence, run: Run, engine: Engine, affordable: Affordable) -> tuple[Sequence, Run]:
    """The run at the point that reaches the error asked for, as pilots of the first frames tell."""
    target = run.request.target_psnr
    if target is None:
        return sequence, run
    tried: dict[str, float] = {}

    def prepared(point: Priced) -> tuple[Sequence, Run]:
        return prepare(run.request, run.journal, engine, run.workshop.jobs, (point,))

    for point in affordable:
        pilot, _ = prepared(point)
        scores = pilot.workshop.path(pilot.pilot(PILOT_FRAMES)) / METRICS
        level = json.loads(scores.read_text())["mean"]["psnr_calibrated_db"]
        if level is None:
            raise ValueError(
                f"a target for PSNR is judged by the first {PILOT_FRAMES} frames, but no camera held out filmed them; "
                "hold out another one, or begin later with --frames"
            )
        tried[point.name] = level
        run.journal.told(
            "pilot", f"{point.name}: {tried[point.name]:.2f} dB in the first frames, {target:g} are asked for"
        )
        if tried[point.name] >= target:
            break
    best = max(tried, key=lambda name: (tried[name] >= target, tried[name]))
    sequence, chosen = prepared(next(point for point in affordable if point.name == best))
    assert chosen.choice is not None
    spent = sum(point.pilot_minutes for point in affordable if point.name in tried)
    minutes = chosen.choice.forecast_minutes + spent
    choice = replace(chosen.choice, pilots=tried, forecast_minutes=minutes)
    return sequence, replace(chosen, choice=choice, started=run.started)


def prepare(
    request: RunRequest, journal: Journal, engine: Engine, jobs: Jobs, affordable: Affordable = ()
) -> tuple[Sequence, Run]:
    """The stages of a run, and what it leaves; its folder is there and belongs to the capture.

    Of the points that may be chosen it takes the finest, and the preset where there are none.
    """
    started = datetime.now(UTC)
    capture = find_sequence(request)
    choice = chosen_of(request, affordable[-1]) if affordable else None
    options = options_of(request, capture, choice.point if choice else request.preset)
    plan = plan_of(request, capture)
    device = plan.device
    options = replace(options, fit=replace(options.fit, device=device), raft=replace(options.raft, device=device))
    folder = Path(request.out) / capture.name
    claim(folder, capture)
    originals = Originals(capture, folder / "file_digests.json")
    workshop = Workshop(Store(folder / "store"), originals, jobs, journal, engine.maker)
    lender = lender_of(request, capture, workshop, engine.submitter)
    # Points are judged alike: small pictures score higher.
    judged = options_of(request, capture, request.preset).pictures if request.target_psnr is not None else None
    submit = engine.submitter(workshop.make)
    sequence = Sequence(workshop, plan, options, submit, Made(), lender, engine.watched, judged)
    return sequence, Run(folder.name, request, options, plan, workshop, journal, started, sequence.made, choice)


def find_sequence(request: RunRequest) -> Capture:
    """The capture under the name that its results get; raises ValueError or FileNotFoundError for bad input."""
    capture = find_capture(Path(request.capture))
    return capture if request.name is None else replace(capture, name=check_name(request.name))


def plan_of(request: RunRequest, capture: Capture) -> Plan:
    """What the request means for this capture; raises ValueError for cameras that it lacks or a missing GPU, or where
    capture.toml says of the rig's size what cannot be."""
    known_of(capture)
    first, stop = request.instants
    held_out = capture.settings.held_out if request.hold_out is None else request.hold_out
    device, side_by_side = choose_device(request.device), jobs_at_once(request) > 1
    named_once = tuple(dict.fromkeys(held_out))
    return Plan(capture.folder, capture.videos, named_once, first, stop, device, side_by_side)


def jobs_of(request: RunRequest) -> Jobs:
    """The jobs of a run, with the cores shared out evenly among those that run side by side."""
    threads = max(1, cores_of(request) // jobs_at_once(request))
    return Jobs(threads=threads, memory_bytes=round(1e9 * request.memory_gb))


def jobs_at_once(request: RunRequest) -> int:
    """Stages that may run side by side."""
    return request.jobs or max(1, cores_of(request) // CORES_PER_JOB)


def cores_of(request: RunRequest | None = None) -> int:
    """Cores that a run may keep busy; without one, those of this process."""
    asked = request.cores if request else None
    return asked or len(os.sched_getaffinity(0))


def _leave_finished(sequence: Sequence, folder: Path) -> None:
    """What is fitted of a run that stops, from the first segment on without a gap, as a scene file that plays."""
    if sequence.made.get("segment") and not sequence.made.get("encode"):
        sequence.encoded().write_finished(folder / PARTIAL, sequence.workshop.site)


def _publish(run: Run, folder: Path) -> Outcome:
    """Put the scene file and the report into the sequence's folder."""
    scene = None
    if key := run.made.get("encode"):
        scene = folder / SCENE
        place(run.workshop.path(key) / SCENE, scene)
        (folder / PARTIAL).unlink(missing_ok=True)
    run.journal.started(REPORT)
    content = collect(remains(run))
    limits = run.options.report
    report = write_report(content, folder, limits=limits)
    run.journal.ended(REPORT)
    events, found = tuple(run.journal.events), findings(content, limits)
    judged = verdict(content, limits, found)
    return Outcome(folder, scene, report.page, summary(content), events, found, judged, content.choice)


def place(source: Path, target: Path) -> None:
    """Give an artefact's file a second name, or a copy where the file system has no links; never half a file."""
    part = partial_path(target)
    part.unlink(missing_ok=True)  # of a killed run
    try:
        os.link(source, part)
    except OSError:
        shutil.copyfile(source, part)
    os.replace(part, target)
