"""Times and calibrations under names that are not read."""

from __future__ import annotations

from pathlib import Path

import pytest

from sync.capture import find_capture
from sync.nearby import unread


def lay(folder: Path, *files: str, settings: str = "") -> Path:
    for file in ("videos/cam1.mp4", "videos/cam2.mp4", *files):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"content")
    (folder / "capture.toml").write_text(settings)
    return folder


@pytest.mark.parametrize("odd", ["timecode/cam1.csv", "Timestamps/cam1.txt", "timestamps.csv", "videos/cam1.csv"])
def test_times_that_are_not_read_are_named(tmp_path: Path, odd: str) -> None:
    (note,) = unread(find_capture(lay(tmp_path, odd)))
    assert "seems to hold times and is passed over: they are read from timecodes/" in note
    assert not list(unread(find_capture(lay(tmp_path, "timecodes/cam1.txt"))))


@pytest.mark.parametrize("odd", ["calib/a.toml", "colmap/0/cameras.bin", "transforms.json", "Calib_2024.toml"])
def test_a_calibration_that_is_not_read_is_named(tmp_path: Path, odd: str) -> None:
    (note,) = unread(find_capture(lay(tmp_path, odd)))
    name = odd.partition("/")[0]
    assert f'write calibration = "{name}" into capture.toml' in note
    for said in ('calibration = "solve"', f'calibration = "{name}"'):
        assert not list(unread(find_capture(lay(tmp_path, odd, settings=said))))


def test_what_is_of_no_concern_is_not_named(tmp_path: Path) -> None:
    others = ("notes.txt", "videos/readme.txt", "calibration/transforms.json", "timecodes/cam1.txt", "audio/cam1.wav")
    assert not list(unread(find_capture(lay(tmp_path, *others, ".cache/timestamps.csv"))))
