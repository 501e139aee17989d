"""Calibrations of other programs: round trips, conventions, names, damaged files."""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calibration.exporters import write_colmap, write_poses_bounds, write_transforms
from calibration.importers import find_calibration, holds_lenses_alone, load_lenses, load_rig
from calibration.importers.names import natural_key
from calibration.rig import Camera, Rig
from tests.support.calibration_scene import arc, look_at, ring
from tests.support.needs import need_data

# Rotations pass through quaternions or an inverse: a few roundings of numbers near 1, and of translations near 1e3.
POSE_TOLERANCE = 1e-9

coordinates = st.floats(-1e3, 1e3).map(lambda value: round(value, 6))
turns = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)


names = st.text("abcXYZ019_- é", min_size=1, max_size=8).map(str.strip).filter(bool)


@st.composite
def rigs(draw, coefficients=(0, 4, 5, 8)):
    chosen = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    return Rig(tuple(draw(cameras(name, coefficients)) for name in chosen), "drawn")


@st.composite
def cameras(draw, name, coefficients):
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array(draw(turns)))[0]
    pose[:3, 3] = [draw(coordinates) for _ in range(3)]
    length = draw(st.sampled_from(coefficients))
    # The last coefficient is not 0, so that the shortest model that holds the lens is the one drawn.
    lens = tuple(draw(st.lists(st.floats(-0.3, 0.3), min_size=length, max_size=length)))
    lens = (*lens[:-1], 0.125) if lens else ()
    focal, centre = st.floats(1, 5000), st.floats(-10, 5000)
    size = draw(st.tuples(st.integers(1, 9000), st.integers(1, 9000)))
    return Camera(name, *size, draw(focal), draw(focal), draw(centre), draw(centre), pose, lens)


def assert_same(loaded: Rig, rig: Rig) -> None:
    assert loaded.names == rig.names
    for a, b in zip(loaded.cameras, rig.cameras, strict=True):
        assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == (b.width, b.height, b.fx, b.fy, b.cx, b.cy)
        assert a.distortion == b.distortion
        assert np.allclose(a.camera_from_world, b.camera_from_world, rtol=0, atol=POSE_TOLERANCE)


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(rigs())
def test_colmap_text_round_trip(tmp_path_factory, rig):
    folder = tmp_path_factory.mktemp("colmap")
    write_colmap(rig, folder)
    assert_same(load_rig(folder), rig)


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(rigs(coefficients=(0, 4, 5)))
def test_transforms_round_trip(tmp_path_factory, rig):
    path = tmp_path_factory.mktemp("transforms") / "transforms.json"
    write_transforms(rig, path)
    assert_same(load_rig(path), rig)


def test_our_own_file_keeps_gains_and_units(tmp_path):
    rig = ring(3)
    rig = Rig((replace(rig.cameras[0], gains=(1.1, 0.9, 1.0)), *rig.cameras[1:]), "", metric=True)
    rig.save(tmp_path / "rig.json")
    loaded = load_rig(tmp_path)
    assert loaded.metric
    assert loaded["cam00"].gains == (1.1, 0.9, 1.0)


COLMAP_MODELS = """1 SIMPLE_PINHOLE 640 480 500 321 239
2 PINHOLE 640 480 500 510 321 239
3 SIMPLE_RADIAL 640 480 500 321 239 -0.1
4 RADIAL 640 480 500 321 239 -0.1 0.02
5 OPENCV 640 480 500 510 321 239 -0.1 0.02 0.001 -0.002
6 FULL_OPENCV 640 480 500 510 321 239 -0.1 0.02 0.001 -0.002 0.01 0.02 0.003 0.004
"""

REFEREE = """
import json, sys, numpy as np, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
model.write_binary(sys.argv[2])
points = np.array(json.loads(sys.argv[3]))
pixels = {}
for image in model.images.values():
    local = (image.cam_from_world() * points)
    pixels[image.name.rsplit(".", 1)[0]] = model.camera(image.camera_id).img_from_cam(local).tolist()
print(json.dumps(pixels))
"""


