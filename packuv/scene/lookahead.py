"""Pictures of a scene file, decoded by threads before they are asked for.

Every picture decodes alone, so several are decoded at a time, each by one thread. The packets are read by the caller's
thread in the order of the file.
"""

from __future__ import annotations

import threading
import zlib
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from packuv.scene.header import TRACK_NAMES
from packuv.scene.matroska import Decoder, FoundPacket
from packuv.scene.source import Source

MOST_PIXELS_A_BYTE = 256
"""Of a packet; FFV1's range coder gets a picture of one grey to 98"""


@dataclass(frozen=True)
class Address:
    """One picture of a scene file."""

    track: int
    packet: int
    """Its number in the track"""
    frame: int
    """Scene frame that it belongs to"""

    @property
    def name(self) -> str:
        return f"packet {self.packet} of track {TRACK_NAMES[self.track]!r} (frame {self.frame}"


class DamageError(ValueError):
    """A packet that is missing, differs from what was written, or does not decode."""

    def __init__(self, message: str, address: Address, span: tuple[int, int] | None) -> None:
        super().__init__(message)
        self.address = address
        self.span = span
        """Its bytes in the file, half-open; None where it was not found"""


class LookAhead:
    """Hands out pictures in the order in which they are asked for, and decodes those that will come next."""

    def __init__(self, path: Path, source: Source, *, workers: int) -> None:
        self._path, self._source, self._index = path, source, source.index
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="packuv-decode")
        self._depth = 2 * workers
        self._queue: deque[tuple[Address, Future[np.ndarray]]] = deque()
        self._local = threading.local()

    def close(self) -> None:
        """Stop the threads; pictures under way are dropped."""
        self.forget()
        self._pool.shutdown()

    def forget(self) -> None:
        """Drop the pictures that were decoded ahead."""
        for _, picture in self._queue:
            picture.cancel()
        self._queue.clear()

    def picture(self, address: Address, following: Iterable[Address]) -> np.ndarray:
        """A picture uint8 [height, width], while some of the `following` ones are being decoded.

        Raises DamageError.
        """
        if not self._queue or self._queue[0][0] != address:
            self.forget()
            self._start(address)
        for number, later in enumerate(following, start=1):
            if number > self._depth:
                break
            if number >= len(self._queue):
                self._start(later)
            elif self._queue[number][0] != later:
                break
        return self._queue.popleft()[1].result()

    def _start(self, address: Address) -> None:
        """Read a packet and begin to decode it; trouble waits until the picture is asked for."""
        try:
            found = self._source.read(address.track, address.packet, address.frame)
        except ValueError as error:
            failed: Future[np.ndarray] = Future()
            failed.set_exception(DamageError(f"{error} ({address.name}))", address, None))
            self._queue.append((address, failed))
        else:
            self._queue.append((address, self._pool.submit(self._decode, address, found)))

    def _decode(self, address: Address, found: FoundPacket) -> np.ndarray:
        entry = self._index.tracks[address.track]
        expected = entry.sizes[address.packet], entry.crc32[address.packet]
        if (len(found.data), zlib.crc32(found.data)) != expected:
            raise self._damage("differs from what was written", address, found)
        if entry.mosaic.width * entry.mosaic.height > MOST_PIXELS_A_BYTE * len(found.data):
            raise self._damage("is too small for its picture", address, found)
        try:
            picture = self._decoder(address.track).decode(found.data)
        except ValueError as error:
            raise self._damage(f"does not decode, {error}", address, found) from None
        if picture.shape != (entry.mosaic.height, entry.mosaic.width):
            raise self._damage(f"has a picture of {picture.shape[1]} x {picture.shape[0]}", address, found)
        return picture

    def _decoder(self, track: int) -> Decoder:
        """This thread's decoder of a track."""
        decoders: dict[int, Decoder] = self._local.__dict__.setdefault("decoders", {})
        if track not in decoders:
            decoders[track] = self._source.decoder(track)
        return decoders[track]

    def _damage(self, what: str, address: Address, found: FoundPacket) -> DamageError:
        start, stop = found.span(self._path)
        return DamageError(
            f"{self._path}: {address.name}, bytes {start} to {stop - 1}) {what}; frames before it and segments that do "
            "not refer to this one can still be read",
            address,
            (start, stop),
        )
