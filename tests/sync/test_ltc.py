"""Linear timecode on sound tracks: written by tests/support/ltc.py, heard again."""

from __future__ import annotations

import subprocess
import wave as wav
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sync.capture import find_capture, load_timecodes, probe_capture
from sync.ltc import DROP_RATE, RATE, RATES, _of_frames, decode_ltc
from sync.probe import container_timecodes, probe_video
from sync.timecode import NANOSECONDS, frame_to_label, frames_per_day, labels_to_ns
from tests.support.ltc import wave
from tests.support.needs import needs_ffmpeg

TOLERANCE_S = 40e-6
"""Two samples"""


def labels_from(number: int, count: int, rate: Fraction, *, drop: bool = False) -> list[str]:
    return [frame_to_label(number + k, rate, drop_frame=drop) for k in range(count)]


@settings(max_examples=40, deadline=None)
@given(
    rate_drop=st.sampled_from([*((rate, False) for rate in RATES), (DROP_RATE, True)]),
    start=st.floats(0, 1),
    lead_s=st.floats(0, 0.5),
    gain=st.sampled_from([1.0, -0.02, 0.3]),
    offset=st.sampled_from([0.0, 0.1]),
)
def test_what_is_written_is_heard(rate_drop, start, lead_s, gain, offset):
    (rate, drop), count = rate_drop, 40
    first = int(start * (frames_per_day(rate, drop_frame=drop) - 1))
    labels = labels_from(first, count, rate, drop=drop)
    heard = decode_ltc(gain * (wave(labels, rate, lead_s=lead_s) + offset), 7.0)
    assert heard is not None
    assert heard.drop == drop
    said = ["{:02}:{:02}:{:02}{}{:02}".format(*row[:3], ";" if drop else ":", row[3]) for row in heard.fields]
    places = [labels.index(label) for label in said]
    assert places == list(range(places[0], places[0] + len(places)))
    assert len(places) >= count - 3  # the first may be cut, the last is
    assert np.allclose(heard.begins_s, 7 + lead_s + np.array(places) / float(rate), rtol=0, atol=TOLERANCE_S)


@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_a_dull_and_noisy_track_is_heard(noise):
    clean = wave(labels_from(90_000, 100, Fraction(25)), Fraction(25))
    dull = np.convolve(clean, np.ones(6) / 6, "same") + np.random.default_rng(1).normal(0, noise, len(clean))
    heard = decode_ltc(dull.astype(np.float32))
    assert heard is not None
    assert len(heard.begins_s) > 85


def test_other_sound_is_no_timecode():
    rng, seconds = np.random.default_rng(2), np.arange(5 * RATE) / RATE
    for sound in (
        np.zeros(0), np.zeros(RATE), rng.normal(size=5 * RATE), np.sin(2 * np.pi * 1000 * seconds),
        np.sign(np.sin(2 * np.pi * 1200 * seconds)), np.sign(np.sin(2 * np.pi * 2400 * seconds)),
    ):  # fmt: skip
        assert decode_ltc(sound.astype(np.float32)) is None


def film(path: Path, channels: list[np.ndarray], *, codec: str = "aac", rate: str = "30") -> Path:
    """A video of 3 seconds whose sound has these channels."""
    sound = path.with_suffix(".wav")
    with wav.open(str(sound), "wb") as file:
        file.setnchannels(len(channels))
        file.setsampwidth(2)
        file.setframerate(RATE)
        file.writeframes((np.stack(channels, axis=1) * 20_000).astype("<i2").tobytes())
    subprocess.run(
        ["ffmpeg", "-v", "error", "-y", "-f", "lavfi", "-i", f"testsrc=size=64x48:rate={rate}:duration=3", "-i", sound,
         "-c:v", "libx264", "-c:a", codec, "-shortest", path],
        check=True,
    )  # fmt: skip
    sound.unlink()
    return path


