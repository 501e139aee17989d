"""The stages before a fit, each on a simulated capture whose truth is exact: how far off is it, and what does it cost?

A capture is filmed twice from the same places. All cameras film a few instants half a second apart, for what needs many
places, and three film neighbouring frames, for what moves. Lenses and sensor noise are added to the pictures here,
since the studio's cameras have neither; clocks are those of an hour-long recording without pictures.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.colour import balance
from calibration.rig import Camera, Rig
from calibration.shading import shading_basis
from calibration.solve import solve_rig
from calibration.triangulate import SparsePoints, triangulate
from packuv.footage import FrameReader
from packuv.motion import MotionOptions
from packuv.motion.step import grey, grown, measure_step, one_opencv_thread, optical_flow
from pipelines.options import SequenceOptions
from studio.capture import ColourOptions, SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions, record
from studio.light import LightOptions
from studio.rig import PlacementOptions, RigKind
from studio.truth import CameraTruth, FrameTruth, read_truth
from sync.align import align
from sync.capture import find_capture
from sync.timecode import Timecodes

Figures = dict[str, float]
"""How far off a stage is, by measure"""
APART = 15
"""Frames of 30 a second between two of the instants that all cameras film"""
RIGHT_DEPTH = 0.01
"""A point that is farther off than this share of its depth is wrong"""
CLEAR_PX = 0.5
"""What moves as fast in the picture should be found; slower things may be"""
EVERY_CLOCK = ClockOptions(drop_share=0.0, max_late_frames=0)


@dataclass(frozen=True)
class Made:
    """What a capture is made with."""

    name: str
    kind: RigKind
    cameras: int
    seed: int
    clock: ClockOptions
    """Of the long recording"""
    minutes: int = 10
    """Its length, at 30 frames a second"""
    size: str = "640x360"
    width: int = 480
    """To which the pictures that tell places, lenses and light are scaled down, since matching them takes longest"""
    instants: int = 4
    steps: int = 6
    """Steps from frame to frame of the cameras that film motion"""
    shading: float = 0.0
    """Of the lenses, as `packuv simulate --set light.shading`"""
    distortion: float = 0.06
    """Greatest k1; the lenses have a third of it or more"""
    noise: float = 2.0
    """Deviation of the sensors' noise, grey values"""

    def options(self, cameras: int, frames: int, fps: int) -> SimulateOptions:
        return SimulateOptions(
            cameras=cameras,
            frames=frames,
            size=self.size,
            fps=Fraction(fps),
            seed=self.seed,
            rig=PlacementOptions(kind=self.kind),
            clock=EVERY_CLOCK,
            colour=ColourOptions(exposure_spread=0.2),
            light=LightOptions(shading=self.shading),
            truth=TruthKind.FULL,
            held_out=0,
        )


CAPTURES = (
    Made("front", RigKind.FRONT, 8, seed=3, clock=ClockOptions(drift_ppm=5.0)),
    Made(
        "ring", RigKind.RING, 12, seed=5, clock=ClockOptions(jitter_us=2000, offset_us=5000, drift_ppm=20), shading=0.35
    ),
)


@dataclass(frozen=True)
class Step:
    """A camera's picture and the next one."""

    before: np.ndarray
    """uint8 [H, W], grey"""
    after: np.ndarray
    truth: FrameTruth
    """Of the earlier picture"""
    later: FrameTruth

    @property
    def clear(self) -> np.ndarray:
        """bool [H, W]: where things are that move clearly, or have come to."""
        fast = [np.linalg.norm(frame.flow, axis=2) > CLEAR_PX for frame in (self.truth, self.later)]
        found: np.ndarray = (fast[0] & self.truth.moves) | (fast[1] & self.later.moves)
        return found

    @property
    def moving(self) -> np.ndarray:
        """The same of all that moves."""
        found: np.ndarray = self.truth.moves | self.later.moves
        return found


