"""The sound of a scene goes along with its frames, and both come back exactly."""

import subprocess

import numpy as np
import pytest

from packuv.scene import EncodeOptions, Sound, open_scene, verify_scene, write_scene
from packuv.scene.matroska import open_matroska
from packuv.scene.sound import HEAD, RATE
from tests.packuv.scene.test_scene import frames_of, make_header, random_sequence, same, save
from tests.support.needs import needs_ffmpeg

SHAPES = [(300, 90, 5), (310, 60, 3)]


def noise(count, seed=0):
    """Samples of 16 bits, float32 [2, count], of any loudness up to full scale."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(-(2**15), 2**15, (2, count)) >> rng.integers(0, 12, (2, count))
    return (codes / 2**15).astype(np.float32)


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    """A scene file with sound, its segments, and the sound."""
    folder = tmp_path_factory.mktemp("scene")
    paths, sound = save(folder, random_sequence(0, SHAPES)), Sound.of("cam2", noise(round(RATE * 0.27)))
    write_scene(folder / "scene.mkv", paths, make_header(8), sound=sound)
    return folder / "scene.mkv", paths, sound


@pytest.mark.parametrize("count", [0, 1, 4608, 4609, 3 * 4608, 20_011])
def test_samples_of_16_bits_come_back(count):
    samples = noise(count, seed=count)
    sound = Sound.of("cam", samples)
    assert sound.entry.samples == count
    assert np.array_equal(sound.samples(), samples)
    for first, some in ((0, 100), (4000, 5000), (count - 1, 9), (count + 7, 9)):
        assert np.array_equal(sound.samples(max(first, 0), some), samples[:, max(first, 0) :][:, :some])


def test_what_is_too_loud_is_cut_off():
    assert Sound.of("cam", np.full((2, 100), 3, np.float32)).samples().max() == (2**15 - 1) / 2**15
    assert Sound.of("cam", np.full((2, 100), -3, np.float32)).samples().min() == -1


def test_what_is_no_flac_is_told():
    flac = bytearray(Sound.of("cam", noise(9000)).flac)
    flac[len(HEAD) : len(HEAD) + 34] = bytes(34)
    with pytest.raises(ValueError, match="what cam heard is no FLAC that can be decoded"):
        Sound("cam", bytes(flac)).samples()


def test_sound_and_frames_come_back(scene_file):
    path, _, sound = scene_file
    frames = frames_of(random_sequence(0, SHAPES))
    with open_scene(path) as scene:
        assert scene.sound() == sound
        assert scene.index.sound == sound.entry
        assert scene.index.sound.seconds == pytest.approx(0.27)
        assert all(same(scene.codes(k), frames[k]) for k in range(8))
    assert verify_scene(path).ok


def test_same_input_same_bytes_and_without_sound_those_of_before(scene_file, tmp_path):
    path, parts, sound = scene_file
    assert Sound.of("cam2", sound.samples()) == sound
    again, plain, left_out = (tmp_path / f"{name}.mkv" for name in ("again", "plain", "left_out"))
    summary = write_scene(again, parts, make_header(8), sound=sound, threads=1)
    assert again.read_bytes() == path.read_bytes()
    assert summary.track_bytes["sound"] == len(sound.flac)
    assert "sound" not in write_scene(plain, parts, make_header(8)).track_bytes
    write_scene(left_out, parts, make_header(8), sound=sound, options=EncodeOptions(sound=False))
    assert left_out.read_bytes() == plain.read_bytes()
    with open_scene(plain) as scene:
        assert scene.sound() is None


def test_sound_lies_among_the_pictures_of_its_time(scene_file):
    """Players need not read ahead."""
    with open_matroska(scene_file[0]) as container:
        times = [float(packet.pts * packet.time_base) for packet in container.demux() if packet.size]
        kinds = {stream.type for stream in container.streams}
    assert kinds == {"video", "audio", "attachment"}
    assert times == sorted(times)


def test_no_bit_of_the_sound_flips_unheard_and_none_costs_a_frame(scene_file, tmp_path):
    path, _, sound = scene_file
    content, rng = path.read_bytes(), np.random.default_rng(0)
    with open_matroska(path) as container:
        packets = [bytes(packet) for packet in container.demux(container.streams.audio[0]) if packet.size]
    assert HEAD + sound.flac[len(HEAD) : len(HEAD) + 34] + b"".join(packets) == sound.flac
    for packet in packets:
        damaged = bytearray(content)
        damaged[content.index(packet) + int(rng.integers(len(packet)))] ^= 1 << int(rng.integers(8))
        (tmp_path / "bad.mkv").write_bytes(damaged)
        report = verify_scene(tmp_path / "bad.mkv")
        assert not report.ok
        assert not report.bad
        assert "its sound is not what was written, which costs no frame" in report.header


def test_sound_is_read_by_the_copy_or_by_the_files_structure(scene_file, tmp_path, monkeypatch):
    path, _, sound = scene_file
    content = path.read_bytes()
    (tmp_path / "no_copy.mkv").write_bytes(content[:-1] + b"x")  # of the copy's magic
    (tmp_path / "no_structure.mkv").write_bytes(bytes(300) + content[300:])
    for name in ("no_copy", "no_structure"):
        with open_scene(tmp_path / f"{name}.mkv") as scene:
            assert scene.damage
            assert scene.sound() == sound
    monkeypatch.setattr("packuv.scene.sound.open_matroska", None)
    with open_scene(path) as scene:
        assert scene.sound() == sound


@needs_ffmpeg
def test_ffmpeg_hears_the_same_and_a_copy_without_sound_is_told(scene_file, tmp_path):
    path, _, sound = scene_file
    (tmp_path / "sound.flac").write_bytes(sound.flac)
    wanted = np.rint(sound.samples() * 2**15).astype("<i2").T.tobytes()
    for source in (path, tmp_path / "sound.flac"):
        command = ["ffmpeg", "-v", "error", "-i", source, "-map", "0:a", "-f", "s16le", "-"]
        done = subprocess.run(command, check=True, capture_output=True)
        assert not done.stderr
        assert done.stdout == wanted
    copy = ["ffmpeg", "-v", "error", "-i", path, "-map", "0", "-c", "copy"]
    subprocess.run([*copy, tmp_path / "copy.mkv"], check=True)
    with open_scene(tmp_path / "copy.mkv") as scene:
        assert scene.sound() == sound
    subprocess.run([*copy, "-map", "-0:a", tmp_path / "mute.mkv"], check=True)
    report = verify_scene(tmp_path / "mute.mkv")
    assert not report.bad
    assert "its sound is not what was written" in report.problem
