"""What the viewer shows: a scene file, or segments in memory, and how the page is told of it."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.codes import Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvsize import UvOptions
from packuv.scene import Scene, open_scene

NEAR_SHARE = 0.02
"""Near plane as a share of the cameras' median distance from their centre, where the scene names none"""

CACHE_BYTES = 64 << 20
"""Dynamic rows that a scene file keeps decoded: requests arrive slightly out of order, and going back costs a key"""

KEPT_KEYS = 4
"""Keyframes that a scene file keeps decoded: that of a segment and those it takes rows from, and the next segment's"""


class Source(Protocol):
    """A dynamic scene as the server reads it; frames and segments count from 0. One thread at a time asks."""

    @property
    def name(self) -> str: ...

    @property
    def rate(self) -> Fraction:
        """Nominal frames per second."""

    @property
    def times_ns(self) -> np.ndarray:
        """int64 [T]: when each frame was filmed."""

    @property
    def light(self) -> np.ndarray:
        """float64 [T, 3]: natural logarithms of each frame's light, r g b; 0 is steady."""

    @property
    def quantizer(self) -> Quantizer: ...

    @property
    def cameras(self) -> tuple[PinholeCamera, ...]:
        """Cameras of the capture, to jump to; may be empty."""

    @property
    def held_out(self) -> frozenset[str]:
        """Names of the cameras that the fit never saw."""

    @property
    def near(self) -> float | None:
        """Depth before which renders of this scene draw nothing, world; None to derive it from the cameras."""

    @property
    def up(self) -> tuple[float, float, float] | None:
        """Where up is, world, a unit vector; None to derive it from the cameras."""

    @property
    def metric(self) -> bool:
        """Whether a world unit is a metre."""

    @property
    def heard(self) -> str:
        """Name of the camera that heard the sound of the scene; empty where it has none."""

    def sound(self) -> bytes:
        """A FLAC file of what was heard from the first frame on; empty where nothing was."""

    @property
    def segments(self) -> tuple[range, ...]:
        """Frames of each segment without a gap; the first of each is its keyframe."""

    def key(self, segment: int) -> Codes:
        """All N Gaussians of a segment at its keyframe."""

    def dynamic(self, segment: int) -> np.ndarray:
        """bool [N]: the D rows that may differ from the keyframe within the segment."""

    def reference(self, segment: int) -> int | None:
        """An earlier segment whose key shares rows with this one's, if that is worth a look."""

    def moving(self, frame: int) -> Codes:
        """The D dynamic rows of a frame."""


class Truth(Protocol):
    """What cameras filmed, to lay beside a scene; any thread asks."""

    @property
    def cameras(self) -> tuple[str, ...]: ...

    def picture(self, camera: str, frame: int) -> np.ndarray | None:
        """uint8 [H, W, 3], RGB: undistorted, in the scene's colours and the light of the frame; None without one."""


@dataclass(frozen=True)
class SegmentSource:
    """Fitted segments in memory, before there is a scene file."""

    parts: tuple[Segment, ...]
    quantizer: Quantizer
    rate: Fraction = Fraction(30)
    cameras: tuple[PinholeCamera, ...] = ()
    name: str = "segments"
    held_out: frozenset[str] = field(default=frozenset())
    near: float | None = None
    up: tuple[float, float, float] | None = None
    metric: bool = False
    heard: str = ""

    def __post_init__(self) -> None:
        if not self.parts:
            raise ValueError("there is nothing to show without a segment; fit one first")
        ends = [part.first + len(part) for part in self.parts]
        for end, part in zip(ends, self.parts[1:], strict=False):
            if part.first != end:
                raise ValueError(
                    f"segments must follow one another, but one ends at {end}, the next begins at {part.first}"
                )

    @property
    def times_ns(self) -> np.ndarray:
        return np.array([int(index * 10**9 / self.rate) for index in range(self.segments[-1].stop)], dtype=np.int64)

    @property
    def light(self) -> np.ndarray:
        return np.zeros((len(self.times_ns), 3))

    def sound(self) -> bytes:
        return b""

    @property
    def segments(self) -> tuple[range, ...]:
        start = self.parts[0].first
        return tuple(range(part.first - start, part.first - start + len(part)) for part in self.parts)

    def key(self, segment: int) -> Codes:
        return self.parts[segment].key

    def dynamic(self, segment: int) -> np.ndarray:
        return self.parts[segment].dynamic

    def reference(self, segment: int) -> int | None:
        return None

    def moving(self, frame: int) -> Codes:
        segment, offset = locate(self.segments, frame)
        part = self.parts[segment]
        return part.key[part.dynamic] if offset == 0 else Codes(part.xyz[offset - 1], part.attributes[offset - 1])


