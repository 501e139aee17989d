"""The rig of another take, held against the pictures of this one."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.accept import Verdict
from calibration.judge import judge_shared
from calibration.rig import Rig
from tests.support.calibration_scene import arc, render

COUNT = 6


@pytest.fixture(scope="module")
def rig() -> Rig:
    return arc(COUNT)


@pytest.fixture(scope="module")
def pictures(rig) -> dict[str, np.ndarray]:
    return {camera.name: render(camera) for camera in rig.cameras}


def with_turned(rig: Rig, name: str, degrees: float) -> Rig:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0]))[0]
    cameras = [replace(c, camera_from_world=turn @ c.camera_from_world) if c.name == name else c for c in rig.cameras]
    return replace(rig, cameras=tuple(cameras))


def test_the_rig_of_a_day_fits_every_take(rig, pictures):
    found = judge_shared(rig, [pictures])
    assert found.moved == ()
    assert found.matches.verdict is Verdict.ACCEPTED
    assert found.usual() > 0.9
    assert set(found.to_json()) == {"moved", "standings", "matches"}


def test_a_camera_that_was_bumped_is_named_and_the_others_are_judged_without_it(rig, pictures):
    bumped = {**pictures, "cam2": render(with_turned(rig, "cam2", 1.5)["cam2"])}
    found = judge_shared(rig, [bumped])
    assert found.moved == ("cam2",)
    assert found.standings["cam2"].fitting < 0.2
    assert found.standings["cam2"].turned_deg == pytest.approx(1.5, abs=0.3)
    assert found.matches.verdict is Verdict.ACCEPTED


def test_a_rig_that_is_wrong_altogether_is_rejected(rig, pictures):
    turned = rig
    for number, name in enumerate(rig.names):
        turned = with_turned(turned, name, (-1) ** number * (8 + 3 * number))
    found = judge_shared(turned, [pictures])
    assert len(found.moved) <= COUNT / 2
    assert found.matches.verdict is not Verdict.ACCEPTED
