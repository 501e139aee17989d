"""Planted faults are mended: the pictures find the right camera again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.accept import PairMatches
from calibration.doubt import WHOLE
from calibration.repair import repair
from calibration.rig import Camera, Rig
from tests.calibration.test_doubt import FAULTS, OTHER, WRONG, evidence, features, found, right

__all__ = ["evidence", "features", "right"]  # fixtures


def errors(rig: Rig, truth: Rig) -> tuple[float, float, float]:
    """Largest error of a centre, share of the rig's radius, of a rotation, degrees, and of a focal length, share."""
    radius = np.linalg.norm(truth.centres - truth.centres.mean(axis=0), axis=1).max()
    pairs = list(zip(rig.cameras, truth.cameras, strict=True))
    turns = [a.camera_from_world[:3, :3] @ b.camera_from_world[:3, :3].T for a, b in pairs]
    degrees = [np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) for turn in turns]
    return (
        float(np.linalg.norm(rig.centres - truth.centres, axis=1).max() / radius),
        float(max(degrees)),
        max(abs(a.fx / b.fx - 1) for a, b in pairs),
    )


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_mended(right, evidence, fault):
    change, named = FAULTS[fault]
    wrong = change(right)
    mended = repair(wrong, evidence, set(found(wrong, evidence)), whole=WHOLE)
    assert set(mended.told) == {named}
    assert found(mended.rig, evidence) == {}
    centre, turn_deg, focal = errors(mended.rig, right)
    # epipolar lines alone say little of a camera that looks aside and stands aside to match
    assert centre < 0.01
    assert turn_deg < 0.2
    assert focal < 0.005
    assert all(a == b for a, b in zip(mended.rig.cameras, wrong.cameras, strict=True) if named not in (WHOLE, a.name))


@pytest.mark.parametrize("whole", [True, False])
def test_cameras_that_have_each_others_name_or_pose_get_their_own(right, evidence, whole):
    mine, its = right[WRONG], right[OTHER]
    odd = replace(its, fx=1.3 * its.fx, fy=1.3 * its.fy) if whole else its
    truth = replace(right, cameras=tuple(odd if c.name == OTHER else c for c in right.cameras))
    matches = list(evidence)
    if whole:  # pictures of a longer lens, which shows the middle larger
        matches = [longer_lens(pair, its) for pair in evidence]
        taken = {WRONG: replace(odd, name=WRONG), OTHER: replace(mine, name=OTHER)}
    else:
        taken = {
            WRONG: replace(mine, camera_from_world=its.camera_from_world),
            OTHER: replace(its, camera_from_world=mine.camera_from_world),
        }
    wrong = replace(right, cameras=tuple(taken.get(c.name, c) for c in right.cameras))
    mended = repair(wrong, matches, {WRONG, OTHER}, whole=WHOLE)
    assert set(mended.told) == {WRONG, OTHER}
    assert errors(mended.rig, truth) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)


def longer_lens(pair: PairMatches, camera: Camera) -> PairMatches:
    """The matches if this camera's focal length were 1.3 times as long."""
    plane = {name: camera.plane_from_pixels(own) for name, own in
             ((pair.first, pair.first_pixels), (pair.second, pair.second_pixels)) if name == camera.name}  # fmt: skip
    longer = replace(camera, fx=1.3 * camera.fx, fy=1.3 * camera.fy)
    own = {
        name: longer.distorted(points) * (longer.fx, longer.fy) + (longer.cx, longer.cy)
        for name, points in plane.items()
    }
    return replace(
        pair,
        first_pixels=own.get(pair.first, pair.first_pixels),
        second_pixels=own.get(pair.second, pair.second_pixels),
    )


def test_what_is_right_is_left_alone(right, evidence):
    mended = repair(right, evidence, {WRONG, WHOLE}, whole=WHOLE)
    assert mended.rig is right or errors(mended.rig, right) == (0.0, 0.0, 0.0)
    assert mended.told == {}
