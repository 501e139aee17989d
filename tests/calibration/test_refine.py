"""Refining a rig by matches whose points and cameras are known: what is wrong comes back, what is right stays."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest

from calibration.accept import PairMatches
from calibration.adjust import AdjustOptions
from calibration.multiview import Sightings, misses_px
from calibration.refine import PLACES, SOLVED, RefineOptions, aligned, refine, sway, tracks
from calibration.rig import Camera, Rig
from tests.calibration.test_repair import errors
from tests.support.calibration_scene import arc

NOISE_PX = 0.2


@pytest.fixture(scope="module")
def right() -> Rig:
    return arc(6, span_deg=58, size=(640, 360), lens=(-0.15, 0.05, 0.001, -0.001))


def matches(rig: Rig, *, count: int = 250, strange: float = 0.03, noise_px: float = NOISE_PX) -> list[PairMatches]:
    """Of points all about where the cameras look; a share of the matches joins any two points."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-1.2, -0.8, 2.0), (1.2, 0.9, 4.0), (count, 3))
    shown = {c.name: c.project(points)[0] + rng.normal(0, noise_px, (count, 2)) for c in rig.cameras}
    found = []
    for first, second in combinations(rig.cameras, 2):
        both = np.flatnonzero(first.sees(points) & second.sees(points) & (rng.random(count) < 0.6))
        other = np.where(rng.random(len(both)) < strange, rng.permutation(both), both)
        found.append(PairMatches(first.name, second.name, shown[first.name][both], shown[second.name][other]))
    return found


def shaken(rig: Rig, *, shift: float = 0.0, turn_deg: float = 0.0, names: tuple[str, ...] = ()) -> Rig:
    """Cameras, all unless some are named, moved by shares of 3 m and turned, in random directions."""
    rng = np.random.default_rng(7)

    def moved(camera: Camera) -> Camera:
        way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.radians(turn_deg) * axis)[0] @ camera.camera_from_world[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ (camera.centre + 3 * shift * way)
        return replace(camera, camera_from_world=pose)

    return replace(rig, cameras=tuple(moved(c) if not names or c.name in names else c for c in rig.cameras))


def test_a_right_rig_stays_the_same_object(right):
    done = refine(right, matches(right))
    assert done.rig is right
    assert done.freed == ()
    assert done.cameras == {}
    assert max(done.gains.values()) < 0.03
    assert done.to_json()["reason"].startswith("matches that the fit does not see lie 0.")


def test_poses_that_are_off_come_back(right):
    wrong = shaken(right, shift=0.005, turn_deg=0.3)
    done = refine(wrong, matches(right), levels=PLACES)
    assert done.freed == ("pose",)
    assert done.rig.source.startswith("an arc; refined (pose): matches that the fit does not see lie 0.")
    before, after = errors(aligned(wrong, right), right), errors(aligned(done.rig, right), right)
    # 0.2 px over a focal length of 608 is 0.02 degrees; some hundred matches a camera average it down
    assert after[0] < 0.002 < before[0]
    assert after[1] < 0.1 < before[1]
    assert all(
        a.fx == b.fx and a.distortion == b.distortion for a, b in zip(done.rig.cameras, wrong.cameras, strict=True)
    )


def test_lenses_that_are_off_are_freed_too(right):
    wrong = replace(right, cameras=tuple(replace(c, fx=1.03 * c.fx, fy=1.03 * c.fy) for c in right.cameras))
    done = refine(wrong, matches(right), levels=(("pose",), ("pose", "focal length")))
    assert done.freed == ("pose", "focal length")
    assert errors(aligned(done.rig, right), right)[2] < 0.01
    assert refine(wrong, matches(right), levels=PLACES).rig[right.names[0]].fx == wrong.cameras[0].fx


def test_one_camera_that_is_far_off_is_named_and_the_others_stay_where_they_are(right):
    wrong = shaken(right, shift=0.03, names=("cam3",))
    done = refine(wrong, matches(right), levels=PLACES)
    assert set(done.told(RefineOptions())) == {"cam3"}
    assert "was moved by" in done.told(RefineOptions())["cam3"]
    assert done.told(RefineOptions(far=math.inf, far_deg=math.inf)) == {}  # as of a solve, which nobody gave places for
    centre, turn_deg, _ = errors(done.rig, right)  # the world is still that of the other cameras
    assert centre < 0.003
    assert turn_deg < 0.1


def test_a_camera_that_its_matches_do_not_fix_is_named(right):
    done = refine(shaken(right, shift=0.005, turn_deg=0.3), matches(right), levels=PLACES)
    assert not any("one half" in said for said in done.told(RefineOptions()).values())
    strict = RefineOptions(unsure=1e-6)
    assert all("one half of the matches places it elsewhere" in said for said in done.told(strict).values())
    assert done.told(strict).keys() == set(right.names)


def test_too_few_matches_leave_the_rig_as_it_is_and_say_so(right):
    wrong = shaken(right, shift=0.005, turn_deg=0.3)
    done = refine(wrong, matches(right, count=25))
    assert done.rig is wrong
    assert done.reason.startswith("too few matches show cam")
    assert refine(wrong, []).rig is wrong


def test_a_rig_in_another_world_is_brought_back(right):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array([0.3, -0.5, 0.9]))[0], (4, -2, 1)
    cameras = []
    for camera in right.cameras:
        elsewhere = camera.camera_from_world @ np.linalg.inv(pose)
        elsewhere[:3, 3] *= 2.5
        cameras.append(replace(camera, camera_from_world=elsewhere))
    back = aligned(replace(right, cameras=tuple(cameras)), right)
    for one, other in zip(back.cameras, right.cameras, strict=True):
        assert np.allclose(one.camera_from_world, other.camera_from_world, atol=1e-9)


def test_what_stands_still_is_one_track_however_many_instants_show_it(right):
    once = tracks(right, matches(right, strange=0.0, noise_px=0.0))
    thrice = tracks(right, matches(right, strange=0.0, noise_px=0.0) * 3)
    assert len(once.views) == len(thrice.views)
    assert np.array_equal(once.camera, thrice.camera)
    # pixels of one cell are put together, which costs the few tracks whose points share one
    assert np.median(misses_px(right, once)) < 1e-6


def test_each_track_has_a_camera_once(right):
    found = tracks(right, matches(right))
    keys = list(zip(found.point.tolist(), found.camera.tolist(), strict=True))
    assert len(set(keys)) == len(keys)
    assert isinstance(found, Sightings)
    assert found.views.min() >= 2


def test_options_must_make_sense():
    with pytest.raises(ValueError, match="must be positive"):
        AdjustOptions(shift=0.0)
    with pytest.raises(ValueError, match="gains shares"):
        RefineOptions(gain=0.01, level_gain=0.02)


def test_a_rig_whose_principal_points_are_wrong_sways_and_a_right_one_does_not(right):
    """What a mapper that keeps them in the middle gives, and what `tasks.stages.calibrate` then says."""
    aside = replace(right, cameras=tuple(replace(c, cx=c.cx + 15 * (-1) ** i) for i, c in enumerate(right.cameras)))
    options = RefineOptions(adjust=SOLVED)
    still, swaying = (sway(rig, matches(right), options=options) for rig in (right, aside))
    assert still.keys() == set(right.names)
    assert max(still.values()) < max(swaying.values())
    assert max(swaying.values()) > options.swaying
