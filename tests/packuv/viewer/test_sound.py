"""The page lets the sound of a scene be heard, in step with its frames."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from packuv.scene import Sound, open_scene
from packuv.scene.sound import RATE
from packuv.viewer.folder import WebOptions, write_web
from packuv.viewer.source import SegmentSource, describe, open_source
from tests.packuv.viewer.test_viewer import fetch
from tests.support.browser import Browser, running_browser
from tests.support.small_scene import small_scene
from tests.support.viewed import make_source, running

IN_STEP_S, APART_S = 0.03, 0.15
"""What sound comes to be beside the frames, within two seconds, as measured; and beyond which it jumps"""


def tone(seconds: float) -> Sound:
    wave = np.sin(np.arange(round(seconds * RATE)) / 20) / 2
    return Sound.of("cam1", np.stack([wave, wave]).astype(np.float32))


class Loud(SegmentSource):
    """Sounds as long as it goes."""

    def sound(self) -> bytes:
        return tone(float(len(self.times_ns) / self.rate)).flac


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_scene(tmp_path_factory.mktemp("scene") / "scene.mkv", sound=tone(0.24))


def test_a_scene_is_served_with_its_sound_and_without_where_there_is_none(scene_path: Path) -> None:
    with open_source(scene_path) as source, running(source) as server:
        assert describe(source)["sound"] == "cam1"
        for encoding in ("identity", "deflate"):
            answer, body = fetch(server, "/sound.flac", **{"Accept-Encoding": encoding})
            assert answer.getheader("Content-Type") == "audio/flac"
            with open_scene(scene_path) as scene:
                assert body == scene.sound().flac
    with av.open(io.BytesIO(body)) as container:
        assert container.duration == 240_000
    with running(make_source(0)) as server:
        assert fetch(server, "/sound.flac")[0].status == 404
        assert "sound" not in json.loads(fetch(server, "/scene.json")[1])


def test_a_folder_for_the_web_holds_the_sound(scene_path: Path, tmp_path: Path) -> None:
    write_web(scene_path, tmp_path / "site", options=WebOptions())
    with open_scene(scene_path) as scene:
        assert (tmp_path / "site/sound.flac").read_bytes() == scene.sound().flac
    assert json.loads((tmp_path / "site/scene.json").read_text())["sound"] == "cam1"
    write_web(small_scene(tmp_path / "mute.mkv"), tmp_path / "mute", options=WebOptions())
    assert not (tmp_path / "mute/sound.flac").exists()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with running_browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.mark.slow
def test_sound_keeps_step_with_frames_at_their_own_pace(browser: Browser) -> None:
    made = make_source(0)
    source = Loud(made.parts, made.quantizer, Fraction(2), made.cameras, heard="cam1")
    apart = "Number(document.documentElement.dataset.apart ?? NaN)"
    heard, silent = f"!isNaN({apart})", f"isNaN({apart})"

    def press(key: str) -> None:
        code = f"dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))"
        browser.call("Runtime.evaluate", expression=code, userGesture=True)

    with running(source) as server:
        browser.open(f"{server.url}#camera=cam1", 320, 240)
        browser.wait_for("document.getElementById('sound').hidden === false")
        asked = f"performance.getEntriesByName('{server.url}sound.flac')[0].startTime"
        assert browser.evaluate(f"{asked} >= Number(document.documentElement.dataset.first)")  # pictures come first
        assert browser.evaluate(silent)  # before somebody touches the page
        press("Home")
        browser.wait_for(heard)
        browser.wait_for(f"Math.abs({apart}) < {IN_STEP_S}")
        steps = []
        for _ in range(30):  # around the end, too
            steps.append(browser.evaluate(apart))
            time.sleep(0.15)
        steps = [step for step in steps if step is not None]
        assert len(steps) > 20
        assert np.median(np.abs(steps)) < APART_S
        press("Home")
        browser.wait_for(f"Math.abs({apart}) < {IN_STEP_S}")
        for off, on in (("n", "n"), (" ", " "), ("l", "l")):  # mute, pause, to and fro
            press(off)
            browser.wait_for(silent, seconds=5)
            press(on)
            if on == "l":
                press("l")
            browser.wait_for(heard, seconds=10)
        browser.evaluate(
            "const s = document.getElementById('speed'); s.value = 2; s.dispatchEvent(new Event('change'))"
        )
        browser.wait_for(silent, seconds=5)
