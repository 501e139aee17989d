"""Judge an imported calibration by pictures of one instant, and find out when its file follows another convention.

Calibration files get their rotations transposed, their poses inverted or their axes flipped on the way between
programs. The geometry alone rarely shows it: cameras on a dome still look inwards. Matches show it at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from calibration.accept import MatchesReport, PairMatches, Verdict, matches_report
from calibration.doubt import WHOLE, accused, doubts
from calibration.features import Features, pairs_by_look
from calibration.moved import Standing, find_moved
from calibration.refine import Refinement, RefineOptions, refine
from calibration.repair import repair
from calibration.rig import Rig
from calibration.triangulate import TriangulateOptions, choose_pairs, detect_all, verified_matches
from calibration.turned import CLOCKWISE, upright, with_turns

_DEFAULTS = TriangulateOptions()
_REFINING = RefineOptions()
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


class Reading(StrEnum):
    """How the poses in a file may have been meant."""

    AS_GIVEN = "as given"
    TRANSPOSED = "rotations transposed"
    INVERTED = "poses inverted (camera to world)"
    OPENGL = "OpenGL camera axes"
    INVERTED_OPENGL = "poses inverted, with OpenGL camera axes"


@dataclass(frozen=True)
class Judgement:
    """What the pictures say about a calibration."""

    rig: Rig
    """The rig to use; its source names the reading when that is not `AS_GIVEN`"""
    reading: Reading
    matches: MatchesReport
    """Of `rig`"""
    given: MatchesReport | None
    """Of the calibration as the file gives it; None when its cameras see no common volume"""
    turned: Mapping[str, int] = field(default_factory=dict)
    """By how many quarters clockwise the pictures of cameras stand otherwise than when they were calibrated"""
    evidence: Sequence[PairMatches] = ()
    """Matches of neighbouring cameras, found without the poses"""
    features: Sequence[Mapping[str, Features]] = ()
    """Of each instant looked at, by camera"""
    doubts: Mapping[str, str] = field(default_factory=dict)
    """What speaks against single cameras, or all of them (`calibration.doubt`)"""
    mended: Mapping[str, str] = field(default_factory=dict)
    """What was doubted, and is mended in `rig` (`calibration.repair`)"""
    refined: Refinement | None = None
    """What adjusting all cameras to all matches did (`calibration.refine`)"""

    def to_json(self) -> dict[str, Any]:
        given = self.given.to_json() if self.given else None
        turned = {"turned": dict(self.turned)} if self.turned else {}
        doubted = {"doubts": dict(self.doubts)} if self.doubts else {}
        mended = {"mended": dict(self.mended)} if self.mended else {}
        facts = {"reading": self.reading.value, "matches": self.matches.to_json(), "given": given}
        refined = {"refined": self.refined.to_json()} if self.refined else {}
        return {**facts, **turned, **doubted, **mended, **refined}


def judge(
    rig: Rig,
    pictures: Mapping[str, np.ndarray],
    *,
    turned: Sequence[str] = (),
    options: TriangulateOptions = _DEFAULTS,
) -> Judgement:
    """Compare the poses with matches between synchronized pictures, camera -> uint8 [H, W, 3] RGB.

    Poses that the pictures reject are read again in other conventions, and the one they accept is taken. When they
    accept none, the given rig comes back with `Verdict.REJECTED`. The pictures of the cameras `turned` were turned
    clockwise by a quarter, which may have been the wrong way (`calibration.turned`). Raises ValueError for pictures
    that do not fit the rig, and when no reading gives the cameras a common volume.
    """
    features = detect_all(rig, pictures, options=options.features)
    found = _upright(rig, features, turned, options) if turned else _judge(rig, features, options)
    return _doubted(replace(found, features=(features,)), options)


def look_again(
    judgement: Judgement, instants: Iterable[Mapping[str, np.ndarray]], *, options: TriangulateOptions = _DEFAULTS
) -> Judgement:
    """The judgement with what pictures of further instants say of its doubts, one after another until none is left.

    Cameras start late, and a scene may show little at one instant.
    """
    for features, found in seen_at(judgement.rig, instants, options=options):
        evidence = [*judgement.evidence, *found]
        judgement = replace(judgement, evidence=evidence, features=[*judgement.features, features])
        judgement = _doubted(judgement, options)
        if not judgement.doubts:
            break
    return judgement


def _doubted(judgement: Judgement, options: TriangulateOptions) -> Judgement:
    """The judgement with what its evidence says of its rig."""
    matches = matches_report(judgement.rig, judgement.evidence, options=options.judge)
    found = doubts(judgement.rig, judgement.evidence, matches, judge=options, features=judgement.features)
    return replace(judgement, matches=matches, doubts=found)


def mend(judgement: Judgement, *, options: TriangulateOptions = _DEFAULTS) -> Judgement:
    """The judgement with a rig in which what was doubted is mended, as far as the pictures tell how and confirm it."""
    before = accused(judgement.doubts)
    done = repair(judgement.rig, judgement.evidence, before, whole=WHOLE)
    if not done.told:
        return judgement
    mended = _doubted(replace(judgement, rig=done.rig), options)
    left = accused(mended.doubts)
    if not left < before:
        return judgement
    told = {name: f"was wrong, and is mended: {what}" for name, what in done.told.items() if name not in left}
    said = {name: f"{what}; it {mended.doubts[name]}" if name in mended.doubts else what for name, what in told.items()}
    return replace(mended, mended=said)


def refined(
    judgement: Judgement,
    instants: Iterable[Mapping[str, np.ndarray]],
    *,
    options: TriangulateOptions = _DEFAULTS,
    refining: RefineOptions = _REFINING,
) -> Judgement:
    """The judgement with a rig adjusted to all matches, where that helps matches that the adjustment did not see.

    Further instants are looked at only when the matches at hand promise a gain. No new doubt may arise.
    """
    if judgement.matches.verdict is not Verdict.ACCEPTED:
        return judgement
    done = refine(judgement.rig, judgement.evidence, options=refining)
    if not done.freed:
        return replace(judgement, refined=done)
    more = [pair for found in matches_at(judgement.rig, instants, options=options) for pair in found]
    evidence = [*judgement.evidence, *more]
    done = refine(judgement.rig, evidence, options=refining)
    found = _doubted(replace(judgement, rig=done.rig, evidence=evidence, refined=done), options)
    new = accused(found.doubts) - accused(judgement.doubts)
    if new:
        return replace(judgement, refined=done.declined(judgement.rig, f"it raises doubts of {', '.join(sorted(new))}"))
    return found


def matches_at(
    rig: Rig, instants: Iterable[Mapping[str, np.ndarray]], *, options: TriangulateOptions = _DEFAULTS
) -> Iterator[list[PairMatches]]:
    """Verified matches between neighbouring cameras, instant by instant."""
    return (matches for _, matches in seen_at(rig, instants, options=options))


def seen_at(
    rig: Rig, instants: Iterable[Mapping[str, np.ndarray]], *, options: TriangulateOptions = _DEFAULTS
) -> Iterator[tuple[dict[str, Features], list[PairMatches]]]:
    """Features of each camera and verified matches between neighbouring ones, instant by instant."""
    pairs = choose_pairs(rig, neighbours=options.neighbours)
    for pictures in instants:
        features = detect_all(rig, pictures, options=options.features)
        near = [(first, second) for first, second in pairs if first in features and second in features]
        yield features, verified_matches(rig, features, near, ratio=options.ratio)


def _upright(
    rig: Rig, features: Mapping[str, Features], turned: Sequence[str], options: TriangulateOptions
) -> Judgement:
    evidence = verified_matches(rig, features, pairs_by_look(features, ratio=options.ratio), ratio=options.ratio)
    further = upright(rig, turned, evidence, options=options.judge)
    judgement = _judge(with_turns(rig, further), features, options)
    quarters = {name: CLOCKWISE + turn + judgement.turned.get(name, 0) for name, turn in further.items()}
    return replace(judgement, turned={**judgement.turned, **{name: turn % 4 for name, turn in quarters.items()}})


def _judge(rig: Rig, features: Mapping[str, Features], options: TriangulateOptions) -> Judgement:
    given, near = _report(rig, features, options)
    fits = given is not None and given.verdict is not Verdict.REJECTED
    if given is not None and fits and not given.bad_cameras:
        return Judgement(rig, Reading.AS_GIVEN, given, given, evidence=near)
    pairs = pairs_by_look(features, ratio=options.ratio)
    evidence = verified_matches(rig, features, pairs, ratio=options.ratio)
    if given is not None and fits:
        return _head_up(rig, given.bad_cameras, features, evidence, given, options) or Judgement(
            rig, Reading.AS_GIVEN, given, given, evidence=near
        )
    for reading in _by_promise(rig, evidence, options):
        other = reread(rig, reading)
        report, seen = _report(other, features, options)
        if report is not None and report.verdict is Verdict.ACCEPTED:
            return Judgement(other, reading, report, given, evidence=seen)
    if judgement := _head_up(rig, rig.names, features, evidence, given, options):
        return judgement
    if given is None:
        raise ValueError(
            f"{rig.source}: the cameras see no common volume, and the pictures agree with no other reading"
        )
    return Judgement(rig, Reading.AS_GIVEN, given, given, evidence=near)


def _head_up(
    rig: Rig,
    suspects: Sequence[str],
    features: Mapping[str, Features],
    evidence: Sequence[PairMatches],
    given: MatchesReport | None,
    options: TriangulateOptions,
) -> Judgement | None:
    """The judgement with cameras turned over that film upside down; None where that does not clear up all suspects."""
    turns = {name: turn for name, turn in upright(rig, suspects, evidence, options=options.judge).items() if turn}
    other = with_turns(rig, turns)
    report, seen = _report(other, features, options) if turns else (None, [])
    if report is None or report.verdict is not Verdict.ACCEPTED or set(report.bad_cameras) & set(turns):
        return None
    return Judgement(other, Reading.AS_GIVEN, report, given, turns, seen)


@dataclass(frozen=True)
class SharedJudgement:
    """What the pictures of a take say about the rig of another one."""

    standings: Mapping[str, Standing]
    """Of the cameras of which the pictures say enough"""
    moved: tuple[str, ...]
    """Cameras that stand elsewhere now"""
    matches: MatchesReport
    """Of all cameras but the moved ones"""

    def usual(self) -> float:
        """Median share of points that fit, of the cameras that have not been moved."""
        fitting = [standing.fitting for name, standing in self.standings.items() if name not in self.moved]
        return float(np.median(fitting)) if fitting else 0.0

    def to_json(self) -> dict[str, Any]:
        standings = {name: asdict(standing) for name, standing in self.standings.items()}
        return {"moved": list(self.moved), "standings": standings, "matches": self.matches.to_json()}


def judge_shared(
    rig: Rig, instants: Iterable[Mapping[str, np.ndarray]], *, options: TriangulateOptions = _DEFAULTS
) -> SharedJudgement:
    """Compare a rig that was right in another take with synchronized pictures of this one, a mapping per instant.

    Its convention is beyond doubt; cameras may have been moved. Raises ValueError for pictures that do not fit the rig.
    """
    evidence = [pair for found in matches_at(rig, instants, options=options) for pair in found]
    standings, moved = find_moved(rig, evidence)
    still = [pair for pair in evidence if not {pair.first, pair.second} & set(moved)]
    kept = rig.select(name for name in rig.names if name not in moved)
    return SharedJudgement(standings, moved, matches_report(kept, still, options=options.judge))


def reread(rig: Rig, reading: Reading) -> Rig:
    """The rig whose poses are read in another convention."""
    if reading is Reading.AS_GIVEN:
        return rig
    cameras = (replace(c, camera_from_world=_reread_pose(c.camera_from_world, reading)) for c in rig.cameras)
    return replace(rig, cameras=tuple(cameras), source=f"{rig.source}, read with {reading.value}", up=None)


def _reread_pose(pose: np.ndarray, reading: Reading) -> np.ndarray:
    if reading is Reading.TRANSPOSED:
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3].T
        return turned
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    poses: dict[Reading, np.ndarray] = {
        Reading.INVERTED: inverse,
        Reading.OPENGL: _OPENGL @ pose,
        Reading.INVERTED_OPENGL: _OPENGL @ inverse,
    }
    return poses[reading]


def _report(
    rig: Rig, features: Mapping[str, Features], options: TriangulateOptions
) -> tuple[MatchesReport | None, list[PairMatches]]:
    """Matches of neighbouring cameras, and what the poses make of them; None when they see no common volume."""
    try:
        pairs = choose_pairs(rig, neighbours=options.neighbours)
    except ValueError:
        return None, []
    near = [(first, second) for first, second in pairs if first in features and second in features]
    evidence = verified_matches(rig, features, near, ratio=options.ratio)
    return matches_report(rig, evidence, options=options.judge), evidence


def _by_promise(rig: Rig, evidence: Sequence[PairMatches], options: TriangulateOptions) -> list[Reading]:
    """The other readings, best first, by what they explain of matches found without any poses."""
    others = [reading for reading in Reading if reading is not Reading.AS_GIVEN]
    promise = {
        reading.value: matches_report(reread(rig, reading), evidence, options=options.judge).explained_share or 0.0
        for reading in others
    }
    return sorted(others, key=lambda reading: -promise[reading.value])
