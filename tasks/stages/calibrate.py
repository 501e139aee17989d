"""Calibrate: the cameras, points of the scene, and what makes the cameras' colours agree."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.accept import CheckOptions, MatchOptions, PairMatches, Verdict, check_rig
from calibration.colour import BalanceOptions, ColourReport, balance, with_colours
from calibration.held_out import balance_held_out
from calibration.importers import find_calibration, holds_lenses_alone, load_lenses, load_rig
from calibration.judge import Judgement, SharedJudgement, judge, judge_shared, look_again, matches_at, mend, refined
from calibration.refine import LEVELS, PLACES, SOLVED, Refinement, RefineOptions, refine, sway
from calibration.rig import Camera, Rig
from calibration.solve import SolveOptions, solve_rig
from calibration.triangulate import SparsePoints, TriangulateOptions, triangulate
from calibration.turned import fitted
from packuv.files import map_npy, save_json
from sync.align import FrameGroups
from sync.capture import Capture, find_capture
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key, Store
from tasks.artefacts.workshop import Workshop
from tasks.stages.footage import RIG, Footage, PictureOptions, Take
from tasks.stages.plan import Plan
from tasks.stages.synchronize import read_videos

CHECK, MATCHES, POINTS, COLOUR = "check.json", "matches.json", "points.npz", "colour.json"

LEFT_OUT = "could not be placed by its pictures, so nothing is made of it; the others were (rig.solve.min_registered)"


@dataclass(frozen=True)
class RigOptions:
    """How cameras are found and judged."""

    check: CheckOptions = field(default_factory=CheckOptions)
    judge: TriangulateOptions = field(default_factory=lambda: TriangulateOptions(judge=MatchOptions(min_explained=0.5)))
    """Matches by which a calibration that is given is judged. Milder than a solve's: a given calibration that is wrong
    explains a few percent, while few cameras before patterned walls let chance matches in (78 % in the demo)"""
    trust: bool = False
    """Use a given calibration although the pictures contradict it"""
    repair: bool = True
    """Mend cameras of a given calibration that the pictures doubt, where they tell how; it is said by name"""
    refine: bool = False
    """Adjust all cameras to all matches, where that helps matches that the adjustment did not see. A solve of
    cameras whose lenses are known is always refined"""
    refining: RefineOptions = field(default_factory=RefineOptions)
    solve: SolveOptions = field(default_factory=lambda: SolveOptions(min_registered=1.0))
    """A camera without a pose is of no use: all must be placed, unless `min_registered` lets some be left out"""
    more_instants: int = 4
    """Instants, spread over the recording, to solve from, or to judge a calibration by, when one does not suffice"""

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


@dataclass(frozen=True, kw_only=True)
class ImportRig(Stage):
    """Import the calibration of the capture and judge it by the pictures: rig.json, check.json, matches.json."""

    name, version = "rig", 7
    take: Take
    """All cameras, as filmed"""
    first: int
    """Instant by which the calibration is judged"""
    files: Files
    options: RigOptions

    def build(self, work: Work) -> Notes:
        capture, footage = find_capture(work.site.capture), Footage(self.take, work.site)
        source = capture.calibration
        if source is None or calibration_files(source).keys() != self.files.sha256.keys():
            raise FileNotFoundError(f"the calibration of {capture.folder} is another one than when the run began")
        pictures = footage.filmed(self.first)
        sizes = _sizes(footage, pictures, read_videos(work.path(self.take.groups)))
        kind, place = _kind(source), _place(capture)
        # No path of this machine goes into an artefact: the same capture elsewhere gives the same bytes.
        given = replace(load_rig(source, self.take.cameras, sizes), source=f"{kind} in {place}")
        rig, turned = fitted(given, sizes)
        work.progress(0, 1, "comparing the calibration with the pictures")
        judgement = judge(rig, pictures, turned=turned, options=self.options.judge)
        if judgement.matches.verdict is Verdict.REJECTED and not self.options.trust:
            raise ValueError(
                f"{source} does not agree with the pictures: {judgement.matches.reason}; correct it, write "
                'calibration = "solve" into capture.toml to have it solved, or use it as it is with '
                "--set rig.trust=true"
            )
        last = len(footage.load_groups().times_ns) - 1
        later = np.unique(np.linspace(self.first, last, self.options.more_instants + 1).round().astype(int))[1:]
        doubted = bool(judgement.doubts)
        if doubted:
            work.progress(0, 1, "comparing it with more pictures")
            judgement = look_again(judgement, map(footage.filmed, later), options=self.options.judge)
        if judgement.doubts and self.options.repair and not self.options.trust:
            work.progress(0, 1, "mending what the pictures doubt")
            judgement = mend(judgement, options=self.options.judge)
        if self.options.refine and not self.options.trust:
            work.progress(0, 1, "refining all cameras")
            more = () if doubted else later  # those have been looked at
            judgement = refined(
                judgement, map(footage.filmed, more), options=self.options.judge, refining=self.options.refining
            )
        moved = judgement.refined.told(self.options.refining) if judgement.refined else {}
        odd = {**moved, **_turned(judgement), **_strays(capture, source), **judgement.doubts, **judgement.mended}
        _save_rig(judgement.rig, self.options, judgement.to_json(), work.out, odd=odd)
        held, verdict = f"{place} holds {kind}", judgement.matches.reason
        notes = {"source": "import", "given": held, "reading": judgement.reading.value}
        return {**notes, **_refined_notes(verdict, judgement.refined)}

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        yield "COLMAP", notes["given"]
        if "unrefined" in notes:
            yield "refining the cameras", notes["unrefined"]


@dataclass(frozen=True, kw_only=True)
class BorrowRig(Stage):
    """Use the rig of another take, and find cameras that were moved since: rig.json, check.json, matches.json."""

    name, version = "rig", 1
    take: Take
    """All cameras, as filmed"""
    first: int
    """Instant from which on the rig is compared with the pictures"""
    lender: str
    """Name of the other take's sequence; its store lies beside this one's"""
    rig: Files
    """The other take's rig.json"""
    options: RigOptions

    def build(self, work: Work) -> Notes:
        footage, options = Footage(self.take, work.site), self.options
        sizes = _sizes(footage, footage.filmed(self.first), read_videos(work.path(self.take.groups)))
        lent = Rig.load(_lent(store_of(work.site.store, self.lender), self.rig)).select(self.take.cameras)
        rig = replace(lent, source=f"rig of {self.lender}: {lent.source}").resized(sizes)
        work.progress(0, 1, f"comparing the rig of {self.lender} with the pictures")
        last = len(footage.load_groups().times_ns) - 1
        instants = np.unique(np.linspace(self.first, last, options.more_instants).round().astype(int))
        judgement = judge_shared(rig, map(footage.filmed, instants), options=options.judge)
        moved = {name: _moved(name, judgement, self.lender) for name in judgement.moved}
        if not options.trust:
            self._check(judgement, moved)
        _save_rig(rig, options, judgement.to_json(), work.out, odd=moved)
        unsure = [name for name in rig.names if name not in judgement.standings]
        return {"source": self.lender, "verdict": judgement.matches.reason, "moved": moved, "unsure": unsure}

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        yield "COLMAP", f"rig of {self.lender}"
        if notes["unsure"]:
            names = ", ".join(notes["unsure"])
            yield "moved cameras", f"pictures say too little to tell whether {names} stand where {self.lender} had them"

    def _check(self, judgement: SharedJudgement, moved: Mapping[str, str]) -> None:
        """Raise ValueError for a rig that cannot be used as it is."""
        least = self.options.judge.judge.bad_share
        lost = [name for name in moved if judgement.standings[name].fitting < least]
        again = "take rig_from out of capture.toml to have this take's rig solved, or use it with --set rig.trust=true"
        if lost:
            found = "; ".join(f"{name} {moved[name]}" for name in lost)
            names = ", ".join(f'"{name}"' for name in lost)
            raise ValueError(f"{found}; leave it out with ignore = [{names}] in capture.toml, {again}")
        if judgement.matches.verdict is Verdict.REJECTED:
            reason = judgement.matches.reason
            raise ValueError(f"the rig of {self.lender} does not agree with this take's pictures: {reason}; {again}")


