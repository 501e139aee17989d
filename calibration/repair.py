"""Mend cameras that the pictures doubt: what of a camera is wrong, and by how much, from matches with the others.

One kind of fault after another is tried, the simplest first: a lens of another focal length, a principal point or a
distortion that is off, a camera that stands or looks elsewhere, all together. The fit sees every other match; the rest
judges it. The other cameras stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np

from calibration.accept import PairMatches, pair_errors_px
from calibration.rig import Camera, Rig

FOCAL, POINT, LENS, POSE = "focal length", "principal point", "distortion", "pose"
SIZES = {FOCAL: 1, POINT: 2, LENS: 2, POSE: 6}
FAULTS_OF_ONE = ((FOCAL,), (POINT,), (LENS,), (POSE,), (FOCAL, LENS), (POSE, FOCAL), (POSE, FOCAL, POINT, LENS))
FAULTS_OF_ALL = ((FOCAL,), (POINT,), (LENS,), (FOCAL, LENS))
SCALES = {FOCAL: (0.1,), POINT: (0.05, 0.05), LENS: (0.1, 0.1), POSE: (0.05,) * 3 + (0.1,) * 3}
"""How far each number is thought to be off: a ratio, picture widths, coefficients, radians and radii of the rig"""
MOST = {FOCAL: 0.4, POINT: 0.15, LENS: 0.6, POSE: 0.5}
"""What is farther off than this in any number was never that camera: matches fit it by chance"""
MOST_MATCHES = 300
"""Of a pair"""
LEAST_MATCHES = 40
"""Of a camera, over all of its pairs"""
FARTHEST_PX = 50.0
"""A match that lies farther off, or behind a camera, counts as lying so far off"""
ROBUST_PX = 0.5
RIGHT_PX, RIGHT_SHARE = 0.4, 0.0007
"""Median distance of matches of a camera that is right, at most: pixels, and as a share of the picture's width"""
BETTER = 0.5
"""Share of the distance before that is left at most"""
SIMPLE = 1.6
"""A simpler fault is taken for the cause if it leaves no more than so many times what the best leaves"""


@dataclass(frozen=True)
class Repair:
    """What was mended."""

    rig: Rig
    told: dict[str, str]
    """By camera, or by `whole`, what was changed and what that does, for people"""


def repair(rig: Rig, evidence: Sequence[PairMatches], suspects: Collection[str], *, whole: str) -> Repair:
    """Mend the cameras among `suspects`, the worst first, and what all lenses have in common if `whole` is among them.

    What matches do not decide, or do not confirm, stays as it is and is not told.
    """
    told: dict[str, str] = {}
    if whole in suspects:
        rig = _mended(rig, rig.names, evidence, FAULTS_OF_ALL, whole, told)
    left = [name for name in rig.names if name in suspects]
    for pair in combinations(left, 2):
        if not set(pair) & told.keys():
            rig = _exchanged(rig, pair, evidence, told)
    left = [name for name in left if name not in told]
    while left:
        others = set(left)
        pairs = {name: _pairs_of(name, evidence, others - {name}) for name in left}
        worst = max(left, key=lambda name: _median(rig, pairs[name]))
        rig = _mended(rig, (worst,), pairs[worst], FAULTS_OF_ONE, worst, told)
        left.remove(worst)
    return Repair(rig, told)


def _pairs_of(name: str, evidence: Sequence[PairMatches], without: Collection[str]) -> list[PairMatches]:
    return [
        pair for pair in evidence if name in (pair.first, pair.second) and not {pair.first, pair.second} & set(without)
    ]


def _mended(
    rig: Rig,
    names: Sequence[str],
    evidence: Sequence[PairMatches],
    faults: Sequence[tuple[str, ...]],
    what: str,
    told: dict[str, str],
) -> Rig:
    """The rig with these cameras mended alike, if the matches that the fit did not see confirm it."""
    seen, unseen = ([_every_other(pair, start) for pair in evidence] for start in (0, 1))
    before = _median(rig, unseen)
    if sum(len(pair.first_pixels) for pair in unseen) < LEAST_MATCHES // 2 or not np.isfinite(before):
        return rig
    radius = float(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).max())
    tried = []
    for fault in faults:
        change = changing(fault, radius)
        values = _fitted(rig, names, seen, fault, change)
        mended = _with(rig, names, change, values)
        tried.append((_median(mended, unseen), fault, values, mended))
    tried = [one for one in tried if _believable(one[1], one[2])]
    if not tried:
        return rig
    best = min(px for px, *_ in tried)
    px, fault, values, mended = next(one for one in tried if one[0] <= SIMPLE * best)
    width = float(np.median([rig[name].width for name in names]))
    if px > min(max(RIGHT_PX, RIGHT_SHARE * width), BETTER * before):
        return rig
    matches = sum(len(pair.first_pixels) for pair in evidence)
    told[what] = f"{_said(fault, values)}; {matches} matches lie {px:.2f} px off, {before:.2f} as it was given"
    return mended


