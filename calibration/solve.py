"""A rig from pictures alone: features and matches here, COLMAP's incremental mapper in a subprocess.

Every device has a lens of its own. The rig stands still, so features of several synchronized instants of a camera count
as features of one picture; matches only join features of the same instant. Full registration at one pixel is no proof
(research: wrong rigs reach it), so the result is judged by all verified matches.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from calibration.accept import MatchesReport, MatchOptions, PairMatches, Verdict, matches_report
from calibration.exporters import colmap_lens
from calibration.features import FeatureOptions, Features, detect, match, pairs_by_look
from calibration.importers import load_rig
from calibration.moved import place_by_others
from calibration.rig import Camera, Rig

_STEERING = ("lens", "shared_lens", "focal_factor", "min_pair_matches", "min_pair_share", "seed", "threads")


_LOST = 0.25
"""Share of the cameras up to which those that the mapper could not place are placed by the others"""


class Lens(StrEnum):
    """COLMAP's lens models that a rig can hold, by what they leave free."""

    PINHOLE = "PINHOLE"
    SIMPLE_RADIAL = "SIMPLE_RADIAL"
    RADIAL = "RADIAL"
    OPENCV = "OPENCV"


@dataclass(frozen=True)
class SolveOptions:
    """How a rig is solved and when it is believed."""

    features: FeatureOptions = field(default_factory=FeatureOptions)
    ratio: float = 0.8
    """Lowe's ratio"""
    lens: Lens = Lens.SIMPLE_RADIAL
    """One focal length and one radial term suffice for most lenses; few pictures do not support more"""
    shared_lens: bool = False
    """True if all devices of a picture size have the same lens at the same zoom; it steadies sparse rigs"""
    focal_factor: float = 1.2
    """First guess of the focal length, in longer picture sides"""
    min_pair_matches: int = 30
    """Matches that must agree on one epipolar geometry for a pair to count. COLMAP's 15 let the repeated panels of a
    dome agree by chance: 27 cameras, 3 instants, then explained 75 % of the matches, with 30 they explained 86 %"""
    min_pair_share: float = 0.3
    """Share of a pair's matches that must agree"""
    seed: int = 0
    threads: int = 1
    """More than one is faster and no longer repeatable to the last bit"""
    min_registered: float = 0.9
    """Share of the cameras that must be placed"""
    judge: MatchOptions = field(default_factory=MatchOptions)
    timeout_seconds: float = 3600.0

    def __post_init__(self) -> None:
        if not 0 < self.ratio <= 1 or self.focal_factor <= 0 or self.threads < 1 or self.timeout_seconds <= 0:
            raise ValueError(f"ratio must be in (0, 1]; focal factor, threads and timeout positive: {self}")
        if not 0 < self.min_registered <= 1:
            raise ValueError(f"min_registered is a share of the cameras in (0, 1], not {self.min_registered}")


def solve_rig(
    pictures: Mapping[str, np.ndarray | Sequence[np.ndarray]],
    options: SolveOptions,
    workspace: Path,
    *,
    lenses: Rig | None = None,
) -> Rig:
    """Place the cameras by their pictures, camera -> uint8 [H, W, 3] RGB, one or a list of synchronized instants.

    A camera that most of its matches contradict counts as not placed and is left out of the rig. Raises ValueError when
    fewer than two cameras are given, when too few can be placed, or when the placed cameras do not explain the matches;
    the message says which were placed and what to try. `lenses` are known ones of all cameras, which stay as they are;
    their poses do not count. The workspace keeps COLMAP's files, its log, and report.json.
    The scale and the orientation of the world are arbitrary.
    """
    instants = _instants(pictures)
    workspace.mkdir(parents=True, exist_ok=True)
    features = {
        name: [detect(picture, options=options.features) for picture in shots] for name, shots in instants.items()
    }
    keypoints = {name: _keypoints(shots) for name, shots in features.items()}
    result = _map(instants, keypoints, _matches(features, keypoints, options), options, workspace, lenses)
    names = list(instants)
    mapped = [name for name in names if name in result["registered"]]
    if len(mapped) < max(3, (1 - _LOST) * len(names)):
        _check_placed(names, mapped, options, workspace)
    matches = _verified(keypoints, workspace)
    rig, again = _completed(load_rig(workspace / "model", names=mapped), instants, matches, lenses, options)
    report = _report(rig, matches, options)
    placed_again = {"placed_by_the_others": again} if again else {}
    (workspace / "report.json").write_text(
        json.dumps({**result, **placed_again, "matches": report.to_json()}, indent=1)
    )
    _check_explained(report, workspace)
    _check_placed(names, rig.names, options, workspace)
    count = f"{len(rig.cameras)} of {len(instants)} cameras"
    others = f", {', '.join(again)} placed by the others" if again else ""
    return Rig(rig.cameras, f"COLMAP, {count}{others}, {result['reprojection_px']:.2f} px, {report.reason}")


