"""Light of the instant in the header of a scene."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from packuv import bounds
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes, Quantizer
from packuv.gaussians.segment import Segment
from packuv.scene import SceneHeader, open_scene, verify_scene, write_scene
from tests.support.hostile import SceneMaker, make_scene


def make_header(frames: int, light: np.ndarray | None = None) -> SceneHeader:
    low, high = np.full(10, -1.5), np.full(10, 2.0)
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    quantizer = Quantizer(np.zeros(3), 1.0, np.full(3, 5.0), low, high)
    header = SceneHeader(quantizer, np.arange(frames, dtype=np.int64) * 40_000_000, Fraction(25))
    return header if light is None else replace(header, light=light)


def write(path, header):
    frames = len(header.times_ns)
    rng = np.random.default_rng(1)
    key = Codes(rng.integers(0, 65536, (20, 3), np.uint16), rng.integers(1, 256, (20, 10), np.uint8))
    still = np.empty((frames - 1, 0, 3), np.uint16), np.empty((frames - 1, 0, 10), np.uint8)
    Segment(0, key, np.zeros(20, bool), *still).save(path.with_suffix(".npz"))
    write_scene(path, [path.with_suffix(".npz")], header)
    return path


lights = st.integers(1, 9).flatmap(lambda frames: arrays(np.float64, (frames, 3), elements=st.floats(-10, 10)))


@given(lights)
def test_light_comes_back_to_the_bit_and_within_half_a_step_of_what_was_given(light):
    header = make_header(len(light), light)
    assert np.abs(header.light - light).max() <= 0.5e-5 + 1e-12
    back = SceneHeader.from_json(json.loads(json.dumps(header.to_json())))
    assert np.array_equal(back.light, header.light)
    assert np.array_equal(replace(header, light=header.light).light, header.light)
    assert np.array_equal(header.first(1).light, header.light[:1])


def test_a_scene_tells_the_light_of_each_frame(tmp_path):
    light = np.array([[0, 0, 0], [0.125, -0.25, 1e-5], [-3, 0, 0.5]])
    path = write(tmp_path / "a.mkv", make_header(3, light))
    assert verify_scene(path).ok
    with open_scene(path) as scene:
        assert [scene.light(frame).tolist() for frame in range(3)] == light.tolist()
        scene.light(1)[:] = 9
        assert scene.light(1)[0] == 0.125
        for outside in (-1, 3):
            with pytest.raises(IndexError, match="of a scene with 3 frames"):
                scene.light(outside)


def test_a_scene_of_steady_light_does_not_mention_it(tmp_path):
    plain = write(tmp_path / "a.mkv", make_header(3))
    for number, steady in enumerate((np.zeros((3, 3)), np.full((3, 3), -4e-6))):
        assert write(tmp_path / f"{number}.mkv", make_header(3, steady)).read_bytes() == plain.read_bytes()
    assert b'"light"' not in plain.read_bytes()
    with open_scene(plain) as scene:
        assert scene.header.light.shape == (3, 3)
        assert not scene.light(2).any()


def test_light_is_checked_at_once():
    with pytest.raises(ValueError, match=r"light must be \(3, 3\), r g b of each frame, but is \(2, 3\)"):
        make_header(3, np.zeros((2, 3)))
    for absurd in (np.nan, np.inf, 10.1):
        with pytest.raises(ValueError, match="light must hold natural logarithms within 10 of 0"):
            make_header(3, np.full((3, 3), absurd))
    frames = bounds.MOST_LIT_FRAMES + 1
    with pytest.raises(ValueError, match="at most 216000 frames, not 216001"):
        make_header(frames, np.full((frames, 3), 0.1))
    assert not make_header(frames).light.any()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("light",), None, "light must be a list of at most 3 entries, but is None"),
        (("light",), [[0] * 6] * 2, "light must hold three lists, red, green and blue, but holds 2"),
        (("light", 1), [0] * 5, "light must hold 6 numbers, but holds 5"),
        (("light", 2, 4), 0.5, "light must hold whole numbers from -1000000 to 1000000, but has 0.5"),
        (("light", 2, 4), 1_000_001, "light must hold whole numbers from -1000000 to 1000000, but has 1000001"),
    ],
)
def test_light_that_makes_no_sense_is_refused_by_name(tmp_path, place, value, message):
    make_scene(tmp_path / "a.mkv")
    SceneMaker(tmp_path / "a.mkv").with_value(tmp_path / "b.mkv", place, value)
    with pytest.raises(ValueError, match=message):
        open_scene(tmp_path / "b.mkv")


def test_a_list_without_entries_is_steady_light(tmp_path):
    make_scene(tmp_path / "a.mkv")
    SceneMaker(tmp_path / "a.mkv").with_value(tmp_path / "b.mkv", ("light",), [])
    with open_scene(tmp_path / "b.mkv") as scene:
        assert np.array_equal(scene.header.light, np.zeros((6, 3)))
