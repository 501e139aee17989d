"""Films: a camera path goes through its views, turns evenly, and its film shows what the rasterizer draws."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.film import SOUND_RATE, CameraPath, PathView, film, fitted, sound_along
from packuv.metrics import psnr
from packuv.progress import no_progress
from packuv.scene import open_scene
from packuv.score import Artist
from tests.packuv.test_score import CAMERA, LIGHT, write_wall


def rotation(vector):
    angle = np.linalg.norm(vector)
    x, y, z = vector / (angle or 1)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def view(seconds, frame=0, vector=(0, 0, 0), eye=(0, 0, 0), **optics):
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.array(vector, float))
    pose[:3, 3] = -pose[:3, :3] @ np.array(eye, float)
    return PathView(seconds, frame, replace(CAMERA, camera_from_world=pose, **optics))


small = st.floats(-2, 2)
vectors = st.tuples(small, small, small)


@given(st.lists(st.tuples(vectors, vectors, st.floats(0.1, 3), st.integers(0, 9)), min_size=1, max_size=5))
def test_a_path_goes_through_its_views_with_rotations_between(told):
    times = np.cumsum([0, *[step for _, _, step, _ in told[1:]]]).tolist()
    views = tuple(view(at, frame, turn, eye) for at, (turn, eye, _, frame) in zip(times, told, strict=True))
    path = CameraPath(views)
    for one in views:
        frame, camera = path.at(one.seconds)
        assert frame == one.frame
        assert np.allclose(camera.camera_from_world, one.camera.camera_from_world, atol=1e-6)
    for moment in np.linspace(-1, path.seconds + 1, 23):
        frame, camera = path.at(moment)
        turn = camera.camera_from_world[:3, :3]
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        assert min(v.frame for v in views) <= frame <= max(v.frame for v in views)


@given(vectors, st.floats(0, 1))
@example((1e-5, 0.0, 0.0), 1.0)
@example((0.0, -9e-6, 3e-6), 0.5)
def test_the_camera_turns_evenly_about_one_axis(vector, share):
    path = CameraPath((view(0), view(4, vector=vector)))
    turn = path.at(4 * share)[1].camera_from_world[:3, :3]
    angle = np.linalg.norm(vector)
    if angle < 3.1:  # beyond a half turn the other way round is shorter
        assert np.allclose(turn, rotation(share * np.array(vector)), atol=1e-9)


def test_a_half_turn_takes_some_axis():
    path = CameraPath((view(0), view(1, vector=(0, np.pi, 0))))
    assert np.allclose(path.at(0.5)[1].camera_from_world[2, :3] @ [0, 0, 1], 0, atol=1e-6)


def test_equal_steps_on_a_line_are_an_even_ride():
    path = CameraPath(tuple(view(float(k), 3 * k, eye=(k, 2 * k, 0)) for k in range(4)))
    for moment in np.linspace(0, 3, 31):
        assert np.allclose(path.at(moment)[1].centre, [moment, 2 * moment, 0], atol=1e-9)
        assert path.at(moment)[0] == round(3 * moment)


@pytest.mark.parametrize("size", [(96, 64), (200, 64), (96, 200)])
def test_the_whole_picture_lies_amid_a_larger_one(size):
    camera = fitted(CAMERA, *size)
    corners = np.array([[0, 0], [CAMERA.width, CAMERA.height]])
    rays = np.c_[(corners - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], [1, 1]]
    pixels, _ = camera.project(rays)
    assert np.allclose(pixels.mean(axis=0), np.array(size) / 2)
    assert np.isclose(np.min((np.array(size) - (pixels[1] - pixels[0])).round(9)), 0)


def test_a_film_shows_the_scene_from_the_path_in_its_light(tmp_path):
    scene_path = write_wall(tmp_path / "lit.mkv", LIGHT)
    path = CameraPath((view(0, 0), view(0.4, 2, vector=(0, 0.2, 0))))
    with open_scene(scene_path) as scene:
        assert film(scene, path, tmp_path / "a.mp4", no_progress, rate=Fraction(10)) == 5
        film(scene, path, tmp_path / "b.mp4", no_progress, rate=Fraction(10))
        drawn = Artist(scene).draw(scene.gaussians(2), path.at(0.4)[1])
        wanted = np.clip(lit_by_hand(drawn, LIGHT[2]), 0, 1)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.average_rate, stream.width, stream.height) == (10, CAMERA.width, CAMERA.height)
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(pictures) == 5
    shown = pictures[-1].transpose(2, 0, 1).astype(np.float32) / 255
    assert psnr(shown, wanted.astype(np.float32)) > 30  # H.264 with chroma at half size
    with open_scene(scene_path) as scene:
        late = CameraPath((view(0, 3),))
        with pytest.raises(ValueError, match="the scene has frames 0 to 2, but the path shows 3"):
            film(scene, late, tmp_path / "c.mp4", no_progress)
        with pytest.raises(ValueError, match="even width and height"):
            film(scene, path, tmp_path / "c.mp4", no_progress, size=(33, 20))
    assert not (tmp_path / "c.mp4").exists()


def test_sound_is_heard_where_frames_pass_as_they_were_filmed(tmp_path):
    """Still for a second, at the pace of the scene for two, racing, back again: of 40 frames at 10 a second."""
    rng = np.random.default_rng(0)
    sound = rng.uniform(-0.5, 0.5, (2, 4 * SOUND_RATE)).astype(np.float32)
    path = CameraPath((view(0, 5), view(1, 5), view(3, 25), view(3.5, 38), view(4, 20)))
    heard = sound_along(path, sound, np.arange(40) / 10, Fraction(4))
    assert heard.shape == (2, 4 * SOUND_RATE)
    assert np.array_equal(heard[:, SOUND_RATE : 3 * SOUND_RATE], sound[:, : 2 * SOUND_RATE])
    assert not heard[:, :SOUND_RATE].any()
    assert not heard[:, 3 * SOUND_RATE :].any()


def test_a_film_has_the_sound_that_goes_along(tmp_path):
    times = np.arange(3 * SOUND_RATE) / SOUND_RATE
    sound = np.stack([np.sin(2 * np.pi * tone * times) for tone in (440, 660)]).astype(np.float32) / 2
    path = CameraPath((view(0, 0), view(0.2, 2)))
    with open_scene(write_wall(tmp_path / "a.mkv", LIGHT)) as scene:
        path = CameraPath((view(0, 0), view(float(scene.header.times_ns[2]) / 1e9, 2)))
        count = film(scene, path, tmp_path / "a.mp4", no_progress, rate=Fraction(30), sound=sound)
        film(scene, path, tmp_path / "b.mp4", no_progress, rate=Fraction(30), sound=sound)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    with av.open(str(tmp_path / "a.mp4")) as container:
        voice = np.concatenate([frame.to_ndarray() for frame in container.decode(audio=0)], axis=1)
    assert abs(voice.shape[1] - count / 30 * SOUND_RATE) <= 2048  # whole frames of AAC
    for side, tone in enumerate((440, 660)):
        part = voice[side, : SOUND_RATE // 20]
        spectrum = np.abs(np.fft.rfft(part * np.hanning(len(part))))
        assert abs(spectrum.argmax() * SOUND_RATE / len(part) - tone) <= 20


def lit_by_hand(drawn, light):
    """A factor on linear light is its power of 1 / 2.4 on sRGB + 0.055."""
    return (drawn + 0.055) * np.exp(light / 2.4)[:, None, None] - 0.055


CAMERA_JSON = {**CAMERA.to_json(), "camera_from_world": np.eye(4).tolist()}
DOUBLE = {**CAMERA_JSON, "camera_from_world": np.diag([2.0, 2, 2, 1]).tolist()}
GOOD = {"format": "packuv-path", "version": 1, "views": [{"seconds": 0, "frame": 1, "camera": CAMERA_JSON}]}


def test_a_path_is_read_from_its_file(tmp_path):
    (tmp_path / "path.json").write_text(json.dumps(GOOD))
    (one,) = CameraPath.load(tmp_path / "path.json").views
    assert (one.seconds, one.frame, one.camera.width) == (0, 1, CAMERA.width)
    assert isinstance(one.camera, PinholeCamera)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "x"}, "says format"),
        ({"views": []}, "needs a view"),
        ({"views": 3}, "must be a list"),
        ({"views": [{**GOOD["views"][0], "seconds": 1}]}, "must begin at 0 and rise"),
        ({"views": GOOD["views"] * 2}, "must begin at 0 and rise"),
        ({"views": [{**GOOD["views"][0], "seconds": -1}]}, "seconds must be from 0"),
        ({"views": [{"seconds": 0, "frame": 0}]}, "needs the field 'camera'"),
        ({"views": [{**GOOD["views"][0], "frame": 0.5}]}, "frame"),
        ({"views": [{"seconds": 0, "frame": 0, "camera": DOUBLE}]}, "must begin with a rotation"),
    ],
)
def test_what_is_no_path_is_said_with_its_name(change, message, tmp_path):
    (tmp_path / "path.json").write_text(json.dumps({**GOOD, **change}))
    with pytest.raises(ValueError, match=f"path.json is no camera path: .*{message}"):
        CameraPath.load(tmp_path / "path.json")
