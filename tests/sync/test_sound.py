"""Starts by sound: claps and speech that all cameras hear, each with noise of its own."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from sync.audio import sound_tracks
from sync.content import sound as module
from sync.content.sound import RATE, Sound, hear, listen, listen_to_one, loudness, starts_by_sound
from sync.timecode import frame_to_label
from tests.support.ltc import wave
from tests.support.sounds import SECONDS, recorded, room, write_video


def heard_at(starts: dict[str, float]) -> dict[str, Sound]:
    """What cameras that began at these times hear."""
    return {
        name: Sound(0.0, loudness(recorded(room(), start, number)))
        for number, (name, start) in enumerate(starts.items())
    }


def test_recordings_of_one_room_tell_when_they_began():
    starts = {"a": 3.0, "b": 0.0, "c": 7.25, "d": 3.5}
    heard = heard_at(starts)
    for name, (start, error) in starts_by_sound(heard).items():
        assert start == pytest.approx(starts[name] - starts["a"], abs=0.002)
        assert error <= 0.005


def test_sound_that_begins_after_the_first_frame_counts_from_it():
    heard = {"a": Sound(0.0, loudness(recorded(room(), 1.0, 1))), "b": Sound(0.25, loudness(recorded(room(), 3.0, 2)))}
    assert starts_by_sound(heard)["b"][0] == pytest.approx(3.0 - 0.25 - 1.0, abs=0.002)


def test_who_hears_something_else_or_nothing_is_missing():
    heard = {
        "a": Sound(0.0, loudness(recorded(room(), 1.0, 1))),
        "elsewhere": Sound(0.0, loudness(recorded(room(7), 1.0, 3))),
        "b": Sound(0.0, loudness(recorded(room(), 2.0, 2))),
        "deaf": Sound(0.0, loudness(np.zeros(SECONDS * RATE))),
        "short": Sound(0.0, loudness(np.ones(100))),
    }
    assert set(starts_by_sound(heard)) == {"a", "b"}
    assert starts_by_sound({"a": heard["a"], "elsewhere": heard["elsewhere"]}) == {}
    assert starts_by_sound({}) == {}


def test_a_pair_that_agrees_by_echo_is_outvoted(monkeypatch):
    starts = {"a": 1.0, "b": 2.0, "c": 3.0, "d": 4.0}
    heard = heard_at(starts)
    shifts = list(module._shifts(heard))
    wrong = [(a, b, shift + (5.0 if (a, b) == ("a", "d") else 0.0)) for a, b, shift in shifts]
    monkeypatch.setattr(module, "_shifts", lambda heard: iter(wrong))
    for name, (start, _) in starts_by_sound(heard).items():
        assert start == pytest.approx(starts[name] - 1.0, abs=0.005)


def test_sound_is_read_from_videos(tmp_path):
    samples = recorded(room(), 0.0, 0)[: 6 * RATE]
    write_video(tmp_path / "a.mkv", samples)
    write_video(tmp_path / "b.mkv", None)
    sound = hear(tmp_path / "a.mkv")
    assert sound is not None
    assert sound.start_s == pytest.approx(0.0, abs=0.01)
    assert len(sound.level) == pytest.approx(6000, abs=20)
    expected = loudness(samples)[: len(sound.level)]
    assert np.corrcoef(sound.level[: len(expected)], expected)[0, 1] > 0.95
    assert hear(tmp_path / "b.mkv") is None


def test_timecode_on_a_channel_is_no_sound_of_the_room(tmp_path):
    """Nor on a track before that of the room; and what is no number is silent."""
    rate, count = 48_000, 8 * 48_000
    labels = wave([frame_to_label(90_000 + k, Fraction(25)) for k in range(210)], Fraction(25))[:count]
    heard = {}
    for number, start in enumerate((0.5, 1.25, 2.0)):
        samples = np.repeat(recorded(room(), start, number)[: 8 * RATE], rate // RATE)
        samples[5000:5400] = np.nan
        tracks = (
            [np.stack([samples, labels]), np.stack([labels, samples])][number:] if number < 2 else [labels, samples]
        )
        write_video(tmp_path / f"{number}.mkv", tracks[0], *tracks[1:2], rate=rate)
        sound = hear(tmp_path / f"{number}.mkv")
        assert sound is not None
        heard[str(number)] = sound
    starts = starts_by_sound(heard)
    assert {name: start for name, (start, _) in starts.items()} == pytest.approx(
        {"0": 0.0, "1": 0.75, "2": 1.5}, abs=0.005
    )


def test_silent_tracks_are_passed_over(tmp_path):
    samples = recorded(room(), 0.0, 0)[: 6 * RATE]
    write_video(tmp_path / "a.mkv", np.zeros(6 * RATE), samples)
    write_video(tmp_path / "b.mkv", np.zeros(6 * RATE), np.full(6 * RATE, np.nan))
    level = hear(tmp_path / "a.mkv").level
    assert np.corrcoef(level, loudness(samples)[: len(level)])[0, 1] > 0.95
    assert not len(hear(tmp_path / "b.mkv").level)


def test_sound_after_damage_stays_where_it_was(tmp_path):
    samples = recorded(room(), 0.0, 0)[: 6 * RATE]
    write_video(tmp_path / "a.mkv", samples)
    whole = hear(tmp_path / "a.mkv")
    (track,) = sound_tracks(tmp_path / "a.mkv")
    pieces = list(track._pieces(RATE, mono=True))
    track._pieces = lambda rate, mono: (piece for number, piece in enumerate(pieces) if not 10 <= number < 14)
    parts = list(track.blocks(20.0, RATE, mono=True))
    assert len(parts) == 2
    start = round(parts[1][0] * RATE)
    assert np.array_equal(parts[1][1][0], np.concatenate([piece[0] for _, piece in pieces])[start:])
    assert len(whole.level) == pytest.approx(6000, abs=20)


def test_listening_begins_at_a_frame_and_is_heard_on_both_sides(tmp_path):
    rng = np.random.default_rng(0)
    sides = rng.uniform(-0.5, 0.5, (2, 2 * RATE)).astype(np.float32)
    write_video(tmp_path / "stereo.mkv", sides)
    heard = listen(tmp_path / "stereo.mkv", 5, 1.0, RATE)  # of 10 frames a second
    assert np.allclose(heard, sides[:, RATE // 2 : 3 * RATE // 2], atol=1e-6)
    beyond = listen(tmp_path / "stereo.mkv", 15, 1.0, RATE)
    assert np.allclose(beyond[:, : RATE // 2], sides[:, 3 * RATE // 2 :], atol=1e-6)
    assert not beyond[:, RATE // 2 :].any()
    write_video(tmp_path / "mono.mkv", sides[0])
    assert np.allclose(listen(tmp_path / "mono.mkv", 0, 2.0, RATE), sides[[0, 0]], atol=1e-6)
    write_video(tmp_path / "none.mkv")
    write_video(tmp_path / "silent.mkv", np.zeros(2 * RATE))
    for name in ("none", "silent"):
        assert listen(tmp_path / f"{name}.mkv", 0, 1.0, RATE) is None


def test_the_first_camera_that_heard_anything_is_listened_to(tmp_path):
    rng = np.random.default_rng(0)
    tracks = {"quiet": np.zeros(2 * RATE), "late": rng.normal(size=2 * RATE), "loud": rng.normal(size=2 * RATE)}
    videos = {name: tmp_path / f"{name}.mkv" for name in tracks}
    for name, samples in tracks.items():
        write_video(videos[name], samples)
    camera, heard = listen_to_one(videos, {"quiet": 0, "late": -1, "loud": 3}, 1.0, RATE)
    assert camera == "loud"
    assert np.array_equal(heard, listen(videos["loud"], 3, 1.0, RATE))
    assert listen_to_one(videos, {"quiet": 0, "late": -1}, 1.0, RATE) is None