def _instants(pictures: Mapping[str, np.ndarray | Sequence[np.ndarray]]) -> dict[str, list[np.ndarray]]:
    listed = {name: [shots] if isinstance(shots, np.ndarray) else list(shots) for name, shots in pictures.items()}
    counts = {name: len(shots) for name, shots in listed.items()}
    if len(listed) < 2 or len(set(counts.values())) != 1 or 0 in counts.values():
        raise ValueError(f"a solve needs two cameras or more with the same number of instants each, but got {counts}")
    for name, shots in listed.items():
        if any(shot.dtype != np.uint8 or shot.ndim != 3 or shot.shape != shots[0].shape for shot in shots):
            raise ValueError(
                f"camera {name!r} needs uint8 pictures [H, W, 3] of one size, "
                f"but got {[(str(shot.dtype), shot.shape) for shot in shots]}"
            )
    return listed


@dataclass(frozen=True)
class _Keypoints:
    """The features of all instants of one camera, those that stand still counted once."""

    pixels: np.ndarray
    """float64 [K, 2]"""
    rows: tuple[np.ndarray, ...]
    """For each instant, int32 [N], the row of `pixels` of each feature"""


def _keypoints(shots: Sequence[Features], still_px: float = 1.0) -> _Keypoints:
    """Put the features of several instants together.

    The static scene shows the same features, and the same wrong matches, at every instant; counted anew each time, a
    few wrong ones would soon outnumber what COLMAP asks of a pair.
    """
    pixels, rows = np.zeros((0, 2)), []
    for shot in shots:
        spots = shot.pixels[np.unique(shot.places, return_index=True)[1]]  # [S, 2], one for each place
        nearest, distance = _nearest(spots, pixels)
        new = distance > still_px
        numbers = np.where(new, len(pixels) + np.cumsum(new) - 1, nearest)
        rows.append(numbers[shot.places].astype(np.int32))
        pixels = np.concatenate([pixels, spots[new]])
    return _Keypoints(pixels, tuple(rows))