def test_colmap_projects_to_the_same_pixels_and_its_binary_files_read_the_same(tmp_path):
    (tmp_path / "text").mkdir()
    (tmp_path / "binary").mkdir()
    (tmp_path / "text/cameras.txt").write_text("# lenses\n" + COLMAP_MODELS)
    pose = "0.5 -0.1 0.7 -0.5 0.3 -0.2 2.5"  # a unit quaternion: its squares add up to 1
    images = "".join(f"{i} {pose} {i} lens{i}.jpg\n\n" for i in range(1, 7))
    (tmp_path / "text/images.txt").write_text(images)
    (tmp_path / "text/points3D.txt").write_text("")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    # pycolmap may not load before OpenCV in one process, so COLMAP answers from its own.
    command = [sys.executable, "-c", REFEREE, tmp_path / "text", tmp_path / "binary", json.dumps(points.tolist())]
    answer = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    rig = load_rig(tmp_path / "text")
    for camera in rig.cameras:
        assert np.abs(camera.project(points)[0] - answer[camera.name]).max() < 1e-9  # both compute in float64
    assert_same(load_rig(tmp_path / "binary"), rig)


def test_transforms_have_opengl_axes(tmp_path):
    """A camera at (0, 0, 5) with no rotation looks along -z, with +y up, in OpenGL."""
    pose = np.eye(4)
    pose[2, 3] = 5
    frames = [{"file_path": "./images/a", "transform_matrix": pose.tolist()}]
    shared = {"w": 200, "h": 100, "camera_angle_x": 2 * math.atan(1), "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(shared))
    camera = load_rig(tmp_path).cameras[0]
    pixels, depth = camera.project(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    assert np.allclose(depth, 5)
    assert np.allclose(pixels, [[100, 50], [120, 50], [100, 30]])  # focal length 100; right is right, up is up


def test_frames_override_shared_intrinsics(tmp_path):
    frame = {"file_path": "b.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 70, "fl_y": 71, "k1": 0.1}
    shared = {"w": 200, "h": 100, "fl_x": 50, "cx": 99, "cy": 51, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(shared))
    camera = load_rig(tmp_path).cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (70, 71, 99, 51)
    assert camera.distortion == (0.1, 0, 0, 0)


@pytest.mark.parametrize("as_matrix", [True, False])
def test_caliscope_projects_as_opencv_does_half_a_pixel_on(tmp_path, as_matrix):
    turn, shift = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 2.0])
    matrix, lens = np.array([[900.0, 0, 618], [0, 905, 394], [0, 0, 1]]), [-0.3, 0.05, -0.004, 0.004, 0.02]
    rotation = cv2.Rodrigues(turn)[0].tolist() if as_matrix else turn.tolist()
    (tmp_path / "camera_array.toml").write_text(
        f"[cameras.3]\ncam_id = 3\nsize = [1280, 720]\nmatrix = {matrix.tolist()}\ndistortions = {lens}\n"
        f"rotation = {rotation}\ntranslation = {shift.tolist()}\n[cameras.4]\ncam_id = 4\nsize = [1280, 720]\n"
    )
    rig = load_rig(tmp_path)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    theirs = cv2.projectPoints(points, turn, shift, matrix, np.array(lens))[0][:, 0]
    assert rig.names == ("cam_3",)  # camera 4 has no pose
    assert rig.metric
    assert np.allclose(rig.cameras[0].project(points)[0], theirs + 0.5, atol=1e-9)
    for video in ("port_3", "cam3", "3"):
        assert load_rig(tmp_path, [video]).names == (video,)


def write_images(folder: Path, names: dict[str, np.ndarray]) -> None:
    """A COLMAP text model with one lens and the given poses."""
    write_colmap(Rig((ring(1).cameras[0],), ""), folder)
    rotations = {name: _quaternion(pose) for name, pose in names.items()}
    lines = [
        f"{i} {rotations[n]} {' '.join(map(str, p[:3, 3]))} 1 {n}\n\n" for i, (n, p) in enumerate(names.items(), 1)
    ]
    (folder / "images.txt").write_text("".join(lines))


def _quaternion(pose: np.ndarray) -> str:
    turn = cv2.Rodrigues(pose[:3, :3])[0].ravel()
    angle = np.linalg.norm(turn)
    return " ".join(map(str, (math.cos(angle / 2), *(math.sin(angle / 2) * turn / max(angle, 1e-12)))))


A, B, C = (look_at((x, -1.0, -3.0), (0, 0, 0)) for x in (-1, 0, 1))


def test_pictures_are_named_after_cameras_or_lie_in_folders_named_after_them(tmp_path):
    write_images(tmp_path, {"cam1/0.jpg": A, "cam1/1.jpg": A, "cam2/0.jpg": B, "cam2/1.jpg": B})
    assert load_rig(tmp_path).names == ("cam1", "cam2")
    assert load_rig(tmp_path, ["cam2"]).names == ("cam2",)
    write_images(tmp_path, {"t0/left.jpg": A, "t1/left.jpg": A, "t0/right.jpg": B})
    assert load_rig(tmp_path).names == ("left", "right")


def test_pictures_of_one_camera_must_agree(tmp_path):
    write_images(tmp_path, {"t0/left.jpg": A, "t1/left.jpg": B, "t0/right.jpg": C})
    with pytest.raises(ValueError, match="must share one pose and lens"):
        load_rig(tmp_path)
    with pytest.raises(ValueError, match="2 pictures of camera 'left' must share one pose and lens, but differ"):
        load_rig(tmp_path, ["left", "right"])


def test_videos_without_a_camera_are_named_and_so_are_the_cameras(tmp_path):
    write_colmap(ring(12), tmp_path)
    both = r"videos without one: door; the file's cameras: cam00, .*, cam07 and 4 more$"
    with pytest.raises(ValueError, match=both):
        load_rig(tmp_path, ["cam00", "door"])


def test_a_frame_may_name_a_video(tmp_path):
    frames = [{"file_path": f"videos/{name}.mp4", "transform_matrix": np.eye(4).tolist()} for name in ("left", "right")]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 64, "h": 48, "fl_x": 60, "frames": frames}))
    assert [camera.name for camera in load_rig(tmp_path, ["right", "left"]).cameras] == ["right", "left"]


