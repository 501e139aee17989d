"""Linear timecode on sound tracks: written by tests/support/ltc.py, heard again."""

from __future__ import annotations

import subprocess
import wave as wav
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sync import ltc
from sync.capture import find_capture, load_timecodes, probe_capture
from sync.clock import ClockMode
from sync.ltc import DROP_RATE, RATE, RATES, _Labels, _of_frames, decode_ltc
from sync.probe import container_timecodes, probe_video
from sync.timecode import NANOSECONDS, frame_to_label, frames_per_day, labels_to_ns
from tests.support.ltc import wave
from tests.support.needs import needs_ffmpeg

TOLERANCE_S = 40e-6
"""Two samples"""


def labels_from(number: int, count: int, rate: Fraction, *, drop: bool = False) -> list[str]:
    return [frame_to_label(number + k, rate, drop_frame=drop) for k in range(count)]


@settings(max_examples=40)
@given(
    rate_drop=st.sampled_from([*((rate, False) for rate in RATES), (DROP_RATE, True)]),
    start=st.floats(0, 1),
    lead_s=st.floats(0, 0.5),
    gain=st.sampled_from([1.0, -0.02, 0.3]),
    offset=st.sampled_from([0.0, 0.1]),
)
@example(rate_drop=(RATES[0], False), start=0.0, lead_s=0.125, gain=1.0, offset=0.0)  # begins in silence
@example(rate_drop=(RATES[1], False), start=0.028913, lead_s=0.49451586643476914, gain=-0.02, offset=0.0)  # likewise
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
    places = heard.begins_s * 25
    assert np.abs(places - np.rint(places)).max() / 25 < TOLERANCE_S / 4  # of single turns up to 31 us


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


@settings(max_examples=30)
@given(
    rate=st.sampled_from(RATES),
    louder=st.floats(0, 3),
    mains=st.sampled_from([50, 60]),
    phase=st.floats(0, 6),
    gain=st.floats(0.1, 0.6),
    rounded=st.integers(1, 8),
)
def test_hum_of_mains_is_not_heard(rate, louder, mains, phase, gain, rounded):
    """Nor where it drives the labels to the ends of the scale, if they are not cut to nothing there."""
    labels = labels_from(90_000, 60, rate)
    clean = np.convolve(wave(labels, rate), np.ones(rounded) / rounded, "same")
    turn = 2 * np.pi * mains * np.arange(len(clean)) / RATE + phase
    sound = gain * (clean + louder * (np.sin(turn) + 0.2 * np.sin(3 * turn)))
    most = gain * (0.4 + louder)
    sound = np.clip(sound, -most, most)
    heard = decode_ltc(sound.astype(np.float32))
    assert heard is not None
    assert len(heard.begins_s) >= 57
    places = [labels.index("{:02}:{:02}:{:02}:{:02}".format(*row)) for row in heard.fields]
    assert np.allclose(heard.begins_s, np.array(places) / float(rate), rtol=0, atol=5 * TOLERANCE_S)


