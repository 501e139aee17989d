"""The scene file: one Matroska file that gives back, frame by frame, the very integers that were fitted.

docs/scene-format.md specifies it. Rows of a scene are in storage order (`packuv.stream.in_storage_order`): the rows
that may change inside a segment come first.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any

import av
import numpy as np

from packuv.camera import PinholeCamera
from packuv.matroska import Encoder, Packet, Reader, Spool, Track, write_matroska
from packuv.quantize import Codes, Gaussians, Quantizer
from packuv.segment import Segment
from packuv.stream import (
    BLOCK,
    NEUTRAL,
    POSITION_CHANNELS,
    REPEAT,
    Mosaic,
    Playback,
    changes,
    changing_channels,
    channel_names,
    in_storage_order,
    key_codes,
    key_rows,
)

FORMAT, VERSION, LAYOUT = "packuv-scene", 1, "compact"
HEADER, CHECKSUM = "packuv.json", "packuv.sha256"
"""Names of the two attachments; the second lets `sha256sum -c` check the first."""
KEY, DYNAMIC = 0, 1
"""Track numbers."""

Progress = Callable[[int, int], None]
"""Called with (steps done, steps in all); a frame takes one step to encode and one to verify."""


@dataclass(frozen=True)
class SceneHeader:
    """What a scene says about itself, besides its pictures."""

    quantizer: Quantizer
    times_ns: np.ndarray
    """int64 [T]: when each frame was filmed, on the capture's clock; frames are at least 1 ms apart"""
    rate: Fraction
    """Nominal frames per second"""
    cameras: tuple[PinholeCamera, ...] = ()
    held_out: tuple[str, ...] = ()
    """Names of the cameras that were not fitted"""
    sync: Mapping[str, Any] = field(default_factory=dict)
    """Summary of the synchronization, JSON"""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """Whatever else should travel along, JSON; programs ignore what they do not know"""

    def __post_init__(self) -> None:
        if self.times_ns.dtype != np.int64 or self.times_ns.ndim != 1:
            raise ValueError(f"frame times must be int64 [T], but are {self.times_ns.dtype} {self.times_ns.shape}")
        if not self.rate > 0:
            raise ValueError(f"the frame rate must be positive, but is {self.rate}")
        unknown = set(self.held_out) - {camera.name for camera in self.cameras}
        if unknown:
            raise ValueError(f"held-out cameras {sorted(unknown)} are not among the scene's cameras")
        try:
            json.dumps([dict(self.sync), dict(self.extra)], allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"sync and extra must be plain JSON: {error}") from None
        if (np.diff(self.times_ms) < 1).any():
            first = int(np.argmin(np.diff(self.times_ms) >= 1))
            raise ValueError(
                f"frames {first} and {first + 1} are {np.diff(self.times_ns)[first]} ns apart; "
                "a scene file needs rising times at least 1 ms apart"
            )

    @property
    def times_ms(self) -> np.ndarray:
        """Presentation times in the file, int64 [T]: milliseconds after the first frame."""
        return (self.times_ns - self.times_ns[:1] + 500_000) // 1_000_000

    def to_json(self) -> dict[str, Any]:
        return {
            "quantizer": self.quantizer.to_json(),
            "times_ns": self.times_ns.tolist(),
            "rate": f"{self.rate.numerator}/{self.rate.denominator}",
            "cameras": [camera.to_json() for camera in self.cameras],
            "held_out": list(self.held_out),
            "sync": dict(self.sync),
            "extra": dict(self.extra),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SceneHeader:
        return cls(
            Quantizer.from_json(data["quantizer"]),
            np.asarray(data["times_ns"], dtype=np.int64),
            Fraction(data["rate"]),
            tuple(PinholeCamera.from_json(camera) for camera in data["cameras"]),
            tuple(data["held_out"]),
            data["sync"],
            data["extra"],
        )


@dataclass(frozen=True)
class SegmentEntry:
    """Where a segment lies in the scene, and how its frames are stored."""

    first: int
    """Scene frame of its key"""
    frames: int
    rows: int
    """Number of Gaussians, N"""
    dynamic: int
    """Number of rows that may change, D: the first ones"""
    first_packet: int
    """Number of its first packet in the dynamic track; its key is packet s of the key track, s being its own number"""
    predictions: tuple[int, ...]
    """Of each frame after the key: REPEAT (no packet), PREVIOUS or LINEAR"""
    differences: tuple[int, ...]
    """Of each frame after the key: 1 where colour residuals are stored as differences to green"""

    def packet(self, step: int) -> int:
        """Packet of the frame `step` frames after the key; meaningless for REPEAT."""
        return self.first_packet + sum(p != REPEAT for p in self.predictions[: step - 1])


@dataclass(frozen=True)
class TrackEntry:
    """A track's picture layout, and what its packets must be."""

    mosaic: Mosaic
    constants: np.ndarray
    """uint8 [channels]: the value of every row in channels without a plane"""
    sizes: tuple[int, ...]
    """Bytes of each packet"""
    crc32: tuple[int, ...]
    """CRC-32 (zlib's) of each packet; FFmpeg reports no failed slice checksum to its caller"""

    def video(self, number: int) -> Track:
        across, down = self.mosaic.grid
        return Track(("key", "dynamic")[number], self.mosaic.width, self.mosaic.height, across * down)

    def to_json(self, number: int, names: Sequence[str]) -> dict[str, Any]:
        mosaic = self.mosaic
        missing = set(range(mosaic.channel_count)) - set(mosaic.channels)
        return {
            "name": self.video(number).name,
            "width": mosaic.width,
            "height": mosaic.height,
            "planes": [names[channel] for channel in mosaic.channels],
            "planes_across": mosaic.grid[0],
            "block": BLOCK,
            "blocks_across": mosaic.blocks_across,
            "blocks_down": mosaic.blocks_down,
            "constants": {names[channel]: int(self.constants[channel]) for channel in sorted(missing)},
            "sizes": list(self.sizes),
            "crc32": list(self.crc32),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], names: Sequence[str]) -> TrackEntry:
        constants = np.zeros(len(names), np.uint8)
        for name, value in data["constants"].items():
            constants[names.index(name)] = value
        planes = tuple(names.index(name) for name in data["planes"])
        mosaic = Mosaic(planes, len(names), int(data["blocks_across"]), int(data["blocks_down"]))
        if (mosaic.width, mosaic.height) != (data["width"], data["height"]) or data["block"] != BLOCK:
            raise ValueError(f"track {data['name']!r} has an unknown picture layout")
        return cls(mosaic, constants, tuple(data["sizes"]), tuple(data["crc32"]))