def test_a_folder_is_searched_as_documented(tmp_path):
    with pytest.raises(FileNotFoundError, match="no calibration at"):
        load_rig(tmp_path / "absent")
    (tmp_path / "notes.md").write_text("")
    with pytest.raises(ValueError, match=r"holds no calibration that we read .*notes\.md"):
        load_rig(tmp_path)
    write_transforms(ring(2), tmp_path / "transforms.json")
    assert len(load_rig(tmp_path).cameras) == 2
    write_colmap(ring(3), tmp_path / "sparse/0")
    assert len(load_rig(tmp_path).cameras) == 3
    ring(4).save(tmp_path / "rig.json")
    assert len(load_rig(tmp_path).cameras) == 4


def test_colmap_without_blank_lines_is_refused_instead_of_losing_every_second_camera(tmp_path):
    write_colmap(ring(4), tmp_path)
    path = tmp_path / "images.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if line))
    with pytest.raises(ValueError, match="two lines for each image"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR is not supported"),
        ({"k4": 0.1}, "OPENCV with k4 is not supported"),
        ({"k1": "a"}, r"transforms\.json: images/cam01\.png: k1 must be a number, but is 'a'"),
        ({"w": 10**400}, "w must be a finite number that float64 holds"),
        ({"fl_x": float("nan")}, "fl_x must be a finite number"),
        ({"h": 360.5}, "h must be a whole number, but is 360.5"),
        ({"fl_x": None, "w": 5}, "float"),
        ({"fl_x": 0}, "fl_x must be above 0"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "must hold a rotation"),
        ({"transform_matrix": [[1]]}, r"must be \[4, 4\] or \[3, 4\], not \(1, 1\)"),
    ],
)
def test_unusable_transforms_are_refused(tmp_path, frame, message):
    path = tmp_path / "transforms.json"
    write_transforms(ring(2), path)
    data = json.loads(path.read_text())
    data["frames"][1].update(frame)
    if frame.get("fl_x", 0) is None:
        del data["frames"][1]["fl_x"]
        message = "must give w, h and fl_x"
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message):
        load_rig(path)


def test_unsupported_lenses_say_what_to_do(tmp_path):
    write_colmap(ring(1), tmp_path)
    (tmp_path / "cameras.txt").write_text("1 FOV 640 360 500 500 320 180 0.1\n")
    with pytest.raises(ValueError, match="undistort the pictures"):
        load_rig(tmp_path)
    with pytest.raises(ValueError, match="no rational lens model"):
        write_transforms(arc(2, lens=(0.1,) * 8), tmp_path / "transforms.json")


