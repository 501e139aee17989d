"""`packuv simulate`: a synthetic capture folder with exact ground truth. docs/simulate.md describes what it holds."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from studio.clocks import EPOCH_NS, SECOND_NS, CameraTimes, ClockOptions, record, tick_times, timecode_lines
from studio.film_set import CROWD, MOVING, FilmSet, build_set
from studio.light import LightOptions, draw_shading, exposure_over_time, light_over_time
from studio.raycast import cast, follow, look_once, render
from studio.rig import PlacementOptions, StudioCamera, place_cameras
from studio.srgb import srgb_from_linear
from studio.truth import PixelTruthWriter, Recording, truth_json
from studio.video import VideoWriter

LATEST_ENTRANCE_S = 6.0
"""In a long capture the visitor does not keep one waiting longer than this"""
LARGEST_SIDE = 8192


class TruthKind(StrEnum):
    """How much truth is written."""

    FULL = "full"
    """All, with depth, flow, objects and masks per pixel"""
    LIGHT = "light"
    """No arrays per pixel"""


class CalibrationKind(StrEnum):
    """Whether the capture comes with the rig's calibration."""

    GIVEN = "given"
    """The exact one, as a COLMAP text model"""
    NONE = "none"
    """It must be solved from the pictures; the truth still has it"""