class SceneSource:
    """An open scene file. Its rows are in storage order: a segment's dynamic rows come first."""

    def __init__(self, scene: Scene) -> None:
        header = scene.header
        self._scene = scene
        self.name, self.rate, self.times_ns = scene.path.name, header.rate, header.times_ns
        self.light = header.light
        self.quantizer, self.cameras, self.held_out = header.quantizer, header.cameras, frozenset(header.held_out)
        self.near: float | None = header.extra.get("near")
        self.up = header.up
        self.metric = header.extra.get("metric") is True
        self.heard = scene.index.heard
        self.segments = tuple(range(entry.first, entry.first + entry.frames) for entry in scene.index.segments)
        self._keys: OrderedDict[int, Codes] = OrderedDict()
        self._moving: OrderedDict[int, Codes] = OrderedDict()
        self._rows = 0  # of all that is kept there
        self._last = -1  # frame at which the scene stands

    def sound(self) -> bytes:
        found = self._scene.sound()
        return found.flac if found else b""

    def key(self, segment: int) -> Codes:
        if segment not in self._keys:
            self._keys[segment] = self._read(self.segments[segment].start)
            while len(self._keys) > KEPT_KEYS:
                self._keys.popitem(last=False)
        return self._keys[segment]

    def dynamic(self, segment: int) -> np.ndarray:
        entry = self._scene.index.segments[segment]
        return np.arange(entry.rows) < entry.dynamic

    def reference(self, segment: int) -> int | None:
        return self._scene.index.segments[segment].reference

    def moving(self, frame: int) -> Codes:
        if frame not in self._moving:
            segment, _ = locate(self.segments, frame)
            on_the_way = self._last in self.segments[segment] and self._last < frame
            for index in range(self._last + 1 if on_the_way else self.segments[segment].start, frame + 1):
                self._keep(index, self._read(index)[: self._scene.index.segments[segment].dynamic])
        return self._moving[frame]

    def _read(self, frame: int) -> Codes:
        codes = self._scene.codes(frame)
        self._last = frame
        return codes

    def _keep(self, frame: int, codes: Codes) -> None:
        before = self._moving.pop(frame, None)
        self._moving[frame] = Codes(codes.xyz.copy(), codes.attributes.copy())  # a view would keep all rows alive
        self._rows += len(codes) - (len(before) if before else 0)
        row_bytes = codes.xyz.itemsize * 3 + codes.attributes.shape[1]
        while len(self._moving) > 1 and self._rows * row_bytes > CACHE_BYTES:
            self._rows -= len(self._moving.popitem(last=False)[1])


@contextmanager
def open_source(path: Path) -> Iterator[SceneSource]:
    """A scene file to show; raises what `packuv.scene.reader.open_scene` raises."""
    with open_scene(path) as scene:
        yield SceneSource(scene)


def locate(segments: Sequence[range], frame: int) -> tuple[int, int]:
    """Segment and offset within it; raises IndexError outside the scene."""
    if not 0 <= frame < segments[-1].stop:
        raise IndexError(f"frame {frame} of a scene with {segments[-1].stop} frames")
    segment = bisect_right(segments, frame, key=attrgetter("start")) - 1
    return segment, frame - segments[segment].start


def describe(source: Source) -> dict[str, Any]:
    """The scene in words and numbers: what the page reads first."""
    quantizer = source.quantizer
    return {
        "name": source.name,
        "rate": [source.rate.numerator, source.rate.denominator],
        "steps_ns": np.diff(source.times_ns).tolist(),
        "sh_degree": quantizer.sh_degree,
        "columns": attribute_count(quantizer.sh_degree),
        "centre": quantizer.centre.tolist(),
        "tables": tables(quantizer),
        "near": near_plane(source),
        "metric": source.metric,
        "layers": UvOptions.layers,
        "segments": [{"first": frames.start, "length": len(frames)} for frames in source.segments],
        "cameras": [{**camera.to_json(), "held_out": camera.name in source.held_out} for camera in source.cameras],
        **({"light": source.light.tolist()} if source.light.any() else {}),
        **({"up": list(source.up)} if source.up else {}),
        **({"sound": source.heard} if source.heard else {}),
    }


def near_plane(source: Source) -> float:
    """Depth of the near plane, world: the scene's own, or a share of the rig's radius."""
    if source.near is not None:
        return source.near
    if not source.cameras:
        return NEAR_SHARE * source.quantizer.unit
    centres = np.array([camera.centre for camera in source.cameras])  # [C, 3]
    radius = float(np.median(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))
    return NEAR_SHARE * (radius or source.quantizer.unit)


def tables(quantizer: Quantizer) -> dict[str, Any]:
    """The quantizer's tables as rules that any IEEE arithmetic follows to the last bit, and where they miss."""
    growth = np.exp(np.log1p(quantizer.reach / quantizer.unit) / 65535)  # [3], of the logarithmic scale, by half a code
    guess, exact = _followed(quantizer.centre, quantizer.unit, growth), quantizer.xyz_table
    missed = zip(*np.nonzero(guess != exact), strict=True)
    return {
        "unit": quantizer.unit,
        "growth": growth.tolist(),
        "except": [[int(axis), int(code), float(exact[axis, code])] for axis, code in missed],
        "low": quantizer.low.tolist(),
        "step": ((quantizer.high - quantizer.low) / 255).tolist(),
    }


def _followed(centre: np.ndarray, unit: float, growth: np.ndarray) -> np.ndarray:
    """Positions float32 [3, 65536] by products alone: of two machines, exponentials may differ in the last bit."""
    powers = np.repeat((growth * growth)[:, None], 32768, axis=1)
    powers[:, 0] = growth
    away = unit * (np.multiply.accumulate(powers, axis=1) - 1)  # of codes 32768 to 65535
    return np.concatenate([centre[:, None] - away[:, ::-1], centre[:, None] + away], axis=1).astype(np.float32)
