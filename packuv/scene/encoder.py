"""Segments -> packets and header of a scene file.

Pictures are coded by several threads, each with a coder of its own; the bytes do not depend on their number.
"""

from __future__ import annotations

import os
import threading
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import av
import numpy as np

import packuv
from packuv.gaussians.codes import Codes
from packuv.gaussians.segment import Segment
from packuv.scene.header import DYNAMIC, KEY, SceneHeader, SceneIndex, SegmentEntry, TrackEntry, codes_digest
from packuv.scene.matroska import Encoder, Packet, Spool
from packuv.scene.mosaic import NEUTRAL, Mosaic
from packuv.scene.sharing import KeyPlanner, KeyReplay, reordered
from packuv.scene.stream import (
    POSITION_CHANNELS,
    REPEAT,
    Tolerance,
    changes,
    changing_channels,
    channel_names,
    key_rows,
)


class Quality(StrEnum):
    """Names for tolerances, see `TOLERANCES`."""

    LOSSLESS = "lossless"
    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"


TOLERANCES = {
    Quality.LOSSLESS: Tolerance(),
    Quality.HIGH: Tolerance(position=16, attribute=1),
    Quality.MEDIUM: Tolerance(position=32, attribute=2),
    Quality.LOW: Tolerance(position=64, attribute=4),
}


@dataclass(frozen=True)
class EncodeOptions:
    """How a scene file is written."""

    tolerance: Tolerance = TOLERANCES[Quality.LOSSLESS]
    """How far frames after a key may differ from the fit. Keys, what stands still and who is present are exact"""
    reach: int = 3
    """Largest number of key pictures that a jump decodes; 1: every key holds all its rows. The keys of a made-up
    sequence of twelve segments took 44 MB with a reach of 1, 20 with 2, 16 with 3, 15.7 with 4"""
    sound: bool = True
    """Whether the sound of the capture goes along, where there is any"""

    def __post_init__(self) -> None:
        if self.reach < 1:
            raise ValueError(f"encode.reach must be at least 1, but is {self.reach}")


MOST_WORKERS = 8
"""Threads that code pictures unless told otherwise; each holds up to three pictures, 50 MB for a million Gaussians"""


def worker_count(threads: int) -> int:
    """`threads`, or if that is 0 one for each core that this process may use, up to a limit."""
    return threads or min(MOST_WORKERS, len(os.sched_getaffinity(0)))


@dataclass(frozen=True)
class Survey:
    """What the first pass over the segments finds."""

    tracks: tuple[TrackEntry, ...]
    """Sizes and planes of the tracks that are needed"""
    references: tuple[int | None, ...]
    """Segment from whose key each one takes rows"""


def survey(segments: Sequence[Path], header: SceneHeader, options: EncodeOptions) -> Survey:
    """First pass: check the segments, and find what the tracks must hold.

    Raises ValueError when the segments do not follow one another or do not match the header.
    """
    if not segments:
        raise ValueError("a scene needs at least one segment; fit one first")
    needs = _Needs(len(channel_names(header.quantizer.sh_degree)), options.reach)
    for path in segments:
        needs.add(path, Segment.load(path))
    if needs.frames != len(header.times_ns):
        raise ValueError(f"the segments hold {needs.frames} frames, but the header has {len(header.times_ns)} times")
    return Survey(needs.tracks(), tuple(needs.references))


