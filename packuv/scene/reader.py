"""Open a scene file: frames by number or time, as integers or as float32 arrays."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path

import numpy as np

from packuv.gaussians.codes import Codes
from packuv.gaussians.floats import Gaussians
from packuv.gaussians.segment import Segment
from packuv.scene.encoder import worker_count
from packuv.scene.header import COMPRESSION, DYNAMIC, KEY, SceneHeader
from packuv.scene.lookahead import Address, LookAhead
from packuv.scene.sharing import assemble
from packuv.scene.sound import Sound, read_sound
from packuv.scene.source import Source
from packuv.scene.stream import REPEAT, Playback, key_codes

NO_RESIDUALS = np.empty((0, 0), np.uint8)


def open_scene(path: Path, *, threads: int = 0) -> Scene:
    """Open a scene file; use it in a `with` statement.

    `threads` decode at a time, by default one for each core. Raises FileNotFoundError when there is no such file,
    ValueError when it is not a scene or its header is damaged.
    """
    return Scene(Path(path), threads=threads)


class Scene:
    """Frames of a scene file, by number. Memory does not grow with its length; one scene object serves one thread.

    Whoever reads on finds the next pictures decoded; going elsewhere costs the key, those that it refers to, and the
    residuals since. Every packet is checked before it is decoded, so damage raises ValueError, which names the track,
    packet, frame and bytes, and never gives wrong codes.
    """

    def __init__(self, path: Path, *, threads: int = 0) -> None:
        self.path = path
        self._source = Source(self.path)
        self.index = self._source.index
        self._pictures = LookAhead(path, self._source, workers=worker_count(threads))
        self._keys: dict[int, Codes] = {}  # of the segment at hand and those on the way to it, as their keys were
        self._segment = self._frame = -1
        self._playback: Playback | None = None
        self._shown: tuple[Gaussians, int] | None = None  # what `gaussians` returned last, and its segment

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        self._pictures.close()
        self._source.close()

    @property
    def header(self) -> SceneHeader:
        return self.index.header

    @property
    def damage(self) -> str:
        """What is wrong with the header or its second copy, of which the other was read, or with the file's length;
        empty if nothing is."""
        return self._source.damage

    def damage_around(self) -> str:
        """The same, and whether any byte outside of the packets is another than was written; reads them."""
        return self._source.damage_around()

    @property
    def lossless(self) -> bool:
        """Whether its codes are those that were fitted."""
        return self.index.tolerance.exact and COMPRESSION not in self.header.extra

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.index.digests)

    def __iter__(self) -> Iterator[Gaussians]:
        """All frames as floats, in order."""
        return (self.gaussians(frame) for frame in range(len(self)))

    def frame_at(self, time_ns: int) -> int:
        """The frame on display at a time on the capture's clock: the last one that is not later, or the first."""
        return max(0, bisect_right(self.header.times_ns, time_ns) - 1)

    def segment_at(self, frame: int) -> int:
        """Number of the segment that holds a frame. Raises IndexError outside the scene."""
        if not 0 <= frame < len(self):
            raise IndexError(f"frame {frame} of a scene with {len(self)} frames")
        return bisect_right(self.index.segments, frame, key=attrgetter("first")) - 1

    def codes(self, frame: int) -> Codes:
        """All Gaussians of a frame as integers, absent ones (opacity code 0) included; yours to change."""
        codes = self._seek(frame)
        return Codes(codes.xyz.copy(), codes.attributes.copy())

    def gaussians(self, frame: int, *, into: Gaussians | None = None) -> Gaussians:
        """All Gaussians of a frame as floats, in the order of `codes`; yours to change.

        With `into`, what the last call returned and nobody has changed, the same arrays come back with this frame in
        them if it lies in the same segment: only rows that may move are written.
        """
        codes = self._seek(frame)
        if self._shown and self._shown[0] is into and self._shown[1] == self._segment:
            dynamic = self.index.segments[self._segment].dynamic
            return self.header.quantizer.decode(codes[:dynamic], into=into)
        shown = self.header.quantizer.decode(codes)
        self._shown = shown, self._segment
        return shown

    def segment(self, number: int) -> Segment:
        """All frames of a segment, its rows in stored order. Raises IndexError outside the scene."""
        if not 0 <= number < len(self.index.segments):
            raise IndexError(f"segment {number} of a scene with {len(self.index.segments)}")
        entry = self.index.segments[number]
        key, moving = self.codes(entry.first), slice(0, entry.dynamic)
        xyz = np.empty((entry.frames - 1, entry.dynamic, 3), np.uint16)
        attributes = np.empty((entry.frames - 1, entry.dynamic, key.attributes.shape[1]), np.uint8)
        for step in range(1, entry.frames):
            codes = self._seek(entry.first + step)
            xyz[step - 1], attributes[step - 1] = codes.xyz[moving], codes.attributes[moving]
        return Segment(entry.first, key, np.arange(entry.rows) < entry.dynamic, xyz, attributes)

    def light(self, frame: int) -> np.ndarray:
        """Light of a frame, float64 [3]: natural logarithms of factors on linear light, r g b; 0 is steady.

        `codes` and `gaussians` are those of steady light: draw them, then see `packuv.colour.lit`; or change them by
        `packuv.gaussians.floats.lit_gaussians`. Raises IndexError outside the scene.
        """
        self.segment_at(frame)
        light: np.ndarray = self.header.light[frame].copy()
        return light

    def sound(self) -> Sound | None:
        """What was heard from the first frame on; None where the scene has no sound. Raises ValueError for sound that
        is damaged, or of a kind that this program does not know."""
        return read_sound(self.path, self.index.sound) if self.index.sound else None

    def _forget(self) -> None:
        self._segment = self._frame = -1
        self._playback = None

    def _seek(self, frame: int) -> Codes:
        """Bring the playback to a frame; on an error nothing half-done stays behind."""
        segment = self.segment_at(frame)
        reading_on = frame == self._frame + 1
        horizon = len(self) - 1 if reading_on else frame
        try:
            if self._playback is None or segment != self._segment or frame < self._frame:
                self._start(segment, horizon)
            while self._frame < frame:
                self._advance(horizon)
        except BaseException:
            self._forget()
            raise
        assert self._playback is not None
        return self._playback.codes

    def _start(self, number: int, horizon: int) -> None:
        """Load a segment's key, and before it those that it refers to unless they are at hand."""
        self._forget()
        way = self._way(number)
        for part in way:
            if part not in self._keys:
                self._keys[part] = self._load_key(part, self._next_picture(number, 0, horizon))
        self._keys = {part: self._keys[part] for part in way}
        entry, key = self.index.segments[number], self._keys[number]
        codes = Codes(key.xyz.copy(), key.attributes.copy())
        self._playback = Playback(codes, entry.dynamic, self.index.tolerance)
        self._segment, self._frame = number, entry.first

    def _way(self, number: int) -> list[int]:
        """Segments whose key pictures a segment's key is made of, from the root to itself."""
        way = [number]
        while (reference := self.index.segments[way[-1]].reference) is not None:
            way.append(reference)
        return way[::-1]

    def _load_key(self, number: int, picture: np.ndarray) -> Codes:
        """A segment's key from its own picture and the key that it refers to."""
        entry, track = self.index.segments[number], self.index.tracks[KEY]
        own = key_codes(track.mosaic.read(picture, track.constants, entry.own))
        if entry.reference is None:
            return own
        reference = self._keys[entry.reference]
        fates = track.mosaic.read_flags(picture, len(reference))
        key = assemble(reference, fates, own, entry.own_dynamic)
        if len(key) != entry.rows:
            raise ValueError(f"{self.path}: the key at frame {entry.first} has {len(key)} rows, not {entry.rows}")
        return key

    def _advance(self, horizon: int) -> None:
        """Add the next frame's residuals."""
        assert self._playback is not None
        entry = self.index.segments[self._segment]
        step = self._frame + 1 - entry.first
        prediction, differences = entry.predictions[step - 1], bool(entry.differences[step - 1])
        rows = NO_RESIDUALS
        if prediction != REPEAT:
            picture, track = self._next_picture(self._segment, step, horizon), self.index.tracks[DYNAMIC]
            count = self._playback.toggle(track.mosaic.read_flags(picture, entry.dynamic))
            rows = track.mosaic.read(picture, track.constants, count)
        self._playback.advance(prediction, differences, rows)
        self._frame += 1

    def _next_picture(self, number: int, step: int, horizon: int) -> np.ndarray:
        """The first picture that is needed from here on; those up to frame `horizon` may be decoded ahead."""
        wanted = self._wanted(number, step, horizon)
        return self._pictures.picture(next(wanted), wanted)

    def _wanted(self, number: int, step: int, horizon: int) -> Iterator[Address]:
        """Pictures that are needed from `step` frames after a segment's key on, up to a frame, in order."""
        known, segments = set(self._keys), self.index.segments
        for segment in range(number, len(segments)):
            entry = segments[segment]
            if entry.first > horizon and segment > number:
                return
            if step == 0:
                yield from (Address(KEY, k, segments[k].first) for k in self._way(segment) if k not in known)
                known.update(self._way(segment))
                step = 1
            packet = entry.packet(step)
            for prediction in entry.predictions[step - 1 : max(0, horizon - entry.first)]:
                if prediction != REPEAT:
                    yield Address(DYNAMIC, packet, entry.first + step)
                    packet += 1
                step += 1
            step = 0
