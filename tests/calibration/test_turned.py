"""Videos that are stored lying: a calibration of the picture as stored and one of it as shown are both right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.accept import MatchOptions, Verdict
from calibration.judge import judge
from calibration.rig import Camera, Rig
from calibration.triangulate import TriangulateOptions
from calibration.turned import fitted
from tests.support.calibration_scene import arc, filmed, ring

# A turn by a quarter is a permutation with signs: only the principal point's subtraction rounds.
TOLERANCE = 1e-9

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))


@pytest.mark.parametrize(
    "lens", [(), (0.1, -0.05, 0.003, -0.002), (0.1, -0.05, 0.003, -0.002, 0.02), (0.1, 0.2, 0.01, 0.02, 0.3, 0.1, 0, 0)]
)
def test_a_turned_camera_sees_what_a_turned_picture_shows(lens):
    for fisheye in (False, True) if len(lens) == 4 else (False,):
        check_turned(
            replace(ring(1).cameras[0], fx=500.0, fy=510.0, cx=310.0, cy=185.0, distortion=lens, fisheye=fisheye)
        )


def check_turned(camera: Camera) -> None:
    pixels, depth = camera.project(POINTS)
    once, same_depth = camera.turned(1).project(POINTS)
    assert np.allclose(once, np.stack([camera.height - pixels[:, 1], pixels[:, 0]], axis=1), atol=TOLERANCE)
    assert np.allclose(depth, same_depth, atol=TOLERANCE)
    assert np.allclose(camera.turned(2).project(POINTS)[0], (camera.width, camera.height) - pixels, atol=TOLERANCE)
    whole = camera.turned(4)
    assert np.allclose(whole.camera_from_world, camera.camera_from_world, atol=TOLERANCE)
    assert (whole.width, whole.fx, whole.distortion) == (camera.width, camera.fx, camera.distortion)


def test_sizes_tell_which_pictures_lie():
    rig = ring(3)
    sizes = {"cam00": (640, 360), "cam01": (360, 640), "cam02": (720, 1280)}
    upright, turned = fitted(rig, sizes)
    assert turned == ("cam01", "cam02")
    assert [(c.width, c.height) for c in upright.cameras] == list(sizes.values())
    with pytest.raises(ValueError, match="must film in the shape it was calibrated in"):
        fitted(rig, sizes | {"cam00": (400, 400)})


def turn_picture(picture: np.ndarray, quarters: int) -> np.ndarray:
    """Clockwise."""
    return np.ascontiguousarray(np.rot90(picture, -quarters))


@pytest.mark.parametrize(
    ("quarters", "as_shown"),
    [
        ({"cam0": 1, "cam2": 3}, False),
        pytest.param({"cam0": 3}, True, marks=pytest.mark.slow),
        pytest.param({"cam0": 3}, False, marks=pytest.mark.slow),
        pytest.param(dict.fromkeys(arc(5).names, 3), False, marks=pytest.mark.slow),
    ],
)
def test_the_pictures_tell_which_way_a_video_was_turned(quarters, as_shown):
    truth, _, pictures = filmed(5)
    turned = {name: turn_picture(picture, quarters.get(name, 0)) for name, picture in pictures.items()}
    shown = Rig(tuple(camera.turned(quarters.get(camera.name, 0)) for camera in truth.cameras), "as shown")
    given = shown if as_shown else truth
    sizes = {name: (picture.shape[1], picture.shape[0]) for name, picture in turned.items()}
    rig, doubtful = fitted(given, sizes)
    judgement = judge(rig, turned, turned=doubtful, options=TriangulateOptions(judge=MatchOptions(min_explained=0.5)))
    assert judgement.matches.verdict is Verdict.ACCEPTED
    assert judgement.turned == ({} if as_shown else quarters)
    for camera, true in zip(judgement.rig.cameras, shown.cameras, strict=True):
        assert same(camera, true)


def same(camera: Camera, true: Camera) -> bool:
    numbers = [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (camera, true)]
    return np.allclose(*numbers, atol=TOLERANCE) and np.allclose(
        camera.camera_from_world, true.camera_from_world, atol=TOLERANCE
    )