def _exchanged(rig: Rig, names: tuple[str, str], evidence: Sequence[PairMatches], told: dict[str, str]) -> Rig:
    """The rig with the calibrations of two cameras, or their poses alone, exchanged, if the matches confirm it."""
    first, second = (rig[name] for name in names)
    whole = (replace(second, name=first.name), replace(first, name=second.name))
    poses = (
        replace(first, camera_from_world=second.camera_from_world),
        replace(second, camera_from_world=first.camera_from_world),
    )
    pairs = [pair for pair in evidence if {pair.first, pair.second} & set(names)]
    before = _median(rig, pairs)
    for what, (one, other) in {"calibration": whole, "pose": poses}.items():
        cameras = tuple({first.name: one, second.name: other}.get(c.name, c) for c in rig.cameras)
        mended, limit = replace(rig, cameras=cameras), max(RIGHT_PX, RIGHT_SHARE * first.width)
        each = [_median(mended, [pair for pair in pairs if name in (pair.first, pair.second)]) for name in names]
        same = (first.width, first.height) == (second.width, second.height)
        if same and all(px <= min(limit, BETTER * before) for px in each):
            for name, other_name, px in zip(names, names[::-1], each, strict=True):
                told[name] = (
                    f"it had the {what} of {other_name}; now its matches lie {px:.2f} px off, {before:.2f} before"
                )
            return mended
    return rig


def _believable(fault: Sequence[str], values: np.ndarray) -> bool:
    parts = zip(fault, np.split(values, np.cumsum([SIZES[kind] for kind in fault])[:-1]), strict=True)
    return all(float(np.abs(part).max()) <= MOST[kind] for kind, part in parts)


def _every_other(pair: PairMatches, start: int) -> PairMatches:
    step = 2 * max(1, len(pair.first_pixels) // (2 * MOST_MATCHES))
    return replace(pair, first_pixels=pair.first_pixels[start::step], second_pixels=pair.second_pixels[start::step])


def _median(rig: Rig, evidence: Sequence[PairMatches]) -> float:
    errors = [pair_errors_px(rig, pair) for pair in evidence if len(pair.first_pixels)]
    return float(np.median(np.minimum(np.concatenate(errors), FARTHEST_PX))) if errors else float("nan")


Change = Callable[[Camera, np.ndarray], Camera]


def changing(fault: Sequence[str], radius: float) -> Change:
    """What the numbers of a fault do to a camera."""

    def changed(camera: Camera, values: np.ndarray) -> Camera:
        parts = dict(zip(fault, np.split(values, np.cumsum([SIZES[kind] for kind in fault])[:-1]), strict=True))
        if FOCAL in parts:
            scale = float(np.exp(parts[FOCAL][0]))
            camera = replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)
        if POINT in parts:
            right, down = camera.width * parts[POINT]
            camera = replace(camera, cx=camera.cx + float(right), cy=camera.cy + float(down))
        if LENS in parts:
            given = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[: max(4, len(camera.distortion))]
            k1, k2 = (float(old + new) for old, new in zip(given[:2], parts[LENS], strict=True))
            camera = replace(camera, distortion=(k1, k2, *given[2:]))
        if POSE in parts:
            camera = replace(camera, camera_from_world=_posed(camera.camera_from_world, parts[POSE], radius))
        return camera

    return changed


def _posed(camera_from_world: np.ndarray, values: np.ndarray, radius: float) -> np.ndarray:
    """Turned about its centre by a rotation vector, then moved by shares of the rig's radius."""
    pose = np.eye(4)
    rotation = camera_from_world[:3, :3]
    centre = -rotation.T @ camera_from_world[:3, 3] + radius * values[3:]
    pose[:3, :3] = cv2.Rodrigues(values[:3])[0] @ rotation
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def _with(rig: Rig, names: Collection[str], change: Change, values: np.ndarray) -> Rig:
    return replace(rig, cameras=tuple(change(c, values) if c.name in names else c for c in rig.cameras))


def _fitted(
    rig: Rig, names: Collection[str], evidence: Sequence[PairMatches], fault: Sequence[str], change: Change
) -> np.ndarray:
    """The numbers of a fault with which the matches agree best; what they do not decide stays near 0."""
    scales = np.array([scale for kind in fault for scale in SCALES[kind]])

    def residuals(unit: np.ndarray) -> np.ndarray:
        mended = _with(rig, names, change, unit * scales)
        errors = [np.minimum(pair_errors_px(mended, pair), FARTHEST_PX) for pair in evidence]
        return np.concatenate([*errors, 0.1 * unit])

    from scipy.optimize import least_squares  # here, since loading it takes 0.5 s, and few cameras need a repair

    found = least_squares(
        residuals, np.zeros(len(scales)), loss="soft_l1", f_scale=ROBUST_PX, diff_step=1e-4, max_nfev=60
    )
    values: np.ndarray = found.x * scales
    return values


def _said(fault: Sequence[str], values: np.ndarray) -> str:
    parts = dict(zip(fault, np.split(values, np.cumsum([SIZES[kind] for kind in fault])[:-1]), strict=True))
    said = []
    if FOCAL in parts:
        said.append(f"its focal length is {np.exp(parts[FOCAL][0]):.1%} of the given one")
    if POINT in parts:
        right, down = 100 * parts[POINT]
        said.append(f"its principal point is off by {right:+.1f} and {down:+.1f} % of the width")
    if LENS in parts:
        k1, k2 = parts[LENS]
        said.append(f"its distortion is off by k1 {k1:+.3f}, k2 {k2:+.3f}")
    if POSE in parts:
        turn, move = np.degrees(np.linalg.norm(parts[POSE][:3])), 100 * np.linalg.norm(parts[POSE][3:])
        said.append(f"it is turned by {turn:.2f} degrees and stands {move:.1f} % of the rig's radius elsewhere")
    return ", ".join(said)
