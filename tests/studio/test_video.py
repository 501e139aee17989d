"""Video files of any length: x264 holds back its first packets, and the muxer then changes the stream's time base."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from studio.video import VideoWriter

HELD_BACK = 33
"""x264 gives its first packet with this picture"""


def frame_times(path: Path) -> list[Fraction]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        times = [packet.pts * stream.time_base for packet in container.demux(stream) if packet.pts is not None]
    return sorted(times)


@pytest.mark.parametrize("fps", [Fraction(1), Fraction(25), Fraction(30), Fraction(30000, 1001), Fraction(120)])
@pytest.mark.parametrize("count", [1, HELD_BACK - 1, HELD_BACK, HELD_BACK + 1, 90])
def test_frames_are_one_period_apart_however_many(tmp_path: Path, count: int, fps: Fraction) -> None:
    rng = np.random.default_rng(count)
    with VideoWriter(tmp_path / "a.mp4", 32, 32, fps) as video:
        for _ in range(count):
            video.write(rng.integers(0, 256, (32, 32, 3), dtype=np.uint8))
    assert frame_times(tmp_path / "a.mp4") == [number / fps for number in range(count)]


def test_a_capture_may_be_longer_than_the_encoder_holds_back(tmp_path: Path) -> None:
    options = SimulateOptions(
        cameras=2,
        frames=HELD_BACK + 2,
        size="32x32",
        samples=1,
        truth=TruthKind.LIGHT,
        clock=ClockOptions(drop_share=0, max_late_frames=0),
    )
    simulate(tmp_path / "capture", options)
    for path in sorted((tmp_path / "capture" / "videos").iterdir()):
        assert frame_times(path) == [Fraction(number, 30) for number in range(HELD_BACK + 2)]


def test_the_same_pictures_give_the_same_bytes_whatever_memory_held_before(tmp_path: Path) -> None:
    """Seen on a processor with AVX-512: of six such files four were different."""
    contents = set()
    for number in range(6):
        used = [np.full(size, 40 * number, np.uint8) for size in range(1000, 3_000_000, 50_000)]
        del used
        film(tmp_path / "other.mp4", seed=100 + number, count=6)
        contents.add(film(tmp_path / "same.mp4", seed=7, count=24))
    assert len(contents) == 1


def film(path: Path, *, seed: int, count: int) -> bytes:
    """A faint pattern that moves, with noise."""
    rng = np.random.default_rng(seed)
    pattern = cv2.GaussianBlur(rng.random((180, 320, 3)) * 60 + 90, (0, 0), 3)
    with VideoWriter(path, 320, 180, Fraction(30)) as video:
        for shift in range(count):
            picture = np.roll(pattern, shift, 1) + rng.normal(0, 2, pattern.shape)
            video.write(np.clip(picture, 0, 255).astype(np.uint8))
    return path.read_bytes()
