"""Rigs that look at one place, rigs that do not, and what matches say about poses."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.accept import (
    CheckOptions,
    MatchesReport,
    MatchOptions,
    PairMatches,
    Verdict,
    check_rig,
    matches_report,
)
from calibration.rig import Camera, Rig
from tests.support.calibration_scene import arc, look_at, ring

COARSE = CheckOptions(samples=21)
GRID = 1.5 * 2 / 20
"""Distance between the samples of COARSE, in rig radii"""


def with_pose(rig: Rig, name: str, pose: np.ndarray) -> Rig:
    return Rig(tuple(replace(c, camera_from_world=pose) if c.name == name else c for c in rig.cameras), rig.source)


def moved(rig: Rig, turn: np.ndarray, scale: float, shift: np.ndarray) -> Rig:
    """The rig after world points x became scale * turn @ x + shift."""
    cameras = []
    for camera in rig.cameras:
        pose = np.eye(4)
        pose[:3, :3] = camera.camera_from_world[:3, :3] @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ (scale * turn @ camera.centre + shift)
        cameras.append(replace(camera, camera_from_world=pose))
    return Rig(tuple(cameras), rig.source)


def test_a_ring_looks_at_its_middle():
    report = check_rig(ring(8), options=COARSE)
    assert np.allclose(report.scene_centre, 0, atol=1e-9)
    assert report.rig_radius == pytest.approx(math.sqrt(9 + 1))
    assert report.seen_share == 1
    assert not report.suspicious
    assert not report.parallel
    assert report.spacing == pytest.approx((2 * 3 * math.sin(math.pi / 8),) * 3)
    # A camera's vertical half angle is atan(180 / 512): it sees 1.05 units up and down at the middle, more beyond it.
    assert 0.9 < report.common_radius < 3


def test_the_common_sphere_is_seen_as_promised():
    rig = ring(6)
    report = check_rig(rig)
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(4000, 3))
    inside *= (
        report.common_radius * rng.uniform(size=(4000, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    )
    seen = np.sum([camera.sees(inside + report.scene_centre) for camera in rig.cameras], axis=0)
    assert (seen >= 3).mean() == pytest.approx(0.9, abs=0.03)  # 4,000 samples and a grid of 41 a side


@settings(max_examples=25)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.floats(1e-3, 1e3), st.tuples(*[st.floats(-100, 100)] * 3))
def test_the_report_moves_and_grows_with_the_world(turn, scale, shift):
    rotation = cv2.Rodrigues(np.array(turn))[0]
    before, after = (
        check_rig(ring(5), options=COARSE),
        check_rig(moved(ring(5), rotation, scale, np.array(shift)), options=COARSE),
    )
    expected = scale * rotation @ before.scene_centre + shift
    assert np.allclose(after.scene_centre, expected, atol=1e-6 * max(scale, 1))
    assert after.rig_radius == pytest.approx(scale * before.rig_radius, rel=1e-6)
    # The grid's axes do not turn with the world.
    assert after.common_radius == pytest.approx(scale * before.common_radius, abs=2 * GRID * after.rig_radius)


def test_one_camera_that_looks_away_is_named_and_does_not_move_the_centre():
    rig = ring(8)
    astray = with_pose(rig, "cam03", look_at(rig["cam03"].centre, 2 * rig["cam03"].centre + (0, 0, 1)))
    report = check_rig(astray, options=COARSE)
    assert list(report.suspicious) == ["cam03"]
    assert "does not see the scene centre" in report.suspicious["cam03"]
    assert np.allclose(report.scene_centre, 0, atol=0.05)  # of a radius of 3.2; the stray axis keeps a small weight
    assert report.seen_share == 7 / 8


def test_a_camera_far_out_is_named():
    rig = ring(8)
    report = check_rig(with_pose(rig, "cam02", look_at((50, -1, 0), (0, 0, 0))), options=COARSE)
    assert report.suspicious == {"cam02": "stands 15.8 times as far from the scene centre as most"}
    assert report.rig_radius == pytest.approx(math.sqrt(10), rel=1e-6)


def test_a_camera_given_twice_is_named():
    rig = ring(8)
    report = check_rig(with_pose(rig, "cam05", rig["cam01"].camera_from_world), options=COARSE)
    assert report.suspicious == {"cam05": "has the same pose as cam01"}


def test_a_lens_that_folds_back_is_named():
    rig = ring(6)
    # 1 + 3 k1 r^2 is 0 at r = 0.65; the corner lies at 0.72.
    bad = replace(rig.cameras[0], distortion=(-0.8, 0.0, 0.0, 0.0))
    report = check_rig(Rig((bad, *rig.cameras[1:]), ""), options=COARSE)
    assert "folds back" in report.suspicious["cam00"]


def test_cameras_that_look_outwards_share_nothing():
    rig = ring(6)
    outward = Rig(tuple(replace(c, camera_from_world=look_at(c.centre, 2 * c.centre)) for c in rig.cameras), "a test")
    with pytest.raises(ValueError, match=r"must see a common volume, but of 6 only 0 see .* axes convention of a test"):
        check_rig(outward, options=COARSE)


def parallel_rig() -> Rig:
    cameras = [
        replace(ring(1).cameras[0], name=f"p{i}", camera_from_world=look_at((i, 0, 0), (i, 0, 9))) for i in range(4)
    ]
    return Rig(tuple(cameras), "parallel")


def test_parallel_axes_take_the_distance_from_points():
    points = np.array([[0.0, 0, 5], [1, 1, 7], [2, 0, 9]])
    report = check_rig(parallel_rig(), points=points, options=COARSE)
    assert report.parallel
    assert np.allclose(report.scene_centre, (1.5, 0, 7))
    assert check_rig(parallel_rig(), options=COARSE).scene_centre == pytest.approx((1.5, 0, 9))  # three times the width


def test_reports_are_json():
    report = check_rig(ring(4), options=COARSE)
    assert json.loads(json.dumps(report.to_json()))["cameras"] == 4
    verdict = matches_report(ring(4), [])
    assert MatchesReport.from_json(json.loads(json.dumps(verdict.to_json()))) == verdict


# Matches


def evidence(rig: Rig, *, noise_px: float = 0.3, count: int = 60, seed: int = 0) -> list[PairMatches]:
    """Points of a ball about the origin, projected into all pairs with Gaussian noise."""
    rng = np.random.default_rng(seed)
    found = []
    for i, first in enumerate(rig.cameras):
        for second in rig.cameras[i + 1 :]:
            points = rng.uniform(-0.6, 0.6, (count, 3))
            pixels = [camera.project(points)[0] + rng.normal(0, noise_px, (count, 2)) for camera in (first, second)]
            found.append(PairMatches(first.name, second.name, *pixels))
    return found


def turned(camera: Camera, degrees: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.6, 0.8, 0]) * math.radians(degrees))[0]
    return turn @ camera.camera_from_world


def test_right_poses_explain_their_matches():
    report = matches_report(ring(6), evidence(ring(6)), errors_px=np.array([0.1, 0.2, 0.4]))
    assert report.verdict is Verdict.ACCEPTED
    assert report.explained_share == 1
    assert (report.pairs, report.matches, report.reprojection_px) == (15, 900, 0.2)
    # The Sampson distance of noise with deviation s in both pictures has deviation s; half lie within 0.67 s.
    assert report.pair_median_px == pytest.approx(0.67 * 0.3, rel=0.1)


def test_one_turned_camera_is_found():
    rig = ring(6)
    wrong = with_pose(rig, "cam04", turned(rig["cam04"], 3))
    report = matches_report(wrong, evidence(rig))
    assert report.bad_cameras == ("cam04",)
    assert all("cam04" in pair for pair in report.bad_pairs)
    assert report.verdict is Verdict.REJECTED  # 5 of 15 pairs are wrong


def test_wrong_poses_are_rejected_though_every_camera_looks_inwards():
    rig, rng = ring(8), np.random.default_rng(3)
    order = rng.permutation(8)
    shuffled = Rig(
        tuple(
            replace(c, camera_from_world=rig.cameras[i].camera_from_world)
            for c, i in zip(rig.cameras, order, strict=True)
        ),
        "",
    )
    assert not check_rig(shuffled, options=COARSE).suspicious
    report = matches_report(shuffled, evidence(rig))
    assert report.verdict is Verdict.REJECTED
    assert report.explained_share is not None
    assert report.explained_share < 0.3


def test_points_behind_a_camera_explain_nothing():
    """Turned by 180 degrees about its optical axis' normal, a camera keeps every epipolar line and sees nothing."""
    first, second = ring(6).cameras[:2]
    behind = second.camera_from_world.copy()
    behind[[0, 2]] *= -1
    matches = evidence(Rig((first, second), ""))
    mirrored = replace(second, camera_from_world=behind)
    flipped = [replace(m, second_pixels=np.array([second.width, 0]) + m.second_pixels * (-1, 1)) for m in matches]
    for pose, pairs, share in ((second, matches, 1.0), (mirrored, flipped, 0.0)):
        report = matches_report(Rig((first, pose), ""), pairs, options=MatchOptions(max_error_px=200))
        assert report.explained_share == share


def test_too_few_matches_decide_nothing():
    report = matches_report(ring(6), evidence(ring(6), count=10))
    assert report.verdict is Verdict.UNDECIDED
    assert report.reason == "only 0 pairs of the 6 cameras have 20 matches or more"
    assert (report.explained_share, report.pair_median_px, report.reprojection_px) == (None, None, None)


def test_several_instants_of_a_pair_count_together():
    rig = arc(4)
    halves = [pair for seed in (1, 2) for pair in evidence_of_arc(rig, seed)]
    report = matches_report(rig, halves)
    assert (report.pairs, report.matches) == (6, 6 * 24)


def evidence_of_arc(rig: Rig, seed: int) -> list[PairMatches]:
    points = np.random.default_rng(seed).uniform(-0.3, 0.3, (12, 3)) + np.array([0, 0.2, 3])
    return [
        PairMatches(a.name, b.name, a.project(points)[0], b.project(points)[0])
        for i, a in enumerate(rig.cameras)
        for b in rig.cameras[i + 1 :]
    ]