@needs_ffmpeg
@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "aac"), (".mov", "pcm_s16le"), (".mkv", "libopus")])
def test_frames_get_the_time_of_the_label_that_sounds(tmp_path: Path, suffix: str, codec: str) -> None:
    """The second channel has labels, the first one noise. Codecs that lose something also shift it, by a sample."""
    noise = 0.3 * np.random.default_rng(3).normal(size=3 * RATE)
    labels = wave(labels_from(25 * 36_000, 80, Fraction(25)), Fraction(25), lead_s=0.013)[: 3 * RATE]
    info = probe_video(film(tmp_path / f"cam{suffix}", [np.clip(noise, -1, 1), labels], codec=codec))
    codes = container_timecodes(info)
    assert (info.label_rate, info.start_label) == (Fraction(25), "10:00:00:00")
    expected = 36_000 * NANOSECONDS + info.pts_ns - 13_000_000
    assert np.abs(codes.times_ns - expected).max() < 300_000
    assert "LTC on its sound track, from 10:00:00:00" in codes.source
    assert codes.cycle_ns == 86_400 * NANOSECONDS


@needs_ffmpeg
def test_cameras_are_matched_by_what_they_hear_and_jumps_are_told(tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    rate, starts = Fraction(30), {"a": 1000, "b": 1007}
    for name, start in starts.items():
        film(tmp_path / "videos" / f"{name}.mov", [wave(labels_from(start, 90, rate), rate)], codec="pcm_s16le")
    jump = [*labels_from(1000, 45, rate), *labels_from(2000, 45, rate)]
    film(tmp_path / "videos" / "c.mov", [wave(jump, rate)], codec="pcm_s16le")
    capture = find_capture(tmp_path)
    infos = probe_capture(capture)
    times = load_timecodes(capture, infos)
    apart = times["b"].times_ns[0] - times["a"].times_ns[0]
    assert abs(apart - labels_to_ns(["00:00:00:07"], rate)[0]) < 1000 * TOLERANCE_S * 1e6
    assert not infos["a"].notes
    assert infos["c"].notes == (
        "c: the LTC on its sound track jumps once; each frame has the time of the label before it",
    )
    assert times["c"].times_ns[-1] - times["c"].times_ns[0] > 30 * NANOSECONDS


@pytest.mark.parametrize(("begins_s", "ends_s"), [(0.0, 6.0), (0.0, 11.0), (8.5, 60.0), (9.0, 70.0), (0.0, 70.0)])
def test_labels_may_sound_for_a_part_of_the_track(begins_s: float, ends_s: float) -> None:
    rate, whole = Fraction(25), np.zeros(70 * RATE, np.float32)
    sound = wave(labels_from(1000, int((ends_s - begins_s) * 25), rate), rate)
    whole[int(begins_s * RATE) :][: len(sound)] = sound
    labels = decode_ltc(whole)
    assert labels is not None
    assert len(labels.begins_s) >= (ends_s - begins_s) * 25 - 3
    assert decode_ltc(whole[: 10 * RATE]) is not None


@needs_ffmpeg
def test_a_look_that_finds_labels_which_a_whole_block_does_not_is_no_end(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    sound = rng.uniform(-1, 1, 3 * RATE)
    sound[:RATE] = 0.02 * wave(labels_from(0, 25, Fraction(25)), Fraction(25))
    assert probe_video(film(tmp_path / "cam.mov", [sound], codec="pcm_s16le")).frame_count == 90


def test_misread_digits_are_not_believed() -> None:
    rate = Fraction(25)
    labels = labels_from(2500, 200, rate)
    for first in (40, 41, 90, 91, 92):
        labels[first] = labels[first][:7] + str((int(labels[first][7]) + 1) % 10) + labels[first][8:]
    heard = decode_ltc(wave(labels, rate))
    assert heard is not None
    pts_ns = np.arange(200) * NANOSECONDS // 25
    times = _of_frames(heard, rate, pts_ns)
    assert np.abs(times.times_ns - labels_to_ns(labels[:1], rate)[0] - pts_ns).max() < 1_000_000
    assert times.jumps == 0