@dataclass(frozen=True, kw_only=True)
class SolveRig(Stage):
    """Solve the rig, from one instant or from several, and the other way if that fails: rig.json, check.json,
    matches.json."""

    name, version = "rig", 4
    take: Take
    """All cameras, as filmed"""
    first: int
    """Instant from which on to solve"""
    lenses: Files = field(default_factory=lambda: Files({}))
    """A calibration of lenses alone, which are then known; else none"""
    options: RigOptions

    def build(self, work: Work) -> Notes:
        footage, options = Footage(self.take, work.site), self.options
        lenses = self._load_lenses(footage, work) if self.lenses.sha256 else None
        rig, shots = self._solve(footage, lenses, work)
        kept = [name for name in self.take.cameras if name in rig.names]
        left = {name: LEFT_OUT for name in self.take.cameras if name not in kept}
        rig, done, swaying = rig.select(kept), None, dict[str, float]()
        # Nobody gave places that it could differ from, so how far it moves is no news.
        refining = replace(options.refining, adjust=SOLVED, far=math.inf, far_deg=math.inf)
        if options.refine or lenses is not None:
            work.progress(0, 1, "refining all cameras")
            levels = PLACES if lenses is not None else LEVELS
            done = refine(rig, self._matches(rig, shots), levels=levels, options=refining)
        if lenses is None and not (done and done.freed):
            work.progress(0, 1, "freeing the lenses")
            swaying = sway(rig, self._matches(rig, shots), options=refining)
        told = {name: _swaying(share) for name, share in swaying.items() if share > refining.swaying}
        unsure = done.told(refining) if done else {}
        parts = {"refined": done.to_json() if done else None, "sway": swaying}
        evidence = {"source": rig.source, **{name: part for name, part in parts.items() if part}}
        _save_rig(done.rig if done else rig, options, evidence, work.out, odd={**told, **unsure, **left})
        return {"source": "COLMAP", **_refined_notes(rig.source, done)}

    def _solve(
        self, footage: Footage, lenses: Rig | None, work: Work
    ) -> tuple[Rig, Sequence[Mapping[str, np.ndarray]]]:
        """The attempt that places most cameras, and the pictures that it was made from."""
        instants = complete_instants(footage.load_groups(), self.take.cameras, self.first)
        found, problems = list[tuple[Rig, Sequence[Mapping[str, np.ndarray]]]](), dict[int, ValueError]()
        for chosen in _attempts(instants, self.options.more_instants, several_first=lenses is not None):
            work.progress(0, 1, f"COLMAP, {len(chosen)} instant{'s' * (len(chosen) > 1)}")
            shots = [footage.filmed(instant) for instant in chosen]
            pictures = {name: [shot[name] for shot in shots] for name in self.take.cameras}
            files = work.scratch / f"instants-{len(chosen)}"
            try:
                found.append((solve_rig(pictures, self.options.solve, files, lenses=lenses), shots))
            except ValueError as error:
                problems[len(chosen)] = error
            if found and len(found[-1][0].cameras) == len(self.take.cameras):
                break
        if not found:
            raise problems[max(problems)]  # that of several instants, since what one alone asks for is more of them
        return max(found, key=lambda one: len(one[0].cameras))

    def _load_lenses(self, footage: Footage, work: Work) -> Rig:
        capture = find_capture(work.site.capture)
        source = capture.calibration
        if source is None or calibration_files(source).keys() != self.lenses.sha256.keys():
            raise FileNotFoundError(f"the calibration of {capture.folder} is another one than when the run began")
        sizes = _sizes(footage, footage.filmed(self.first), read_videos(work.path(self.take.groups)))
        return load_lenses(source, self.take.cameras, sizes)

    def _matches(self, rig: Rig, shots: Sequence[Mapping[str, np.ndarray]]) -> list[PairMatches]:
        """Of the instants that it was solved from."""
        placed = ({name: shot[name] for name in rig.names} for shot in shots)
        return [pair for pairs in matches_at(rig, placed, options=self.options.judge) for pair in pairs]

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if "unrefined" in notes:
            yield "refining the cameras", notes["unrefined"]