@dataclass(frozen=True)
class SceneIndex:
    """All that packuv.json holds."""

    header: SceneHeader
    tracks: tuple[TrackEntry, ...]
    """The key track and, if anything ever changes, the dynamic track"""
    segments: tuple[SegmentEntry, ...]
    digests: tuple[str, ...]
    """`digest` of each frame's codes"""
    tools: Mapping[str, str]
    """Versions of the programs that wrote the file"""

    def __post_init__(self) -> None:
        frames = sum(segment.frames for segment in self.segments)
        if not frames == len(self.header.times_ns) == len(self.digests) or not self.tracks:
            raise ValueError(
                f"{frames} frames in segments, {len(self.header.times_ns)} times, {len(self.digests)} digests, "
                f"{len(self.tracks)} tracks do not belong together"
            )
        for segment in self.segments:
            self._check_segment(segment)

    def _check_segment(self, segment: SegmentEntry) -> None:
        after_key = len(segment.predictions) == len(segment.differences) == segment.frames - 1
        fits = 0 <= segment.dynamic <= segment.rows <= self.tracks[KEY].mosaic.capacity
        stored = segment.packet(segment.frames) if len(self.tracks) > 1 else 0
        if len(self.tracks) > 1:
            fits &= segment.dynamic <= self.tracks[DYNAMIC].mosaic.capacity
            fits &= stored <= len(self.tracks[DYNAMIC].crc32)
        elif set(segment.predictions) - {REPEAT}:
            fits = False
        if not after_key or not fits:
            raise ValueError(f"the segment at frame {segment.first} does not fit the scene's tracks")

    def to_json(self) -> dict[str, Any]:
        names = channel_names(self.header.quantizer.sh_degree)
        return {
            "format": FORMAT,
            "version": VERSION,
            "layout": LAYOUT,
            "channels": list(names),
            "tracks": [entry.to_json(number, names) for number, entry in enumerate(self.tracks)],
            "segments": [vars(segment) for segment in self.segments],
            "digests": list(self.digests),
            "tools": dict(self.tools),
            **self.header.to_json(),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SceneIndex:
        if data["format"] != FORMAT or data["version"] != VERSION or data["layout"] != LAYOUT:
            raise ValueError(
                f"it is {data['format']} version {data['version']}, layout {data['layout']}; this program reads "
                f"{FORMAT} version {VERSION}, layout {LAYOUT}"
            )
        names = list(channel_names(int(data["quantizer"]["sh_degree"])))
        lists = ("predictions", "differences")
        return cls(
            SceneHeader.from_json(data),
            tuple(TrackEntry.from_json(track, names) for track in data["tracks"]),
            tuple(SegmentEntry(**{**s, **{key: tuple(s[key]) for key in lists}}) for s in data["segments"]),
            tuple(data["digests"]),
            data["tools"],
        )


def digest(codes: Codes) -> str:
    """BLAKE2b of 16 bytes, in hex, over the positions (little-endian, row by row), then the attributes."""
    hasher = hashlib.blake2b(np.ascontiguousarray(codes.xyz, dtype="<u2").data, digest_size=16)
    hasher.update(np.ascontiguousarray(codes.attributes).data)
    return hasher.hexdigest()


# Writing


@dataclass(frozen=True)
class SceneSummary:
    """What `write_scene` wrote."""

    frames: int
    bytes: int
    """Size of the file"""
    track_bytes: Mapping[str, int]
    """Sum of the packets of each track"""
    digests: tuple[str, ...]


def write_scene(
    path: Path,
    segments: Sequence[Path],
    header: SceneHeader,
    *,
    threads: int = 0,
    progress: Progress | None = None,
) -> SceneSummary:
    """Encode segment files, in order, into one scene file, and read all of it back before it gets its name.

    Two segments at most are in memory. Raises ValueError when the segments do not follow one another or do not match
    the header, RuntimeError when the file does not decode to what was written.
    """
    path = Path(path)
    tracks = _survey(segments, header)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    steps = 2 * len(header.times_ns)
    report = progress or (lambda done, total: None)
    try:
        with tempfile.TemporaryFile(dir=path.parent) as file:
            spool = Spool(file)
            writer = _SceneWriter(header, tracks, spool, threads)
            for segment in segments:
                writer.add(in_storage_order(Segment.load(segment)), lambda done: report(done, steps))
            index = writer.index()
            _mux(partial, index, spool)
        check = verify_scene(partial, threads=threads, progress=lambda done, _: report(steps // 2 + done, steps))
        if not check.ok:
            raise RuntimeError(f"the scene was written but does not read back: {check.problem}")
        _publish(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    names = [entry.video(number).name for number, entry in enumerate(index.tracks)]
    track_bytes = {name: sum(entry.sizes) for name, entry in zip(names, index.tracks, strict=True)}
    return SceneSummary(len(index.digests), path.stat().st_size, track_bytes, index.digests)


def _survey(segments: Sequence[Path], header: SceneHeader) -> tuple[TrackEntry, ...]:
    """First pass: check the segments, and find the sizes and planes that the two tracks need."""
    if not segments:
        raise ValueError("a scene needs at least one segment; fit one first")
    needs = _Needs(len(channel_names(header.quantizer.sh_degree)))
    for path in segments:
        needs.add(path, Segment.load(path))
    if needs.frames != len(header.times_ns):
        raise ValueError(f"the segments hold {needs.frames} frames, but the header has {len(header.times_ns)} times")
    return needs.tracks()


class _Needs:
    """What the pictures of a scene must be able to hold."""

    def __init__(self, channels: int) -> None:
        self.frames = 0
        self._end: int | None = None  # instant after the last segment
        self._rows = self._dynamic = 0
        self._moving = np.zeros(channels, bool)
        self._low, self._high = np.full(channels, 255, np.uint8), np.zeros(channels, np.uint8)

    def add(self, path: Path, segment: Segment) -> None:
        channels = POSITION_CHANNELS + segment.key.attributes.shape[1]
        if channels != len(self._moving):
            raise ValueError(f"{path} has {channels} channels a row, but the header's quantizer {len(self._moving)}")
        if not len(segment.key):
            raise ValueError(f"{path} holds no Gaussians; a segment needs at least one row, be it absent")
        if self._end not in (None, segment.first):
            raise ValueError(f"{path} starts at instant {segment.first}, but the segment before it ends at {self._end}")
        self._end = segment.first + len(segment)
        self.frames += len(segment)
        self._rows, self._dynamic = max(self._rows, len(segment.key)), max(self._dynamic, segment.xyz.shape[1])
        self._moving |= changing_channels(segment)
        rows = key_rows(segment.key)
        self._low = np.minimum(self._low, rows.min(axis=0))
        self._high = np.maximum(self._high, rows.max(axis=0))

    def tracks(self) -> tuple[TrackEntry, ...]:
        """Channels that never vary get no plane, but the key track has at least one; nothing moves: no second track."""
        channels = len(self._moving)
        varying = tuple(np.flatnonzero(self._low < self._high).tolist()) or (0,)
        key = TrackEntry(Mosaic.of(self._rows, varying, channels), np.minimum(self._low, self._high), (), ())
        if not self._moving.any():
            return (key,)
        mosaic = Mosaic.of(self._dynamic, tuple(np.flatnonzero(self._moving).tolist()), channels)
        return key, TrackEntry(mosaic, np.full(channels, NEUTRAL, np.uint8), (), ())


class _TrackWriter:
    """Encodes the pictures of one track into the spool."""

    def __init__(self, number: int, entry: TrackEntry, header: SceneHeader, spool: Spool, threads: int) -> None:
        self._number, self._entry, self._spool = number, entry, spool
        self._encoder = Encoder(entry.video(number), threads=threads)
        self._times = header.times_ms
        self._durations = np.append(np.diff(self._times), max(1, round(1000 / header.rate)))
        self.sizes: list[int] = []
        self.crc32: list[int] = []

    def add(self, rows: np.ndarray, frame: int) -> None:
        data = self._encoder.encode(self._entry.mosaic.draw(rows))
        self._spool.append(Packet(self._number, int(self._times[frame]), int(self._durations[frame]), data))
        self.sizes.append(len(data))
        self.crc32.append(zlib.crc32(data))

    @property
    def entry(self) -> TrackEntry:
        return replace(self._entry, sizes=tuple(self.sizes), crc32=tuple(self.crc32))


class _SceneWriter:
    """Second pass: all pictures into the spool, all numbers into the index."""

    def __init__(self, header: SceneHeader, tracks: Sequence[TrackEntry], spool: Spool, threads: int) -> None:
        self._header = header
        self._writers = [_TrackWriter(number, entry, header, spool, threads) for number, entry in enumerate(tracks)]
        self._segments: list[SegmentEntry] = []
        self._digests: list[str] = []

    def add(self, stored: Segment, progress: Callable[[int], None]) -> None:
        """Encode a segment in storage order."""
        first, first_packet = len(self._digests), self._packets()
        current, dynamic = Codes(stored.key.xyz.copy(), stored.key.attributes.copy()), stored.xyz.shape[1]
        self._writers[KEY].add(key_rows(stored.key), first)
        self._digest(current, progress)
        predictions, differences = [], []
        for step, change in enumerate(changes(stored), start=1):
            if change.rows is not None:
                self._writers[DYNAMIC].add(change.rows, first + step)
            predictions.append(change.prediction)
            differences.append(int(change.differences))
            current.xyz[:dynamic], current.attributes[:dynamic] = stored.xyz[step - 1], stored.attributes[step - 1]
            self._digest(current, progress)
        how = tuple(predictions), tuple(differences)
        self._segments.append(SegmentEntry(first, len(stored), len(current), dynamic, first_packet, *how))

    def index(self) -> SceneIndex:
        tracks = tuple(writer.entry for writer in self._writers)
        return SceneIndex(self._header, tracks, tuple(self._segments), tuple(self._digests), _tools())

    def _packets(self) -> int:
        """Number of packets in the dynamic track so far."""
        return sum(len(writer.sizes) for writer in self._writers[DYNAMIC:])

    def _digest(self, codes: Codes, progress: Callable[[int], None]) -> None:
        self._digests.append(digest(codes))
        progress(len(self._digests))


def _tools() -> dict[str, str]:
    codec, container = (av.library_versions[name] for name in ("libavcodec", "libavformat"))
    return {
        "packuv": version("packuv"),
        "av": av.__version__,
        "libavcodec": ".".join(map(str, codec)),
        "libavformat": ".".join(map(str, container)),
        "numpy": np.__version__,
    }


def _mux(path: Path, index: SceneIndex, spool: Spool) -> None:
    document = json.dumps(index.to_json(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    checksum = f"{hashlib.sha256(document).hexdigest()}  {HEADER}\n".encode()
    write_matroska(
        path,
        [entry.video(number) for number, entry in enumerate(index.tracks)],
        spool,
        {HEADER: ("application/json", document), CHECKSUM: ("text/plain", checksum)},
        rate=index.header.rate,
    )


def _publish(partial: Path, path: Path) -> None:
    """Give the file its name in one step, after its bytes are on the disk."""
    for target in (partial, None, path.parent):
        if target is None:
            os.replace(partial, path)
            continue
        descriptor = os.open(target, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# Reading


def open_scene(path: Path, *, threads: int = 0) -> Scene:
    """Open a scene file; use it in a `with` statement.

    Raises FileNotFoundError when there is none, ValueError when it is not a scene or its header is damaged.
    """
    return Scene(Path(path), threads=threads)


class Scene:
    """Frames of a scene file, by number. One frame's state is in memory; one scene object serves one thread.

    Reading on is cheap; going elsewhere costs one key frame and the residuals since. Every packet is checked before it
    is decoded, so damage raises ValueError, which names the track, packet and frame, and never gives wrong codes.
    """

    def __init__(self, path: Path, *, threads: int = 0) -> None:
        self.path = path
        self._reader = Reader(path, threads=threads)
        try:
            self.index = _read_index(path, self._reader)
        except BaseException:
            self._reader.close()
            raise
        self._starts = [segment.first for segment in self.index.segments]
        self._times_ms = self.header.times_ms
        self._segment = self._frame = -1
        self._playback: Playback | None = None

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        self._reader.close()

    @property
    def header(self) -> SceneHeader:
        return self.index.header

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.index.digests)

    def frame_at(self, time_ns: int) -> int:
        """The frame on display at a time on the capture's clock: the last one that is not later, or the first."""
        return max(0, int(np.searchsorted(self.header.times_ns, time_ns, side="right")) - 1)

    def codes(self, frame: int) -> Codes:
        """All Gaussians of a frame as integers, absent ones (opacity code 0) included; yours to change."""
        codes = self._seek(frame)
        return Codes(codes.xyz.copy(), codes.attributes.copy())

    def gaussians(self, frame: int) -> Gaussians:
        """All Gaussians of a frame as floats, in the order of `codes`."""
        return self.header.quantizer.decode(self._seek(frame))

    def _forget(self) -> None:
        self._segment = self._frame = -1
        self._playback = None

    def _seek(self, frame: int) -> Codes:
        """Bring the playback to a frame; on an error nothing half-done stays behind."""
        if not 0 <= frame < len(self):
            raise IndexError(f"frame {frame} of a scene with {len(self)} frames")
        segment = bisect_right(self._starts, frame) - 1
        try:
            if self._playback is None or segment != self._segment or frame < self._frame:
                self._start(segment)
            while self._frame < frame:
                self._advance()
        except BaseException:
            self._forget()
            raise
        assert self._playback is not None
        return self._playback.codes

    def _start(self, number: int) -> None:
        """Load a segment's key."""
        self._forget()
        entry, track = self.index.segments[number], self.index.tracks[KEY]
        rows = track.mosaic.read(self._picture(KEY, number, entry.first), track.constants, entry.rows)
        self._playback = Playback(key_codes(rows), entry.dynamic)
        self._segment, self._frame = number, entry.first

    def _advance(self) -> None:
        """Add the next frame's residuals."""
        assert self._playback is not None
        entry, frame = self.index.segments[self._segment], self._frame + 1
        step = frame - entry.first
        prediction, picture = entry.predictions[step - 1], None
        if prediction != REPEAT:
            picture = self._picture(DYNAMIC, entry.packet(step), frame)
        self._playback.advance(prediction, bool(entry.differences[step - 1]), self.index.tracks[-1].mosaic, picture)
        self._frame = frame

    def _picture(self, track: int, packet: int, frame: int) -> np.ndarray:
        """Read, check and decode one packet."""
        entry = self.index.tracks[track]
        found = self._reader.read(track, int(self._times_ms[frame]))
        if len(found.data) != entry.sizes[packet] or zlib.crc32(found.data) != entry.crc32[packet]:
            raise ValueError(
                f"{self.path}: packet {packet} of track {entry.video(track).name!r} (frame {frame}, bytes from "
                f"{found.position} on) is damaged; frames before it and other segments can still be read"
            )
        picture = self._reader.decode(track, found.data)
        if picture.shape != (entry.mosaic.height, entry.mosaic.width):
            raise ValueError(
                f"{self.path}: track {entry.video(track).name!r} has pictures of {picture.shape}, "
                f"but the header says {entry.mosaic.height} x {entry.mosaic.width}"
            )
        return picture


def _read_index(path: Path, reader: Reader) -> SceneIndex:
    attachments = reader.attachments
    for name in (HEADER, CHECKSUM):
        if name not in attachments:
            raise ValueError(f"{path} is not a whole PackUV scene: it lacks the attachment {name}")
    document = attachments[HEADER]
    if attachments[CHECKSUM].decode(errors="replace").split() != [hashlib.sha256(document).hexdigest(), HEADER]:
        raise ValueError(f"{path}: its header {HEADER} is damaged, it does not match {CHECKSUM}")
    try:
        index = SceneIndex.from_json(json.loads(document))
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path}: its header {HEADER} lacks or misuses a field ({error!r})") from None
    except ValueError as error:
        raise ValueError(f"{path}: its header {HEADER} cannot be read: {error}") from None
    expected = tuple(entry.video(number).name for number, entry in enumerate(index.tracks))
    if reader.tracks[: len(expected)] != expected:
        raise ValueError(f"{path} must have the video tracks {expected}, but has {reader.tracks}")
    return index


# Verification


@dataclass(frozen=True)
class VerifyReport:
    """What `verify_scene` found."""

    frames: int
    bad: tuple[int, ...]
    """Frames that cannot be read back exactly, in order"""
    problem: str
    """The first thing that is wrong, empty if nothing is"""

    @property
    def ok(self) -> bool:
        return not self.bad


def verify_scene(path: Path, *, threads: int = 0, progress: Progress | None = None) -> VerifyReport:
    """Decode every frame and compare it with its digest in the header.

    Damage inside a segment costs the rest of that segment only. Raises like `open_scene` when nothing can be read.
    """
    bad: list[int] = []
    problem = ""
    with open_scene(path, threads=threads) as scene:
        for segment in scene.index.segments:
            for frame, trouble in _check_frames(scene, segment):
                if trouble:
                    bad.append(frame)
                    problem = problem or trouble
                if progress:
                    progress(frame + 1, len(scene))
        return VerifyReport(len(scene), tuple(bad), problem)


def _check_frames(scene: Scene, segment: SegmentEntry) -> Iterator[tuple[int, str]]:
    """Every frame of a segment, with what is wrong with it or an empty text."""
    lost = ""
    for frame in range(segment.first, segment.first + segment.frames):
        if not lost:
            try:
                same = digest(scene._seek(frame)) == scene.index.digests[frame]
            except ValueError as error:
                lost = str(error)
            else:
                yield frame, "" if same else f"{scene.path}: the codes of frame {frame} do not match their digest"
                continue
        yield frame, lost
