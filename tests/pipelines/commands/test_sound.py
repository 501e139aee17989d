"""The sound of a scene file, as commands tell of it, take it along and let it be heard."""

from __future__ import annotations

import json

import av
import numpy as np
import pytest

from packuv.scene import Sound, open_scene
from packuv.scene.sound import RATE
from pipelines.cli import main
from tests.support.small_scene import FRAMES, small_scene

TONES = (440, 660)


@pytest.fixture(scope="module")
def loud(tmp_path_factory):
    """A scene file of 0.24 s in which a tone is heard on each side from its third frame on."""
    times = np.arange(round(0.24 * RATE)) / RATE
    sides = np.stack([np.sin(2 * np.pi * tone * times) for tone in TONES]) / 2 * (times >= 0.08)
    path = tmp_path_factory.mktemp("loud") / "scene.mkv"
    return small_scene(path, sound=Sound.of("cam1", sides.astype(np.float32)))


def test_info_and_verify_tell_of_sound(loud, tmp_path, capsys):
    assert main(["info", str(loud), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["sound"]
    assert (said["camera"], said["codec"], said["seconds"]) == ("cam1", "flac", 0.24)
    assert main(["info", str(loud)]) == 0
    assert "sound      flac, 0.24 s, of cam1\n" in capsys.readouterr().out
    assert main(["verify", str(loud)]) == 0
    with open_scene(loud) as scene:
        packet = scene.sound().flac[-500:-480]
    content = loud.read_bytes()
    assert content.count(packet) == 1
    (tmp_path / "bad.mkv").write_bytes(content.replace(packet, packet[::-1]))
    capsys.readouterr()
    assert main(["verify", str(tmp_path / "bad.mkv")]) == 1
    said = capsys.readouterr().out
    assert "its sound is not what was written" in said
    assert f"all {FRAMES} frames decode to exactly what was written" in said
    small_scene(tmp_path / "mute.mkv")
    assert main(["info", str(tmp_path / "mute.mkv")]) == 0
    assert "sound" not in capsys.readouterr().out


def test_an_export_says_what_becomes_of_the_sound(loud, tmp_path, capsys):
    assert main(["export", str(loud), "--frames", "0:2", "-o", str(tmp_path / "frames")]) == 0
    assert "sound      of cam1 is left out\n" in capsys.readouterr().out
    assert main(["export", "atlas", str(loud), "-o", str(tmp_path / "atlas.mkv")]) == 0
    assert "sound      of cam1 is left out\n" in capsys.readouterr().out
    assert main(["export", str(loud), "--frame", "0", "-o", str(tmp_path / "frame.ply")]) == 0
    assert "sound" not in capsys.readouterr().out


def test_a_compressed_scene_sounds_the_same(loud, tmp_path):
    assert main(["compress", str(loud), "--ratio", "1.3", "--iterations", "0", "-o", str(tmp_path / "small.mkv")]) == 0
    with open_scene(loud) as whole, open_scene(tmp_path / "small.mkv") as small:
        assert small.sound() == whole.sound()


def test_a_film_of_the_file_alone_has_its_sound(loud, tmp_path, capsys):
    with open_scene(loud) as scene:
        camera = scene.header.cameras[0].to_json()
    views = [{"seconds": seconds, "frame": frame, "camera": camera} for seconds, frame in ((0, 2), (0.12, 5))]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"format": "packuv-path", "version": 1, "views": views}))
    assert main(["film", str(loud), str(path), "-o", str(tmp_path / "film.mp4")]) == 0
    assert "sound of cam1" in capsys.readouterr().out
    with av.open(str(tmp_path / "film.mp4")) as container:
        voice = np.concatenate([frame.to_ndarray() for frame in container.decode(audio=0)], axis=1)
    for side, tone in enumerate(TONES):
        part = voice[side, : round(0.1 * RATE)]  # of the third frame on, where it begins
        spectrum = np.abs(np.fft.rfft(part * np.hanning(len(part))))
        assert abs(spectrum.argmax() * RATE / len(part) - tone) <= 20
        assert np.abs(part[: RATE // 50]).max() > 0.3
    small_scene(tmp_path / "mute.mkv")
    assert main(["film", str(tmp_path / "mute.mkv"), str(path), "-o", str(tmp_path / "mute.mp4")]) == 0
    assert "sound" not in capsys.readouterr().out