def test_labels_of_which_most_are_misread_are_no_times() -> None:
    rate = Fraction(25)
    fields = np.array([[0, 0, second // 25 * (second % 3), second % 25] for second in range(200)])
    assert _of_frames(_Labels(np.arange(200) / 25, fields, False), rate, np.arange(200) * 40_000_000) is None


@settings(max_examples=25)
@given(st.lists(st.tuples(st.floats(-2, 2), st.integers(1, 4000)), max_size=60))
def test_any_sound_is_heard_or_not(parts):
    sound = np.concatenate([np.full(length, level, np.float32) for level, length in parts] or [np.zeros(0)])
    assert decode_ltc(sound) is None


def tracks(path: Path, sounds: list[np.ndarray], *, codec: str = "pcm_f32le", rate: int = RATE) -> Path:
    """A video of 3 seconds with a track for each sound, float32 as it is; `rate` is what the header says."""
    inputs: list[str] = []
    for number, sound in enumerate(sounds):
        raw = path.with_suffix(f".{number}.raw")
        raw.write_bytes(sound.astype("<f4").tobytes())
        inputs += ["-f", "f32le", "-ar", str(rate), "-ac", "1", "-i", str(raw)]
    maps = [part for number in range(len(sounds) + 1) for part in ("-map", str(number))]
    subprocess.run(
        ["ffmpeg", "-v", "error", "-y", "-f", "lavfi", "-i", "testsrc=size=64x48:rate=30:duration=3", *inputs,
         *maps, "-c:v", "libx264", "-c:a", codec, path],
        check=True,
    )  # fmt: skip
    return path


@needs_ffmpeg
def test_labels_on_the_second_track_and_numbers_that_are_none(tmp_path: Path) -> None:
    rate = Fraction(25)
    labels = wave(labels_from(90_000, 80, rate), rate)[: 3 * RATE]
    room = np.random.default_rng(1).normal(0, 0.1, 3 * RATE)
    room[:RATE] = np.nan
    labels[100:140], labels[200:210] = np.nan, np.inf
    info = probe_video(tracks(tmp_path / "cam.mov", [room, labels]))
    assert (info.start_label, info.notes) == ("01:00:00:00", ())
    assert info.heard_ns is not None
    assert np.abs(info.heard_ns - 3_600 * NANOSECONDS - info.pts_ns).max() < 300_000


@needs_ffmpeg
def test_labels_that_begin_after_silence_are_heard(tmp_path: Path) -> None:
    rate = Fraction(25)
    late = np.concatenate([np.zeros(12 * RATE), wave(labels_from(90_300, 80, rate), rate)])
    info = probe_video(tracks(tmp_path / "cam.mov", [late]))
    assert (info.start_label, info.notes) == ("01:00:00:00", ())


@needs_ffmpeg
def test_two_tracks_that_disagree_are_both_told(tmp_path: Path) -> None:
    rate = Fraction(25)
    sounds = [wave(labels_from(first, 80, rate), rate)[: 3 * RATE] for first in (90_000, 90_250)]
    info = probe_video(tracks(tmp_path / "cam.mov", sounds))
    assert info.start_label == "01:00:00:00"
    assert info.notes == (
        "cam: channel 1 of sound track 2 carries LTC, too, which is +10.0 s from that of channel 1 of sound track 1; "
        "the latter is used",
    )


@needs_ffmpeg
def test_a_track_whose_header_has_another_rate_is_named(tmp_path: Path) -> None:
    rate = Fraction(25)
    sound = wave(labels_from(90_000, 80, rate), rate)
    info = probe_video(tracks(tmp_path / "cam.mov", [sound], rate=44_100))
    assert info.start_label is None
    (note,) = info.notes
    assert "carries LTC of 22.97 labels a second, which is no rate of labels: is the sample rate" in note


@needs_ffmpeg
def test_labels_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    rate, rng = Fraction(25), np.random.default_rng(5)
    sound = wave(labels_from(90_000, 80, rate), rate)[: 3 * RATE]
    digits = np.arange(len(sound)) % 1920 < 1400  # of each label; the sync word is left
    broken = np.where(digits & (rng.random(len(sound)) < 0.3), rng.uniform(-1, 1, len(sound)), sound)
    info = probe_video(tracks(tmp_path / "cam.mov", [broken]))
    assert info.start_label is None
    assert info.notes == (
        "cam: channel 1 of sound track 1 carries LTC, but is too distorted to be read; it is not used",
    )


@needs_ffmpeg
def test_labels_go_on_over_damage(tmp_path: Path) -> None:
    """What comes after a damaged packet stays where it was."""
    rate = Fraction(25)
    path = tracks(tmp_path / "cam.mkv", [0.5 * wave(labels_from(90_000, 80, rate), rate)[: 3 * RATE]], codec="flac")
    whole = probe_video(path)
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(audio=0) if packet.size]
        spoilt = [bytes(packet) for packet in packets[10:13]]
    data = path.read_bytes()
    for packet in spoilt:
        assert data.count(packet) == 1
        data = data.replace(packet, b"\x55" * len(packet))
    path.write_bytes(data)
    info = probe_video(path)
    assert info.start_label == whole.start_label == "01:00:00:00"
    assert info.heard_ns is not None
    assert whole.heard_ns is not None
    assert np.abs(info.heard_ns - whole.heard_ns).max() < 300_000
    assert info.notes == ("cam: 3 packets of the sound track with LTC are damaged: its labels go on over them",)


@needs_ffmpeg
def test_cameras_without_labels_beside_some_with_are_named(tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    rate = Fraction(30)
    for name in ("a", "b"):
        film(tmp_path / "videos" / f"{name}.mov", [wave(labels_from(108_000, 90, rate), rate)], codec="pcm_s16le")
    film(tmp_path / "videos" / "c.mov", [np.zeros(3 * RATE)], codec="pcm_s16le")
    capture = find_capture(tmp_path)
    infos = probe_capture(capture)
    with pytest.raises(ValueError, match=r"^c must have a start label or LTC .*as a, b have.*set clock = 'content'"):
        load_timecodes(capture, infos)
    assert set(load_timecodes(capture, infos, ClockMode.CONTENT)) == {"a", "b", "c"}
    midnight = dict(infos)
    for name in ("a", "b"):  # labels that begin where the container's times do
        midnight[name] = replace(infos[name], heard_ns=infos["c"].pts_ns, start_label="00:00:00:00")
    assert load_timecodes(capture, midnight)["c"].notes == (
        "it has no start label, as a, b have: its times count from 0",
    )


@needs_ffmpeg
def test_what_was_heard_is_kept_until_the_file_is_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rate, kept = Fraction(25), tmp_path / "kept"
    path = tracks(tmp_path / "cam.mov", [wave(labels_from(90_000, 80, rate), rate)[: 3 * RATE]])
    first = probe_video(path, kept=kept)
    (place,) = kept.iterdir()
    with monkeypatch.context() as deaf:
        deaf.setattr(ltc, "_hear", lambda *_: pytest.fail("it was heard already"))
        again = probe_video(path, kept=kept)
    assert (again.start_label, again.label_rate, again.notes) == (first.start_label, first.label_rate, first.notes)
    assert np.array_equal(again.heard_ns, first.heard_ns)
    for damage in (b"", b"PK damaged", place.read_bytes()[:100]):
        place.write_bytes(damage)
        assert np.array_equal(probe_video(path, kept=kept).heard_ns, first.heard_ns)
    tracks(tmp_path / "cam.mov", [wave(labels_from(0, 80, rate), rate)[: 3 * RATE]])
    assert probe_video(path, kept=kept).start_label == "00:00:00:00"
    probe_video(tracks(tmp_path / "mute.mov", [np.zeros(3 * RATE)]), kept=tmp_path / "none")
    assert not (tmp_path / "none").exists()