def binary_model(folder: Path) -> None:
    lens = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, 500, 500, 320, 240)
    (folder / "cameras.bin").write_bytes(lens)
    image = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 2, 1) + b"a.png\0" + struct.pack("<Qddq", 1, 3, 4, -1)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 1) + image)


@given(st.data())
def test_a_cut_binary_model_is_reported_never_half_read(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("binary")
    binary_model(folder)
    assert load_rig(folder).names == ("a",)
    name = data.draw(st.sampled_from(["cameras.bin", "images.bin"]))
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(ValueError, match=rf"{name[:-4]}\.bin"):
        load_rig(folder)


@given(st.text("0123456789.- abPINHOLE#\n", max_size=80))
def test_any_text_is_a_model_or_a_clear_error(tmp_path_factory, text):
    folder = tmp_path_factory.mktemp("text")
    write_colmap(ring(2), folder)
    (folder / "cameras.txt").write_text(text)
    with pytest.raises(ValueError, match=r"cameras\.txt"):
        load_rig(folder)


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("images.txt", "1 0 0 0 0 0 0 1 1 a.png", r"images\.txt: image 'a.png': a rotation's quaternion must have the"),
        ("images.txt", "1 nan 0 0 0 0 0 1 1 a.png", r"images\.txt: line 1: a pose's number must be a finite number"),
        ("images.txt", "1 1e999 0 0 0 0 0 1 1 a.png", r"images\.txt: line 1: a pose's number must be a finite number"),
        ("images.txt", "1 1e300 1e300 0 0 0 0 1 1 a.png", r"images\.txt: image 'a.png': .* length 1, but is"),
        ("images.txt", "1 1 0 0 0 0 0 1 7 a.png", r"images\.txt: images must have cameras of cameras.txt, .* not 7"),
        ("images.txt", "1 1 0 0 0 0 x 1 1 a.png", r"images\.txt: line 1: a pose's number must be a number, but is 'x'"),
        ("images.txt", "# no images", r"images\.txt: it lists no images"),
        ("images.txt", "1 1 0 0 0", r"images\.txt: line 1 must give IMAGE_ID, QW"),
        ("cameras.txt", "1 PINHOLE 640 360 500 500 320 1e400", r"cameras\.txt: line 1: a parameter must be a finite"),
        (
            "cameras.txt",
            "1 PINHOLE 64O 360 500 500 320 180",
            r"cameras\.txt: line 1: the width must be a number, but is",
        ),
        (
            "cameras.txt",
            f"1 PINHOLE {'9' * 400} 360 500 500 320 180",
            r"cameras\.txt: line 1: the width must be a finite",
        ),
        ("cameras.txt", "1 PINHOLE", r"cameras\.txt: line 1 must give CAMERA_ID, MODEL"),
    ],
)
def test_a_fault_is_said_of_its_file(tmp_path, file, line, message):
    write_colmap(ring(1), tmp_path)
    (tmp_path / file).write_text(line + "\n")
    with pytest.raises(ValueError, match=message) as raised:
        load_rig(tmp_path)
    assert ("cameras.txt: " in str(raised.value)) is (file == "cameras.txt")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_text_may_be_unicode_of_any_kind(tmp_path, encoding):
    (tmp_path / "model").mkdir()
    write_colmap(ring(2), tmp_path / "model")
    write_transforms(ring(2), tmp_path / "transforms.json")
    ring(2).save(tmp_path / "rig.json")
    write_easymocap(tmp_path, ring(2))
    names = ("model/cameras.txt", "model/images.txt", "transforms.json", "rig.json", "intri.yml", "extri.yml")
    for path in (tmp_path / name for name in names):
        path.write_text(path.read_text().replace("\n", "\r\n"), encoding=encoding, newline="")
        if not path.name.startswith(("cameras", "intri")):
            assert load_rig(path).names == ("cam00", "cam01")