@dataclass(frozen=True)
class Filmed:
    """A simulated capture on disk."""

    made: Made
    work: Path
    _shots: dict[int, list[dict[str, np.ndarray]]] = field(default_factory=dict)

    @classmethod
    def there(cls, made: Made, work: Path) -> Filmed:
        """The capture in the folder `work`, made if it is not there yet."""
        for name, options in (
            ("rig", made.options(made.cameras, made.instants, 30 // APART)),
            ("motion", made.options(3, made.steps + 1, 30)),
        ):
            if not (folder := work / f"{made.name}-{name}").exists():
                simulate(folder, options)
        return cls(made, work)

    @cached_property
    def truth(self) -> Mapping[str, CameraTruth]:
        return read_truth(self.work / f"{self.made.name}-rig").cameras

    def rig(self, width: int | None = None) -> Rig:
        """As it is, with the lenses that are added; of videos `width` wide."""
        rng, cameras = np.random.default_rng([self.made.seed, 1]), []
        for name, own in self.truth.items():
            lens = (float(rng.uniform(1 / 3, 1) * self.made.distortion), 0.0, 0.0, 0.0)
            pinhole = own.camera
            whole = Camera(
                name, pinhole.width, pinhole.height, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy,
                pinhole.camera_from_world, lens,
            )  # fmt: skip
            cameras.append(whole.resized(width, pinhole.height * width // pinhole.width) if width else whole)
        return Rig(tuple(cameras), "truth")

    def shots(self, width: int) -> list[dict[str, np.ndarray]]:
        """The pictures of all cameras, uint8 [H, W, 3], by instant."""
        if width not in self._shots:
            reader = FrameReader(find_capture(self.work / f"{self.made.name}-rig").videos)
            self._shots[width] = [
                {camera.name: self._shot(reader, camera, instant, width) for camera in self.rig().cameras}
                for instant in range(self.made.instants)
            ]
        return self._shots[width]

    def _shot(self, reader: FrameReader, camera: Camera, instant: int, width: int) -> np.ndarray:
        """Through the lens, on a noisy sensor, then scaled."""
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        plane = camera.plane_from_pixels(np.stack([x.ravel(), y.ravel()], axis=1))
        source = (plane * (camera.fx, camera.fy) + (camera.cx, camera.cy) - 0.5).astype(np.float32)
        grid = source.reshape(camera.height, camera.width, 2)
        across, down = np.ascontiguousarray(grid[..., 0]), np.ascontiguousarray(grid[..., 1])
        filmed = reader.read(camera.name, instant)
        bent = cv2.remap(filmed, across, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        picture = self._noisy(np.asarray(bent), [instant, int(camera.name[-2:])])
        return np.asarray(
            cv2.resize(picture, (width, camera.height * width // camera.width), None, 0, 0, cv2.INTER_AREA)
        )

    def _noisy(self, picture: np.ndarray, where: list[int]) -> np.ndarray:
        rng = np.random.default_rng([self.made.seed, 2, *where])
        noise = rng.normal(0, self.made.noise, picture.shape)
        noisy: np.ndarray = np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)
        return noisy

    @cached_property
    def steps(self) -> list[Step]:
        """Of the cameras that film motion."""
        folder, found = self.work / f"{self.made.name}-motion", list[Step]()
        reader = FrameReader(find_capture(folder).videos)
        for number, (name, own) in enumerate(read_truth(folder).cameras.items()):
            pictures = [grey(self._noisy(reader.read(name, index), [100 + index, number])) for index in range(len(own))]
            frames = [own.frame(index) for index in range(len(own))]
            found += map(Step, pictures, pictures[1:], frames, frames[1:])
        return found

    @cached_property
    def points(self) -> SparsePoints:
        """What the default settings triangulate."""
        return _triangulated(self, SequenceOptions(), self.made.width)


# What each stage gives: a call to be timed, and then its figures


def _sync(filmed: Filmed, options: SequenceOptions, width: int, instants: int) -> Iterator[Figures | None]:
    made = filmed.made
    times = record(made.cameras, made.minutes * 60 * 30, Fraction(30), made.seed, made.clock)
    ticks = {f"cam{number:02}": own.ticks for number, own in enumerate(times, start=1)}
    codes = {
        name: Timecodes(own.stamps_ns, np.arange(len(own.stamps_ns))) for name, own in zip(ticks, times, strict=True)
    }
    yield None
    groups, _ = align(codes, options.sync)
    yield None
    shown = ticks[groups.reference][groups.frames[:, groups.cameras.index(groups.reference)]]
    wrong, late = [], []
    for column, name in enumerate(groups.cameras):
        if name != groups.reference:
            place = np.searchsorted(ticks[name], shown)
            there = ticks[name][np.minimum(place, len(ticks[name]) - 1)] == shown
            frames = groups.frames[:, column]
            wrong.append(frames != np.where(there, place, -1))
            late.append(groups.residuals_ns[frames >= 0, column])
    yield {
        "wrong_percent": 100 * float(np.mean(wrong)),
        "time_ms": float(np.sqrt(np.mean(np.square(np.concatenate(late) / 1e6)))),
    }


def _solve(filmed: Filmed, options: SequenceOptions, width: int, instants: int) -> Iterator[Figures | None]:
    shots, truth = filmed.shots(width)[:instants], filmed.rig(width)
    with tempfile.TemporaryDirectory() as folder:
        yield None
        solved = solve_rig(
            {name: [shot[name] for shot in shots] for name in truth.names}, options.rig.solve, Path(folder)
        )
        yield None
    yield {**pose_errors(solved, truth), **lens_errors(solved, truth), "placed": len(solved.cameras)}


def pose_errors(solved: Rig, truth: Rig) -> Figures:
    """In the alignment that brings the centres nearest: centres by the rig's radius, root mean square, and turns."""
    truth = truth.select(solved.names)
    a, b = solved.centres - solved.centres.mean(axis=0), truth.centres - truth.centres.mean(axis=0)
    left, sizes, right = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left @ sign @ right
    apart = float(np.trace(np.diag(sizes) @ sign) / (a**2).sum()) * a @ turn.T - b
    turns = [
        np.linalg.norm(cv2.Rodrigues(one.camera_from_world[:3, :3] @ turn.T @ other.camera_from_world[:3, :3].T)[0])
        for one, other in zip(solved.cameras, truth.cameras, strict=True)
    ]
    radius = np.sqrt((b**2).sum(axis=1).mean())
    return {
        "centre_percent": 100 * float(np.sqrt((apart**2).sum(axis=1).mean()) / radius),
        "turn_deg": float(np.degrees(np.sqrt(np.mean(np.square(turns))))),
    }


def lens_errors(solved: Rig, truth: Rig) -> Figures:
    """Of focal lengths, and of where lenses send a picture's points, but for what a turn of the camera makes up for."""
    focal, rays = [], []
    for one in solved.cameras:
        own = truth[one.name]
        grid = (np.stack(np.meshgrid(np.arange(16), np.arange(9)), axis=-1).reshape(-1, 2) + 0.5) / (16, 9)
        pixels = grid * (own.width, own.height)
        apart = (one.plane_from_pixels(pixels) - own.plane_from_pixels(pixels)) * (own.fx, own.fy)
        rays.append((apart - apart.mean(axis=0)) / own.width * 640)
        focal.append(np.sqrt(one.fx * one.fy / (own.fx * own.fy)) - 1)
    return {
        "focal_percent": 100 * float(np.sqrt(np.mean(np.square(focal)))),
        "rays_px": float(np.sqrt((np.concatenate(rays) ** 2).sum(axis=1).mean())),
    }


def _triangulated(filmed: Filmed, options: SequenceOptions, width: int) -> SparsePoints:
    shots = filmed.shots(width)
    later = [instant // APART for instant in options.points.more_instants if instant // APART < len(shots)]
    chosen = [0, *later]
    return triangulate(filmed.rig(width), [shots[instant] for instant in chosen], options=options.points.triangulate)


def _points(filmed: Filmed, options: SequenceOptions, width: int, instants: int) -> Iterator[Figures | None]:
    filmed.shots(width)
    yield None
    points = _triangulated(filmed, options, width)
    report = balance(filmed.rig(width), points, options=options.points.balance)
    yield None
    light = light_error(filmed, report.gains, report.shading)
    yield {"points": len(points.xyz), **depth_errors(filmed, points, filmed.rig(width)), "light_percent": light}


def depth_errors(filmed: Filmed, points: SparsePoints, rig: Rig) -> Figures:
    """Of points against what the cameras that show them really see there, along their axes."""
    apart = []
    for index, camera in enumerate(rig.cameras):
        own = filmed.truth[camera.name]
        for instant in np.unique(points.instant):
            mine = (points.camera == index) & (points.instant[points.point] == instant)
            depth = own.frame(int(instant)).depth
            scale = depth.shape[1] / camera.width
            x, y = (np.floor(points.xy[mine] * scale).astype(int).T[axis] for axis in (0, 1))
            pose = camera.camera_from_world
            found = points.xyz[points.point[mine]] @ pose[2, :3] + pose[2, 3]
            # Features sit at outlines, where a hair's breadth decides what is seen: the nearest of 3 x 3 pixels counts.
            around = [
                depth[np.clip(y + dy, 0, depth.shape[0] - 1), np.clip(x + dx, 0, depth.shape[1] - 1)]
                for dy in (-1, 0, 1)
                for dx in (-1, 0, 1)
            ]
            apart.append(np.abs(found / np.array(around) - 1).min(axis=0))
    errors = np.concatenate(apart)
    return {
        "depth_percent": 100 * float(np.median(errors)),
        "wrong_points_percent": 100 * float((errors > RIGHT_DEPTH).mean()),
    }


def _colour(filmed: Filmed, options: SequenceOptions, width: int, instants: int) -> Iterator[Figures | None]:
    rig, points = filmed.rig(width), filmed.points
    yield None
    report = balance(rig, points, options=options.points.balance)
    yield None
    yield {"light_percent": light_error(filmed, report.gains, report.shading)}


def light_error(
    filmed: Filmed, gains: Mapping[str, Sequence[float]], shading: Mapping[str, tuple[float, float]]
) -> float:
    """What is left of the cameras' differences in light, anywhere in their pictures, percent, root mean square."""
    left = []
    for camera in filmed.rig().cameras:
        own = filmed.truth[camera.name]
        grid = (np.stack(np.meshgrid(np.arange(16), np.arange(9)), axis=-1).reshape(-1, 2) + 0.5) / (16, 9)
        plane = (grid * (camera.width, camera.height) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        fall = shading_basis(camera, plane) @ np.subtract(list(asdict(own.shading).values()), shading[camera.name])
        left.append(np.log(gains[camera.name]) + np.log(own.gains) + fall[:, None])  # [144, 3]
    errors = np.array(left)
    errors -= errors.mean(axis=(0, 1))  # one factor for all cameras is nobody's fault
    return 100 * float(np.sqrt(np.mean(np.square(errors))))


def _flow(filmed: Filmed, options: SequenceOptions, width: int, instants: int) -> Iterator[Figures | None]:
    steps = filmed.steps
    yield None
    flows = [optical_flow(step.before, step.after, options.motion) for step in steps]
    yield None
    moving, still = [], []
    for step, flow in zip(steps, flows, strict=True):
        apart = np.linalg.norm(cv2.resize(flow, step.before.shape[::-1]) - step.truth.flow, axis=2)
        moving.append(apart[step.truth.moves & step.truth.seen])
        still.append(apart[~step.truth.moves])
    yield {"moving_px": float(np.concatenate(moving).mean()), "still_px": float(np.concatenate(still).mean())}


def _masks(filmed: Filmed, options: SequenceOptions, width: int, instants: int) -> Iterator[Figures | None]:
    steps = filmed.steps
    yield None
    masks = [_mask(step, options.motion) for step in steps]
    yield None
    clear, right, marked, found = (0, 0, 0, 0)
    for step, mask in zip(steps, masks, strict=True):
        clear, found = clear + int(step.clear.sum()), found + int((mask & step.clear).sum())
        marked, right = marked + int(mask.sum()), right + int((mask & step.moving).sum())
    recall, precision = found / clear, right / max(marked, 1)
    worth = 2 * recall * precision / max(recall + precision, 1e-9)
    yield {"recall": recall, "precision": precision, "wrong_percent": 100 * (1 - worth)}


def _mask(step: Step, options: MotionOptions) -> np.ndarray:
    height, width = step.before.shape
    return grown(measure_step(step.before, step.after, options).mask, width, height, options.dilation_px)


Stage = Callable[[Filmed, SequenceOptions, int, int], Iterator[Figures | None]]
"""Gets ready, yields, does what is timed, yields, and yields its figures"""
STAGES: Mapping[str, Stage] = {
    "sync": _sync,
    "solve": _solve,
    "points": _points,
    "colour": _colour,
    "flow": _flow,
    "masks": _masks,
}
REPEATS = {"sync": 3, "colour": 3, "flow": 2}
"""Of stages that are quick: the least CPU time counts"""


def measure(
    stage: str, filmed: Filmed, options: SequenceOptions, width: int | None = None, instants: int = 1
) -> dict[str, Any]:
    """CPU seconds of a stage on one thread, children and all, and its figures; or why it refused."""
    costs, figures = [], dict[str, Any]()
    with one_opencv_thread():
        for _ in range(REPEATS.get(stage, 1)):
            work = STAGES[stage](filmed, options, width or filmed.made.width, instants)
            next(work)
            before = _seconds()
            try:
                next(work)
                costs.append(_seconds() - before)
                figures = {name: float(f"{value:.4g}") for name, value in (next(work) or {}).items()}
            except ValueError as problem:
                costs.append(_seconds() - before)
                figures = {"refused": str(problem).partition(" (")[0][:200]}
    return {"cpu_seconds": round(min(costs), 4), **figures}


def _seconds() -> float:
    """CPU time of this process and of the children that have ended."""
    return time.process_time() + sum(os.times()[2:4])
