"""The sound of a scene: a FLAC file, which travels as a track of the scene's own.

FLAC is lossless, so that what a camera recorded in 16 bits comes back as it was; every player knows it in Matroska, and
every browser as a file. docs/scene-format.md, "Sound".
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from packuv.bounds import MOST_SAMPLES
from packuv.scene.copy import CopyDamageError, read_copy
from packuv.scene.header import SoundEntry
from packuv.scene.matroska import open_matroska

SOUND = "sound"
"""Name of the track beside those of pictures"""
CODEC = "flac"
RATE = 48_000
"""Samples a second: that of video cameras, of which a packet of FLAC takes whole milliseconds"""
LAYOUT = "stereo"
FULL = 1 << 15
"""Of 16 bits, what stands for 1"""
CODING = {"lpc_type": "fixed", "flags": "+bitexact"}
"""Predictors of whole numbers: others are 2 % smaller, but found by sums that depend on the processor"""
HEAD = b"fLaC\x80\x00\x00\x22"
"""Of a FLAC file before its STREAMINFO, of INFO bytes; packets follow that"""
INFO = 34


@dataclass(frozen=True)
class Sound:
    """What a camera heard from the first frame of a scene on."""

    camera: str
    flac: bytes
    """A FLAC file, stereo, 16 bits, at RATE"""

    @classmethod
    def of(cls, camera: str, samples: np.ndarray) -> Sound:
        """Code samples, float32 [2, n] at RATE, of which 1 is full scale."""
        context = av.CodecContext.create(CODEC, "w")
        assert isinstance(context, av.AudioCodecContext)
        context.sample_rate, context.layout, context.format, context.options = RATE, LAYOUT, "s16", CODING
        context.open()
        packets: list[av.Packet[av.AudioStream]] = []
        for start in range(0, samples.shape[1], context.frame_size):
            part = np.rint(samples[:, start : start + context.frame_size] * FULL).clip(-FULL, FULL - 1)
            woven = np.ascontiguousarray(part.T, np.int16).reshape(1, -1)
            frame = av.AudioFrame.from_ndarray(woven, format="s16", layout=LAYOUT)
            frame.sample_rate, frame.pts = RATE, start
            packets += context.encode(frame)
        packets += context.encode(None)
        info = bytes(packets[-1].get_sidedata("new_extradata"))  # with the number of samples, and their MD5
        return cls(camera, HEAD + info + b"".join(map(bytes, packets)))

    def samples(self, first: int = 0, count: int = MOST_SAMPLES) -> np.ndarray:
        """float32 [2, n] at RATE, from one sample on so many, or as there are. Raises ValueError for no FLAC."""
        parts, begins, resampler = [np.zeros((2, 0), np.float32)], 0, av.AudioResampler("fltp", LAYOUT, RATE)
        for frame in self._frames():
            for part in resampler.resample(frame):
                wanted = slice(max(0, first - begins), max(0, first + count - begins))
                parts.append(part.to_ndarray()[:, wanted].astype(np.float32))
                begins += part.samples
            if begins >= first + count:
                break
        return np.concatenate(parts, axis=1)

    def _frames(self) -> Iterator[av.AudioFrame]:
        try:
            with av.open(io.BytesIO(self.flac), "r", format=CODEC) as container:
                yield from container.decode(audio=0)
        except av.FFmpegError as error:
            raise ValueError(f"what {self.camera} heard is no FLAC that can be decoded ({error.strerror})") from None

    @property
    def entry(self) -> SoundEntry:
        """What the header says of it."""
        count = int.from_bytes(self.flac[len(HEAD) + 13 : len(HEAD) + 18]) & (1 << 36) - 1
        return SoundEntry(self.camera, CODEC, RATE, 2, count, hashlib.sha256(self.flac).hexdigest())


def read_sound(path: Path, entry: SoundEntry) -> Sound:
    """The sound of a scene file, of which the header says this; raises ValueError where it is another."""
    if entry.codec != CODEC:
        raise ValueError(f"{path}: its sound is {entry.codec}, but this program reads {CODEC}; it costs no frame")
    for find in (_copied, _demuxed):
        found = find(path)
        if hashlib.sha256(found).hexdigest() == entry.sha256:
            return Sound(entry.camera, found)
    raise ValueError(f"{path}: its sound is not what was written, which costs no frame; copy the file again")


def _copied(path: Path) -> bytes:
    """Where the second copy of the header says, without a look at the pictures between."""
    with path.open("rb") as file, suppress(CopyDamageError):
        if copy := read_copy(file):
            private, spans = copy.sound
            packets = (os.pread(file.fileno(), stop - first, first) for first, stop in spans if first < stop)
            return HEAD + private[-INFO:] + b"".join(packets)
    return b""


def _demuxed(path: Path) -> bytes:
    """By the file's own structure."""
    parts = list[bytes]()
    with suppress(av.FFmpegError, IndexError), open_matroska(path) as container:
        voice = container.streams.audio[0]
        parts.append(HEAD + (voice.codec_context.extradata or b"")[-INFO:])
        parts.extend(bytes(packet) for packet in container.demux(voice))
    return b"".join(parts)
