"""Cameras that were moved since the rig was solved, found by what the others locate."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest

from calibration.accept import PairMatches
from calibration.moved import MovedOptions, find_moved, place_by_others
from calibration.rig import Camera, Rig
from tests.support.calibration_scene import ring

RADIUS = math.sqrt(9 + 1)
"""Of `ring`, from its middle"""
TURN_DEG, SHIFT = 0.15, 0.006
"""How far noise of 0.3 px moves a camera, at most; before few points a turn and a shift make up for each other"""


def evidence(rig: Rig, *, points: int = 60, noise_px: float = 0.3, chance: int = 0, seed: int = 0) -> list[PairMatches]:
    """Points of a ball about the origin as all cameras show them, and `chance` matches of each pair that are wrong."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-0.6, 0.6, (points, 3))
    shown = {c.name: c.project(xyz)[0] + rng.normal(0, noise_px, (points, 2)) for c in rig.cameras}

    def pair(first: str, second: str) -> PairMatches:
        wrong = rng.uniform(0, 300, (2, chance, 2))
        return PairMatches(
            first, second, np.concatenate([shown[first], wrong[0]]), np.concatenate([shown[second], wrong[1]])
        )

    return [pair(first, second) for first, second in combinations(rig.names, 2)]


def bumped(camera: Camera, *, turn_deg: float = 0.0, shift: float = 0.0) -> Camera:
    """Turned about an axis across its view, and shifted by a share of the ring's radius."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.6, 0.8, 0]) * math.radians(turn_deg))[0]
    pose[:3, 3] = shift * RADIUS * np.array([0.8, 0.6, 0])
    return replace(camera, camera_from_world=pose @ camera.camera_from_world)


def with_bumped(rig: Rig, **how: dict[str, float]) -> Rig:
    return replace(rig, cameras=tuple(bumped(c, **how.get(c.name, {})) for c in rig.cameras))


def test_a_rig_that_stands_where_it_stood_has_no_moved_camera():
    standings, moved = find_moved(ring(6), evidence(ring(6), chance=20))
    assert moved == ()
    assert set(standings) == set(ring(6).names)
    assert all(s.fitting > 0.95 and s.turned_deg < TURN_DEG and s.shifted < SHIFT for s in standings.values())


@pytest.mark.parametrize("how", [{"turn_deg": 0.5}, {"turn_deg": 5.0}, {"shift": 0.02}, {"turn_deg": 1, "shift": 0.05}])
def test_a_moved_camera_is_found_and_how_far_it_went(how):
    rig = ring(6)
    standings, moved = find_moved(rig, evidence(with_bumped(rig, cam04=how), chance=20))
    assert moved == ("cam04",)
    assert standings["cam04"].turned_deg == pytest.approx(how.get("turn_deg", 0), abs=TURN_DEG)
    assert standings["cam04"].shifted == pytest.approx(how.get("shift", 0), abs=SHIFT)
    assert standings["cam04"].fitting < 0.5 < min(standings[name].fitting for name in rig.names if name != "cam04")


def test_a_turn_along_the_epipolar_lines_is_found():
    """In a flat ring a turn about the upright axis leaves matches of neighbours explained pair by pair."""
    rig, upright = ring(8, height=0.0), np.eye(4)
    upright[:3, :3] = cv2.Rodrigues(np.array([0, math.radians(1.0), 0]))[0]
    cameras = [
        replace(c, camera_from_world=upright @ c.camera_from_world) if c.name == "cam02" else c for c in rig.cameras
    ]
    assert find_moved(rig, evidence(replace(rig, cameras=tuple(cameras))))[1] == ("cam02",)


def test_two_moved_neighbours_are_both_found():
    rig = ring(8)
    _, moved = find_moved(rig, evidence(with_bumped(rig, cam03={"turn_deg": 2.0}, cam04={"shift": 0.05})))
    assert set(moved) == {"cam03", "cam04"}


def test_chance_matches_are_no_evidence():
    rig = ring(6)
    standings, moved = find_moved(rig, evidence(rig, points=6, chance=60))
    assert (standings, moved) == ({}, ())


def test_no_more_than_half_of_the_cameras_have_been_moved():
    rig, rng = ring(6), np.random.default_rng(0)
    all_moved = with_bumped(rig, **{name: {"turn_deg": float(rng.uniform(1, 5))} for name in rig.names})
    assert len(find_moved(rig, evidence(all_moved))[1]) <= 3


def test_options_refuse_what_proves_nothing():
    with pytest.raises(ValueError, match="unusable options"):
        MovedOptions(min_points=4)


def test_the_others_place_a_camera_that_stands_nobody_knows_where():
    rig, lost = ring(6), ring(6).cameras[2]
    others = rig.select(name for name in rig.names if name != lost.name)
    found = place_by_others(others, bumped(lost, turn_deg=170, shift=0.9), evidence(rig, chance=20))
    assert np.linalg.norm(found.centre - lost.centre) < SHIFT * RADIUS
    turn = cv2.Rodrigues(found.camera_from_world[:3, :3] @ lost.camera_from_world[:3, :3].T)[0]
    assert np.degrees(np.linalg.norm(turn)) < TURN_DEG
    assert (found.fx, found.cx, found.name) == (lost.fx, lost.cx, lost.name)


def test_points_that_agree_on_no_pose_place_nobody():
    rig, lost = ring(6), ring(6).cameras[2]
    others = rig.select(name for name in rig.names if name != lost.name)
    rng = np.random.default_rng(1)
    scattered = [
        replace(pair, **{side: rng.uniform(0, 300, (60, 2))})
        for pair in evidence(rig)
        for side in [f"{'first' if pair.first == lost.name else 'second'}_pixels"]
        if lost.name in (pair.first, pair.second)
    ]
    known = [pair for pair in evidence(rig) if lost.name not in (pair.first, pair.second)]
    assert place_by_others(others, lost, [*known, *scattered]) is None
    assert place_by_others(others, lost, known) is None