def _nearest(points: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row of the nearest of `among` [K, 2] for each of `points` [N, 2], and its distance; 256 points at a time."""
    if not len(among):
        return np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    nearest = [
        ((among[None] - points[start : start + 256, None]) ** 2).sum(axis=2).argmin(axis=1)
        for start in range(0, len(points), 256)
    ]
    rows = np.concatenate([*nearest, np.zeros(0, np.int64)])
    return rows, np.linalg.norm(among[rows] - points, axis=1)


def _matches(
    features: Mapping[str, Sequence[Features]], keypoints: Mapping[str, _Keypoints], options: SolveOptions
) -> dict[str, np.ndarray]:
    """'a b' (indices of cameras) -> int32 [K, 2], rows of the cameras' keypoints, each row in at most one match."""
    names = list(features)
    pairs = pairs_by_look({name: shots[0] for name, shots in features.items()}, ratio=options.ratio)
    found = {}
    for first, second in pairs:
        parts = []
        for index, (a, b) in enumerate(zip(features[first], features[second], strict=True)):
            rows = match(a, b, ratio=options.ratio)[0]
            ends = keypoints[first].rows[index][rows[:, 0]], keypoints[second].rows[index][rows[:, 1]]
            parts.append(np.stack(ends, axis=1))
        found[f"{names.index(first)} {names.index(second)}"] = _one_to_one(np.unique(np.concatenate(parts), axis=0))
    return found


def _one_to_one(rows: np.ndarray) -> np.ndarray:
    """Matches [K, 2] whose ends have no other match; instants that contradict each other prove neither."""
    clear = np.ones(len(rows), bool)
    for column in rows.T:
        _, inverse, counts = np.unique(column, return_inverse=True, return_counts=True)
        clear &= counts[inverse] == 1
    return rows[clear].astype(np.int32)


def _map(
    instants: Mapping[str, Sequence[np.ndarray]],
    keypoints: Mapping[str, _Keypoints],
    matched: Mapping[str, np.ndarray],
    options: SolveOptions,
    workspace: Path,
    lenses: Rig | None,
) -> dict[str, Any]:
    """Run the mapper; raises ValueError with the end of its log when it fails or takes too long."""
    for stale in ("result.json", "inliers.npz"):
        (workspace / stale).unlink(missing_ok=True)
    for stale in ("model", "mapped"):
        shutil.rmtree(workspace / stale, ignore_errors=True)
    pixels = {f"keypoints {index}": points.pixels for index, points in enumerate(keypoints.values())}
    np.savez(workspace / "matches.npz", **pixels, **matched)  # type: ignore[arg-type]  # keys are no keywords of savez
    (workspace / "spec.json").write_text(json.dumps(_spec(instants, options, lenses), indent=1))
    command = [sys.executable, "-m", "calibration.mapper", str((workspace / "spec.json").resolve())]
    with (workspace / "mapper.log").open("w") as log:
        try:
            subprocess.run(command, stdout=log, stderr=log, timeout=options.timeout_seconds, check=True)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as problem:
            tail = (workspace / "mapper.log").read_text(errors="replace")[-500:]
            raise ValueError(f"COLMAP must finish, but {problem}; its log ends: {tail}") from None
    return dict(json.loads((workspace / "result.json").read_text()))


def _spec(instants: Mapping[str, Sequence[np.ndarray]], options: SolveOptions, lenses: Rig | None) -> dict[str, Any]:
    cameras = [
        {"name": name, "width": shots[0].shape[1], "height": shots[0].shape[0]} for name, shots in instants.items()
    ]
    if lenses is not None:
        for camera in cameras:
            model, numbers = colmap_lens(lenses[camera["name"]])
            camera["lens"] = {"model": model, "numbers": list(numbers)}
    steering = {key: getattr(options, key) for key in _STEERING}
    return {"cameras": cameras, **steering}


def _completed(
    rig: Rig,
    instants: Mapping[str, Sequence[np.ndarray]],
    matches: Sequence[PairMatches],
    lenses: Rig | None,
    options: SolveOptions,
) -> tuple[Rig, list[str]]:
    """The mapped rig without the cameras that their matches contradict, but with those that the others then place.

    The mapper takes cameras as they come; a camera with few right matches may meet the wrong ones first. Also returns
    who was placed so, by name.
    """
    bad = _report(rig, matches, options).bad_cameras
    mapped, rig = rig, rig.select(name for name in rig.names if name not in bad)
    again = list[str]()
    lost = [name for name in instants if name not in rig.names]
    if len(rig.cameras) < 3 or len(lost) > _LOST * len(instants):
        return rig, again
    for name in lost:
        height, width = instants[name][0].shape[:2]
        guesses = [lenses[name]] if lenses else _guesses(rig, mapped, name, (width, height))
        for camera in (place_by_others(rig, guess, matches) for guess in guesses):
            if camera is None:
                continue
            more = replace(rig, cameras=(*rig.cameras, camera)).select(n for n in instants if n in {*rig.names, name})
            if name not in _report(more, matches, options).bad_cameras:
                rig = more
                again.append(name)
                break
    return rig, again


def _guesses(rig: Rig, mapped: Rig, name: str, size: tuple[int, int]) -> list[Camera]:
    """The camera with the lens that the mapper gave it, or with those of the others, the most usual first."""
    if name in mapped.names:
        return [mapped[name]]
    alike = [camera for camera in rig.cameras if (camera.width, camera.height) == size]
    usual = float(np.median([camera.fx for camera in alike])) if alike else 0.0
    return [replace(camera, name=name) for camera in sorted(alike, key=lambda camera: abs(camera.fx - usual))]


def _check_placed(names: Sequence[str], placed: Sequence[str], options: SolveOptions, workspace: Path) -> None:
    """Raise ValueError when too few of the cameras are placed."""
    if len(placed) >= max(2, options.min_registered * len(names)):
        return
    lost = [name for name in names if name not in placed]
    few = len(lost) <= len(names) // 4
    without = f"to go on without, write ignore = {json.dumps(lost)} into capture.toml; else " if few else ""
    raise ValueError(
        f"COLMAP must place {options.min_registered:.0%} of {len(names)} cameras so that the matches agree, but placed "
        f"{len(placed)} ({placed}), not {lost}; {without}give more instants, pictures with more texture, or a "
        f"calibration of your own (log: {workspace / 'mapper.log'})"
    )


def _verified(keypoints: Mapping[str, _Keypoints], workspace: Path) -> list[PairMatches]:
    """The matches that agreed pair by pair."""
    names, pixels = list(keypoints), [points.pixels for points in keypoints.values()]
    found = []
    with np.load(workspace / "inliers.npz") as inliers:
        for pair, rows in inliers.items():
            a, b = (int(part) for part in pair.split())
            found.append(PairMatches(names[a], names[b], pixels[a][rows[:, 0]], pixels[b][rows[:, 1]]))
    return found


def _report(rig: Rig, matches: Sequence[PairMatches], options: SolveOptions) -> MatchesReport:
    """How the rig explains the matches of its cameras."""
    own = [pair for pair in matches if pair.first in rig.names and pair.second in rig.names]
    return matches_report(rig, own, options=options.judge)


def _check_explained(report: MatchesReport, workspace: Path) -> None:
    if report.verdict is Verdict.REJECTED:
        raise ValueError(
            f"the solved rig must explain the matches, but {report.reason}; bad cameras {list(report.bad_cameras)}, "
            f"{len(report.bad_pairs)} bad pairs of {report.pairs}; give more instants that are really synchronized, "
            f"or a calibration of your own (report: {workspace / 'report.json'})"
        )