def _swaying(share: float) -> str:
    return (
        f"stands where it does only to {share:.1%} of the rig's radius: other lenses explain its matches as well; "
        "lenses that are known (calibration/intri.yml alone) would tell"
    )


def _refined_notes(verdict: str, done: Refinement | None) -> Notes:
    """The verdict with what refining did, or why it did nothing."""
    if done is None:
        return {"verdict": verdict}
    if not done.freed:
        return {"verdict": verdict, "unrefined": done.reason}
    return {"verdict": f"{verdict}; {done.reason}"}


def _attempts(instants: np.ndarray, more: int, *, several_first: bool) -> list[list[int]]:
    """Instants to solve from: the first alone, and some spread over the recording. With known lenses these come before,
    since their poses are nearer; else they cost more than they are sure to bring (docs/calibration.md)."""
    first = [int(instants[0])]
    spread = instants[np.linspace(0, len(instants) - 1, more).round().astype(int)]
    several = sorted(set(spread.tolist()))
    if len(several) == 1:
        return [first]
    return [several, first] if several_first else [first, several]


def find_rig(
    workshop: Workshop, plan: Plan, groups: Key, pictures: PictureOptions, options: RigOptions
) -> ImportRig | SolveRig:
    """The stage for a capture with a calibration, or for one without."""
    take = Take(groups=groups, cameras=tuple(plan.videos), pictures=pictures.as_filmed)
    source = workshop.capture.calibration
    if source is None:
        # Trust is of given rigs: who trusts a lent one must not have it solved again.
        return SolveRig(take=take, first=plan.first, options=replace(options, trust=False))
    find_calibration(source)  # a folder without a calibration is a mistake, which no solution may hide
    files = workshop.files(calibration_files(source), "reading calibration")
    if holds_lenses_alone(source):
        return SolveRig(take=take, first=plan.first, lenses=files, options=replace(options, trust=False))
    return ImportRig(take=take, first=plan.first, files=files, options=options)


