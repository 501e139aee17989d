"""Frames of a video by number, decoded by PyAV; FFmpeg converts what it shows as it is meant, we convert the rest.

What a decoder says of damage is kept, and what follows from it: pictures are predicted from others, so that those
decoded after a damaged one are wrong, too, up to the next key frame, although the decoder says nothing of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np

from packuv.footage.damage import Damage, DamagedPictureError
from packuv.footage.develop import Developer, converted
from packuv.footage.jpeg import jpeg_fault
from packuv.footage.packets import Packets
from packuv.footage.transfer import Transfer
from packuv.footage.turn import Turn

Develop = Callable[[av.VideoFrame], np.ndarray]
"""Makes a decoded frame a picture, uint8 [H, W, 3]"""
STEPS_BACK = (0, 1, 3, 7, 15)
"""Key frames before the one that leads to a frame from which it is tried, too: a demuxer may land after the one that is
asked for, and a decoder may need more than one to recover"""


class ExactDecoder:
    """One open video. Reading in ascending order never seeks, unless a key frame lies on the way."""

    def __init__(
        self,
        path: Path,
        packets: Packets,
        damage: dict[int, Damage],
        *,
        said: Transfer | None,
        threads: int,
        careful: bool = False,
    ) -> None:
        """What is found damaged goes into `damage`, by number of the frame; `careful` looks into JPEG data as well."""
        self._container = av.open(str(path))
        stream = self._container.streams[packets.index]
        assert isinstance(stream, av.VideoStream)
        self._stream = stream
        self._stream.codec_context.thread_count = threads
        coding = packets.coding
        self._develop: Develop = converted if coding.plain(said) else Developer(coding, coding.curve(said)).picture
        self._packets, self._damage = packets, damage
        self._jpeg = careful and self._stream.codec_context.name == "mjpeg"
        self._nal_bytes = _nal_bytes(self._stream.codec_context)
        self._frames: Iterator[av.VideoFrame] = iter(())
        self._turn: Turn | None = None
        self._at: int | None = None
        """Frame that was decoded last"""
        self._key, self._sure_from = 0, 0
        """Where this pass began, and the frame from which on what the decoder calls damaged is: before, it may lack
        what comes before the key frame"""
        self._begun, self._doubtful = False, False
        """Whether the pass came to its key frame, and whether it met damage of which it is not sure"""
        self._spare = set[int]()
        """Times of packets on their way of which no other needs the picture"""

    def read(self, frame: int) -> tuple[np.ndarray, float]:
        """A picture, uint8 [H, W, 3], and when it is shown, seconds; raises DamagedPictureError
        where there is none, IndexError where nothing leads to it."""
        decoded = self._frame(frame)
        if self._turn is None:
            self._turn = Turn.of_frame(decoded)
        assert decoded.pts is not None
        return self._turn.shown(self._develop(decoded)), decoded.pts * float(self._packets.base)

    def _frame(self, wanted: int) -> av.VideoFrame:
        if self._damage.get(wanted) is Damage.LOST:
            raise DamagedPictureError("it is damaged")
        keys = self._packets.keys
        count = int(np.searchsorted(keys, wanted, side="right"))  # of key frames up to the wanted one
        last = int(keys[count - 1]) if count else -1
        ahead = self._at is not None and self._at < wanted and last <= self._at + 1
        if ahead and (found := self._decode_until(wanted)) and not self._doubtful:
            return found
        found = None
        for step in STEPS_BACK:
            if step >= count:
                break
            self._seek(int(keys[count - 1 - step]), first=step == count - 1)
            found = self._decode_until(wanted) or found
            if found and not self._doubtful:
                return found
            if self._begun and wanted >= self._sure_from:
                break
        if found:
            return found
        if self._begun:
            self._mark(wanted, Damage.LOST)
            raise DamagedPictureError("it is damaged")
        raise IndexError("no key frame leads to it")

    def _seek(self, key: int, *, first: bool) -> None:
        start = int(self._packets.ticks[key])
        self._container.seek(start, stream=self._stream, backward=True)
        self._key, self._sure_from = key, 0 if first else self._packets.key_after(key)
        self._begun = self._doubtful = False
        self._spare.clear()
        self._frames = self._whole_from(start)

    def _decode_until(self, wanted: int) -> av.VideoFrame | None:
        self._at, tick = None, self._packets.ticks[wanted]
        for decoded in self._frames:
            if decoded.pts is not None and decoded.pts >= tick:
                self._at = wanted if decoded.pts == tick else None
                return decoded if decoded.pts == tick else None
        return None

    def _whole_from(self, start: int) -> Iterator[av.VideoFrame]:
        """Frames that need nothing from before the key frame at `start`: pictures that lead it in may."""
        for decoded in self._decoded():
            if decoded.pts is not None and not self._begun:
                self._begun = decoded.pts == start or (decoded.key_frame and decoded.pts < start)
            if self._begun:
                yield decoded

    def _decoded(self) -> Iterator[av.VideoFrame]:
        """All frames from here on; what is damaged among them is marked."""
        for packet in self._container.demux(self._stream):
            if packet.pts is not None and packet.size and self._is_spare(packet):
                self._spare.add(packet.pts)
            if self._jpeg and packet.size and jpeg_fault(memoryview(packet)):
                self._found(packet.pts, Damage.CONCEALED)
            try:
                frames = packet.decode()
            except av.FFmpegError:
                self._found(packet.pts, Damage.LOST)
                continue
            for frame in frames:
                if frame.is_corrupt:
                    self._found(frame.pts, Damage.CONCEALED)
                self._spare.discard(frame.pts)
                yield frame

    def _is_spare(self, packet: av.Packet[av.VideoStream]) -> bool:
        """Whether no other picture needs this one, as containers hardly ever say, but H.264 does."""
        return packet.is_disposable or (self._nal_bytes > 0 and _unreferenced(memoryview(packet), self._nal_bytes))

    def _found(self, tick: int | None, what: Damage) -> None:
        """The decoder calls the frame of this time damaged."""
        frame = None if tick is None else self._packets.frame_at(tick)
        if frame is None or frame < self._key:
            return
        if frame < self._sure_from:
            self._doubtful = True
        else:
            self._mark(frame, what)

    def _mark(self, frame: int, what: Damage) -> None:
        # Of a packet that could not be decoded nothing is believed.
        if what is Damage.LOST or int(self._packets.ticks[frame]) not in self._spare:
            for other in self._packets.after(frame).tolist():
                self._damage.setdefault(other, Damage.FOLLOWS)
        if self._damage.get(frame) is not Damage.LOST:
            self._damage[frame] = what


def _nal_bytes(codec: av.VideoCodecContext) -> int:
    """Bytes of the lengths before units of H.264 in MP4 and Matroska; 0 for other streams."""
    said = codec.extradata or b""
    return (said[4] & 3) + 1 if codec.name == "h264" and len(said) > 4 and said[0] == 1 else 0


def _unreferenced(packet: memoryview, nal_bytes: int) -> bool:
    """Whether the picture of an H.264 packet is one that no other refers to (nal_ref_idc 0 of its first slice)."""
    at = 0
    while at + nal_bytes < len(packet):
        header = packet[at + nal_bytes]
        if header & 31 in (1, 5):
            return header >> 5 & 3 == 0
        at += nal_bytes + int.from_bytes(packet[at : at + nal_bytes])
    return False
