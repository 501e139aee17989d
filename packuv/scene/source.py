"""Where the header and the packets of a scene file come from: its second copy, or else the file's own structure."""

from __future__ import annotations

import contextlib
import hashlib
import os
import zlib
from pathlib import Path

from packuv.scene.copy import AROUND, Copy, CopyDamageError, digest_around, read_copy, segment_end
from packuv.scene.header import CHECKSUM, HEADER, HeaderDamageError, SceneIndex
from packuv.scene.matroska import Decoder, FoundPacket, Reader

FROM_COPY = "the second copy was read; copy the file again while that is whole"


class Source:
    """An open scene file; for one thread, but for `decoder`.

    Either of header and copy will do. Raises FileNotFoundError for a missing file, and ValueError for one that is no
    scene, or whose header is damaged in both places.
    """

    def __init__(self, path: Path) -> None:
        self._path = Path(path)
        self._file = self._path.open("rb")
        self._copy: Copy | None = None
        self.damage = ""
        """What is wrong with the header or its second copy, of which the other was read; empty if nothing is"""
        try:
            self._copy = read_copy(self._file)
        except CopyDamageError as error:
            self.damage = f"{self._path}: {error}"
        self.damage = self._cut() or self.damage
        self._reader: Reader | None = None
        self.index = self._read_index()
        self._times_ms = self.index.header.times_ms

    def close(self) -> None:
        self._file.close()
        if self._reader:
            self._reader.close()

    def damage_around(self) -> str:
        """What `damage` says, and whether any byte that lies in no packet is another than was written; reads them."""
        if self.damage or not (self._copy and self._copy.around):
            return self.damage
        spans = (
            (position, position + size)
            for track, places in zip(self.index.tracks, self._copy.positions, strict=True)
            for position, size in zip(places, track.sizes, strict=True)
        )
        fits = segment_end(self._file) == self._file.seek(0, os.SEEK_END)
        whole = fits and digest_around(self._file, spans, self._copy.start) == self._copy.around
        return "" if whole else f"{self._path}: {AROUND}"

    def _cut(self) -> str:
        """What is wrong with the file's length."""
        size, end = self._file.seek(0, os.SEEK_END), segment_end(self._file)
        if end is None or end == size:
            return ""
        if size < end:
            return (
                f"{self._path} is cut short: it must have {end} bytes, but has {size}; frames whose pictures are there "
                "play, but copy the file again"
            )
        return f"{self._path} must have {end} bytes, but has {size}: something else follows; copy the file again"

    def decoder(self, track: int) -> Decoder:
        """A new decoder for a track."""
        source = self._copy or self._reader
        assert source is not None
        return Decoder(self.index.tracks[track].video(track), source.codec_private[track])

    def read(self, track: int, number: int, frame: int) -> FoundPacket:
        """A packet by its number in the track; `frame` is the one it belongs to.

        What is found where the copy says is looked for in the file's structure if it is not what was written: programs
        that write the file anew may move packets. Raises ValueError where nothing is found.
        """
        if self._copy:
            entry = self.index.tracks[track]
            position = self._copy.positions[track][number]
            found = FoundPacket(os.pread(self._file.fileno(), entry.sizes[number], position), position)
            lost = self._reader is None or track >= len(self._reader.tracks)  # a structure that is damaged itself
            if lost or zlib.crc32(found.data) == entry.crc32[number]:
                return found
        assert self._reader is not None
        return self._reader.read(track, int(self._times_ms[frame]))

    def _read_index(self) -> SceneIndex:
        try:
            self._reader = Reader(self._path)
        except ValueError as error:
            return self._copied_index(error)
        try:
            return self._own_index(self._reader)
        except HeaderDamageError as error:
            return self._copied_index(error)
        except ValueError:
            self.close()
            raise

    def _own_index(self, reader: Reader) -> SceneIndex:
        try:
            attachments = reader.attachments
            index = SceneIndex.decode(attachments)
        except ValueError as error:
            raise type(error)(f"{self._path}: {error}") from None
        expected = tuple(entry.video(number).name for number, entry in enumerate(index.tracks))
        if reader.tracks[: len(expected)] != expected:
            raise HeaderDamageError(f"{self._path} must have the video tracks {expected}, but has {reader.tracks}")
        if self._copy and (self._copy.header != attachments[HEADER] or not _has_places(self._copy, index)):
            self._copy = None  # of another scene
        return index

    def _copied_index(self, error: ValueError) -> SceneIndex:
        """The header of the copy; raises the error of the file's own where there is none that makes sense."""
        if self._copy:
            checksum = f"{hashlib.sha256(self._copy.header).hexdigest()}  {HEADER}".encode()
            with contextlib.suppress(ValueError):
                index = SceneIndex.decode({HEADER: self._copy.header, CHECKSUM: checksum})
                if _has_places(self._copy, index):
                    self.damage = f"{error}; {FROM_COPY}"
                    return index
        self.close()
        raise ValueError(str(error)) from None


def _has_places(copy: Copy, index: SceneIndex) -> bool:
    return [len(places) for places in copy.positions] == [len(track.sizes) for track in index.tracks]
