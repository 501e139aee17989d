"""t_offsets.json: whose times it moves and by how much, and when it is passed over."""

from __future__ import annotations

import json
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sync.align import AlignOptions, align
from sync.capture import find_capture, load_timecodes, offsets_of, timing_notes
from sync.clock import ClockMode
from sync.offsets import T_OFFSETS, find_offsets, read_offsets
from sync.probe import ColourTags, VideoInfo

PERIOD_NS = 16_666_667
UNTAGGED = ColourTags("yuv420p", 8, None, None, None, None)
CAMERAS = ("00", "01", "02")


def info() -> VideoInfo:
    times = np.arange(40, dtype=np.int64) * PERIOD_NS
    return VideoInfo(64, 48, "h264", Fraction(60), 40, times, 40 * PERIOD_NS, 1000, UNTAGGED)


def capture_of(folder: Path, offsets: object, *, settings: str = "", inside: str = ".") -> Path:
    (folder / "videos").mkdir(parents=True)
    for name in CAMERAS:
        (folder / "videos" / f"{name}.mp4").write_bytes(b"content")
    (folder / inside).mkdir(exist_ok=True)
    (folder / inside / T_OFFSETS).write_text(json.dumps(offsets))
    (folder / "capture.toml").write_text(settings)
    return folder


@pytest.mark.parametrize("inside", [".", "calibration"])
def test_offsets_are_taken_off_the_times_to_the_nanosecond(tmp_path, inside):
    path = capture_of(tmp_path / "c", {"0000": 0, "0001": 0.0041, "0002": -0.002500001}, inside=inside)
    capture = find_capture(path)
    groups, _ = align(load_timecodes(capture, dict.fromkeys(CAMERAS, info())), AlignOptions(reference="00"))
    assert (groups.frames == groups.frames[:, :1]).all()
    assert set(groups.residuals_ns[:, 1].tolist()) == {-4_100_000}
    assert set(groups.residuals_ns[:, 2].tolist()) == {2_500_001}


def test_a_camera_that_is_late_by_frames_is_matched_by_them(tmp_path):
    """Frame n of camera 01 shows what frame n - 3 of the others does."""
    capture = find_capture(capture_of(tmp_path / "c", {"00": 0, "01": 0.05, "02": 0}))
    infos = dict.fromkeys(CAMERAS, info())
    groups, _ = align(load_timecodes(capture, infos), AlignOptions(reference="00"))
    there = groups.frames[:, 1] >= 0
    assert there.sum() == 37
    assert (groups.frames[there, 1] - groups.frames[there, 0] == 3).all()
    first, second = timing_notes(capture, infos, ClockMode.TRUSTED)
    assert "moves the times of 3 cameras by -50 to +0 ms: it is read as seconds" in first
    assert "by up to 3.0 frames: if it counts frames instead of seconds" in second


def test_what_capture_toml_says_comes_on_top(tmp_path):
    capture = find_capture(
        capture_of(tmp_path / "c", {"01": 0.004}, settings="time_offset_s = { 01 = 0.1, 02 = -0.2 }")
    )
    assert offsets_of(capture, ClockMode.TRUSTED) == {"01": Decimal("0.096"), "02": Decimal("-0.2")}
    found = load_timecodes(capture, dict.fromkeys(CAMERAS, info()))
    assert [int(found[name].times_ns[0]) for name in CAMERAS] == [0, 96_000_000, -200_000_000]
    assert found["01"].notes[-1].startswith("+0.1 s are added to its times, as time_offset_s")
    lacking = timing_notes(capture, dict.fromkeys(CAMERAS, info()), ClockMode.TRUSTED)[1]
    assert lacking == "t_offsets.json has no offset for 00, 02: taken for 0"


@given(said=st.decimals(-9, 9, places=11), late=st.decimals(-9, 9, places=11))
def test_times_move_by_what_the_recipe_says(tmp_path_factory, said, late):
    """To the nanosecond, also where the two parts have halves of one."""
    settings = f"time_offset_s = {{ 01 = {said:f} }}"
    path = capture_of(tmp_path_factory.mktemp("c") / "c", {"01": 0}, settings=settings)
    (path / T_OFFSETS).write_text(f'{{"01": {late:f}}}')
    capture = find_capture(path)
    codes = load_timecodes(capture, dict.fromkeys(CAMERAS, info()))["01"]
    assert codes.times_ns[0] == int(offsets_of(capture, ClockMode.TRUSTED)["01"] * 10**9)
    assert offsets_of(capture, ClockMode.TRUSTED)["01"] == said - late


@pytest.mark.parametrize("clock", [ClockMode.TRIGGERED, ClockMode.CONTENT])
def test_where_times_are_not_trusted_the_file_is_passed_over_and_that_said(tmp_path, clock):
    capture = find_capture(capture_of(tmp_path / "c", {"01": 0.004}))
    infos = dict.fromkeys(CAMERAS, info())
    assert offsets_of(capture, clock) == {}
    assert not load_timecodes(capture, infos, clock)["01"].times_ns[0]
    (note,) = timing_notes(capture, infos, clock)
    assert f"t_offsets.json is passed over for clock = '{clock}'" in note


def test_a_capture_without_the_file_is_as_it_was(tmp_path):
    capture = find_capture(capture_of(tmp_path / "c", {}, inside="elsewhere"))
    assert capture.offsets is None
    assert offsets_of(capture, ClockMode.TRUSTED) == {}
    assert timing_notes(capture, dict.fromkeys(CAMERAS, info()), ClockMode.TRUSTED) == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[0.1, 0.2]", "must give seconds by camera"),
        ("{}", "must give seconds by camera"),
        ("{", "is no JSON"),
        ("\udcff", "is no JSON"),
        ("[" * 100_000, "is no JSON"),
        ('{"01": "late"}', "offset of '01' must be a number of seconds, .* but is late"),
        ('{"01": NaN}', "offset of '01' must be a number of seconds"),
        ('{"01": 1e999999999}', "offset of '01' must be a number of seconds"),
        ('{"01": true}', "offset of '01' must be a number of seconds"),
        ('{"left": 0.1}', "names left, none of which is a camera of this capture"),
    ],
)
def test_files_that_cannot_be_are_named(tmp_path, text, message):
    path = tmp_path / T_OFFSETS
    path.write_text(text, errors="surrogateescape")
    with pytest.raises(ValueError, match=message):
        read_offsets(path, CAMERAS)


def test_two_files_are_one_too_many(tmp_path):
    capture_of(tmp_path / "c", {"01": 0}, inside="calibration")
    (tmp_path / "c" / T_OFFSETS).write_text("{}")
    with pytest.raises(ValueError, match=r"has t_offsets\.json twice"):
        find_offsets(tmp_path / "c")


def test_numbers_may_have_zeros_before_them_unless_that_leaves_doubt(tmp_path):
    path = tmp_path / T_OFFSETS
    path.write_text('{"0001": 0.5, "001": 0.25, "2": 1}')
    assert read_offsets(path, CAMERAS) == {"02": Decimal(-1)}