def check_given(source: Path | None, groups: Path, cameras: tuple[str, ...], first: int) -> None:
    """Raise what the stage of `find_rig` raises before it looks at pictures: of a calibration that cannot be read, or
    not for videos of these sizes, or where no instant is there to solve from; `groups` is a sync artefact."""
    videos = read_videos(groups)
    sizes = {name: (videos[name]["width"], videos[name]["height"]) for name in cameras}
    if source is not None and not holds_lenses_alone(source):
        fitted(load_rig(source, cameras, sizes), sizes)
        return
    if source is not None:
        load_lenses(source, cameras, sizes)
    complete_instants(FrameGroups.load(groups), cameras, first)


def check_lent(lender: Path, groups: Path, cameras: tuple[str, ...]) -> None:
    """Raise what `BorrowRig` raises before it looks at pictures: of a camera that films in another shape than in the
    take whose rig it uses; `lender` and `groups` are sync artefacts of the two."""
    lent, own = read_videos(lender), read_videos(groups)
    for name in cameras:
        width, height = lent[name]["width"], lent[name]["height"]
        Camera(name, width, height, 1, 1, 0, 0, np.eye(4)).resized(own[name]["width"], own[name]["height"])


def borrow_rig(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    pictures: PictureOptions,
    lender: Workshop,
    lent: Key,
    options: RigOptions,
) -> BorrowRig:
    """The stage for a capture that uses the rig of another one, which is there."""
    name = lender.store.root.parent.name
    return BorrowRig(
        take=Take(groups=groups, cameras=tuple(plan.videos), pictures=pictures.as_filmed),
        first=plan.first,
        lender=name,
        rig=lender.files({RIG: lender.path(lent) / RIG}, "reading rig"),
        options=options,
    )


def read_names(folder: Path) -> tuple[str, ...]:
    """Cameras of the rig of an artefact."""
    return Rig.load(folder / RIG).names


def store_of(store: Path, sequence: str) -> Path:
    """Where the artefacts of another sequence of the same output folder are, given those of one."""
    return store.parent.parent / sequence / store.name


