"""Which cameras of a calibration the pictures doubt, by name.

That most matches fit says little about a single camera, or about a lens that is wrong by a little: right calibrations
explain 0.86 to 1.0 of the matches, wrong ones 0.55 to 0.98. The distance tells: matches of right cameras lie 0.1 to 0.3
pixels from their epipolar lines, those of wrong ones 1 to 6. A camera that is wrong along its epipolar lines shows the
points that the others locate elsewhere, and one of which too few are known is not confirmed (`calibration.confirm`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.accept import MatchesReport, MatchOptions, PairMatches, Verdict, merged, pair_errors_px
from calibration.confirm import confirm
from calibration.features import Features
from calibration.refine import tracks
from calibration.rig import Camera, Rig
from calibration.triangulate import TriangulateOptions, choose_pairs, matches_along, on_one_geometry

FOCAL_SCALES = (0.8, 0.85, 0.91, 0.95, 1.05, 1.1, 1.18, 1.25)
BENDS = (-0.3, -0.15, -0.07, -0.03, 0.03, 0.07, 0.15, 0.3)
"""Of k1, for all cameras alike: lenses of a kind, whose distortion was dropped, or was undone already"""
WHOLE = "the calibration"
"""What is said of all cameras together is said of it"""


@dataclass(frozen=True)
class DoubtOptions:
    """From when on a camera is doubted."""

    least_px: float = 0.6
    """Median Sampson distance of its matches, pixels of the undistorted picture ..."""
    share: float = 0.0011
    """... and as a share of the picture's width: lenses are calibrated less exactly in pixels of large pictures"""
    over_others: float = 4.0
    """... and at least this many times that of the other cameras: what all have is said of the calibration"""
    accusing: int = 2
    """Pairs that must speak against a camera: patterns that repeat let a single one match on a geometry of its own"""
    accusing_matches: int = 30
    """Matches with which a pair speaks against its cameras: in small pictures of look-alike people two or three pairs
    of a right camera had 20 to 33 by chance, as many as a solve asks of a pair (`SolveOptions.min_pair_matches`)"""
    confirming: int = 8
    """Matches with which a pair speaks for its cameras, where most of them fit: chance ones never do"""
    fitting: float = 0.6
    """Share of them that must"""
    alibis: int = 2
    """Pairs that clear a camera, whatever others say, if many of their matches fit to a fraction of a pixel: patterns
    that repeat let cameras far apart agree on a geometry of its own, never two on the given one"""
    alibi_matches: int = 60
    """Matches of such a pair that fit, and ..."""
    alibi_fitting: float = 0.5
    """... share of all its matches; those that repeat are among them"""
    exact: float = 0.5
    """Share of the limit that the median of a camera's pair lies within, to show that the camera is no more than a
    little wrong ..."""
    gross: float = 8.0
    """... so that two such cameras whose matches miss by this many times the limit matched what only looks alike"""
    better: float = 0.6
    """Share of the median distance that other lenses leave at most, to be believed"""
    noise_px: float = 0.15
    """A median below this cannot be better"""

    def limit_px(self, width: int) -> float:
        """Of a camera with pictures of this width."""
        return max(self.least_px, self.share * width)


def doubts(
    rig: Rig,
    evidence: Sequence[PairMatches],
    report: MatchesReport,
    *,
    judge: TriangulateOptions,
    features: Sequence[Mapping[str, Features]] = (),
    options: DoubtOptions = DoubtOptions(),
) -> dict[str, str]:
    """What speaks against single cameras, and against all of them: camera or WHOLE -> what, for people.

    `evidence` are matches found without the poses (`triangulate.verified_matches`), `report` what was made of them.
    Cameras that these do not confirm are asked again by matches along their epipolar lines, among the `features` of
    each instant.
    """
    if report.verdict is Verdict.UNDECIDED:
        return {WHOLE: f"is neither confirmed nor refuted by the pictures: {report.reason}"}
    evidence = _of_one_geometry(rig, evidence)
    errors = _errors_px(rig, evidence)
    limit = options.limit_px(int(np.median([camera.width for camera in rig.cameras])))
    three = _by_three(rig, rig.names, evidence, features, judge, limit)
    cleared = _cleared(rig, errors, options)
    known = _confirming_px(errors, judge.judge, options) | _medians_px(errors, options.accusing_matches)
    exact = {name for key, px in known.items() if px <= options.exact * limit for name in key}
    chance = {key for key, px in known.items() if px > limit and key <= cleared}
    chance |= {key for key, px in known.items() if px > options.gross * limit and key <= exact}
    known = {key: px for key, px in known.items() if key not in chance}
    off, left = _peeled(rig, known, cleared, set(rig.names) - three.keys(), options)
    found = {name: f"lies {_far(px)} off its neighbours in the median, others {_usual(left):.1f}: " + WRONG
             for name, px in off.items()}  # fmt: skip
    kept = rig.select(name for name in rig.names if name not in off)
    right = [
        pair
        for pair in evidence
        if not {pair.first, pair.second} & off.keys() and frozenset((pair.first, pair.second)) not in chance
    ]
    if better := _better_lens(kept, right, judge.judge.min_matches, options):
        found[WHOLE] = f"fits the pictures better with {better}: its lenses are not those of these videos"
    elif left and _usual(left) > limit:
        found[WHOLE] = (
            f"misses the pictures by {_far(_usual(left))} in the median, right ones by 0.1 to 0.3: focal lengths, "
            "principal points, distortion or poses are not those of these videos"
        )
    if WHOLE in found:  # where all are wrong, nothing tells of one
        return found
    return found | (_by_three(rig, kept.names, right, features, judge, limit) if off else three)


