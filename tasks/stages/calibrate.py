"""Calibrate: the cameras, points of the scene, and what makes the cameras' colours agree."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibration.accept import CheckOptions, MatchOptions, Verdict, check_rig
from calibration.colour import BalanceOptions, balance, with_gains
from calibration.importers import load_rig
from calibration.judge import judge
from calibration.rig import Rig
from calibration.solve import SolveOptions, solve_rig
from calibration.triangulate import SparsePoints, TriangulateOptions, triangulate
from packuv.files import save_json
from packuv.footage import FrameReader
from packuv.progress import Progress
from sync.align import FrameGroups
from sync.capture import Capture, find_capture
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.footage import RIG, Footage
from tasks.stages.plan import Plan
from tasks.stages.synchronize import read_videos

RIG_VERSION = 1
POINTS_VERSION = 1
CHECK, MATCHES, POINTS, COLOUR = "check.json", "matches.json", "points.npz", "colour.json"


@dataclass(frozen=True)
class RigOptions:
    """How cameras are found and judged."""

    check: CheckOptions = field(default_factory=CheckOptions)
    judge: TriangulateOptions = field(default_factory=lambda: TriangulateOptions(judge=MatchOptions(min_explained=0.5)))
    """Matches by which a calibration that is given is judged. Milder than a solve's: a given calibration that is wrong
    explains a few percent, while few cameras before patterned walls let chance matches in (78 % in the demo)"""
    trust: bool = False
    """Use a given calibration although the pictures contradict it"""
    solve: SolveOptions = field(default_factory=lambda: SolveOptions(min_registered=1.0))
    """A camera without a pose is of no use: all must be placed"""
    more_instants: int = 4
    """Instants, spread over the recording, to solve from when one does not suffice"""

    def __post_init__(self) -> None:
        if self.more_instants < 1:
            raise ValueError(f"more_instants must be at least 1, but is {self.more_instants}")


@dataclass(frozen=True)
class PointOptions:
    """How points and colours are found."""

    triangulate: TriangulateOptions = field(default_factory=TriangulateOptions)
    balance: BalanceOptions = field(default_factory=BalanceOptions)
    more_instants: tuple[int, ...] = (15, 30)
    """Instants after the first whose points tell colours too: cameras that start late have none in the first"""


def find_rig(workshop: Workshop, plan: Plan, groups: Key, options: RigOptions) -> Key:
    """Import and judge the calibration of the capture, or solve it: rig.json, check.json, matches.json."""
    capture = find_capture(plan.capture)
    cameras = tuple(plan.videos)
    footage = Footage(plan.capture, workshop.path(groups), Path(), cameras, 0, None)
    arguments: dict[str, Any] = {"footage": footage, "first": plan.first, "options": options}
    reads: dict[str, Any] = {"rig": options, "cameras": cameras, "first": plan.first}
    inputs: dict[str, Any] = {"groups": groups}
    if capture.calibration is None:
        return workshop.make("rig", RIG_VERSION, reads, inputs, "tasks.stages.calibrate:build_solution", arguments)
    source = capture.calibration
    workshop.listener.skipped("COLMAP", f"{_place(capture)} holds {_kind(source)}")
    inputs["calibration"] = workshop.digests(_files(source), "reading calibration")
    arguments["calibration"] = source
    return workshop.make("rig", RIG_VERSION, reads, inputs, "tasks.stages.calibrate:build_import", arguments)


def find_points(workshop: Workshop, plan: Plan, groups: Key, rig: Key, options: PointOptions) -> Key:
    """Triangulate points and balance the colours: points.npz of the first instant, rig.json with gains, colour.json.

    Only fitted cameras take part; the others keep a gain of 1.
    """
    footage = Footage(plan.capture, workshop.path(groups), workshop.path(rig), tuple(plan.videos), plan.first, None)
    arguments = {"footage": footage, "fitted": plan.fitted, "options": options}
    reads = {"points": options, "cameras": list(plan.videos), "fitted": plan.fitted, "first": plan.first}
    inputs = {"groups": groups, "rig": rig}
    key = workshop.make("points", POINTS_VERSION, reads, inputs, "tasks.stages.calibrate:build_points", arguments)
    notes = workshop.store.receipt(key).notes
    if not notes["points"]:
        workshop.listener.skipped("sparse points", f"{notes['reason']}; the fit starts at random places")
    elif not notes["balanced"]:
        workshop.listener.skipped("colour balance", notes["reason"])
    return key


def build_import(
    footage: Footage, calibration: Path, first: int, options: RigOptions, out: Path, progress: Progress
) -> dict[str, Any]:
    """The job behind `find_rig` where a calibration is given."""
    sizes = {name: (video["width"], video["height"]) for name, video in read_videos(footage.groups).items()}
    rig = load_rig(calibration, footage.cameras).resized(sizes)
    progress(0, 1, "comparing the calibration with the pictures")
    judgement = judge(rig, filmed(footage, first), options=options.judge)
    if judgement.matches.verdict is Verdict.REJECTED and not options.trust:
        raise ValueError(
            f"{calibration} does not agree with the pictures: {judgement.matches.reason}; correct it, write "
            'calibration = "solve" into capture.toml to have it solved, or use it as it is with --set rig.trust=true'
        )
    _save_rig(judgement.rig, options, judgement.to_json(), out)
    return {"source": "import", "reading": judgement.reading.value, "verdict": judgement.matches.reason}


def build_solution(
    footage: Footage, first: int, options: RigOptions, out: Path, scratch: Path, progress: Progress
) -> dict[str, Any]:
    """The job behind `find_rig` where the rig must be solved: from one instant, and from several if that fails."""
    instants = complete_instants(footage.load_groups(), footage.cameras, first)
    progress(0, 1, "COLMAP")
    try:
        rig = solve_rig(filmed(footage, instants[0]), options.solve, scratch)
    except ValueError:
        if options.more_instants == 1 or len(instants) == 1:
            raise
        chosen = instants[np.linspace(0, len(instants) - 1, options.more_instants).round().astype(int)]
        progress(0, 1, f"COLMAP, {len(set(chosen.tolist()))} instants")
        shots = [filmed(footage, instant) for instant in sorted(set(chosen.tolist()))]
        pictures = {name: [shot[name] for shot in shots] for name in footage.cameras}
        rig = solve_rig(pictures, options.solve, scratch)
    _save_rig(rig.select(footage.cameras), options, {"source": rig.source}, out)
    return {"source": "COLMAP", "verdict": rig.source}


def build_points(
    footage: Footage, fitted: tuple[str, ...], options: PointOptions, out: Path, progress: Progress
) -> dict[str, Any]:
    """The job behind `find_points`."""
    rig = footage.load_rig()
    count = len(footage.load_groups().times_ns)
    chosen = [0, *(instant for instant in options.more_instants if 0 < instant < count)]
    shown = ({name: picture for name, picture in filmed(footage, instant).items() if name in fitted}
             for instant in chosen)  # fmt: skip
    progress(0, 1, "matching features")
    try:
        points = triangulate(rig.select(fitted), shown, options=options.triangulate)
    except ValueError as problem:  # the rig was judged before: it is the scene that shows too little
        rig.save(out / RIG)
        return {"points": 0, "balanced": False, "reason": str(problem)}
    report = balance(points, options=options.balance)
    points.save(out / POINTS)
    with_gains(rig, report).save(out / RIG)
    save_json(out / COLOUR, without_nan(report.to_json()))
    return {"points": len(points.xyz), "balanced": report.kept, "reason": report.reason, **_figures(points)}


def complete_instants(groups: FrameGroups, cameras: tuple[str, ...], first: int) -> np.ndarray:
    """Instants from `first` on at which every camera has a frame, int64 [n]; ValueError if there is none."""
    columns = [groups.cameras.index(name) for name in cameras]
    found = np.flatnonzero((groups.frames[:, columns] >= 0).all(axis=1))
    found = found[found >= first]
    if not len(found):
        raise ValueError(
            f"no instant from {first} on has frames of all {len(cameras)} cameras, as a solve needs; list cameras that "
            "film little under ignore in capture.toml, or give a calibration"
        )
    return found


def _save_rig(rig: Rig, options: RigOptions, evidence: Mapping[str, Any], out: Path) -> None:
    report = check_rig(rig, options=options.check)
    rig.save(out / RIG)
    save_json(out / CHECK, without_nan(report.to_json()))
    save_json(out / MATCHES, without_nan(evidence))


def _figures(points: SparsePoints) -> dict[str, float]:
    return {"error_px": float(np.median(points.error_px)), "views": float(points.views.mean())}


def filmed(footage: Footage, instant: int) -> dict[str, np.ndarray]:
    """Pictures as filmed, uint8 [H, W, 3] RGB, of the cameras that have one at this instant of the footage."""
    groups, videos = footage.load_groups(), find_capture(footage.capture).videos
    reader = FrameReader({name: videos[name] for name in footage.cameras})
    numbers = {name: int(groups.frames[instant, groups.cameras.index(name)]) for name in footage.cameras}
    return {name: reader.read(name, number) for name, number in numbers.items() if number >= 0}


def without_nan(value: Any) -> Any:
    """The same JSON value with null for numbers that JSON cannot hold."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _files(source: Path) -> dict[str, Path]:
    """Every file of a calibration, by its relative name."""
    if source.is_file():
        return {source.name: source}
    return {str(path.relative_to(source)): path for path in sorted(source.rglob("*")) if path.is_file()}


def _place(capture: Capture) -> str:
    assert capture.calibration is not None
    folder = capture.calibration if capture.calibration.is_dir() else capture.calibration.parent
    inside = folder.is_relative_to(capture.folder)  # by name: it may be a link
    return f"{folder.relative_to(capture.folder) if inside else folder}/"


def _kind(source: Path) -> str:
    """What a calibration is, for people."""
    if source.is_dir():
        return "a COLMAP model" if any(source.glob("cameras.*")) else "a calibration"
    return source.name
