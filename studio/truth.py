"""The ground truth of a synthetic capture, written by `simulate` and read back for tests and benchmarks.

truth/truth.json holds everything small. truth/<camera>.npz holds what is exact per pixel: what stands still once,
and for each frame the object map and the pixels of movers. docs/simulate.md names every field.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from studio.clocks import CameraTimes
from studio.film_set import MOVING, OBJECTS
from studio.light import LensShading
from studio.raycast import Hits, Motion
from studio.rig import StudioCamera

VERSION = 3
MOVES, SEEN = 1, 2
"""Bits of the flags"""


class Recording(NamedTuple):
    """What is decided about a camera before it films."""

    camera: StudioCamera
    times: CameraTimes
    gains: np.ndarray
    """float64 [3]: factors r g b on linear light that its exposure and white balance apply"""
    exposure: np.ndarray
    """float64 [frames]: factor on top by recorded frame"""
    shading: LensShading


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """What is exact per pixel of one recorded frame, at the ray through the pixel's centre."""

    depth: np.ndarray
    """float32 [H, W]: along the camera's z axis, metres"""
    object: np.ndarray
    """uint8 [H, W]: index into `Truth.objects`"""
    flow: np.ndarray
    """float32 [H, W, 2]: x and y displacement to the camera's next recorded frame, pixels; see `CameraTimes`"""
    moves: np.ndarray
    """bool [H, W]: the point moves in the world until then, by more than a micrometre"""
    seen: np.ndarray
    """bool [H, W]: the point is inside the next picture, and nothing hides it there"""


@dataclass(frozen=True, eq=False)
class CameraTruth:
    """All about one camera."""

    camera: StudioCamera
    times: CameraTimes
    gains: np.ndarray
    """float64 [3]: factors r g b on linear light that this camera's exposure and white balance applied"""
    exposure: np.ndarray
    """float64 [frames]: factor on top by recorded frame; geometric mean 1"""
    shading: LensShading
    """What the lens does to light over the picture"""
    path: Path
    """The npz file with the frames; it is missing if the capture was made with light truth"""

    def __len__(self) -> int:
        """Number of recorded frames."""
        return len(self.times.ticks)

    def frame(self, index: int) -> FrameTruth:
        """Truth of recorded frame `index`, 0 <= index < len(self).

        Raises:
            IndexError: no such frame.
            FileNotFoundError: the capture was made with light truth.
        """
        if not 0 <= index < len(self):
            raise IndexError(
                f"camera {self.camera.name!r} recorded {len(self)} frames, numbered from 0; asked for {index}"
            )
        if not self.path.is_file():
            raise FileNotFoundError(f"no file {self.path}; simulate with truth 'full' to have depth, flow and masks")
        with np.load(self.path) as data:
            fields = {name: data[f"{name}_{index:06d}"] for name in ("object", "flags", "depth", "flow")}
            return _unpacked(data["room_depth"], **fields)


@dataclass(frozen=True, eq=False)
class Truth:
    """All about a synthetic capture."""

    fps: Fraction
    tick_times_ns: np.ndarray
    """int64 [T]: true times of the trigger's ticks"""
    light: np.ndarray
    """float64 [T, 3]: factors r g b of the lamps' light at the ticks, geometric mean 1 per channel"""
    entrance_ns: int
    """True time at which the door begins to open"""
    parcel_ns: int | None
    """True time of the first tick that shows the parcel; None: there is none"""
    objects: tuple[str, ...]
    """Names by object id"""
    movers: tuple[str, ...]
    """Those that can move"""
    cameras: dict[str, CameraTruth]


def read_truth(capture: Path) -> Truth:
    """The truth of a capture folder.

    Raises:
        FileNotFoundError: no truth there; the capture is not synthetic.
        ValueError: written by another version of the studio.
    """
    path = capture / "truth" / "truth.json"
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; only captures made by `packuv simulate` have truth")
    data = json.loads(path.read_text())
    if data["version"] != VERSION:
        raise ValueError(f"{path} has version {data['version']}, but this program reads {VERSION}; simulate again")
    return Truth(
        fps=Fraction(data["fps"]),
        tick_times_ns=np.array(data["tick_times_ns"], np.int64),
        light=np.array(data["light"], np.float64),
        entrance_ns=data["entrance_ns"],
        parcel_ns=data["parcel_ns"],
        objects=tuple(data["objects"]),
        movers=tuple(data["movers"]),
        cameras={name: _camera_from_json(name, item, path.parent) for name, item in data["cameras"].items()},
    )