def test_what_is_no_text_says_so(tmp_path):
    (tmp_path / "transforms.json").write_bytes(b'{"frames": "\xe9"}')
    with pytest.raises(ValueError, match=r"json must be text in UTF-8 or UTF-16, but byte 12 fits neither"):
        load_rig(tmp_path)
    (tmp_path / "transforms.json").write_text('{"frames": [\n}')
    with pytest.raises(ValueError, match=r"transforms\.json is no JSON: .*, line 2"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("picture", "video"),
    [
        ("caf\u00e9.png", "cafe\u0301"),  # composed, and taken apart as macOS does
        ("cafe\u0301.png", "caf\u00e9"),
        ("CAM1.PNG", "cam1"),
        ("cam1.mp4.jpg", "cam1"),
        ("cam1_000001.jpg", "cam1"),
        ("cam1-17.jpg", "cam1"),
        ("cam1/frame_000017.jpg", "cam1"),
        ("images\\cam1\\0.jpg", "cam1"),
    ],
)
def test_names_that_mean_one_camera(tmp_path, picture, video):
    other = picture.replace("cam1", "cam2").replace("CAM1", "CAM2").replace("caf", "caff")
    write_images(tmp_path, {picture: A, other: B})
    second = video.replace("cam1", "cam2").replace("caf", "caff")
    rig = load_rig(tmp_path, [second, video])
    assert rig.names == (second, video)
    assert np.allclose(rig[video].camera_from_world, A, atol=1e-9)


def test_cameras_that_differ_in_case_alone_are_told_apart(tmp_path):
    write_images(tmp_path, {"cam.png": A, "CAM.png": B})
    assert load_rig(tmp_path, ["CAM", "cam"]).names == ("CAM", "cam")
    with pytest.raises(ValueError, match="2 pictures of camera 'Cam' must share one pose and lens"):
        load_rig(tmp_path, ["Cam"])