UNCONFIRMED = "is not confirmed"
"""So begins what is said of a camera that nothing speaks against, and too little for"""
WRONG = "its pose, focal length, principal point or distortion is wrong, or its name is another camera's"


def accused(said: Mapping[str, str]) -> set[str]:
    """Of what `doubts` says, whom something speaks against."""
    return {name for name, what in said.items() if not what.startswith(UNCONFIRMED)}


Medians = Mapping[frozenset[str], float]
"""By pair of cameras, median Sampson distance of its matches, pixels"""
Errors = Mapping[frozenset[str], np.ndarray]
"""Likewise, of each match, float64 [K]"""


def _by_three(
    rig: Rig,
    names: Sequence[str],
    evidence: Sequence[PairMatches],
    features: Sequence[Mapping[str, Features]],
    judge: TriangulateOptions,
    limit_px: float,
) -> dict[str, str]:
    """What three of these cameras at a time say, who see what no two of them do, of each that they do not confirm."""
    telling = [pair for pair in evidence if len(pair.first_pixels) >= judge.judge.min_matches]
    # A wrong camera spoils many pairs of a small rig; what the better ones say, a pixel's noise is for all.
    best = np.percentile([np.median(pair_errors_px(rig, pair)) for pair in telling] or [limit_px], 25)
    noise_px = float(np.clip(1.48 * best, limit_px / 4, limit_px))
    part = rig.select(names)
    wrong, unsure = confirm(part, tracks(part, evidence), noise_px=noise_px)
    asked = {*wrong, *unsure}
    if asked and features:
        near = choose_pairs(rig, neighbours=judge.neighbours)
        pairs = [pair for pair in near if asked & set(pair) and set(pair) <= set(names)]
        along = [
            match
            for found in features
            for match in matches_along(rig, found, [p for p in pairs if set(p) <= found.keys()], options=judge)
        ]
        wrong, unsure = confirm(part, tracks(part, [*evidence, *along]), noise_px=noise_px)
    return wrong | {name: f"{UNCONFIRMED}: {why}" for name, why in unsure.items()}


def _of_one_geometry(rig: Rig, evidence: Sequence[PairMatches]) -> list[PairMatches]:
    """By pair, the matches of all instants that agree on one epipolar geometry, since the rig stands still.

    Each instant's were verified alone, where a geometry of its own explains eight matches and often a dozen by chance.
    What stands still shows the same wrong matches at every instant, so these count once.
    """
    found = []
    for pair, instants in merged(evidence):
        if instants == 1:
            found.append(pair)
            continue
        cells = np.floor(np.hstack([pair.first_pixels, pair.second_pixels]))
        once = np.sort(np.unique(cells, axis=0, return_index=True)[1])
        pair = replace(pair, first_pixels=pair.first_pixels[once], second_pixels=pair.second_pixels[once])
        flat = [
            rig[name].undistorted_pixels(pixels)
            for name, pixels in ((pair.first, pair.first_pixels), (pair.second, pair.second_pixels))
        ]
        kept = on_one_geometry(*flat)
        if kept is not None:
            found.append(replace(pair, first_pixels=pair.first_pixels[kept], second_pixels=pair.second_pixels[kept]))
    return found


def _medians_px(errors: Errors, least: int) -> dict[frozenset[str], float]:
    """Of the pairs that have so many matches at least."""
    return {key: float(np.median(found)) for key, found in errors.items() if len(found) >= least}


