"""What other programs' formats make of a scene: its frames through their doors of `packuv.interchange`, and back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from packuv.each import spread
from packuv.gaussians.floats import SH_C0, Gaussians, arrays, drawn, logit
from packuv.interchange import WRITTEN, SplatFormat, read_gaussians, write_gaussians
from packuv.interchange.clip import Clip, ClipOptions
from packuv.interchange.conventions import half_turn
from packuv.interchange.fourdgs import SH_REACH
from packuv.metrics import decibels
from packuv.scene import Scene
from packuv.score import Artist

MEASURED = tuple(
    kind for kind in WRITTEN if kind == SplatFormat.FOURDGS or (kind.door.read is not None and kind.door.write)
)
"""Formats that are written here and read again, by us or by their own library"""
USUAL = (SplatFormat.FOURDGS, SplatFormat.SPZ, SplatFormat.SOG)
"""Those that others play sequences in"""


class Pictures:
    """Pictures of a scene at some frames, on cameras that were not fitted, or on three where all were."""

    def __init__(self, scene: Scene, *, frames: int) -> None:
        self.frames = spread(range(len(scene)), frames)
        header = scene.header
        names = header.held_out or spread([camera.name for camera in header.cameras], 3)
        self._cameras = [camera for camera in header.cameras if camera.name in names]
        self._artist = Artist(scene) if self._cameras else None
        self._truth = [self._draw(scene.gaussians(frame)) for frame in self.frames]

    def _draw(self, gaussians: Gaussians) -> list[np.ndarray]:
        laid_out = Gaussians(*map(np.ascontiguousarray, arrays(gaussians)))  # as a file has them they may be columns
        return [self._artist.draw(laid_out, camera) for camera in self._cameras] if self._artist else []

    def psnr(self, show: Callable[[int], Gaussians]) -> float | None:
        """Of what is shown at a frame, over frames and cameras together, dB; None without cameras, or where equal."""
        errors = [
            np.square(picture - truth, dtype=np.float64).mean()
            for frame, expected in zip(self.frames, self._truth, strict=True)
            for picture, truth in zip(self._draw(show(frame)), expected, strict=True)
        ]
        mean = float(np.mean(errors)) if errors else 0.0
        return decibels(mean) if mean else None


@dataclass
class _Trip:
    """Frames that went out and came back."""

    bytes: int = 0
    frames: int = 0
    """That these bytes hold"""
    wrote_seconds: float = 0.0
    read_seconds: float = 0.0
    shown: dict[int, Gaussians] = field(default_factory=dict)


def measure_doors(scene: Scene, kinds: Sequence[SplatFormat], pictures: Pictures, folder: Path) -> Iterator[Any]:
    """A row for each format, in steady light, absent Gaussians left out.

    A format of single frames is a file a frame, of which those that are drawn are written and the rest is
    extrapolated. Seconds are from the scene file to the format's, and from there to Gaussians.
    """
    rows = sum(segment.rows * segment.frames for segment in scene.index.segments)
    for kind in kinds:
        try:
            trip = (
                _sequence(kind, scene, pictures.frames, folder)
                if kind.door.write_clip
                else _files(kind, scene, pictures.frames, folder)
            )
        except ValueError as error:  # its library is not there
            yield {"layout": str(kind), "skipped": str(error)}
            continue
        size = trip.bytes * len(scene) / trip.frames
        exact = all(_equal(trip.shown[frame], drawn(scene.gaussians(frame))) for frame in pictures.frames)
        yield {
            "layout": str(kind),
            "exact": exact,
            "lacks": kind.door.lacks,
            "bytes": round(size),
            "frames": len(scene),
            "frames_measured": trip.frames,
            "bits_per_gaussian_and_frame": size * 8 / rows,
            "encode_seconds_per_frame": trip.wrote_seconds / trip.frames,
            "decode_seconds_per_frame": trip.read_seconds / len(trip.shown),
            "psnr_to_lossless_db": pictures.psnr(trip.shown.__getitem__),
        }


def _files(kind: SplatFormat, scene: Scene, frames: Sequence[int], folder: Path) -> _Trip:
    """A file for each of the frames."""
    trip = _Trip(frames=len(frames))
    for frame in frames:
        path, start = folder / f"{frame:06}{kind.suffix}", time.perf_counter()
        write_gaussians(path, scene.gaussians(frame), kind=kind)
        written = time.perf_counter()
        trip.shown[frame] = read_gaussians(path)
        trip.wrote_seconds += written - start
        trip.read_seconds += time.perf_counter() - written
        trip.bytes += path.stat().st_size
    return trip


def _sequence(kind: SplatFormat, scene: Scene, frames: Sequence[int], folder: Path) -> _Trip:
    """All frames in one file, of which some are shown; all share the time to open it."""
    path, start = folder / f"clip{kind.suffix}", time.perf_counter()
    clip = Clip(scene, range(len(scene)), ClipOptions(bake_light=False))
    assert kind.door.write_clip is not None
    kind.door.write_clip(path, clip)
    trip = _Trip(path.stat().st_size, len(scene), time.perf_counter() - start)
    start = time.perf_counter()
    show = _played(path, clip)
    opened = time.perf_counter() - start
    trip.shown = {frame: show(frame) for frame in frames}
    shown = time.perf_counter() - start - opened
    trip.read_seconds = shown + opened * len(frames) / len(scene)
    return trip


def _played(path: Path, clip: Clip) -> Callable[[int], Gaussians]:
    """The Gaussians of a .4dgs file at a frame of its clip, as its own library has them."""
    import fourdgs

    whole = fourdgs.read(str(path)).gaussians
    starts = np.append(clip.seconds, clip.seconds[-1:] + float(1 / clip.rate))

    def show(frame: int) -> Gaussians:
        state = whole.state_at((starts[frame] + starts[frame + 1]) / 2)
        rows = state["indices"]
        sh = [(whole.colors[rows, None, :3] - 0.5) / SH_C0]
        if whole.sh_degree:
            bands = whole.sh[rows].reshape(len(rows), 3, -1).transpose(0, 2, 1)
            sh.append(bands / 255 * (2 * SH_REACH) - SH_REACH)
        turns, scales = state["orientations"][:, [3, 0, 1, 2]], np.log(whole.scales[rows])
        values = state["centers"], scales, turns, logit(state["opacity"]), np.concatenate(sh, axis=1)
        return half_turn(Gaussians(*(np.asarray(value, np.float32) for value in values)))

    return show


def _equal(a: Gaussians, b: Gaussians) -> bool:
    return all(map(np.array_equal, arrays(a), arrays(b)))
