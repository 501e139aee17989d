"""The sound tracks of a video, as far as they are whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

GAP_S = 0.05
"""Between two packets, from which on sound is missing: containers round their times to a millisecond"""
LOUDEST = 8.0
"""Of a sample, whose full scale is 1: floating-point tracks may hold anything"""


@dataclass
class Track:
    """One sound track of a file that is being read."""

    path: Path
    number: int
    """From 0, among sound tracks"""
    damaged: int = 0
    """Packets that the last reading could not decode"""

    def blocks(self, seconds: float, rate: int, *, mono: bool = False) -> Iterator[tuple[float, np.ndarray]]:
        """Start in the container's seconds and samples, float32 [channels, n] at `rate`, of stretches without a gap,
        about so long. What is no number is silent; damaged packets are counted and leave a gap."""
        parts, begins, count = list[np.ndarray](), 0.0, 0
        for start, piece in self._pieces(rate, mono=mono):
            after = begins + count / rate
            if parts and (abs(start - after) > GAP_S or len(piece) != len(parts[0])):
                yield begins, _finite(parts)
                parts = []
            if not parts:
                begins, count = start, 0
            parts.append(piece)
            count += piece.shape[1]
            if count >= seconds * rate:
                yield begins, _finite(parts)
                parts, begins, count = [], begins + count / rate, 0
        if parts:
            yield begins, _finite(parts)

    def _pieces(self, rate: int, *, mono: bool) -> Iterator[tuple[float, np.ndarray]]:
        resampler, form, begins, count = None, None, 0.0, 0
        for frame in self._frames():
            if form != (form := (frame.format.name, frame.layout.name, frame.sample_rate)):
                resampler = av.AudioResampler("fltp", "mono" if mono else frame.layout, rate)
            start = float(frame.time or 0.0)
            if not count or abs(start - begins - count / rate) > GAP_S:
                begins, count = start, 0
            assert resampler is not None
            for resampled in resampler.resample(frame):
                samples = resampled.to_ndarray()
                yield begins + count / rate, samples
                count += samples.shape[1]

    def _frames(self) -> Iterator[av.AudioFrame]:
        self.damaged = 0
        with suppress(av.FFmpegError), av.open(str(self.path)) as container:
            for packet in container.demux(container.streams.audio[self.number]):
                try:
                    yield from packet.decode()
                except av.FFmpegError:
                    self.damaged += 1


def sound_tracks(path: Path) -> list[Track]:
    """Those of a video; none where it cannot be opened."""
    with suppress(av.FFmpegError), av.open(str(path)) as container:
        return [Track(path, number) for number in range(len(container.streams.audio))]
    return []


def _finite(parts: list[np.ndarray]) -> np.ndarray:
    samples = np.nan_to_num(np.concatenate(parts, axis=1), posinf=0.0, neginf=0.0)
    finite: np.ndarray = np.clip(samples, -LOUDEST, LOUDEST).astype(np.float32)
    return finite
