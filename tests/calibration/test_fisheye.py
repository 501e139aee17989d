"""Fisheyes: OpenCV's model, there and back, through files, and undistorted."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.accept import Verdict, check_rig
from calibration.exporters import write_colmap, write_poses_bounds, write_transforms
from calibration.importers import load_rig
from calibration.judge import judge
from calibration.rig import Camera, Rig, distort_fisheye, undistort_fisheye
from calibration.triangulate import triangulate
from packuv.footage.lens import LensCamera, undistorted_camera, undistortion_maps
from tasks.stages.footage import lens_camera
from tests.support.calibration_scene import arc, render, ring

LENS = (0.03, 0.01, -0.002, 0.001)
# Bisection ends at the last bits of an angle near 1.5, whose tangent is 29 at most.
BACK_TOLERANCE = 1e-11
POSE_TOLERANCE = 1e-9
MAP_TOLERANCE_PX = 0.05
"""Maps are fixed point, in 1/32 pixels"""


def fisheyes(count: int = 4) -> Rig:
    cameras = [replace(c, fx=300.0, fy=302.0, cx=321.0, distortion=LENS, fisheye=True) for c in ring(count).cameras]
    return Rig(tuple(cameras), "fisheyes")


@settings(max_examples=50)
@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=20),
    st.tuples(st.floats(-0.02, 0.1), st.floats(-0.01, 0.02), st.floats(0, 0.005), st.floats(0, 0.002)),
)
def test_the_model_is_opencvs_and_its_inverse_undoes_it(rays, lens):
    plane = np.array(rays)
    theirs = cv2.fisheye.distortPoints(plane[None], np.eye(3), np.array(lens))[0]
    filmed = distort_fisheye(plane, lens)
    assert np.allclose(filmed, theirs, atol=1e-12)
    assert np.allclose(undistort_fisheye(filmed, lens), plane, atol=BACK_TOLERANCE * 10)


def test_rays_beyond_the_widest_angle_stay_in_front():
    camera = replace(fisheyes(1).cameras[0], fx=150.0, fy=150.0)  # its corner lies 2.4 rad from the axis
    plane = camera.plane_from_pixels(np.array([[0.0, 0.0], [320.0, 180.0]]))
    assert np.isfinite(plane).all()
    assert np.linalg.norm(plane[0]) == pytest.approx(np.tan(np.radians(88)), rel=1e-9)


def test_a_fisheye_that_folds_is_named_and_one_that_does_not_is_not():
    assert not check_rig(fisheyes(6)).suspicious
    rig = fisheyes(6)
    bad = replace(rig.cameras[2], distortion=(-0.4, 0.0, 0.0, 0.0))
    assert "folds back" in check_rig(Rig((*rig.cameras[:2], bad, *rig.cameras[3:]), "")).suspicious["cam02"]


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("format", ["colmap", "transforms", "rig.json"])
def test_fisheyes_keep_through_files(tmp_path, format, mixed):
    rig = fisheyes()
    if mixed:
        rig = Rig((*rig.cameras[:3], replace(ring(4).cameras[3], distortion=(0.1, 0.0, 0.0, 0.01))), "")
    if format == "colmap":
        write_colmap(rig, tmp_path)
    elif format == "transforms":
        write_transforms(rig, tmp_path / "transforms.json")
    else:
        rig.save(tmp_path / "rig.json")
    loaded = load_rig(tmp_path)
    for a, b in zip(loaded.cameras, rig.cameras, strict=True):
        assert (a.fisheye, a.distortion, a.matrix.tolist()) == (b.fisheye, b.distortion, b.matrix.tolist())
        assert np.allclose(a.camera_from_world, b.camera_from_world, atol=POSE_TOLERANCE)
    with pytest.raises(ValueError, match="write COLMAP or transforms"):
        write_poses_bounds(rig, tmp_path / "poses_bounds.npy", np.ones((4, 2)))


def test_a_lens_of_zeros_is_a_fisheye_all_the_same(tmp_path):
    rig = Rig(tuple(replace(c, distortion=(0.0,) * 4) for c in fisheyes().cameras), "")
    write_colmap(rig, tmp_path)
    assert load_rig(tmp_path).cameras[0].fisheye
    text = (tmp_path / "cameras.txt").read_text()
    assert text.count("OPENCV_FISHEYE") == 4


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("OPENCV_FISHEYE 640 360 300 302 321 180 0.03 0.01 -0.002 0.001", LENS),
        ("SIMPLE_RADIAL_FISHEYE 640 360 300 321 180 0.03", (0.03, 0, 0, 0)),
        ("RADIAL_FISHEYE 640 360 300 321 180 0.03 0.01", (0.03, 0.01, 0, 0)),
        ("SIMPLE_FISHEYE 640 360 300 321 180", (0, 0, 0, 0)),
        ("FISHEYE 640 360 300 302 321 180", (0, 0, 0, 0)),
    ],
)
def test_colmaps_fisheyes_are_opencvs(tmp_path, model, lens):
    write_colmap(fisheyes(1), tmp_path)
    (tmp_path / "cameras.txt").write_text(f"1 {model}\n")
    camera = load_rig(tmp_path).cameras[0]
    assert camera.fisheye
    assert camera.distortion == lens
    assert (camera.fx, camera.cx) == (300, 321)


def test_instant_ngp_says_is_fisheye(tmp_path):
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    data = {"w": 640, "h": 360, "fl_x": 300, "is_fisheye": True, "k1": 0.03, "k4": 0.001, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    camera = load_rig(tmp_path).cameras[0]
    assert camera.fisheye
    assert camera.distortion == (0.03, 0, 0, 0.001)


def test_undistortion_shows_each_ray_where_the_pinhole_puts_it():
    camera = fisheyes(1).cameras[0]
    lens = lens_camera(camera)
    assert LensCamera.from_json(json.loads(json.dumps(lens.to_json()))).to_json() == lens.to_json()
    pinhole = undistorted_camera(lens)
    maps = undistortion_maps(lens, pinhole)
    assert maps is not None
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32)
    shown = [cv2.remap(axis, *maps, cv2.INTER_LINEAR) for axis in (x, y)]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1) + 0.5
    rays = (pixels - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
    world = np.hstack([rays, np.ones((len(rays), 1))]) - camera.camera_from_world[:3, 3]
    filmed, _ = camera.project(world @ camera.camera_from_world[:3, :3])
    inside = ((filmed > 1) & (filmed < (camera.width - 1, camera.height - 1))).all(axis=1)
    assert inside.mean() > 0.98  # the widest pinhole that shows only what was filmed
    theirs = np.stack([axis.ravel() for axis in shown], axis=1) + 0.5
    assert np.abs(theirs - filmed)[inside].max() < MAP_TOLERANCE_PX
    assert 0.5 <= pinhole.fx / camera.fx < 4


def test_a_fisheye_needs_four_coefficients():
    with pytest.raises(ValueError, match="fisheye model has 4 coefficients, not 5"):
        Camera("a", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4), (0.1,) * 5, fisheye=True)
    with pytest.raises(ValueError, match="fisheye lens has 4 coefficients, not 0"):
        LensCamera(lens_camera(ring(1).cameras[0]).pinhole, fisheye=True)


@pytest.mark.slow
def test_pictures_of_fisheyes_agree_with_their_poses_and_not_with_a_pinholes():
    cameras = [replace(c, fx=170.0, fy=171.0, distortion=(0.05, -0.02, 0.0, 0.0), fisheye=True) for c in arc(5).cameras]
    rig = Rig(tuple(cameras), "fisheyes")
    pictures = {camera.name: render(camera) for camera in cameras}
    judgement = judge(rig, pictures)
    assert judgement.matches.verdict is Verdict.ACCEPTED
    assert judgement.matches.pair_median_px is not None
    assert judgement.matches.pair_median_px < 0.5  # a right calibration of sharp pictures stays below 1
    straight = Rig(tuple(replace(c, fisheye=False, distortion=()) for c in cameras), "taken for pinholes")
    wrong = judge(straight, pictures).matches
    assert wrong.pair_median_px is None or wrong.pair_median_px > 2 * judgement.matches.pair_median_px
    points = triangulate(rig, [pictures])
    assert len(points.xyz) > 50
    assert np.median(points.error_px) < 0.5