class _Needs:
    """What the pictures of a scene must be able to hold."""

    def __init__(self, channels: int, reach: int) -> None:
        self.frames = 0
        self.references: list[int | None] = []
        self._planner = KeyPlanner(reach)
        self._end: int | None = None  # instant after the last segment
        self._cells = self._dynamic = 0
        self._moving = np.zeros(channels, bool)
        self._low, self._high = np.full(channels, 255, np.uint8), np.zeros(channels, np.uint8)

    def add(self, path: Path, segment: Segment) -> None:
        self._check(path, segment)
        self._end = segment.first + len(segment)
        self.frames += len(segment)
        plan = self._planner.plan(segment)
        self.references.append(plan.reference)
        self._cells = max(self._cells, len(plan.own), len(plan.fates))
        self._dynamic = max(self._dynamic, segment.xyz.shape[1])
        self._moving |= changing_channels(segment)
        if len(plan.own):
            rows = key_rows(segment.key[plan.own])
            self._low = np.minimum(self._low, rows.min(axis=0))
            self._high = np.maximum(self._high, rows.max(axis=0))

    def _check(self, path: Path, segment: Segment) -> None:
        channels = POSITION_CHANNELS + segment.key.attributes.shape[1]
        if channels != len(self._moving):
            raise ValueError(f"{path} has {channels} channels a row, but the header's quantizer {len(self._moving)}")
        if not len(segment.key):
            raise ValueError(f"{path} holds no Gaussians; a segment needs at least one row, be it absent")
        if self._end not in (None, segment.first):
            raise ValueError(f"{path} starts at instant {segment.first}, but the segment before it ends at {self._end}")

    def tracks(self) -> tuple[TrackEntry, ...]:
        """Channels that never vary get no plane, but the key track has at least one; nothing moves: no second track."""
        channels = len(self._moving)
        varying = tuple(np.flatnonzero(self._low < self._high).tolist()) or (0,)
        mosaic = Mosaic.of(self._cells, varying, channels, flagged=any(r is not None for r in self.references))
        key = TrackEntry(mosaic, np.minimum(self._low, self._high), 0)
        if not self._moving.any():
            return (key,)
        mosaic = Mosaic.of(self._dynamic, tuple(np.flatnonzero(self._moving).tolist()), channels, flagged=True)
        return key, TrackEntry(mosaic, np.full(channels, NEUTRAL, np.uint8), 0)