def _confirming_px(errors: Errors, judge: MatchOptions, options: DoubtOptions) -> dict[frozenset[str], float]:
    """Of the pairs that speak for their cameras."""
    return {
        key: float(np.median(found))
        for key, found in errors.items()
        if len(found) >= options.confirming and (found <= judge.max_error_px).mean() >= options.fitting
    }


def _errors_px(rig: Rig, evidence: Sequence[PairMatches]) -> dict[frozenset[str], np.ndarray]:
    """Sampson distances by pair."""
    return {frozenset((pair.first, pair.second)): pair_errors_px(rig, pair) for pair in evidence}


def _cleared(rig: Rig, errors: Errors, options: DoubtOptions) -> set[str]:
    """Cameras with an alibi: others confirm them beyond doubt. What two of them have against each other is chance."""
    sure = []
    for key, found in errors.items():
        fits = found <= min(options.limit_px(rig[name].width) for name in key)
        if fits.sum() >= options.alibi_matches and fits.mean() >= options.alibi_fitting:
            sure.append(key)
    return {name for name in rig.names if sum(name in key for key in sure) >= options.alibis}


def _peeled(
    rig: Rig, pairs: Medians, cleared: Collection[str], confirmed: Collection[str], options: DoubtOptions
) -> tuple[dict[str, float], Medians]:
    """Cameras that lie off, the worst first, each judged without those before it; and the pairs of the others.

    A wrong camera spoils all of its own pairs, but only one of each neighbour's. What misses by far says nothing
    against a camera that three at a time confirm: it is chance, or the other one's fault. Half of the cameras at most:
    beyond that it is the calibration that is wrong.
    """
    left, off = dict(pairs), dict[str, float]()
    most = {c.name: options.gross * options.limit_px(c.width) for c in rig.cameras if c.name in confirmed}
    while left and 2 * (len(off) + 1) <= len(rig.cameras):
        own = {
            name: {key: px for key, px in left.items() if name in key and px <= most.get(name, np.inf)}
            for name in rig.names
        }
        accused = [name for name, pairs in own.items() if _accused(rig[name], pairs, options)]
        each = {name: _usual(own[name]) for name in accused if name not in cleared}
        if not each:
            break
        worst = max(each, key=lambda name: each[name])
        others = _usual({key: px for key, px in left.items() if worst not in key})
        if each[worst] <= max(options.limit_px(rig[worst].width), options.over_others * others):
            break
        off[worst] = each[worst]
        left = {key: px for key, px in left.items() if worst not in key}
    return off, left


def _better_lens(rig: Rig, evidence: Sequence[PairMatches], least: int, options: DoubtOptions) -> str:
    """What all lenses would have in common with which the pictures agree far better; empty where nothing does."""
    now = _usual(_medians_px(_errors_px(rig, evidence), least))
    if now <= options.noise_px:
        return ""
    tried = {
        f"focal lengths of {scale:.0%}": _usual(_medians_px(_errors_px(_with_focal(rig, scale), evidence), least))
        for scale in FOCAL_SCALES
    }
    if not any(camera.fisheye for camera in rig.cameras):
        tried |= {
            f"k1 of {bend:+.2f} beside theirs": _usual(_medians_px(_errors_px(_with_bend(rig, bend), evidence), least))
            for bend in BENDS
        }
    best = min(tried, key=lambda name: tried[name])
    return f"{best} ({tried[best]:.2f} px instead of {now:.2f})" if tried[best] < options.better * now else ""


def _with_focal(rig: Rig, scale: float) -> Rig:
    return replace(rig, cameras=tuple(replace(c, fx=scale * c.fx, fy=scale * c.fy) for c in rig.cameras))


def _with_bend(rig: Rig, k1: float) -> Rig:
    def bent(camera: Camera) -> Camera:
        values = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[: max(4, len(camera.distortion))]
        return replace(camera, distortion=(values[0] + k1, *values[1:]))

    return replace(rig, cameras=tuple(bent(camera) for camera in rig.cameras))


def _accused(camera: Camera, pairs: Medians, options: DoubtOptions) -> bool:
    """Whether enough pairs speak against a camera; of one that has a single pair, that one."""
    against = sum(px > options.limit_px(camera.width) for px in pairs.values())
    return against >= min(options.accusing, max(1, len(pairs)))


def _usual(pairs: Medians) -> float:
    return float(np.median(list(pairs.values()))) if pairs else 0.0


def _far(px: float) -> str:
    """Infinite where most of what is matched lies behind a camera."""
    return f"{px:.1f} px" if np.isfinite(px) else "more than can be measured, most matches lying behind a camera,"
