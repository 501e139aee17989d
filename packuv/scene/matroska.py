"""FFV1 pictures, sound and attachments in one Matroska file, through PyAV alone.

Every picture is intra-coded (g = 1), so any packet decodes by itself, and a packet's time is the time of the frame it
belongs to, in milliseconds, Matroska's own clock in FFmpeg.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np

from packuv.bounds import MOST_JSON_BYTES, MOST_PIXELS

TIME_BASE = Fraction(1, 1000)
MAGIC = b"\x1a\x45\xdf\xa3"
"""First bytes of every EBML file."""
BLOCK_HEADER = 64
"""A block's own fields before its packet are never longer, bytes."""


@dataclass(frozen=True)
class VideoTrack:
    """One FFV1 video track of 8-bit grey pictures."""

    name: str
    width: int
    height: int
    slices: int
    """FFV1 slices of a picture, coded on their own"""


@dataclass(frozen=True)
class Packet:
    """One coded picture, or some sound."""

    track: int
    """Number of its track in the file"""
    time_ms: int
    duration_ms: int
    data: bytes


class Encoder:
    """Codes the pictures of one track, on the calling thread."""

    def __init__(self, track: VideoTrack) -> None:
        self._context = av.CodecContext.create("ffv1", "w")
        assert isinstance(self._context, av.VideoCodecContext)
        _configure(self._context, track)
        self._context.thread_count = 1
        self._track = track

    def encode(self, picture: np.ndarray) -> bytes:
        """The packet of a picture uint8 [height, width]."""
        expected = (self._track.height, self._track.width)
        if picture.shape != expected or picture.dtype != np.uint8:
            raise ValueError(
                f"track {self._track.name!r} holds uint8 {expected} pictures, but got {picture.dtype} {picture.shape}"
            )
        frame = av.VideoFrame.from_ndarray(picture, format="gray")
        packets = self._context.encode(frame)
        if len(packets) != 1:
            raise RuntimeError(f"FFV1 must give one packet a picture, but gave {len(packets)}; report this PyAV build")
        return bytes(packets[0])


class Decoder:
    """Decodes the pictures of one track, on the calling thread; decoders may work at the same time."""

    def __init__(self, track: VideoTrack, codec_private: bytes) -> None:
        self._track = track
        self._context = av.CodecContext.create("ffv1", "r")
        assert isinstance(self._context, av.VideoCodecContext)
        self._context.extradata = codec_private or None
        self._context.options = {"max_pixels": str(MOST_PIXELS)}
        self._context.width, self._context.height = track.width, track.height
        self._context.thread_count = 1

    def decode(self, data: bytes) -> np.ndarray:
        """The picture of a packet, uint8 [height, width]; raises ValueError for bytes that are none.

        FFmpeg hides failed slice checksums; check the bytes first.
        """
        try:
            frames = self._context.decode(av.Packet(data))
        except av.FFmpegError as error:
            raise ValueError(f"a packet of track {self._track.name!r} does not decode ({error.strerror})") from None
        if len(frames) != 1 or frames[0].format.name != "gray":
            raise ValueError(f"track {self._track.name!r} is not one of 8-bit grey FFV1 pictures")
        return frames[0].to_ndarray()


def _configure(context: av.VideoCodecContext, track: VideoTrack) -> None:
    context.width, context.height, context.pix_fmt = track.width, track.height, "gray"
    context.time_base = TIME_BASE
    context.options = {
        "level": "3",
        "coder": "1",
        "context": "0",  # the larger model is 2 to 4 % larger on keys and residuals, which start anew each picture
        "slices": str(track.slices),
        "slicecrc": "1",
        "g": "1",
        "flags": "+bitexact",
    }


class Spool:
    """Coded packets on disk, until all that the header says about them is known."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._index: list[tuple[int, int, int, int, int]] = []  # track, time, duration, offset, size

    def append(self, packet: Packet) -> None:
        offset = self._file.seek(0, os.SEEK_END)
        self._file.write(packet.data)
        self._index.append((packet.track, packet.time_ms, packet.duration_ms, offset, len(packet.data)))

    def __iter__(self) -> Iterator[Packet]:
        for track, time_ms, duration_ms, offset, size in self._index:
            self._file.seek(offset)
            yield Packet(track, time_ms, duration_ms, self._file.read(size))


def write_matroska(
    path: Path,
    tracks: Sequence[VideoTrack],
    packets: Iterable[Packet],
    attachments: Mapping[str, tuple[str, bytes]],
    *,
    rate: Fraction,
    flac: bytes = b"",
) -> None:
    """Write packets, in order of time, and attachments (name -> MIME type, content); same input, same bytes.

    `flac` is a file of sound that goes along as a track after the others. The `bitexact` flag keeps dates, library
    versions and random identifiers out of the file.
    """
    options = {"fflags": "+bitexact", "max_interleave_delta": "1"}  # packets come in order: never hold them back
    with av.open(str(path), "w", format="matroska", options=options) as container:
        streams = list[Any]()
        for track in tracks:
            stream = container.add_stream("ffv1", rate=rate)
            _configure(stream.codec_context, track)
            stream.metadata["title"] = track.name
            stream.time_base = TIME_BASE
            streams.append(stream)
        heard = list[Packet]()
        if flac:
            with av.open(io.BytesIO(flac), "r", format="flac") as source:
                voice = source.streams.audio[0]
                streams.append(container.add_stream_from_template(voice))
                heard += (_heard(packet, len(tracks)) for packet in source.demux(voice) if packet.size)
        for name, (mime, content) in attachments.items():
            container.add_attachment(name, mime, content)
        for packet in merge(packets, heard, key=attrgetter("time_ms")):
            container.mux(_muxable(packet, streams[packet.track]))


def _heard(packet: av.Packet[av.AudioStream], track: int) -> Packet:
    """A packet of sound, in the file's clock."""
    times = (Fraction(value or 0) * (packet.time_base or 0) for value in (packet.pts, packet.duration))
    time_ms, duration_ms = (round(time / TIME_BASE) for time in times)
    return Packet(track, time_ms, duration_ms, bytes(packet))


