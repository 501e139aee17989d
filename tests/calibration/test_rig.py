"""Cameras and rigs: files, projection and its inverse."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.rig import Camera, Rig, distort
from tests.support.calibration_scene import arc, ring

LENSES = [
    (),
    (-0.2, 0.05, 0.001, -0.002),
    (-0.2, 0.05, 0.001, -0.002, -0.01),
    (0.1, 0.02, 0.0, 0.001, 0.01, 0.2, 0.03, 0.01),
]


def same(a: Camera, b: Camera) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(Camera))


@given(st.lists(st.floats(-1e6, 1e6), min_size=7, max_size=7), st.sampled_from([0, 4, 5, 8]), st.booleans())
def test_a_saved_rig_loads_as_the_same_numbers(tmp_path_factory, numbers, lens, metric):
    path = tmp_path_factory.mktemp("rig") / "rig.json"
    camera = ring(3).cameras[1]
    pose = camera.camera_from_world.copy()
    pose[:3, 3] = numbers[:3]
    gains = tuple(abs(value) + 0.1 for value in numbers[3:6])
    rig = Rig(
        (replace(camera, camera_from_world=pose, gains=gains, distortion=(numbers[6] / 1e7,) * lens),), "test", metric
    )
    rig.save(path)
    loaded = Rig.load(path)
    assert (loaded.source, loaded.metric) == ("test", metric)
    assert same(loaded.cameras[0], rig.cameras[0])  # exact: repr of a float reads back to itself


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_to_rays_undoes_projection(lens):
    camera = arc(3, lens=lens).cameras[0]
    rng = np.random.default_rng(1)
    pixels = rng.uniform((0, 0), (camera.width, camera.height), (200, 2))
    rays = np.hstack([camera.plane_from_pixels(pixels), np.ones((200, 1))]) @ camera.camera_from_world[:3, :3]
    depth = rng.uniform(0.5, 5, 200)
    back, found = camera.project(camera.centre + depth[:, None] * rays)
    # The inverse lens iterates until 1e-12 or 100 times; 1e-5 px is far below any feature's accuracy.
    assert np.abs(back - pixels).max() < 1e-5
    assert np.allclose(found, depth)


def test_the_lens_model_is_opencv_s():
    import cv2

    plane = np.random.default_rng(2).uniform(-0.6, 0.6, (50, 2))
    for lens in LENSES[1:]:
        points = np.hstack([plane, np.ones((50, 1))])
        theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens))[0][:, 0]
        assert np.allclose(distort(plane, lens), theirs, atol=1e-12)


def test_a_camera_sees_what_lies_before_it_and_in_its_picture():
    camera = ring(4).cameras[0]
    ahead = camera.centre + 2 * camera.forward
    aside = ahead + 3 * camera.camera_from_world[0, :3]
    assert camera.sees(np.stack([ahead, aside, camera.centre - camera.forward])).tolist() == [True, False, False]


def test_a_folding_lens_does_not_bring_the_far_side_into_the_picture():
    # 1 + k1 r^2 is 0 at r = 1.83: rays near it land at the picture's centre.
    camera = replace(ring(4).cameras[0], distortion=(-0.3, 0.0, 0.0, 0.0))
    sideways = camera.centre + camera.forward + 1.8 * camera.camera_from_world[0, :3]
    pixels, _ = camera.project(sideways[None])
    assert 0 <= pixels[0, 0] <= camera.width
    assert not camera.sees(sideways[None])[0]


def test_select_keeps_the_order_asked_for():
    rig = ring(4)
    assert rig.select(["cam03", "cam01"]).names == ("cam03", "cam01")
    with pytest.raises(KeyError, match="no camera 'cam9'"):
        rig.select(["cam9"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_from_world": np.diag([1.0, 1, -1, 1])}, "rigid"),
        ({"camera_from_world": np.full((4, 4), np.nan)}, "rigid"),
        ({"distortion": (0.1, 0.2)}, "4, 5 or 8 coefficients, not 2"),
        ({"cx": float("nan")}, "finite"),
        ({"fx": -1.0}, "positive"),
    ],
)
def test_impossible_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(ring(3).cameras[0], **change)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a rig file"),
        ("[]", "not a rig file"),
        ('{"cameras": [], "metric": true}', "needs the field 'source'"),
        ('{"cameras": [{"name": "a", "focal": 3}], "source": "", "metric": true}', r"unknown fields \['focal'\]"),
    ],
)
def test_a_damaged_rig_file_is_named(tmp_path, text, message):
    path = tmp_path / "rig.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        Rig.load(path)


def test_the_file_holds_what_the_docs_list(tmp_path):
    ring(2).save(tmp_path / "rig.json")
    data = json.loads((tmp_path / "rig.json").read_text())
    assert sorted(data) == ["cameras", "metric", "source"]
    assert sorted([*data["cameras"][0], "fisheye"]) == sorted(field.name for field in fields(Camera))


def test_another_picture_size_scales_pixels_and_another_shape_is_refused():
    camera = replace(ring(1).cameras[0], distortion=(0.05, -0.02, 0.001, 0.002))
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
    half = camera.resized(camera.width // 2, camera.height // 2)
    assert np.abs(2 * half.project(points)[0] - camera.project(points)[0]).max() < 1e-9
    assert (half.width, half.height) == (camera.width // 2, camera.height // 2)
    with pytest.raises(ValueError, match="must film in the shape it was calibrated in"):
        camera.resized(camera.width, camera.height // 2)
