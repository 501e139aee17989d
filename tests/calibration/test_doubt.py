"""Planted faults of single cameras and of all lenses: the pictures name them, and leave right calibrations alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.accept import MatchOptions, PairMatches, Verdict, matches_report
from calibration.doubt import WHOLE, accused, doubts
from calibration.features import Features
from calibration.judge import judge
from calibration.rig import Camera, Rig
from calibration.triangulate import TriangulateOptions, choose_pairs, detect_all, verified_matches
from tests.support.calibration_scene import arc, render

LENS = (-0.15, 0.05, 0.001, -0.001)
OPTIONS = TriangulateOptions(judge=MatchOptions(min_explained=0.5))
WRONG, OTHER = "cam3", "cam1"


@pytest.fixture(scope="module")
def right() -> Rig:
    return arc(6, span_deg=58, size=(640, 360), lens=LENS)


@pytest.fixture(scope="module")
def features(right) -> dict[str, Features]:
    pictures = {camera.name: render(camera, oversample=1) for camera in right.cameras}
    return detect_all(right, pictures, options=OPTIONS.features)


@pytest.fixture(scope="module")
def evidence(right, features) -> list[PairMatches]:
    """Matches found without the poses, and so the same for any: but for the lenses, which RANSAC takes out."""
    return verified_matches(right, features, choose_pairs(right, neighbours=8), ratio=OPTIONS.ratio)


def found(rig: Rig, evidence: list[PairMatches], *features: dict[str, Features]) -> dict[str, str]:
    report = matches_report(rig, evidence, options=OPTIONS.judge)
    return doubts(rig, evidence, report, judge=OPTIONS, features=features)


def one(change: Callable[[Camera], Camera]) -> Callable[[Rig], Rig]:
    return lambda rig: replace(rig, cameras=tuple(change(c) if c.name == WRONG else c for c in rig.cameras))


def every(change: Callable[[Camera], Camera]) -> Callable[[Rig], Rig]:
    return lambda rig: replace(rig, cameras=tuple(map(change, rig.cameras)))


def turned(axis: int) -> Callable[[Camera], Camera]:
    """By two degrees."""

    def turn(camera: Camera) -> Camera:
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.radians(2.0) * np.eye(3)[axis])[0]
        return replace(camera, camera_from_world=pose @ camera.camera_from_world)

    return turn


def moved(axis: int) -> Callable[[Camera], Camera]:
    """By 3 % of the rig's radius of 3."""

    def move(camera: Camera) -> Camera:
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ (0.09 * np.eye(3)[axis])
        return replace(camera, camera_from_world=pose)

    return move


def longer(camera: Camera) -> Camera:
    return replace(camera, fx=1.1 * camera.fx, fy=1.1 * camera.fy)


def aside(camera: Camera) -> Camera:
    return replace(camera, cx=camera.cx + 0.05 * camera.width)


def flat(camera: Camera) -> Camera:
    return replace(camera, distortion=())


FAULTS: dict[str, tuple[Callable[[Rig], Rig], str]] = {
    "focal length": (one(longer), WRONG),
    "focal lengths": (every(longer), WHOLE),
    "principal point": (one(aside), WRONG),
    "principal points": (every(aside), WHOLE),
    "no distortion": (one(flat), WRONG),
    "no distortions": (every(flat), WHOLE),
    "turned about x": (one(turned(0)), WRONG),
    "turned about y": (one(turned(1)), WRONG),
    "turned about z": (one(turned(2)), WRONG),
    "moved across": (one(moved(1)), WRONG),
    "moved along": (one(moved(0)), WRONG),
}


def test_a_right_calibration_is_not_doubted(right, evidence):
    assert found(right, evidence) == {}


def test_walls_that_look_alike_accuse_nobody_whom_two_others_confirm(right, evidence):
    """Many pairs far apart match one brick wall with another, on a geometry of its own, more often than themselves."""
    alike = []
    for number, pair in enumerate(evidence):
        if abs(int(pair.first[3:]) - int(pair.second[3:])) > 2:
            shifted = replace(pair, second_pixels=pair.second_pixels + np.array([0, 30 + 5 * number]))
            alike += [shifted, shifted, shifted]
    assert len(alike) >= 9
    assert found(right, [*evidence, *alike]) == {}
    change, named = FAULTS["turned about x"]
    assert named in found(change(right), [*evidence, *alike])


def test_a_dozen_chance_matches_at_each_instant_accuse_nobody(right, evidence):
    """An epipolar geometry of its own explains so many; in small pictures of a crowd they add up over the instants."""
    rng = np.random.default_rng(0)
    seen = [pair for pair in evidence if "cam5" not in (pair.first, pair.second)]
    near = next(pair for pair in evidence if (pair.first, pair.second) == ("cam4", "cam5"))
    seen.append(replace(near, first_pixels=near.first_pixels[:12], second_pixels=near.second_pixels[:12]))
    chance = [PairMatches(other, "cam5", *rng.uniform(0, 350, (2, 12, 2))) for other in ("cam0", "cam1")]
    said = found(right, [*seen, *chance * 3])  # what stands still is as wrong at every instant
    assert set(said) == {"cam5"}  # a dozen matches with one neighbour do not confirm it
    assert accused(said) == set()
    change, named = FAULTS["focal length"]
    assert set(found(change(right), [*evidence, *chance * 3])) == {named}


def test_matches_along_the_lines_tell_where_few_are_found_without_the_poses(right, evidence, features):
    few = [
        replace(pair, first_pixels=pair.first_pixels[:most], second_pixels=pair.second_pixels[:most])
        for pair in evidence
        for most in [1 if WRONG in (pair.first, pair.second) else None]
    ]
    said = found(right, few)
    assert (set(said), accused(said)) == ({WRONG}, set())
    assert found(right, few, features) == {}
    change, named = FAULTS["principal point"]
    assert set(found(change(right), few, features)) == {named}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(right, evidence, fault):
    change, named = FAULTS[fault]
    assert set(found(change(right), evidence)) == {named}


def test_two_cameras_whose_names_were_swapped_are_refused_or_named(right, evidence):
    poses = {WRONG: right[OTHER].camera_from_world, OTHER: right[WRONG].camera_from_world}
    cameras = (replace(c, camera_from_world=poses.get(c.name, c.camera_from_world)) for c in right.cameras)
    swapped = replace(right, cameras=tuple(cameras))
    report = matches_report(swapped, evidence, options=OPTIONS.judge)
    assert report.verdict is Verdict.REJECTED or {WRONG, OTHER} <= set(found(swapped, evidence))


def test_pictures_that_say_nothing_leave_a_calibration_unconfirmed():
    rig = arc(4)
    blank = {camera.name: np.full((camera.height, camera.width, 3), 90, np.uint8) for camera in rig.cameras}
    judgement = judge(rig, blank, options=OPTIONS)
    assert judgement.doubts[WHOLE].startswith("is neither confirmed nor refuted by the pictures")
    assert judgement.to_json()["doubts"] == dict(judgement.doubts)