def _muxable(packet: Packet, stream: Any) -> av.Packet[Any]:
    out = av.Packet(packet.data)
    out.stream, out.time_base = stream, TIME_BASE
    out.pts = out.dts = packet.time_ms
    out.duration, out.is_keyframe = packet.duration_ms, True
    return out


@dataclass(frozen=True)
class FoundPacket:
    """A packet and where its bytes lie in the file."""

    data: bytes
    position: int
    """Offset of the block that holds it, bytes from the start of the file"""

    def span(self, path: Path) -> tuple[int, int]:
        """Where exactly the packet's bytes lie in the file, half-open."""
        with path.open("rb") as file:
            file.seek(self.position)
            before = max(0, file.read(BLOCK_HEADER + len(self.data)).find(self.data))
        return self.position + before, self.position + before + len(self.data)


def open_matroska(path: Path) -> av.container.InputContainer:
    """A Matroska file whose pictures FFmpeg's decoders refuse beyond MOST_PIXELS; raises av.FFmpegError."""
    options = {"max_pixels": str(MOST_PIXELS)}
    return av.open(str(path), format="matroska", metadata_errors="replace", options=options)


class Reader:
    """Packets by track and time; one reader for one thread.

    Raises FileNotFoundError for a missing file, and ValueError for one that is not Matroska, is cut short, or holds no
    such packet.
    """

    def __init__(self, path: Path) -> None:
        self._path = Path(path)
        with self._path.open("rb") as file:
            if file.read(4) != MAGIC:
                raise ValueError(f"{path} is not a Matroska file")
        try:
            self._container = open_matroska(self._path)
        except av.FFmpegError as error:
            raise ValueError(f"{path}: its Matroska header is damaged or cut short ({error.strerror})") from None
        for number, stream in enumerate(self._container.streams.video):
            if stream.codec_context is None or stream.codec_context.name != "ffv1":
                self._container.close()
                raise ValueError(f"{path}: video track {number} must be FFV1; the file is damaged or no scene")
        self.codec_private = tuple(stream.codec_context.extradata or b"" for stream in self._container.streams.video)
        """Of each track: what its decoder needs"""
        self.sound_private = b"".join(
            stream.codec_context.extradata or b"" for stream in self._container.streams.audio[:1]
        )
        """The same of sound; empty where there is none"""
        self._packets: Iterator[av.Packet[Any]] = self._container.demux(*self._container.streams.video)

    def close(self) -> None:
        self._container.close()

    @property
    def tracks(self) -> tuple[str, ...]:
        """Names of the video tracks."""
        return tuple(stream.metadata.get("title", "") for stream in self._container.streams.video)

    @property
    def attachments(self) -> dict[str, bytes]:
        """Name and content; raises ValueError for one that is too large for a header."""
        found = {stream.name or "": stream.data or b"" for stream in self._container.streams.attachments}
        for name, content in found.items():
            if len(content) > MOST_JSON_BYTES:
                raise ValueError(
                    f"its attachment {name!r} has {len(content)} bytes, but {MOST_JSON_BYTES} is the most for a header"
                )
        return found

    def packets(self) -> Iterator[tuple[int, FoundPacket]]:
        """Number of the track and packet, all in the order of the file from where the reader is; sound comes as one
        track more."""
        streams = (*self._container.streams.video, *self._container.streams.audio[:1])
        numbers = {stream.index: number for number, stream in enumerate(streams)}
        for packet in self._container.demux(*streams):
            if packet.size:
                yield numbers[packet.stream.index], FoundPacket(bytes(packet), packet.pos or 0)

    def read(self, track: int, time_ms: int) -> FoundPacket:
        """The packet of a track at a time. Reading in the order of the file costs no seek."""
        found = self._scan(track, time_ms, first_only=True)
        if found is None:
            self._seek(track, time_ms)
            found = self._scan(track, time_ms, first_only=False)
        if found is None:
            raise ValueError(
                f"{self._path}: track {self.tracks[track]!r} has no packet at {time_ms} ms; "
                "the file is damaged or cut short"
            )
        return found

    def _scan(self, track: int, time_ms: int, *, first_only: bool) -> FoundPacket | None:
        """Look for a packet from here on, at the next one only or until the track's time has passed."""
        wanted = self._container.streams.video[track].index
        try:
            for packet in self._packets:
                time = packet.pts if packet.stream.index == wanted else None
                if time == time_ms:
                    return FoundPacket(bytes(packet), packet.pos or 0)
                if first_only or (time is not None and time > time_ms):
                    return None
        except (av.FFmpegError, EOFError):
            return None
        return None

    def _seek(self, track: int, time_ms: int) -> None:
        stream = self._container.streams.video[track]
        try:
            self._container.seek(time_ms, stream=stream)
            self._packets = self._container.demux(*self._container.streams.video)
        except av.FFmpegError:
            self._packets = iter(())  # a file cut short has no such time: the scan reports it
