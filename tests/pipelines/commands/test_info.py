"""What `packuv info` tells people of a scene fits a screen, however long the scene is."""

from __future__ import annotations

import pytest

from pipelines.commands.scenes import MOST_STARTS, _info_text


def facts(segments: int) -> dict:
    return {
        "file": "scene.mkv",
        "bytes": 10**8,
        "bytes_per_frame": 2500.0,
        "frames": 40 * segments,
        "rate": "30",
        "seconds": 40 * segments / 30,
        "sh_degree": 0,
        "light": None,
        "sound": None,
        "lossless": True,
        "compression": None,
        "tolerance": {"position": 0, "attribute": 0},
        "cameras": ["cam01", "cam02"],
        "held_out": [],
        "segments": [{"first": 40 * n, "frames": 40 + n % 2, "gaussians": 9, "dynamic": 3} for n in range(segments)],
        "tools": {"packuv": "0.1.0"},
    }


@pytest.mark.parametrize("segments", [1, MOST_STARTS])
def test_all_starts_of_few_segments_are_named(segments: int) -> None:
    starts = ", ".join(str(40 * number) for number in range(segments))
    assert f"segments   {segments}, from frame {starts}\n" in _info_text(facts(segments))


def test_half_an_hour_fits_a_screen() -> None:
    text = _info_text(facts(1350))
    assert max(map(len, text.splitlines())) < 200
    assert "and so on, 40 to 41 frames each (--json lists all)" in text
