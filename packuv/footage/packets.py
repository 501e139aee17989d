"""What demuxing alone tells of a video: when each frame is shown, and which ones need no other."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from packuv.files import open_npz, save_npz
from packuv.footage.coding import Coding
from packuv.footage.pictures import first_coding, picture_names

LONG = 1000
"""Frames of a video from which on what its packets tell is worth a file"""
TABLES = 2
"""Version of these files"""
REORDERED = 64
"""Frames that are shown before one that is decoded earlier, at most"""


@dataclass(frozen=True, eq=False)
class Packets:
    """What demuxing alone tells of a video."""

    ticks: np.ndarray
    """int64 [n], ascending: when each frame is shown"""
    base: Fraction
    """Seconds of a tick"""
    keys: np.ndarray
    """int64, ascending: numbers of the key frames"""
    order: np.ndarray
    """int32 [n]: the how-manieth of all that is decoded each frame is"""
    coding: Coding
    index: int = 0
    """Number of the one that is read among all streams of the container"""
    pictures: tuple[str, ...] = ()
    """Names of files by frame, where the video is a folder of pictures"""

    @property
    def seconds(self) -> np.ndarray:
        """float64 [n], seconds, ascending."""
        return self.ticks * float(self.base)

    def frame_at(self, tick: int) -> int | None:
        """The frame that is shown then."""
        frame = int(np.searchsorted(self.ticks, tick))
        return frame if frame < len(self.ticks) and self.ticks[frame] == tick else None

    def key_after(self, frame: int) -> int:
        """The next key frame after a frame, or the number of frames where there is none."""
        place = int(np.searchsorted(self.keys, frame, side="right"))
        return int(self.keys[place]) if place < len(self.keys) else len(self.ticks)

    def after(self, frame: int) -> np.ndarray:
        """Frames that are decoded after one and shown before the key frame that ends what relies on it, int64."""
        reach = np.arange(max(0, frame - REORDERED), self.key_after(frame))
        found: np.ndarray = reach[self.order[reach] > self.order[frame]]
        return found

    @classmethod
    def read(cls, path: Path, kept: Path | None = None) -> Packets:
        """By demuxing, which reads the whole file; once of a long one, where `kept` is a folder for what it told.

        Raises FileNotFoundError for a missing file, ValueError for one that is no video with a time per frame.
        """
        if path.is_dir():
            return cls._of_folder(path)
        if not path.is_file():
            raise FileNotFoundError(f"no video at {path}")
        table = None if kept is None else kept / f"{_name_of_now(path)}.npz"
        known = table is not None and table.exists()
        try:
            with av.open(str(path)) as container:
                stream = chosen_stream(container)
                base, coding, number = stream.time_base, Coding.of(stream), stream.index
                times = _loaded(table) if table is not None and known else _demuxed(container, stream)
        except (av.FFmpegError, IndexError, ValueError) as error:
            raise ValueError(f"{path} cannot be read as a video ({_first_line(error)}); export it again") from error
        if not len(times) or base is None:
            raise ValueError(f"{path} holds no timed video frames; remux it (ffmpeg -i {path.name} -c copy out.mkv)")
        if table is not None and not known and len(times) >= LONG and table.name == f"{_name_of_now(path)}.npz":
            with suppress(OSError):  # only a memory
                table.parent.mkdir(parents=True, exist_ok=True)
                save_npz(table, {"times": times})
        ticks, keys, order = (
            np.ascontiguousarray(times[:, 0]),
            np.flatnonzero(times[:, 1]),
            times[:, 2].astype(np.int32),
        )
        return cls(ticks, base, keys, order, coding, number)

    @classmethod
    def _of_folder(cls, path: Path) -> Packets:
        names = picture_names(path)
        if not names:
            raise FileNotFoundError(f"no numbered pictures in {path}")
        each = np.arange(len(names))
        return cls(each, Fraction(1), each, each.astype(np.int32), first_coding(path, names), 0, tuple(names))


def chosen_stream(container: av.container.InputContainer) -> av.VideoStream:
    """The one that players show, as in `sync.probe`; raises ValueError where there is none."""
    stream = container.streams.best("video")
    if not isinstance(stream, av.VideoStream):
        raise ValueError("it holds no video")
    return stream


def _demuxed(container: av.container.InputContainer, stream: av.VideoStream) -> np.ndarray:
    """When each frame is shown, whether it is a key frame, and the how-manieth it is decoded, int64 [n, 3], in order.

    Packets that an edit list cuts away are marked for discarding; no decoder shows them.
    """
    found = (
        (packet.pts, packet.is_keyframe)
        for packet in container.demux(stream)
        if packet.pts is not None and packet.size and not packet.is_discard
    )
    times = np.fromiter(found, np.dtype((np.int64, 2)))
    order = np.lexsort((times[:, 1], times[:, 0]))
    return np.column_stack([times[order], order])


def _loaded(table: Path) -> np.ndarray:
    with open_npz(table) as data:
        times: np.ndarray = data["times"]
        return times


def _name_of_now(path: Path) -> str:
    """Another one after each change of a file, by which it is known as git's index knows it."""
    seen = path.stat()
    words = (TABLES, path.resolve(), seen.st_size, seen.st_mtime_ns, seen.st_ctime_ns, seen.st_ino)
    return hashlib.sha256("\0".join(map(str, words)).encode()).hexdigest()


def packet_seconds(path: Path) -> np.ndarray:
    """When each frame of a video is shown, by demuxing alone: float64 [n], seconds, ascending."""
    return Packets.read(path).seconds


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
