"""A camera whose frames are pictures in a folder, numbered by their names: what it holds, and when each was taken.

`cam01/000000.jpg`, `Cam001/Cam001_rgb000000.jpg`, `7/frame_12.png`: whatever stands before and after the number, padded
with zeros or not. Frame k is the k-th picture in order of the numbers; numbers that are missing are dropped frames.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import numpy as np

from sync.natural import natural_key
from sync.timecode import frames_to_ns

PICTURE_SUFFIXES = frozenset({".exr", ".jpeg", ".jpg", ".png"})
CODECS = {b"v/1\x01": "exr", b"\x89PNG": "png"}
"""FFmpeg's decoder by the first bytes of a file, whatever it is called; of all others that of JPEG"""
USUAL_RATE = Fraction(30)
"""Frames per second of pictures, where neither capture.toml nor a video tells"""
LARGEST_SHARE_LOST = 10
"""Numbers for each picture beyond which they are no count of frames, but, say, times"""
NAMED = 5
"""Missing pictures that are named one by one"""


@dataclass(frozen=True, eq=False)
class Pictures:
    """The pictures of one camera."""

    folder: Path
    names: tuple[str, ...]
    """Of the files by frame, in natural order"""
    numbers: np.ndarray
    """int64 [n], strictly increasing: by which the names differ"""
    empty: tuple[str, ...]
    """Files without content, taken for dropped frames"""
    others: tuple[str, ...]
    """Pictures without a number, passed over"""
    size_bytes: int

    def __len__(self) -> int:
        return len(self.names)

    @property
    def step(self) -> int:
        """By which numbers grow from frame to frame."""
        return max(1, int(np.gcd.reduce(np.diff(self.numbers)))) if len(self) > 1 else 1

    @property
    def counted(self) -> bool:
        """Whether the numbers count frames; else pictures are taken to follow each other without a gap."""
        return len(self.missing_spans()) == 0 or self.places()[-1] < LARGEST_SHARE_LOST * len(self)

    def places(self) -> np.ndarray:
        """int64 [n], from 0: where each frame would be if none had been dropped."""
        places: np.ndarray = (self.numbers - self.numbers[0]) // self.step
        return places

    def missing_spans(self) -> list[range]:
        """Numbers that are missing between the first and the last."""
        after = np.flatnonzero(np.diff(self.numbers) > self.step)
        return [range(int(self.numbers[k]) + self.step, int(self.numbers[k + 1]), self.step) for k in after]

    def times_ns(self, rate: Fraction, origin: int) -> np.ndarray:
        """int64 [n]: when each was taken, at `rate` numbers a second, where the number `origin` is time 0."""
        return frames_to_ns(self.numbers - origin if self.counted else np.arange(len(self)), rate)

    def notes(self, camera: str) -> tuple[str, ...]:
        """What a person should know, one sentence each."""
        notes = []
        if not self.counted:
            notes.append(f"{camera}: the names of its pictures count no frames; they are taken one after the other")
        elif spans := self.missing_spans():
            count = sum(map(len, spans))
            notes.append(
                f"{camera}: {count} of {len(self) + count} pictures are missing, taken for dropped frames: numbers "
                f"{_listed([_span(span) for span in spans])}"
            )
        if self.empty:
            notes.append(f"{camera}: {len(self.empty)} pictures are empty files, left out: {_listed(self.empty)}")
        if self.others:
            notes.append(f"{camera}: pictures without a number are passed over: {_listed(self.others)}")
        return tuple(notes)


def is_picture(name: str) -> bool:
    """Whether a file's name is that of a picture that can be a frame.

    >>> is_picture("0001.PNG"), is_picture("._0001.png"), is_picture("0001.txt")
    (True, False, False)
    """
    return not name.startswith(".") and os.path.splitext(name)[1].lower() in PICTURE_SUFFIXES


def holds_pictures(folder: Path) -> bool:
    """Whether a folder has pictures with a number in it; cost: the entries up to the first."""
    with os.scandir(folder) as entries:
        return any(is_picture(entry.name) and _has_number(entry.name) for entry in entries)


def list_pictures(folder: Path) -> Pictures:
    """The pictures of a folder in order of their numbers.

    Raises:
        FileNotFoundError: no such folder, or no picture in it.
        ValueError: names that differ by more than a number, or one number twice.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; a camera's pictures lie in one, as {folder.name}/000000.png")
    with os.scandir(folder) as entries:
        sizes = {entry.name: entry.stat().st_size for entry in entries if is_picture(entry.name) and entry.is_file()}
    numbered = sorted(filter(_has_number, sizes), key=lambda name: natural_key(os.path.splitext(name)[0]))
    names = [name for name in numbered if sizes[name]]
    if not names:
        raise FileNotFoundError(
            f"{folder} must hold numbered pictures ({', '.join(sorted(PICTURE_SUFFIXES))}), but has none"
        )
    return Pictures(
        folder=folder,
        names=tuple(names),
        numbers=_numbers(folder, names),
        empty=tuple(name for name in numbered if not sizes[name]),
        others=tuple(sorted(sizes.keys() - set(numbered))),
        size_bytes=sum(sizes.values()),
    )


def decode_picture(path: Path) -> av.VideoFrame:
    """A picture as its file stores it; raises ValueError for one that cannot be decoded."""
    content = path.read_bytes()
    codec = av.CodecContext.create(CODECS.get(content[:4], "mjpeg"), "r")
    assert isinstance(codec, av.VideoCodecContext)
    codec.thread_count = 1
    try:
        packet = av.Packet(content)
        frames = codec.decode(packet) or codec.decode(None)
    except av.FFmpegError as error:
        raise ValueError(f"{path} is no picture that FFmpeg can read: {error.strerror}; copy it again") from None
    if not frames:
        raise ValueError(f"{path} holds no picture; copy it again")
    return frames[0]


def _numbers(folder: Path, names: Sequence[str]) -> np.ndarray:
    """The number by which names differ that are in natural order, int64 [n]."""
    stems = [os.path.splitext(name)[0] for name in names]
    shape = re.sub(r"\d+", "#", stems[0]).lower()
    for name, stem in zip(names, stems, strict=True):
        if re.sub(r"\d+", "#", stem).lower() != shape:
            raise ValueError(
                f"the pictures of a camera must be named alike but for their number, but {folder} holds {names[0]} "
                f"and {name}; give each camera a folder of its own"
            )
    columns = list(zip(*([int(run) for run in re.findall(r"\d+", stem)] for stem in stems), strict=True))
    for column in reversed(columns):
        if all(a < b for a, b in pairwise(column)):
            if max(column) >= 1 << 63:
                raise ValueError(f"{folder}: {names[-1]} has a number that is too large; count pictures from 0")
            return np.array(column, dtype=np.int64)
    twice = next(
        (k for k in range(1, len(names)) if all(column[k] == column[k - 1] for column in columns)), len(names) - 1
    )
    raise ValueError(
        f"each picture of a camera must have a number of its own that grows, but {folder} holds {names[twice - 1]} and "
        f"{names[twice]}; name them apart, or give each camera a folder of its own"
    )


def _has_number(name: str) -> bool:
    return any(character.isdecimal() for character in os.path.splitext(name)[0])


def _span(numbers: range) -> str:
    return str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"


def _listed(items: Sequence[str]) -> str:
    rest = f" and {len(items) - NAMED} more" if len(items) > NAMED else ""
    return ", ".join(items[:NAMED]) + rest