class SceneEncoder:
    """Second pass: all pictures into the spool, all numbers into the index. Use it in a `with` statement."""

    def __init__(
        self,
        header: SceneHeader,
        found: Survey,
        spool: Spool,
        tolerance: Tolerance,
        *,
        threads: int,
    ) -> None:
        self._header, self._tolerance = header, tolerance
        self._replay = KeyReplay(found.references)
        self._pool = ThreadPoolExecutor(worker_count(threads))
        self._queue = _Queue(header, spool, len(found.tracks), limit=2 * worker_count(threads))
        self._writers = [_TrackWriter(number, entry, self._pool) for number, entry in enumerate(found.tracks)]
        self._segments: list[SegmentEntry] = []
        self._digests: list[str] = []

    def __enter__(self) -> SceneEncoder:
        return self

    def __exit__(self, *exception: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def add(self, segment: Segment, progress: Callable[[int], None]) -> None:
        """Encode the next segment; `progress` gets the number of frames so far."""
        plan, first = self._replay.plan(segment), len(self._digests)
        first_packet = sum(self._queue.counts[DYNAMIC:])
        self._put(KEY, first, key_rows(segment.key[plan.own]), plan.fates)
        stored = reordered(segment, plan.order)
        self._digest(stored.key, progress)
        current, dynamic = Codes(stored.key.xyz.copy(), stored.key.attributes.copy()), stored.xyz.shape[1]
        predictions, differences = [], []
        for step, (change, codes) in enumerate(changes(stored, self._tolerance), start=1):
            if change.prediction != REPEAT:
                self._put(DYNAMIC, first + step, change.rows, change.toggled)
            predictions.append(change.prediction)
            differences.append(int(change.differences))
            current.xyz[:dynamic], current.attributes[:dynamic] = codes.xyz, codes.attributes
            self._digest(current, progress)
        self._segments.append(
            SegmentEntry(
                first,
                len(stored),
                len(stored.key),
                dynamic,
                plan.reference,
                len(plan.own),
                plan.own_dynamic,
                first_packet,
                tuple(predictions),
                tuple(differences),
            )
        )

    def finish(self) -> SceneIndex:
        """Wait for the last pictures; the index of what the spool holds. Where all that moves stays within the
        tolerance, nothing is put into the second track, and there is none."""
        self._queue.drain(0)
        written = zip(self._writers, self._queue.sizes, self._queue.crc32, strict=True)
        parts = [(writer.entry, sizes, crc) for writer, sizes, crc in written if sizes]
        tracks = tuple(replace(entry, sizes=tuple(sizes), crc32=tuple(crc)) for entry, sizes, crc in parts)
        segments, digests = tuple(self._segments), tuple(self._digests)
        return SceneIndex(self._header, self._tolerance, tracks, segments, digests, _tools())

    def _put(self, track: int, frame: int, rows: np.ndarray, flags: np.ndarray) -> None:
        self._queue.put(track, frame, self._writers[track].start(rows, flags))

    def _digest(self, codes: Codes, progress: Callable[[int], None]) -> None:
        self._digests.append(codes_digest(codes))
        progress(len(self._digests))


class _TrackWriter:
    """Codes the pictures of one track, each on a thread of the pool."""

    def __init__(self, number: int, entry: TrackEntry, pool: ThreadPoolExecutor) -> None:
        self.entry = entry
        self._number, self._pool = number, pool
        self._local = threading.local()

    def start(self, rows: np.ndarray, flags: np.ndarray) -> Future[bytes]:
        """Begin to code a picture. The first one settles in how many slices the track is coded."""
        if not self.entry.slices:
            return self._settle(rows, flags)
        return self._pool.submit(self._code, rows, flags)

    def _settle(self, rows: np.ndarray, flags: np.ndarray) -> Future[bytes]:
        """Few slices share what they learn, a slice for each plane keeps planes apart, which differ: try both."""
        across, down = self.entry.mosaic.grid
        picture = self.entry.mosaic.draw(rows, flags)
        candidates = [replace(self.entry, slices=slices) for slices in (4, across * down)]
        encoders = [Encoder(candidate.video(self._number)) for candidate in candidates]
        trials = [self._pool.submit(encoder.encode, picture) for encoder in encoders]
        best = min(range(len(trials)), key=lambda k: len(trials[k].result()))
        self.entry = candidates[best]
        return trials[best]

    def _code(self, rows: np.ndarray, flags: np.ndarray) -> bytes:
        if not hasattr(self._local, "encoder"):
            self._local.encoder = Encoder(self.entry.video(self._number))
        encoder: Encoder = self._local.encoder
        return encoder.encode(self.entry.mosaic.draw(rows, flags))


class _Queue:
    """Pictures that are being coded, in the order of the file; bounded, and emptied into the spool from the front."""

    def __init__(self, header: SceneHeader, spool: Spool, tracks: int, *, limit: int) -> None:
        self._times = header.times_ms
        self._durations = np.append(np.diff(self._times), max(1, round(1000 / header.rate)))
        self._spool, self._limit = spool, limit
        self._waiting: deque[tuple[int, int, Future[bytes]]] = deque()
        self.counts = [0] * tracks
        """Packets of each track so far"""
        self.sizes: list[list[int]] = [[] for _ in range(tracks)]
        self.crc32: list[list[int]] = [[] for _ in range(tracks)]

    def put(self, track: int, frame: int, packet: Future[bytes]) -> None:
        self.counts[track] += 1
        self._waiting.append((track, frame, packet))
        self.drain(self._limit)

    def drain(self, count: int) -> None:
        """Wait until at most `count` pictures are left."""
        while len(self._waiting) > count:
            track, frame, packet = self._waiting.popleft()
            data = packet.result()
            self._spool.append(Packet(track, int(self._times[frame]), int(self._durations[frame]), data))
            self.sizes[track].append(len(data))
            self.crc32[track].append(zlib.crc32(data))


def _tools() -> dict[str, str]:
    codec, container = (av.library_versions[name] for name in ("libavcodec", "libavformat"))
    return {
        "packuv": packuv.__version__,
        "av": av.__version__,
        "libavcodec": ".".join(map(str, codec)),
        "libavformat": ".".join(map(str, container)),
        "numpy": np.__version__,
    }