@dataclass(frozen=True, kw_only=True)
class FindPoints(Stage):
    """Triangulate points and balance the colours: points.npz, rig.json with gains and shading, colour.json.

    Points, their colours, and the fitted cameras' gains and shading come from the pictures of fitted cameras alone; the
    others are brought to these points afterwards. Colours are those of steady light and exposure, so that gains hold at
    every instant.
    """

    name, version = "points", 3
    take: Take
    """All cameras, as filmed"""
    fitted: tuple[str, ...]
    options: PointOptions

    def build(self, work: Work) -> Notes:
        footage, options = Footage(self.take, work.site), self.options
        rig, watch = footage.load_rig(), footage.watch_for_log()
        light, count = footage.load_light(), len(footage.load_groups().times_ns)
        known = count if light is None else len(light.light)
        chosen = [0, *(instant for instant in options.more_instants if 0 < instant < min(known, count))]
        unseen = [name for name in rig.names if name not in self.fitted]
        kept = _KeptPictures(work.scratch, rig.names)

        def shown() -> Iterator[dict[str, np.ndarray]]:
            for instant in chosen:
                pictures = watch.passing(footage.filmed(instant))
                if unseen:
                    kept.add(pictures)
                yield {name: picture for name, picture in pictures.items() if name in self.fitted}

        work.progress(0, 1, "matching features")
        try:
            points = triangulate(rig.select(self.fitted), shown(), options=options.triangulate)
        except ValueError as problem:  # the rig was judged before: it is the scene that shows too little
            rig.save(work.out / RIG)
            return {"points": 0, "balanced": False, "reason": str(problem), "log_like": watch.suspects}
        work.progress(0, 1, "balancing colours")
        factors = None if light is None else light.of(rig.names, count)
        factors = None if factors is None else factors[chosen]
        points = _steady(points, rig.names, factors)
        report = balance(rig.select(self.fitted), points, options=options.balance)
        report = balance_held_out(
            rig,
            points,
            report,
            kept.load(),
            light=factors,
            patch_px=options.triangulate.patch_px,
            options=options.balance,
        )
        points.save(work.out / POINTS)
        with_colours(rig, report).save(work.out / RIG)
        save_json(work.out / COLOUR, without_nan(report.to_json()))
        return {"points": len(points.xyz), **_colour_notes(report), "log_like": watch.suspects, **_figures(points)}

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if not notes["points"]:
            yield "sparse points", f"{notes['reason']}; the fit starts at random places"
            return
        if not notes["balanced"]:
            yield "colour balance", notes["reason"]
        elif not notes["shaded"]:
            yield "lens shading", notes["shading"]
        for name, why in notes["unlike"].items():
            yield f"colour of {name}", why


class _KeptPictures:
    """Pictures of a few instants, kept in files until the colours of their points are known."""

    def __init__(self, folder: Path, cameras: tuple[str, ...]) -> None:
        self._folder, self._cameras, self._instants = folder, cameras, list[tuple[str, ...]]()

    def add(self, pictures: Mapping[str, np.ndarray]) -> None:
        """Those of the next instant."""
        for name, picture in pictures.items():
            np.save(self._path(len(self._instants), name), picture)
        self._instants.append(tuple(pictures))

    def load(self) -> list[dict[str, np.ndarray]]:
        """All of them by instant, mapped into memory."""
        return [
            {name: map_npy(self._path(index, name)) for name in names} for index, names in enumerate(self._instants)
        ]

    def _path(self, instant: int, camera: str) -> Path:
        return self._folder / f"picture-{instant}-{self._cameras.index(camera)}.npy"


def _colour_notes(report: ColourReport) -> Notes:
    few = {name: f"only {report.observations[name]} points tell its colours" for name in report.weak_cameras}
    return {
        "balanced": report.kept,
        "reason": report.reason,
        "shaded": report.shaded,
        "shading": report.shading_reason,
        "unlike": few if report.kept else {},  # where nothing is balanced, no camera is unlike others
    }


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


def _steady(points: SparsePoints, names: Sequence[str], factors: np.ndarray | None) -> SparsePoints:
    """Points with the colours that they have in steady light and exposure; `factors`, float [instants, cameras of
    these names, 3], is the natural logarithm of what both make of light."""
    if factors is None:
        return points
    columns = np.array([names.index(name) for name in points.cameras])
    changes = factors[points.instant[points.point], columns[points.camera]]  # [M, 3]
    return replace(points, colour=(points.colour / np.exp(changes)).astype(points.colour.dtype))