def truth_json(
    options: Mapping[str, Any],
    fps: Fraction,
    ticks_ns: np.ndarray,  # int64 [T]
    light: np.ndarray,  # float64 [T, 3]
    entrance_ns: int,
    parcel_ns: int | None,
    recordings: Sequence[Recording],
) -> dict[str, Any]:
    """Contents of truth.json."""
    return {
        "version": VERSION,
        "options": dict(options),
        "fps": f"{fps.numerator}/{fps.denominator}",
        "tick_times_ns": ticks_ns.tolist(),
        "light": light.tolist(),
        "entrance_ns": entrance_ns,
        "parcel_ns": parcel_ns,
        "objects": list(OBJECTS),
        "movers": list(MOVING),
        "cameras": {recording.camera.name: _camera_to_json(recording) for recording in recordings},
    }


class PixelTruthWriter:
    """Writes the npz file of one camera frame by frame, in constant memory; use it in a `with` statement."""

    def __init__(self, path: Path, room_depth: np.ndarray) -> None:
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=4)
        self._count = 0
        self._add("room_depth", room_depth.astype(np.float32))

    def write(self, hits: Hits, motion: Motion) -> None:
        """Append a frame."""
        movers = hits.item >= 0
        flags = MOVES * motion.moves.astype(np.uint8) + SEEN * motion.seen.astype(np.uint8)
        for name, values in (
            ("object", hits.owner),
            ("flags", flags),
            ("depth", hits.depth[movers].astype(np.float32)),
            ("flow", motion.flow[movers].astype(np.float32)),
        ):
            self._add(f"{name}_{self._count:06d}", values)
        self._count += 1

    def __enter__(self) -> PixelTruthWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._zip.close()

    def _add(self, name: str, values: np.ndarray) -> None:
        # ZipInfo's own date is 1980: the bytes must not depend on when they are written
        info = zipfile.ZipInfo(f"{name}.npy")
        info.compress_type = zipfile.ZIP_DEFLATED
        with self._zip.open(info, "w", force_zip64=True) as file:
            np.lib.format.write_array(file, values, allow_pickle=False)


def _unpacked(
    room_depth: np.ndarray, object: np.ndarray, flags: np.ndarray, depth: np.ndarray, flow: np.ndarray
) -> FrameTruth:
    movers = object >= OBJECTS.index(MOVING[0])
    whole_depth, whole_flow = room_depth.copy(), np.zeros((*object.shape, 2), np.float32)
    whole_depth[movers], whole_flow[movers] = depth, flow
    return FrameTruth(whole_depth, object, whole_flow, (flags & MOVES) > 0, (flags & SEEN) > 0)


_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_TIMES = ("ticks", "times_ns", "next_times_ns", "stamps_ns", "dropped")
_CLOCK = ("first_index", "offset_ns", "drift_ppm", "phase_ns")


def _camera_to_json(recording: Recording) -> dict[str, Any]:
    camera, times, gains, exposure, shading = recording
    return {
        **{name: getattr(camera, name) for name in _LENS},
        "camera_from_world": camera.camera_from_world.tolist(),
        "gains": gains.tolist(),
        "shading": asdict(shading),
        "exposure": exposure.tolist(),
        **{name: getattr(times, name).tolist() for name in _TIMES},
        **{name: getattr(times, name) for name in _CLOCK},
    }


def _camera_from_json(name: str, item: Mapping[str, Any], folder: Path) -> CameraTruth:
    pose = np.array(item["camera_from_world"], dtype=np.float64)
    arrays = {key: np.array(item[key], np.int64) for key in _TIMES}
    times = CameraTimes(**arrays, **{key: item[key] for key in _CLOCK})  # type: ignore[arg-type]  # from JSON
    camera = StudioCamera(name, **{key: item[key] for key in _LENS}, camera_from_world=pose)
    gains, exposure = (np.array(item[key], np.float64) for key in ("gains", "exposure"))
    return CameraTruth(camera, times, gains, exposure, LensShading(**item["shading"]), folder / f"{name}.npz")
