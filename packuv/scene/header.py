"""What a scene file says about its pictures: the header that travels as the attachment packuv.json.

docs/scene-format.md specifies it.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from typing import Any

import numpy as np

from packuv import bounds
from packuv.bounds import field as field_of
from packuv.camera import PinholeCamera
from packuv.files import parse_json
from packuv.gaussians.codes import Codes, Quantizer
from packuv.scene.matroska import VideoTrack
from packuv.scene.mosaic import BLOCK, Mosaic
from packuv.scene.stream import LINEAR, REPEAT, Tolerance, channel_names

FORMAT, VERSION, LAYOUT = "packuv-scene", 2, "compact"
HEADER, CHECKSUM = "packuv.json", "packuv.sha256"
"""Names of the two attachments; the second lets `sha256sum -c` check the first."""
KEY, DYNAMIC = 0, 1
"""Track numbers."""
TRACK_NAMES = ("key", "dynamic")
FLAG_NAMES = ("kept", "changed")
"""Names of the tracks' planes of flags."""
COMPRESSION = "compression"
"""Name of what `extra` says of a scene whose codes are coarser than those of the lossless one that it was made from"""
ADOPTED = "adopted"
"""Name of what `extra` says of a scene that was made of splat files"""
LENSES = "lenses"
"""Name of what `extra` says of the cameras as they film"""
LIGHT_STEPS = 100_000
"""Light is stored in steps of 1 / LIGHT_STEPS, a thousandth of a percent"""


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
    light: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    """float64 [T, 3]: light of each frame, natural logarithms of factors on linear light, r g b; none given: all 0.
    The Gaussians are those of steady light. Rounded to LIGHT_STEPS, as the file holds it"""

    def __post_init__(self) -> None:
        if self.times_ns.dtype != np.int64 or self.times_ns.ndim != 1:
            raise ValueError(f"frame times must be int64 [T], but are {self.times_ns.dtype} {self.times_ns.shape}")
        if len(self.times_ns) > bounds.MOST_FRAMES:
            raise ValueError(f"a scene has at most {bounds.MOST_FRAMES} frames, but this one {len(self.times_ns)}")
        if (self.times_ns > bounds.MOST_NS).any() or (self.times_ns < -bounds.MOST_NS).any():
            raise ValueError(f"frame times must lie within {bounds.MOST_NS} ns of 0")
        object.__setattr__(self, "light", _checked_light(self.light, len(self.times_ns)))
        if not self.rate > 0:
            raise ValueError(f"the frame rate must be positive, but is {self.rate}")
        unknown = set(self.held_out) - {camera.name for camera in self.cameras}
        if unknown:
            raise ValueError(f"held-out cameras {sorted(unknown)} are not among the scene's cameras")
        near = self.extra.get("near")
        if near is not None:
            bounds.positive(near, "the scene's near plane, extra.near,")
        _ = self.up
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
        milliseconds: np.ndarray = (self.times_ns - self.times_ns[:1] + 500_000) // 1_000_000
        return milliseconds

    def seconds_to(self, frame: int) -> float:
        """From the first frame to another one."""
        return int(self.times_ns[frame] - self.times_ns[0]) / 1e9

    @property
    def seconds(self) -> float:
        """Of the whole scene, with its last frame."""
        return self.seconds_to(-1) + float(1 / self.rate)

    @property
    def near(self) -> float:
        """Depth before which nothing is drawn, world; raises ValueError where the scene does not say."""
        return float(field_of(self.extra, "near", "the scene's header: extra"))

    @property
    def filmed(self) -> bool:
        """Whether its cameras filmed it: splat files come without any, and get some to be looked at from."""
        return bool(self.cameras) and ADOPTED not in self.extra

    @property
    def up(self) -> tuple[float, float, float] | None:
        """Where up is, world, a unit vector; None where the scene does not say."""
        given = self.extra.get("up")
        if given is None:
            return None
        x, y, z = bounds.numbers(given, "the scene's up, extra.up,", (3,)).tolist()
        if not 0.99 < math.hypot(x, y, z) < 1.01:
            raise ValueError(f"the scene's up, extra.up, must be a unit vector, but is {bounds.shown(given)}")
        return x, y, z

    def first(self, frames: int) -> SceneHeader:
        """The header of a scene that ends after so many frames."""
        return replace(self, times_ns=self.times_ns[:frames], light=self.light[:frames])

    def to_json(self) -> dict[str, Any]:
        return {
            "quantizer": self.quantizer.to_json(),
            "times_ns": self.times_ns.tolist(),
            "rate": f"{self.rate.numerator}/{self.rate.denominator}",
            "cameras": [camera.to_json() for camera in self.cameras],
            "held_out": list(self.held_out),
            "sync": dict(self.sync),
            "extra": dict(self.extra),
            # Absent in steady light, so that scenes of it keep their bytes.
            **({"light": _light_steps(self.light).T.tolist()} if self.light.any() else {}),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SceneHeader:
        what = "a scene's header"
        quantizer, times, rate, cameras, held_out, sync, extra = (
            field_of(data, name, what)
            for name in ("quantizer", "times_ns", "rate", "cameras", "held_out", "sync", "extra")
        )
        times_ns = np.array(bounds.wholes(times, "times_ns", least=-bounds.MOST_NS, most=bounds.MOST_NS), np.int64)
        return cls(
            Quantizer.from_json(quantizer),
            times_ns,
            bounds.rate_of(rate, "rate"),
            tuple(map(PinholeCamera.from_json, bounds.items(cameras, "cameras", most=bounds.MOST_CAMERAS))),
            _texts(held_out, "held_out", most=bounds.MOST_CAMERAS),
            bounds.fields(sync, "sync"),
            bounds.fields(extra, "extra"),
            _light_of(data.get("light", []), len(times_ns)),
        )


def _checked_light(light: np.ndarray, frames: int) -> np.ndarray:
    """Light as the file holds it, float64 [frames, 3]."""
    light = np.asarray(light, np.float64)
    if light.shape == (0, 3):
        return np.zeros((frames, 3))
    if light.shape != (frames, 3):
        raise ValueError(f"light must be {(frames, 3)}, r g b of each frame, but is {light.shape}")
    if not (np.abs(light) <= bounds.MOST_LIGHT).all():
        raise ValueError(f"light must hold natural logarithms within {bounds.MOST_LIGHT:g} of 0")
    if frames > bounds.MOST_LIT_FRAMES and light.any():
        raise ValueError(f"a scene whose light changes has at most {bounds.MOST_LIT_FRAMES} frames, not {frames}")
    return _light_steps(light) / LIGHT_STEPS


def _light_steps(light: np.ndarray) -> np.ndarray:
    steps: np.ndarray = np.rint(light * LIGHT_STEPS).astype(np.int64)
    return steps


def _light_of(value: object, frames: int) -> np.ndarray:
    """float64 [frames, 3] of what a header says; none where it lists nothing."""
    channels = bounds.items(value, "light", most=3)
    if len(channels) not in (0, 3):
        raise ValueError(f"light must hold three lists, red, green and blue, but holds {len(channels)}")
    most = round(bounds.MOST_LIGHT * LIGHT_STEPS)
    steps = [bounds.wholes(channel, "light", least=-most, most=most, count=frames) for channel in channels]
    return np.array(steps, np.float64).T.reshape(-1, 3) / LIGHT_STEPS


def _texts(value: object, what: str, *, most: int) -> tuple[str, ...]:
    return tuple(bounds.words(item, what) for item in bounds.items(value, what, most=most))


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
    reference: int | None
    """Earlier segment from whose key it takes rows"""
    own: int
    """Number of rows that its own key picture holds"""
    own_dynamic: int
    """Of these, how many may change: the first ones"""
    first_packet: int
    """Number of its first packet in the dynamic track; its key is packet s of the key track, s being its own number"""
    predictions: tuple[int, ...]
    """Of each frame after the key: REPEAT (no packet), PREVIOUS or LINEAR"""
    differences: tuple[int, ...]
    """Of each frame after the key: 1 where colour residuals are stored as differences to green"""

    @classmethod
    def from_json(cls, data: Mapping[str, Any], number: int) -> SegmentEntry:
        what = f"segment {number}"
        found = {item.name: field_of(bounds.fields(data, what), item.name, what) for item in fields(cls)}

        def count(name: str, most: int) -> int:
            return bounds.whole(found[name], f"{what}: {name}", most=most)

        def steps(name: str, most: int) -> tuple[int, ...]:
            return tuple(bounds.wholes(found[name], f"{what}: {name}", most=most, count=frames - 1))

        frames = bounds.whole(found["frames"], f"{what}: frames", least=1, most=bounds.MOST_FRAMES)
        return cls(
            first=count("first", bounds.MOST_FRAMES),
            frames=frames,
            rows=count("rows", bounds.MOST_GAUSSIANS),
            dynamic=count("dynamic", bounds.MOST_GAUSSIANS),
            reference=None if found["reference"] is None else count("reference", bounds.MOST_FRAMES),
            own=count("own", bounds.MOST_GAUSSIANS),
            own_dynamic=count("own_dynamic", bounds.MOST_GAUSSIANS),
            first_packet=count("first_packet", bounds.MOST_FRAMES),
            predictions=steps("predictions", LINEAR),
            differences=steps("differences", 1),
        )

    def packet(self, step: int) -> int:
        """Packet of the frame `step` frames after the key; meaningless for REPEAT."""
        return self.first_packet + sum(p != REPEAT for p in self.predictions[: step - 1])


@dataclass(frozen=True)
class TrackEntry:
    """A track's picture layout, and what its packets must be."""

    mosaic: Mosaic
    constants: np.ndarray
    """uint8 [channels]: the value of every row in channels without a plane"""
    slices: int
    """Of a picture in FFV1"""
    sizes: tuple[int, ...] = ()
    """Bytes of each packet"""
    crc32: tuple[int, ...] = ()
    """CRC-32 (zlib's) of each packet; FFmpeg reports no failed slice checksum to its caller"""

    def video(self, number: int) -> VideoTrack:
        return VideoTrack(TRACK_NAMES[number], self.mosaic.width, self.mosaic.height, self.slices)

    def to_json(self, number: int, names: Sequence[str]) -> dict[str, Any]:
        mosaic = self.mosaic
        missing = set(range(mosaic.channel_count)) - set(mosaic.channels)
        flags = [FLAG_NAMES[number]] if mosaic.flagged else []
        return {
            "name": TRACK_NAMES[number],
            "width": mosaic.width,
            "height": mosaic.height,
            "planes": [names[channel] for channel in mosaic.channels] + flags,
            "planes_across": mosaic.grid[0],
            "block": BLOCK,
            "blocks_across": mosaic.blocks_across,
            "blocks_down": mosaic.blocks_down,
            "constants": {names[channel]: int(self.constants[channel]) for channel in sorted(missing)},
            "slices": self.slices,
            "sizes": list(self.sizes),
            "crc32": list(self.crc32),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], names: Sequence[str]) -> TrackEntry:
        title = bounds.words(field_of(bounds.fields(data, "a track"), "name", "a track"), "a track's name")
        what = f"track {title!r}"
        given = {name: field_of(data, name, what) for name in ("planes", "constants", "slices", "sizes", "crc32")}
        planes = _texts(given["planes"], f"{what}: planes", most=len(names) + 1)
        flagged = bool(planes) and planes[-1] in FLAG_NAMES
        named, fixed = planes[: len(planes) - flagged], bounds.fields(given["constants"], f"{what}: constants")
        if sorted((*named, *fixed)) != sorted(names):
            raise ValueError(f"{what} must give every channel either a plane or a constant")
        constants = np.zeros(len(names), np.uint8)
        for name, value in fixed.items():
            constants[names.index(name)] = bounds.whole(value, f"{what}: constant {name}", most=255)
        return cls(
            cls._mosaic(data, what, Mosaic(tuple(map(names.index, named)), len(names), 1, 1, flagged)),
            constants,
            bounds.whole(given["slices"], f"{what}: slices", least=1, most=1024),
            tuple(bounds.wholes(given["sizes"], f"{what}: sizes", most=bounds.MOST_PIXELS)),
            tuple(bounds.wholes(given["crc32"], f"{what}: crc32", most=2**32 - 1)),
        )

    @staticmethod
    def _mosaic(data: Mapping[str, Any], what: str, planes: Mosaic) -> Mosaic:
        """The layout of these planes that a track states."""
        sides = {
            name: bounds.whole(field_of(data, name, what), f"{what}: {name}", least=1, most=bounds.MOST_SIDE_PX)
            for name in ("blocks_across", "blocks_down", "width", "height", "planes_across", "block")
        }
        bounds.check_picture(sides["width"], sides["height"], what)
        mosaic = replace(planes, blocks_across=sides["blocks_across"], blocks_down=sides["blocks_down"])
        stated = tuple(sides[name] for name in ("width", "height", "planes_across", "block"))
        if (mosaic.width, mosaic.height, mosaic.grid[0], BLOCK) != stated:
            raise ValueError(f"{what} has an unknown picture layout")
        return mosaic