def _lent(root: Path, rig: Files) -> Path:
    """The rig.json of this content, from whichever recipe it was made."""
    store, sha256 = Store(root), rig.sha256[RIG]
    for key in store.keys():  # noqa: SIM118  # a store is no mapping
        if store.receipt(key).outputs.get(RIG, {}).get("sha256") == sha256:
            return store.path(key) / RIG
    raise FileNotFoundError(f"the store {root} has lost its rig since the run began; start the run again")


def _moved(name: str, judgement: SharedJudgement, lender: str) -> str:
    """What the pictures say of a moved camera, for people."""
    standing = judgement.standings[name]
    fit = f"{standing.fitting:.0%} of its matches fit, others {judgement.usual():.0%}"
    return f"has been moved since {lender}: {fit}, its picture lies {standing.offset_px:.1f} px off"


def _save_rig(
    rig: Rig, options: RigOptions, evidence: Mapping[str, Any], out: Path, *, odd: Mapping[str, str] | None = None
) -> None:
    """`odd` is what pictures say about single cameras."""
    report = check_rig(rig, options=options.check)
    report = replace(report, suspicious={**report.suspicious, **(odd or {})})
    rig.save(out / RIG)
    save_json(out / CHECK, without_nan(report.to_json()))
    save_json(out / MATCHES, without_nan(evidence))


def _figures(points: SparsePoints) -> dict[str, float]:
    return {"error_px": float(np.median(points.error_px)), "views": float(points.views.mean())}


def without_nan(value: Any) -> Any:
    """The same JSON value with null for numbers that JSON cannot hold."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def calibration_files(source: Path) -> dict[str, Path]:
    """Every file of a calibration, by its relative name."""
    if source.is_file():
        return {source.name: source}
    return {str(path.relative_to(source)): path for path in sorted(source.rglob("*")) if path.is_file()}


def _place(capture: Capture) -> str:
    assert capture.calibration is not None
    folder = capture.calibration if capture.calibration.is_dir() else capture.calibration.parent
    inside = folder.is_relative_to(capture.folder)  # by name: it may be a link
    return f"{folder.relative_to(capture.folder) if inside else folder.name}/"


def _kind(source: Path) -> str:
    """What a calibration is, for people."""
    return find_calibration(source).format.KIND if source.is_dir() else source.name


def _sizes(
    footage: Footage, pictures: Mapping[str, np.ndarray], videos: Mapping[str, Mapping[str, Any]]
) -> dict[str, tuple[int, int]]:
    """Widths and heights of all cameras' pictures as they are shown: a video may be stored lying on its side."""
    sizes = {name: (videos[name]["width"], videos[name]["height"]) for name in footage.take.cameras}
    late = {name: numbers[numbers >= 0] for name, numbers in footage.load_frames().items() if name not in pictures}
    reader = footage.open_reader()
    shown = {**pictures, **{name: reader.read(name, int(own[0])) for name, own in late.items() if len(own)}}
    return {**sizes, **{name: (picture.shape[1], picture.shape[0]) for name, picture in shown.items()}}


def _turned(judgement: Judgement) -> dict[str, str]:
    """What to say of cameras whose pictures stand otherwise than when they were calibrated."""
    sure = judgement.matches.verdict is Verdict.ACCEPTED
    told = "which the pictures confirm" if sure else "which way, the pictures do not tell"
    return {
        name: f"was calibrated with its picture turned by {90 * quarters} degrees against the video, {told}"
        for name, quarters in judgement.turned.items()
    }


def _strays(capture: Capture, source: Path) -> dict[str, str]:
    """Files of calibration/ of which nothing is read, where nobody chose among them."""
    folder = capture.folder / "calibration"
    if capture.settings.calibration is not None or not source.is_relative_to(folder):
        return {}
    found = find_calibration(source)
    read = found.file.relative_to(folder)
    strays = (path.relative_to(capture.folder) for path in found.strays(folder))
    return {str(path): f"is not read, but {read} is" for path in strays}
