"""What a run would do: what of it is there, what would run, what is spared and why, and what all of it takes.

Looks at captures and stores, and changes neither. Frames are matched as a run matches them, in a folder that is thrown
away, so that what a run refuses is refused here; then comes the look at the machine, of seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from packuv.lpips import lacking
from packuv.motion import MotionBackend
from packuv.progress import Progress, no_progress
from pipelines.choice import affordable, check_judges
from pipelines.disk import free_bytes
from pipelines.events import Event, Journal
from pipelines.forecast import (
    Forecast,
    Machine,
    Size,
    again_seconds,
    attempts,
    forecast,
    machine_of,
    minutes_text,
    question_of,
    with_rig,
)
from pipelines.options import SequenceOptions
from pipelines.process import There, find_sequence, jobs_at_once, jobs_of, options_of, plan_of, points_of, walk
from pipelines.request import STAGES, RunRequest
from pipelines.space import check_room, missing_bytes, size_found
from pipelines.stages import Made
from pipelines.stages import Sequence as Stages
from sync.capture import Capture, find_lender
from sync.masks import find_masks
from sync.nearby import unread
from tasks.artefacts.digests import Signature
from tasks.artefacts.originals import Originals
from tasks.artefacts.store import Store
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import check_given, check_lent
from tasks.stages.plan import Plan
from tasks.stages.scale import known_of
from tasks.stages.synchronize import UNREAD

LAST_OF = {
    "sync": "sync",
    "calibrate": "points",
    "flow": "keyframes",
    "encode": "encode",
    "verify": "verify",
    "evaluate": "evaluate",
}
"""Kind of the artefact that a stage ends with; the fit ends where the scene is encoded"""


@dataclass(frozen=True)
class Step:
    """One stage of `pipelines.request.STAGES`."""

    stage: str
    does: str
    """runs, goes on, or there already"""
    minutes: float
    """That are left"""


@dataclass(frozen=True)
class Ahead:
    """What a run would do."""

    name: str
    """Of the sequence"""
    preset: str
    size: Size
    steps: tuple[Step, ...]
    spared: tuple[tuple[str, str], ...]
    """What is not done, and why, as far as it is known before"""
    unknown: tuple[str, ...]
    """What the forecast leaves out"""
    forecast: Forecast
    """Had nothing been there"""
    moving: float | None
    """Share of the pictures' tiles that something moves in"""
    device: str
    """Who fits, cpu or cuda"""
    root: Path
    """Of the store"""

    @property
    def minutes(self) -> float:
        """That are left."""
        return sum(step.minutes for step in self.steps)

    @property
    def gpu_bytes(self) -> float:
        """Of the memory of a GPU, for the largest fit; 0 where none fits."""
        return self.forecast.gpu_bytes if self.device == "cuda" else 0

    def check_room(self) -> None:
        """Raise OSError (no space) where the disk cannot hold what is left to write."""
        check_room(self.root, self.forecast.disk_bytes)

    @property
    def missing_bytes(self) -> float:
        """On the disk, for what is left to write, with a margin."""
        return missing_bytes(self.root, self.forecast.disk_bytes)

    @property
    def free_bytes(self) -> int:
        return free_bytes(self.root)


def look_ahead(request: RunRequest, *, progress: Progress = no_progress) -> Ahead:
    """What this request would do now. Raises ValueError or FileNotFoundError for bad input, as the run itself would."""
    capture, jobs = find_sequence(request), jobs_of(request)
    plan, points = plan_of(request, capture), points_of(request, capture)
    check_judges(request, plan.held_out)
    root = Path(request.out) / capture.name / "store"
    size = _size(request, capture, plan, root, progress)
    asked = points or {request.preset: options_of(request, capture, request.preset)}
    question = question_of(plan, size, tuple(asked.values()))
    machine = machine_of(root.parent, question, jobs, jobs_at_once(request), afresh=not points, progress=progress)
    chosen = affordable(request, points, size, machine) if points else ()
    point = chosen[-1].name if chosen else request.preset
    options, journal = asked[point], Journal()
    expected = forecast(size, options, machine, request.stop_after)
    made = walk(request, chosen, journal)[0] if root.is_dir() else Made()
    return Ahead(
        capture.name,
        point,
        size,
        tuple(_steps(expected, made, Store(root))),
        tuple(dict.fromkeys([*_spared(capture, plan, options, size), *_skips(journal.events)])),
        tuple(_unknown(options, size, machine, request.target_psnr is not None)),
        expected,
        machine.probe.moving,
        plan.device,
        root,
    )


class _Passing(Journal):
    """Says how far a stage is to whoever watches the whole look."""

    def __init__(self, progress: Progress) -> None:
        super().__init__()
        self._progress = progress

    def moved(self, label: str, done: float, total: float, note: str = "") -> None:
        self._progress(done, total, f"{label} {note}".rstrip())


class _Unread(Originals):
    """A capture whose files are not read for their digests: nothing that is made of it is kept."""

    def digests(
        self, files: Mapping[str, Path], progress: Callable[[float, float, str], None] = lambda *_: None
    ) -> dict[str, str]:
        return dict.fromkeys(files, "unread")

    def look(self) -> dict[str, Signature]:
        return {}