def test_other_files_are_named(tmp_path):
    write_colmap(ring(2), tmp_path / "sparse/0")
    write_transforms(ring(2), tmp_path / "transforms.json")
    for name in ("README.md", ".DS_Store", "sparse/0/points3D.bin", "sparse/1/cameras.bin", "old.npy"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    found = find_calibration(tmp_path)
    assert found.file == tmp_path / "sparse/0/cameras.txt"
    strays = [str(path.relative_to(tmp_path)) for path in found.strays(tmp_path)]
    assert strays == ["old.npy", "sparse/1/cameras.bin", "transforms.json"]


@pytest.mark.parametrize("name", ["cameras.json", "dataset.JSON"])
def test_a_file_of_another_name_is_known_by_what_it_says(tmp_path, name):
    write_transforms(ring(2), tmp_path / name)
    assert load_rig(tmp_path).names == ("cam00", "cam01")
    ring(3).save(tmp_path / name)
    assert load_rig(tmp_path / name).names == ("cam00", "cam01", "cam02")


# LLFF and N3DV


@st.composite
def llff_rigs(draw):
    """What the format can hold: one focal length, a centred principal point, names in order, no lens."""
    rig = draw(rigs(coefficients=(0,)))
    plain = [replace(c, fy=c.fx, cx=c.width / 2, cy=c.height / 2) for c in rig.cameras]
    return Rig(tuple(sorted(plain, key=lambda camera: natural_key(camera.name))), "drawn")


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(llff_rigs())
def test_poses_bounds_round_trip(tmp_path_factory, rig):
    path = tmp_path_factory.mktemp("llff") / "poses_bounds.npy"
    bounds = np.tile([0.5, 20.0], (len(rig.cameras), 1))
    write_poses_bounds(rig, path, bounds)
    rows = np.load(path)
    assert rows.shape == (len(rig.cameras), 17)
    assert rows.dtype == np.float64
    assert np.array_equal(rows[:, 15:], bounds)
    assert_same(load_rig(path, rig.names), rig)
    assert_same(load_rig(path.parent, rig.names), rig)


def test_poses_bounds_axes_are_down_right_back(tmp_path):
    camera = Camera("a", 640, 360, 500.0, 500.0, 320.0, 180.0, np.eye(4))
    write_poses_bounds(Rig((camera,), ""), tmp_path / "poses_bounds.npy", np.array([[1.0, 2.0]]))
    pose = np.load(tmp_path / "poses_bounds.npy")[0, :15].reshape(3, 5)
    assert np.array_equal(pose, [[0, 1, 0, 0, 360], [1, 0, 0, 0, 640], [0, 0, -1, 0, 500]])


def test_rows_of_poses_bounds_go_by_order_or_by_number(tmp_path):
    rig = Rig(tuple(replace(c, name=f"cam{k:02d}") for k, c in enumerate(square(4).cameras)), "")
    write_poses_bounds(rig, tmp_path / "poses_bounds.npy", np.ones((4, 2)))
    names = ["cam20", "cam03", "cam11", "cam08"]  # as many as rows: in order of their names, as N3DV has it
    loaded = load_rig(tmp_path, names)
    for number, name in enumerate(sorted(names)):
        assert np.allclose(loaded[name].camera_from_world, rig.cameras[number].camera_from_world, atol=POSE_TOLERANCE)
    fewer = load_rig(tmp_path, ["cam03", "cam01"])
    assert np.allclose(fewer["cam03"].camera_from_world, rig["cam03"].camera_from_world, atol=POSE_TOLERANCE)
    with pytest.raises(ValueError, match="4 rows, which belong to the videos in the order of their names"):
        load_rig(tmp_path, ["cam03", "cam07"])


def square(count: int) -> Rig:
    """A ring that poses_bounds.npy can hold."""
    plain = [replace(c, fy=c.fx, cx=c.width / 2, cy=c.height / 2, distortion=()) for c in ring(count).cameras]
    return Rig(tuple(plain), "")


def test_poses_bounds_refuses_what_it_cannot_hold(tmp_path):
    path, bounds = tmp_path / "poses_bounds.npy", np.ones((3, 2))
    for change in ({"fy": 400.0}, {"cx": 300.0}, {"distortion": (0.1, 0.0, 0.0, 0.0)}):
        rig = square(3)
        with pytest.raises(ValueError, match="write COLMAP or transforms"):
            write_poses_bounds(Rig((*rig.cameras[:2], replace(rig.cameras[2], **change)), ""), path, bounds)
    with pytest.raises(ValueError, match="sort the rig"):
        write_poses_bounds(Rig(square(3).cameras[::-1], ""), path, bounds)
    assert not path.exists()
    np.save(path, np.ones((3, 15)))
    with pytest.raises(ValueError, match=r"row of 17 finite numbers for each camera, but is \(3, 15\)"):
        load_rig(path)


# EasyMocap


def write_easymocap(folder: Path, rig: Rig, *, sizes: bool = True, matrices: bool = True) -> None:
    intri = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extri = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    intri.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    for name in rig.names:
        intri.write("", name)
    intri.endWriteStruct()
    for camera in rig.cameras:
        matrix = camera.matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        intri.write(f"K_{camera.name}", matrix)
        intri.write(f"dist_{camera.name}", np.array([(*camera.distortion, *(0.0,) * 5)[:5]]))
        if sizes:
            intri.write(f"H_{camera.name}", camera.height)
            intri.write(f"W_{camera.name}", float(camera.width))
        rotation = np.ascontiguousarray(camera.camera_from_world[:3, :3])
        extri.write(f"R_{camera.name}", cv2.Rodrigues(rotation)[0])
        if matrices:
            extri.write(f"Rot_{camera.name}", rotation)
        extri.write(f"T_{camera.name}", np.ascontiguousarray(camera.camera_from_world[:3, 3:]))
    intri.release()
    extri.release()


@pytest.mark.parametrize("matrices", [True, False])
def test_easymocap_calibrations_are_read(tmp_path, matrices):
    rig = arc(3, lens=(0.1, -0.05, 0.001, 0.002, 0.03))
    write_easymocap(tmp_path, rig, matrices=matrices)
    for source in (tmp_path, tmp_path / "intri.yml", tmp_path / "extri.yml"):
        loaded = load_rig(source, rig.names)
        for a, b in zip(loaded.cameras, rig.cameras, strict=True):
            assert (a.width, a.height, a.distortion) == (b.width, b.height, b.distortion)
            assert np.allclose(a.matrix, b.matrix, rtol=0, atol=POSE_TOLERANCE)
            assert np.allclose(a.camera_from_world, b.camera_from_world, rtol=0, atol=POSE_TOLERANCE)


def test_unusable_easymocap_files_say_what_is_missing(tmp_path):
    write_easymocap(tmp_path, ring(2), sizes=False)
    with pytest.raises(ValueError, match=r"must give camera 'cam00' its picture size, as H_cam00: 1080"):
        load_rig(tmp_path)
    write_easymocap(tmp_path, ring(2))
    (tmp_path / "intri.yml").write_text((tmp_path / "intri.yml").read_text().replace("K_cam01", "K_cam09"))
    with pytest.raises(ValueError, match="K_cam01 must be a matrix of 3 x 3 numbers"):
        load_rig(tmp_path)
    (tmp_path / "intri.yml").write_text("names: [a]\n  - {")
    with pytest.raises(ValueError, match=r"intri\.yml"):
        load_rig(tmp_path)
    write_easymocap(tmp_path, ring(2))
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(FileNotFoundError, match="side by side"):
        load_rig(tmp_path)


# Real calibrations


def test_fox_photographs_are_chosen_by_name(data):
    fox = need_data(data / "fox")
    names = sorted(path.stem for path in (fox / "images").iterdir())
    rig = load_rig(fox / "transforms.json", names)
    assert rig.names == tuple(names)
    assert len(rig.cameras) == 50
    assert rig.cameras[0].distortion == (0.0578421, -0.0805099, -0.000980296, 0.00015575)


def test_webcams_of_both_caliscope_layouts(data):
    webcams = need_data(data / "webcams")
    new, old = (load_rig(webcams / name) for name in ("camera_array.toml", "config.toml"))
    assert new.names == old.names == ("cam_0", "cam_1", "cam_2", "cam_3")
    assert all(
        np.allclose(a.camera_from_world, b.camera_from_world) for a, b in zip(new.cameras, old.cameras, strict=True)
    )


@pytest.mark.parametrize("deep", ["names: " + "[" * 1000 + "]" * 1000, "- " * 1000 + "1", "? " * 1_000_000])
def test_yaml_that_is_nested_too_deep_is_refused(tmp_path, deep):
    for name in ("intri.yml", "extri.yml"):
        (tmp_path / name).write_text(f"%YAML:1.0\n---\n{deep}\n")
    with pytest.raises(ValueError, match="nested too deep"):
        load_rig(tmp_path, ("cam1", "cam2"))


@pytest.mark.parametrize(
    ("was", "now"),
    [
        ("rows: 3", "rows: 999999999"),
        ("rows: 3", "rows: -3"),
        ("rows: 3", "rows: three"),
        ("cols: 3", ""),
        ("data: [", "data: [ 1., "),
        ("data: [", "data: [ x, "),
        ("data: [", "data: [ [1.], "),
        ("data: [", "dote: ["),
    ],
)
def test_a_damaged_matrix_of_opencv_is_refused(tmp_path, was, now):
    """OpenCV's own parser ends the program at some of them."""
    write_easymocap(tmp_path, ring(2))
    text = (tmp_path / "intri.yml").read_text()
    assert was in text
    (tmp_path / "intri.yml").write_text(text.replace(was, now, 1))
    with pytest.raises(ValueError, match=r"K_cam\d+ must "):
        load_rig(tmp_path, ("cam1", "cam2"))


def test_lenses_without_poses_are_known_lenses(tmp_path):
    matrix = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [{}]\n"
    text = '%YAML:1.0\n---\nnames:\n   - "a"\n   - "b"\n'
    for name, focal in (("a", 500), ("b", 600)):
        text += f"K_{name}: " + matrix.format(3, 3, f"{focal}, 0, 319.5, 0, {focal}, 179.5, 0, 0, 1")
        text += f"dist_{name}: " + matrix.format(5, 1, "-0.1, 0.02, 0, 0, 0")
    (tmp_path / "intri.yml").write_text(text)
    sizes = {"a": (640, 360), "b": (640, 360)}
    assert holds_lenses_alone(tmp_path)
    lenses = load_lenses(tmp_path, ("b", "a"), sizes)
    assert lenses.names == ("b", "a")
    assert [(c.fx, c.cx, c.cy) for c in lenses.cameras] == [(600, 320, 180), (500, 320, 180)]
    assert lenses["a"].distortion[:2] == (-0.1, 0.02)
    with pytest.raises(ValueError, match="c"):
        load_lenses(tmp_path, ("a", "c"), {**sizes, "c": (640, 360)})
    (tmp_path / "extri.yml").write_text("%YAML:1.0\n---\n")
    assert not holds_lenses_alone(tmp_path)
