"""Frames of a video by number, decoded by PyAV; FFmpeg converts what it shows as it is meant, we convert the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np

from packuv.footage.coding import Coding
from packuv.footage.develop import Developer
from packuv.footage.transfer import Transfer

Develop = Callable[[av.VideoFrame], np.ndarray]
"""Makes a decoded frame a picture, uint8 [H, W, 3]"""


class ExactDecoder:
    """One open video. Reading in ascending order never seeks, unless a key frame lies on the way."""

    def __init__(self, path: Path, ticks: np.ndarray, keys: np.ndarray, *, said: Transfer | None, threads: int) -> None:
        """`ticks` are the presentation times of all frames, `keys` the numbers of those that need no other frame."""
        self._container = av.open(str(path))
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_count = threads
        coding = Coding.of(self._stream)
        self._develop: Develop = _converted if coding.plain(said) else Developer(coding, coding.curve(said)).picture
        self._ticks, self._keys = ticks, keys
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._at: int | None = None
        """Frame that was decoded last"""

    def read(self, frame: int) -> tuple[np.ndarray, float]:
        """A picture, uint8 [H, W, 3], and when it is shown, seconds; raises IndexError if it cannot be reached."""
        decoded = self._frame(frame)
        assert self._stream.time_base is not None
        assert decoded.pts is not None
        return self._develop(decoded), decoded.pts * float(self._stream.time_base)

    def _frame(self, wanted: int) -> av.VideoFrame:
        count = int(np.searchsorted(self._keys, wanted, side="right"))  # of key frames up to the wanted one
        last = int(self._keys[count - 1]) if count else -1
        ahead = self._at is not None and self._at < wanted and last <= self._at + 1
        if ahead and (found := self._decode_until(wanted)):
            return found
        # A demuxer may land after the key frame that is asked for; then the one before it leads there.
        for key in self._keys[:count][::-1]:
            start = int(self._ticks[key])
            self._container.seek(start, stream=self._stream, backward=True)
            self._frames = self._whole_from(start)
            if found := self._decode_until(wanted):
                return found
        raise IndexError("no key frame leads to it")

    def _decode_until(self, wanted: int) -> av.VideoFrame | None:
        self._at, tick = None, self._ticks[wanted]
        for decoded in self._frames:
            if decoded.pts is not None and decoded.pts >= tick:
                self._at = wanted if decoded.pts == tick else None
                return decoded if decoded.pts == tick else None
        return None

    def _whole_from(self, start: int) -> Iterator[av.VideoFrame]:
        """Frames that need nothing from before the key frame at `start`: pictures that lead it in may."""
        begun = False
        for decoded in self._container.decode(self._stream):
            if decoded.pts is not None:
                begun = begun or decoded.pts == start or (decoded.key_frame and decoded.pts < start)
            if begun and not decoded.is_corrupt:
                yield decoded


def _converted(frame: av.VideoFrame) -> np.ndarray:
    """By FFmpeg, with the matrix and the range that the frame is tagged with.

    By one thread: with several, FFmpeg 8.0's conversion now and then loses pixels.
    """
    picture: np.ndarray = frame.reformat(format="rgb24", interpolation="BILINEAR", threads=1).to_ndarray()
    return picture