def _size(request: RunRequest, capture: Capture, plan: Plan, root: Path, progress: Progress) -> Size:
    """How much there is to process, of frames that are matched as the run would match them, unless it did already."""
    lender = find_lender(capture)
    with _matched(request, capture, plan, root, progress) as (groups, _):
        size = size_found(groups, plan)
        if request.stop_after == "sync" or lender is None:
            return _placed(size, groups, request, capture, plan)
        known_of(lender)
        lending = Plan(lender.folder.absolute(), lender.videos, (), 0, None, "cpu", side_by_side=False)
        asked = replace(request, capture=str(lender.folder.absolute()), name=None, frames=":", hold_out=())
        with _matched(asked, lender, lending, root.parent.parent / lender.name / "store", progress) as (lent, made):
            whole = _placed(size_found(lent, lending), lent, request, lender, lending)
            check_lent(lent, groups, tuple(plan.videos))
        return size if made.get("rig") else replace(size, lender=whole)


def _placed(size: Size, groups: Path, request: RunRequest, capture: Capture, plan: Plan) -> Size:
    """Raises what a run would of this calibration and these videos."""
    if request.stop_after != "sync":
        check_given(capture.calibration, groups, tuple(plan.videos), plan.first)
    return with_rig(size, capture)


@contextmanager
def _matched(
    request: RunRequest, capture: Capture, plan: Plan, root: Path, progress: Progress
) -> Iterator[tuple[Path, Made]]:
    """The groups of frames, of the store or matched now, and what of the stages up to the rig is there."""
    matching = replace(request, stop_after="calibrate", max_minutes=None, target_psnr=None)
    made = walk(matching, (), Journal())[0] if root.is_dir() else Made()
    if (groups := made.get("sync")) and (made.get("mask_files") or not find_masks(capture)):
        yield Store(root).path(groups), made
        return
    jobs, options = jobs_of(request), options_of(request, capture, request.preset)
    with TemporaryDirectory(prefix="packuv-plan-") as folder:
        originals = _Unread(capture, Path(folder) / "file_digests.json")
        workshop = Workshop(Store(Path(folder) / "store"), originals, jobs, _Passing(progress))
        stages = Stages(workshop, plan, options, lambda stage: There(workshop.make(stage)), Made())
        yield workshop.path(stages.matched()), made


def _steps(expected: Forecast, made: Made, store: Store) -> Iterator[Step]:
    reached = {stage for stage, last in LAST_OF.items() if last in made.keys}
    if reached:
        reached |= set(STAGES[: max(STAGES.index(stage) for stage in reached) + 1])
    for stage, seconds in expected.seconds.items():
        left = 1.0
        if stage == "fit" and stage not in reached:
            left -= _fitted_frames(made, store) / expected.frames
        does = "there already" if stage in reached else "goes on" if left < 1 else "runs"
        yield Step(stage, does, 0.0 if stage in reached else left * seconds / 60)


def _fitted_frames(made: Made, store: Store) -> int:
    """Of the segments that are there."""
    spans = [store.receipt(key).recipe["options"].get("span", (0, 0)) for key in made.keys.get("segment", ())]
    return sum(stop - start for start, stop in spans)


def _spared(capture: Capture, plan: Plan, options: SequenceOptions, size: Size) -> Iterator[tuple[str, str]]:
    """Work that the capture or the settings spare."""
    fit = options.fit
    yield from ((UNREAD, note) for note in unread(capture))
    if capture.settings.rig_from:
        if not (size.lender and size.lender.solved):
            yield "solving the cameras", f"their rig is that of {capture.settings.rig_from}"
    elif capture.calibration is not None and not size.solved:
        given = capture.calibration.name + "/" * capture.calibration.is_dir()
        yield "solving the cameras", f"they are imported from {given}, if the pictures confirm them"
    if not options.light.enabled:
        yield "light", "light.enabled is false"
    if not fit.background.instants:
        yield "backdrop", "fit.background.instants is 0"
    if not options.content.enabled:
        yield "content", "content.enabled is false"
    if not options.patches.enabled:
        yield "patches", "patches.enabled is false"
    if not options.motion.keep_flow:
        yield "keeping optical flow", "motion.keep_flow is false"
    if not fit.sh_degree:
        yield "view dependence", "fit.sh_degree is 0"
    if not plan.held_out:
        yield "unseen scores", "no camera is held out"
    weights = options.evaluate.lpips_weights
    if why := lacking(Path(weights).resolve() if weights else None):
        yield "LPIPS", why


def _skips(events: Sequence[Event]) -> Iterator[tuple[str, str]]:
    yield from ((event.label, event.reason) for event in events if event.outcome == "skipped")


def _unknown(options: SequenceOptions, size: Size, machine: Machine, pilots: bool) -> Iterator[str]:
    if (size.lender or size).solved:
        yield _solve_told(size.lender or size, options, machine)
    if options.motion.backend is MotionBackend.RAFT:
        yield "optical flow by RAFT takes half a second to seconds a picture more without a GPU"
    if pilots:
        yield "pilots of --target-psnr"


def _solve_told(size: Size, options: SequenceOptions, machine: Machine) -> str:
    """How a solve is counted, and what it takes where that does not suffice."""
    known = ", of which the lenses alone are known," if size.lenses else ""
    first, then = attempts(size, options)
    instants = "one instant" if first == 1 else f"{first} instants"
    counted = (
        f"the cameras{known} have to be solved by COLMAP, which is counted as from {instants} of pictures full of "
        "features"
    )
    if first == then:
        return counted
    more = minutes_text(again_seconds(size, options, machine) / 60)
    return f"{counted}; where {'these do' if first > 1 else 'that does'} not place all, it takes {more} more"