@dataclass(frozen=True)
class ColourOptions:
    """How the cameras differ in colour. Gains over all cameras have a geometric mean of 1 per channel."""

    exposure_spread: float = 0.10
    """A camera is brighter or darker by up to this share of linear light"""
    white_balance_spread: float = 0.05
    """Each channel differs by up to this share on top"""

    def __post_init__(self) -> None:
        for name in ("exposure_spread", "white_balance_spread"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be 0 to 1, but is {getattr(self, name)}")


@dataclass(frozen=True)
class SimulateOptions:
    """What to simulate. The same options give the same bytes."""

    cameras: int = 8
    frames: int = 24
    """Ticks of the trigger; a camera that starts late or drops frames records fewer"""
    size: str = "640x360"
    """Picture size WIDTHxHEIGHT, pixels, both even"""
    fps: Fraction = Fraction(30)
    """Ticks per second"""
    seed: int = 0
    """Decides colours and details of the room, the rig's irregularities, clocks and gains"""
    samples: int = 2
    """Rays per pixel along each axis: 2 means 4 rays"""
    rig: PlacementOptions = field(default_factory=PlacementOptions)
    clock: ClockOptions = field(default_factory=ClockOptions)
    colour: ColourOptions = field(default_factory=ColourOptions)
    light: LightOptions = field(default_factory=LightOptions)
    entrance_share: float = 0.3
    """The door opens after this share of the capture, but after six seconds at the latest"""
    movers: tuple[str, ...] = MOVING
    """Which of the things that can move do; the others stand as at the start. None at all: a still scene"""
    crowd: int = 0
    """Persons who walk round beside the walker, all over the room: with 27 most of a picture moves"""
    parcel_share: float = 0.0
    """From the tick after this share of the capture on a parcel stands on the floor; 0: there is none"""
    truth: TruthKind = TruthKind.FULL
    calibration: CalibrationKind = CalibrationKind.GIVEN
    held_out: int | None = None
    """Cameras that capture.toml names as held out, to score the result on; None: one of four or more"""
    name: str = "studio"
    """Name of the sequence"""

    def __post_init__(self) -> None:
        if not 2 <= self.cameras <= 999:
            raise ValueError(f"a capture needs 2 to 999 cameras, but got {self.cameras}")
        if self.frames < 2:
            raise ValueError(f"a capture needs at least 2 frames, but got {self.frames}")
        if not 1 <= self.fps <= 1000:
            raise ValueError(f"fps must be 1 to 1000, but is {self.fps}")
        if self.seed < 0:
            raise ValueError(f"the seed must be 0 or more, but is {self.seed}")
        if not 1 <= self.samples <= 8:
            raise ValueError(f"samples must be 1 to 8 rays along each axis of a pixel, but is {self.samples}")
        if not 0 <= self.entrance_share <= 1:
            raise ValueError(f"entrance_share must be 0 to 1, but is {self.entrance_share}")
        if not 0 <= self.parcel_share <= 1:
            raise ValueError(f"parcel_share must be 0 to 1, but is {self.parcel_share}")
        if not 0 <= self.held_out_count <= self.cameras - 2:
            raise ValueError(
                f"held_out must leave two cameras to fit: 0 to {self.cameras - 2} of {self.cameras}, "
                f"but is {self.held_out}"
            )
        if not re.fullmatch(r"[\w.-]+", self.name):
            raise ValueError(f"the name must consist of letters, digits, '.', '_' and '-', but is {self.name!r}")
        if unknown := [name for name in self.movers if name not in MOVING]:
            raise ValueError(f"movers must be among {', '.join(MOVING)}, but has {', '.join(unknown)}")
        if not 0 <= self.crowd <= sum(CROWD):
            raise ValueError(f"a crowd has 0 to {sum(CROWD)} persons, but is {self.crowd}")
        self._check_size()

    @property
    def parcel_tick(self) -> int | None:
        """The first tick that shows the parcel; None: there is none."""
        return round(self.parcel_share * self.frames) if self.parcel_share else None

    @property
    def held_out_count(self) -> int:
        return int(self.cameras >= 4) if self.held_out is None else self.held_out

    @property
    def width(self) -> int:
        return int(self.size.split("x")[0])

    @property
    def height(self) -> int:
        return int(self.size.split("x")[1])

    def _check_size(self) -> None:
        if not re.fullmatch(r"\d{1,6}x\d{1,6}", self.size):
            raise ValueError(f"size must be WIDTHxHEIGHT in pixels, as 640x360, but is {self.size!r}")
        if not all(32 <= side <= LARGEST_SIDE and side % 2 == 0 for side in (self.width, self.height)):
            raise ValueError(
                f"a picture's sides must be even, since video halves its chroma, and 32 to {LARGEST_SIDE} pixels long, "
                f"but the size is {self.size}"
            )


def simulate(
    folder: Path, options: SimulateOptions | None = None, progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a capture folder with videos, timecodes, calibration and truth.

    The folder appears complete or not at all: it is written beside its place and renamed.

    Args:
        folder: must not exist, or be empty.
        progress: called with pictures done and in all, at the start and after each picture.

    Raises:
        ValueError: the folder has something in it, or the options contradict each other.
    """
    options = options or SimulateOptions()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise ValueError(f"{folder} must be a new or an empty folder, but something is there; name another one")
    times = record(options.cameras, options.frames, options.fps, options.seed, options.clock)
    target = folder.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    work = target.parent / f".{target.name}.{os.getpid()}.partial"
    work.mkdir()
    try:
        _write(work, times, options, progress)
        os.replace(work, target)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def draw_gains(cameras: int, seed: int, options: ColourOptions) -> np.ndarray:
    """Factors on linear light by camera, float64 [C, 3]; their geometric mean over the cameras is 1 per channel."""
    rng = np.random.default_rng([seed, 6])
    exposure = rng.uniform(-1, 1, (cameras, 1)) * np.log1p(options.exposure_spread)
    balance = rng.uniform(-1, 1, (cameras, 3)) * np.log1p(options.white_balance_spread)
    log = exposure + balance
    gains: np.ndarray = np.exp(log - log.mean(axis=0))
    return gains


def _write(
    folder: Path, times: tuple[CameraTimes, ...], options: SimulateOptions, progress: Callable[[int, int], None] | None
) -> None:
    digits = max(2, len(str(options.cameras)))
    names = [f"cam{number + 1:0{digits}d}" for number in range(options.cameras)]
    rig = place_cameras(names, options.width, options.height, options.seed, options.rig)
    held_out = _held_out(names, options)
    light = light_over_time(options.frames, options.light)
    entrance_s = min(options.entrance_share * float(options.frames / options.fps), LATEST_ENTRANCE_S)
    for part in ("videos", "timecodes", "truth"):
        (folder / part).mkdir()
    _write_settings(folder / "capture.toml", held_out, options)
    if options.calibration is CalibrationKind.GIVEN:
        _write_colmap(folder / "calibration", rig)
    for name, camera_times in zip(names, times, strict=True):
        (folder / "timecodes" / f"{name}.txt").write_text("\n".join(timecode_lines(camera_times)) + "\n")
    entrance_ns = EPOCH_NS + round(entrance_s * SECOND_NS)
    recordings = _recordings(rig, times, held_out, options)
    ticks_ns = tick_times(options.frames, options.fps)
    parcel_ns = None if options.parcel_tick is None else int(ticks_ns[min(options.parcel_tick, len(ticks_ns) - 1)])
    truth = truth_json(_plain(options), options.fps, ticks_ns, light, entrance_ns, parcel_ns, recordings)
    (folder / "truth" / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    _film_all(folder, entrance_s, light, recordings, options, progress)


def _held_out(names: Sequence[str], options: SimulateOptions) -> list[str]:
    """Evenly spread over the rig, and never the first camera."""
    count = options.held_out_count
    return [names[(2 * place + 1) * options.cameras // (2 * count)] for place in range(count)]


def _recordings(
    rig: Sequence[StudioCamera], times: Sequence[CameraTimes], held_out: Sequence[str], options: SimulateOptions
) -> list[Recording]:
    gains = draw_gains(options.cameras, options.seed, options.colour)
    shading = draw_shading(options.cameras, options.seed, options.light)
    jumps = [camera for camera in rig if camera.name not in held_out][1]
    exposures = [
        exposure_over_time(t.ticks, options.frames // 2, options.light.exposure_jump if camera is jumps else 0.0)
        for camera, t in zip(rig, times, strict=True)
    ]
    return [Recording(*parts) for parts in zip(rig, times, gains, exposures, shading, strict=True)]


def _film_all(
    folder: Path,
    entrance_s: float,
    light: np.ndarray,  # float64 [T, 3]
    recordings: Sequence[Recording],
    options: SimulateOptions,
    progress: Callable[[int, int], None] | None,
) -> None:
    report = progress or (lambda done, total: None)
    done, total = 0, sum(len(recording.times.ticks) for recording in recordings)
    report(done, total)
    tick = options.parcel_tick
    film_set = build_set(
        options.seed,
        entrance_s,
        shine=options.light.shine,
        wall_lamps=options.light.wall_lamps,
        moving=options.movers,
        crowd=options.crowd,
        # a hair before the tick, for times are whole nanoseconds
        parcel_s=None if tick is None else float((tick - Fraction(1, 100)) / options.fps),
    )
    for recording in recordings:
        for _ in film(folder, film_set, light, recording, options):
            done += 1
            report(done, total)


def film(
    folder: Path,
    film_set: FilmSet,
    light: np.ndarray,  # float64 [T, 3]
    recording: Recording,
    options: SimulateOptions,
) -> Iterator[np.ndarray]:
    """Write one camera's video, and its truth if that is full, into a capture folder; yields each picture as it is
    written, uint8 [H, W, 3], sRGB."""
    camera, times, gains, exposure, shading = recording
    by_frame = gains * light[times.ticks] * exposure[:, None]  # [F, 3]
    by_pixel = shading.factors(camera)[:, :, None]  # [H, W, 1]
    view = camera.view
    backdrop = look_once(view, film_set.standing, film_set.light, film_set.colours, samples=options.samples)
    with ExitStack() as stack:
        video = stack.enter_context(
            VideoWriter(folder / "videos" / f"{camera.name}.mp4", camera.width, camera.height, options.fps)
        )
        truth = None
        if options.truth is TruthKind.FULL:
            truth = stack.enter_context(
                PixelTruthWriter(folder / "truth" / f"{camera.name}.npz", backdrop.centre_depth)
            )
        moment = film_set.at(_seconds(times.times_ns[0]))
        for factors, next_ns in zip(by_frame, times.next_times_ns, strict=True):
            rig_light = render(
                view, backdrop, film_set.standing, moment.movers, moment.blockers, film_set.light, film_set.colours
            )
            picture = srgb_picture(rig_light, factors * by_pixel)
            video.write(picture)
            later = film_set.at(_seconds(next_ns))
            if truth is not None:
                hits = cast(view, backdrop, moment.movers)
                truth.write(hits, follow(view, hits, film_set.standing, moment.movers, later.movers))
            moment = later
            yield picture


def _seconds(time_ns: np.int64) -> float:
    return int(time_ns - EPOCH_NS) / SECOND_NS


def srgb_picture(light: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """What a camera records of linear light: factors, clipping at 1, sRGB, float32 [H, W, 3] to uint8 [H, W, 3].

    Args:
        factors: for the whole picture, float64 [3], or by pixel, [H, W, 3].
    """
    return (255 * srgb_from_linear(np.clip(light * factors, 0, 1)) + 0.5).astype(np.uint8)


def _write_settings(path: Path, held_out: list[str], options: SimulateOptions) -> None:
    fps = options.fps
    lines = [
        "# Written by packuv simulate",
        f'name = "{options.name}"',
        f"fps = {fps}" if fps.denominator == 1 else f'fps = "{fps}"',
        f'clock = "{"trusted" if options.clock.free_running else "triggered"}"',
        f"tags = {json.dumps(['synthetic', str(options.rig.kind)])}",
    ]
    path.write_text("\n".join(lines + ([f"held_out = {json.dumps(held_out)}"] if held_out else [])) + "\n")


def _write_colmap(folder: Path, rig: tuple[StudioCamera, ...]) -> None:
    """A COLMAP text model without points; numbers are written so that they read back exactly."""
    folder.mkdir()
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, camera in enumerate(rig, start=1):
        lens = " ".join(repr(float(value)) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        cameras.append(f"{number} PINHOLE {camera.width} {camera.height} {lens}")
        pose = [*quaternion(camera.camera_from_world[:3, :3]), *camera.camera_from_world[:3, 3]]
        images += [f"{number} {' '.join(repr(float(value)) for value in pose)} {number} {camera.name}.png", ""]
    (folder / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion w x y z with w >= 0 of a rotation [3, 3], float64 [4]."""
    r = rotation
    # the eigenvector method: the largest eigenvalue of this symmetric matrix belongs to the quaternion x y z w
    matrix = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    _, vectors = np.linalg.eigh(matrix)
    x, y, z, w = vectors[:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def _plain(options: Any) -> Any:
    """Options as JSON values, for the record."""
    if is_dataclass(options) and not isinstance(options, type):
        return {f.name: _plain(getattr(options, f.name)) for f in fields(options)}
    return str(options) if isinstance(options, Fraction) else options