@dataclass(frozen=True)
class SoundEntry:
    """What the sound of a scene must be."""

    camera: str
    """That heard it"""
    codec: str
    sample_rate: int
    channels: int
    samples: int
    """Of each channel"""
    sha256: str
    """Of the FLAC file that the track's STREAMINFO and packets make"""

    @property
    def seconds(self) -> float:
        return self.samples / self.sample_rate

    @classmethod
    def from_json(cls, data: object) -> SoundEntry:
        found = {item.name: field_of(bounds.fields(data, "sound"), item.name, "sound") for item in fields(cls)}

        def words(name: str) -> str:
            return bounds.words(found[name], f"sound: {name}")

        def count(name: str, least: int, most: int) -> int:
            return bounds.whole(found[name], f"sound: {name}", least=least, most=most)

        return cls(
            words("camera"),
            words("codec"),
            count("sample_rate", 1, bounds.MOST_SAMPLE_RATE),
            count("channels", 1, bounds.MOST_SOUND_CHANNELS),
            count("samples", 0, bounds.MOST_SAMPLES),
            words("sha256"),
        )


class HeaderDamageError(ValueError):
    """A header that is not the one that was written."""


@dataclass(frozen=True)
class SceneIndex:
    """All that packuv.json holds."""

    header: SceneHeader
    tolerance: Tolerance
    """By how much frames after a key may differ from what was fitted"""
    tracks: tuple[TrackEntry, ...]
    """The key track and, if anything ever changes, the dynamic track"""
    segments: tuple[SegmentEntry, ...]
    digests: tuple[str, ...]
    """`codes_digest` of each frame's codes"""
    tools: Mapping[str, str]
    """Versions of the programs that wrote the file"""
    sound: SoundEntry | None = None
    """What the sound must be that goes along, if any does"""

    @property
    def heard(self) -> str:
        """Name of the camera that heard the sound; empty where there is none."""
        return self.sound.camera if self.sound else ""

    def __post_init__(self) -> None:
        frames = sum(segment.frames for segment in self.segments)
        if not frames == len(self.header.times_ns) == len(self.digests) or not self.tracks:
            raise ValueError(
                f"{frames} frames in segments, {len(self.header.times_ns)} times, {len(self.digests)} digests, "
                f"{len(self.tracks)} tracks do not belong together"
            )
        first, depths = 0, list[int]()
        for number, segment in enumerate(self.segments):
            depths.append(self._depth(segment, depths))
            if segment.first != first or not self._fits(number, segment):
                raise ValueError(f"the segment at frame {segment.first} does not fit the scene's tracks")
            first += segment.frames

    def _depth(self, segment: SegmentEntry, depths: Sequence[int]) -> int:
        """Number of keys that a segment's key is made of, given those of the segments before it."""
        if segment.reference is None or not 0 <= segment.reference < len(depths):
            return 1  # the latter does not fit
        if depths[segment.reference] == bounds.MOST_REFERENCES:
            raise ValueError(
                f"the key at frame {segment.first} is made of more than {bounds.MOST_REFERENCES} keys, one of another"
            )
        return depths[segment.reference] + 1

    def _fits(self, number: int, segment: SegmentEntry) -> bool:
        key, mosaic = self.tracks[KEY], self.tracks[KEY].mosaic
        after_key = len(segment.predictions) == len(segment.differences) == segment.frames - 1
        counts = 0 <= segment.dynamic <= segment.rows and 0 <= segment.own_dynamic <= segment.own <= segment.rows
        if segment.reference is None:
            complete = (segment.own, segment.own_dynamic) == (segment.rows, segment.dynamic)
        else:
            earlier = 0 <= segment.reference < number
            complete = earlier and mosaic.flagged and self.segments[segment.reference].rows <= mosaic.capacity
        stored = number < len(key.crc32) == len(key.sizes) and segment.own <= mosaic.capacity
        return after_key and counts and complete and stored and self._fits_dynamic(segment)

    def _fits_dynamic(self, segment: SegmentEntry) -> bool:
        if len(self.tracks) == 1:
            return not set(segment.predictions) - {REPEAT}
        track = self.tracks[DYNAMIC]
        packets = segment.first_packet >= 0 and segment.packet(segment.frames) <= len(track.crc32) == len(track.sizes)
        return packets and track.mosaic.flagged and segment.dynamic <= track.mosaic.capacity

    def to_json(self) -> dict[str, Any]:
        names = channel_names(self.header.quantizer.sh_degree)
        return {
            "format": FORMAT,
            "version": VERSION,
            "layout": LAYOUT,
            "tolerance": vars(self.tolerance),
            "channels": list(names),
            "tracks": [entry.to_json(number, names) for number, entry in enumerate(self.tracks)],
            "segments": [vars(segment) for segment in self.segments],
            "digests": list(self.digests),
            "tools": dict(self.tools),
            # Absent where nothing is heard, so that such scenes keep their bytes.
            **({"sound": vars(self.sound)} if self.sound else {}),
            **self.header.to_json(),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SceneIndex:
        kind, version, layout = (
            field_of(bounds.fields(data, HEADER), name, "it") for name in ("format", "version", "layout")
        )
        if (kind, version, layout) != (FORMAT, VERSION, LAYOUT):
            said = [bounds.shown(value).strip("'") for value in (kind, version, layout)]
            raise ValueError(
                f"it is {said[0]} version {said[1]}, layout {said[2]}; this program reads "
                f"{FORMAT} version {VERSION}, layout {LAYOUT}"
            )
        header = SceneHeader.from_json(data)
        names = list(channel_names(header.quantizer.sh_degree))
        tracks, segments, digests, tools = (
            field_of(data, name, "a scene's header") for name in ("tracks", "segments", "digests", "tools")
        )
        most = bounds.MOST_FRAMES
        return cls(
            header,
            _tolerance(field_of(data, "tolerance", "a scene's header")),
            tuple(TrackEntry.from_json(track, names) for track in bounds.items(tracks, "tracks", most=2)),
            tuple(
                SegmentEntry.from_json(segment, number)
                for number, segment in enumerate(bounds.items(segments, "segments", most=most))
            ),
            _texts(digests, "digests", most=most),
            {
                bounds.words(name, "tools"): bounds.words(value, f"tools: {name}")
                for name, value in bounds.fields(tools, "tools").items()
            },
            SoundEntry.from_json(data["sound"]) if "sound" in data else None,
        )

    def encode(self) -> dict[str, tuple[str, bytes]]:
        """The attachments of the file: name -> MIME type, content."""
        document = json.dumps(self.to_json(), sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
        if len(document) > bounds.MOST_JSON_BYTES:
            raise ValueError(
                f"a scene's header has at most {bounds.MOST_JSON_BYTES} bytes, but this one {len(document)}; "
                "write fewer frames, or less extra"
            )
        checksum = f"{hashlib.sha256(document).hexdigest()}  {HEADER}\n".encode()
        return {HEADER: ("application/json", document), CHECKSUM: ("text/plain", checksum)}

    @classmethod
    def decode(cls, attachments: Mapping[str, bytes]) -> SceneIndex:
        """The inverse of `encode`.

        Raises HeaderDamageError for attachments that are missing or damaged, ValueError for those that make no sense.
        """
        for name in (HEADER, CHECKSUM):
            if name not in attachments:
                raise HeaderDamageError(f"it is not a whole PackUV scene, it lacks the attachment {name}")
        document = attachments[HEADER]
        if attachments[CHECKSUM][:200].decode(errors="replace").split() != [
            hashlib.sha256(document).hexdigest(),
            HEADER,
        ]:
            raise HeaderDamageError(f"its header {HEADER} is damaged, it does not match {CHECKSUM}")
        try:
            return cls.from_json(parse_json(document, "it"))
        except ValueError as error:
            raise ValueError(f"its header {HEADER} cannot be read: {error}") from None


def _tolerance(data: object) -> Tolerance:
    found = bounds.fields(data, "tolerance")
    position, attribute = (
        bounds.whole(field_of(found, name, "tolerance"), f"tolerance: {name}", most=65535)
        for name in ("position", "attribute")
    )
    return Tolerance(position, attribute)


def codes_digest(codes: Codes) -> str:
    """BLAKE2b of 16 bytes, in hex, over the positions (little-endian, row by row), then the attributes."""
    hasher = hashlib.blake2b(np.ascontiguousarray(codes.xyz, dtype="<u2").data, digest_size=16)
    hasher.update(np.ascontiguousarray(codes.attributes).data)
    return hasher.hexdigest()
