"""What a GPU does, and how fast: tests, an iteration by stage, a profile, pictures on their way to it, a keyframe and
frames beside the CPU's.

    make gpu                                  # or, where nothing is set up: OUT=results bench/gpu.sh
    NUMBA_ENABLE_CUDASIM=1 python -m bench.gpu --toy --out runs/toy     # in numba's simulator, to see that it runs

It needs torch, numba, numba-cuda and numpy, and by way of `bench.bare` no other package: scenes are drawn by the CPU's
rasterizer and held as arrays. Each part is written as soon as it is done; one that fails is told, and the next begins;
one for which no time is left is told, too. Exit code 1 if a part failed or the tests did.
"""

from __future__ import annotations

import argparse
import contextlib
import cProfile
import importlib.util
import io
import os
import pstats
import shutil
import subprocess
import sys
import time
import traceback
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast
from unittest.mock import patch

import numba
import numpy as np
import torch

from bench.bare import missing
from bench.command import parser
from packuv.camera import PinholeCamera
from packuv.files import save_json
from packuv.fit import resident, rows_cuda, shots_cuda
from packuv.fit.device import compared_differently, drawn_differently, labelled_differently
from packuv.fit.frames import fit_segment
from packuv.fit.gpu_memory import FitLoad, alive_bytes
from packuv.fit.keyframe import KeyState, choose_quantizer
from packuv.fit.lift import LiftOptions
from packuv.fit.model import Model
from packuv.fit.options import FitOptions, FrameOptions, SolverOptions
from packuv.fit.pace import FitSize, made_up, step_seconds
from packuv.fit.shots import find_shots
from packuv.fit.solvers import open_solver
from packuv.fit.start.bounds import find_bounds
from packuv.fit.start.first import SH_BASE, round_gaussians
from packuv.fit.start.points import Points
from packuv.footage import Views
from packuv.footage.lens import LensCamera
from packuv.gaussians.floats import Gaussians, arrays
from packuv.gaussians.segment import Segment
from packuv.metrics import decibels
from packuv.raster import RasterOptions, render
from packuv.raster.cuda import launch
from packuv.raster.cuda import render as on_gpu

SIMULATED = bool(cast(Any, numba.config).ENABLE_CUDASIM)
TESTS = ("raster/test_cuda.py", "fit/test_cuda.py", "fit/test_rows_cuda.py", "fit/test_density_cuda.py",
         "fit/test_resident.py")  # fmt: skip
NEAR = 0.05


@dataclass(frozen=True)
class GpuOptions:
    sizes: tuple[FitSize, ...] = (FitSize(640, 360, 60_000), FitSize(1600, 1000, 300_000), FitSize(1600, 1000, 500_000))
    """Of which an iteration is measured"""
    first: int = 4
    """Iterations before those that are measured, in which kernels are compiled"""
    iterations: int = 100
    """Of each size, between two changes of density as in a keyframe"""
    tests: tuple[str, ...] = TESTS
    scene: FitSize = field(default_factory=lambda: FitSize(640, 360, 40_000))
    """Of the sequence: its pictures, and Gaussians of the fit"""
    cameras: int = 9
    """Of the sequence, the last one unseen by the fit"""
    key_iterations: int = 1000
    frames: int = 20
    rig: tuple[int, int, int] = (88, 1920, 1200)
    """Cameras whose pictures of an instant are sent to the GPU, and the size of these"""
    turn: float = 0.1
    """Radians by which the ball goes on in a frame, on a circle of 0.3"""
    frame_iterations: int = 96
    """Of each frame at most"""
    seconds: float = 520.0
    """In all; a part begins if it is likely to end before"""


TOY = GpuOptions(
    sizes=(FitSize(16, 12, 12),),
    first=1,
    iterations=2,
    tests=("fit/test_rows_cuda.py::test_no_rows",),
    scene=FitSize(16, 12, 12),
    cameras=4,
    key_iterations=2,
    frames=2,
    rig=(2, 16, 12),
    turn=2.0,
    frame_iterations=2,
)


# Tests and agreement


def measure_tests(options: GpuOptions, out: Path) -> dict[str, Any]:
    """The tests of what runs on a GPU, if pytest is there, and the comparisons by which any fit chooses its device."""
    found: dict[str, Any] = {}
    if not SIMULATED:
        checks = {"drawn": drawn_differently, "compared": compared_differently, "labelled": labelled_differently}
        found = {name: check("cuda") or "as the CPU" for name, check in checks.items()}
    if importlib.util.find_spec("pytest") is None:
        return {**found, "pytest": "not installed"}
    # Without plugins, which may want what is missing, and without the project's settings, which name some.
    alone = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "bench.bare", "pytest", "-c", "/dev/null", "--rootdir", ".", "-q", "-rfEs",
               "--disable-warnings", "--import-mode=importlib", "-p", "no:cacheprovider"]  # fmt: skip
    command += [f"tests/packuv/{test}" for test in options.tests]
    done = subprocess.run(command, env=alone, capture_output=True, text=True, timeout=200)
    (out / "tests.txt").write_text(done.stdout + done.stderr)
    if done.returncode:
        raise RuntimeError(f"tests failed, see tests.txt: {done.stdout.strip().splitlines()[-1:]}")
    return {**found, "pytest": done.stdout.strip().splitlines()[-1]}


# An iteration


STAGES: Sequence[tuple[str, Any, str]] = (
    ("project and list", on_gpu, "_listed"),
    ("sort", on_gpu, "_sorted"),
    ("blend", on_gpu, "_blended"),
    ("response", shots_cuda.ShotOnGpu, "_applied"),
    ("loss", resident, "pulls"),
    ("blend backward", on_gpu, "_blend_backward"),
    ("blend backward and gradients", resident, "carry"),
    ("Adam, guard, codes", rows_cuda.RowsOnGpu, "step"),
    ("rows come and go", resident.ResidentSolver, "_change_density"),
)


def measure_iterations(options: GpuOptions, _: Path) -> list[dict[str, Any]]:
    return [measure_iteration(size, options) for size in options.sizes]


def measure_iteration(size: FitSize, options: GpuOptions) -> dict[str, Any]:
    """Milliseconds on the GPU, whole and by stage, and beside them the CPU's and what gsplat takes to draw."""
    solver, shots = made_up(size, "cuda")
    solver.fix(choose_quantizer(solver.model.gaussians, solver.bounds, 0))
    begun = time.perf_counter()
    solver.run(shots, options.first, of=1000)
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    solver.run(shots, options.iterations, of=1000)
    whole = 1000 * (time.perf_counter() - begun) / options.iterations
    with timed_stages() as times:
        solver.run(shots, options.iterations, of=1000, grow_from=size.gaussians)
    gaussians, shot = solver.model.gaussians, shots[0]
    return {
        "size": str(size),
        "first_seconds": first,
        "ms": whole,
        "stages_ms": {name: 1000 * float(np.median(part)) for name, part in times.items() if part},
        "cpu_ms": 1000 * step_seconds(size),
        "gsplat_draw_and_gradients_ms": _by_gsplat(gaussians, shot.camera),
        "memory_bytes": 0 if SIMULATED else torch.cuda.max_memory_allocated(),
        "memory_foreseen_bytes": alive_bytes(FitLoad([(size.width, size.height)] * len(shots), len(gaussians))),
    }


@contextlib.contextmanager
def timed_stages() -> Iterator[dict[str, list[float]]]:
    """Seconds of each stage of a resident iteration, the GPU brought to rest before and after."""
    times: dict[str, list[float]] = {name: [] for name, _, _ in STAGES}
    with contextlib.ExitStack() as stack:
        for name, place, function in STAGES:
            stack.enter_context(patch.object(place, function, _timed(getattr(place, function), times[name])))
        yield times


def _timed(function: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    def run(*given: Any, **named: Any) -> Any:
        rest()
        begun = time.perf_counter()
        found = function(*given, **named)
        rest()
        seconds.append(time.perf_counter() - begun)
        return found

    return run


def rest() -> None:
    """Wait until the GPU has nothing to do."""
    if not SIMULATED:
        torch.cuda.synchronize()


def _by_gsplat(gaussians: Gaussians, camera: PinholeCamera) -> float | None:
    """A picture and its gradients, transfers included; None where gsplat is not installed."""
    if SIMULATED or importlib.util.find_spec("gsplat") is None:
        return None
    from bench import yardstick

    seconds: list[float] = []
    slope = np.ones((3, camera.height, camera.width), np.float32)
    draw = _timed(lambda: yardstick.gradients(yardstick.render(gaussians, camera, options=raster), slope), seconds)
    raster = RasterOptions(NEAR, device="cuda")
    for _ in range(6):
        draw()
    return 1000 * float(np.median(seconds[1:]))


# Pictures of an instant


def measure_pictures(options: GpuOptions, _: Path) -> dict[str, Any]:
    """How long the pictures of an instant travel, and what an iteration takes while a thread sends them, as it sends
    those of the next instant in a fit."""
    cameras, width, height = options.rig
    pixels, size = np.zeros((height, width, 3), np.uint8), options.sizes[len(options.sizes) // 2]
    solver, shots = made_up(size, "cuda")
    solver.run(shots, options.first, of=1000)
    travel = _seconds(lambda: send_all(pixels, cameras))
    count = options.iterations // 4 + 1
    with ThreadPoolExecutor(1) as pool:
        pool.submit(send_all, pixels, cameras)
        meanwhile = _seconds(lambda: solver.run(shots, count, of=1000))
    return {
        "pictures": f"{cameras} of {width}x{height}",
        "ms": 1000 * travel,
        "gigabytes_a_second": cameras * pixels.nbytes / travel / 1e9,
        "iteration": str(size),
        "iteration_ms_meanwhile": 1000 * meanwhile / count,
    }


def send_all(pixels: np.ndarray, count: int) -> None:
    """Pin and send a picture so many times; all of them lie on the GPU in the end."""
    for sent in [launch.send(pixels) for _ in range(count)]:
        sent()


def _seconds(work: Callable[[], Any]) -> float:
    """Until the GPU has done it, too."""
    taken: list[float] = []
    _timed(work, taken)()
    return taken[0]


# A sequence


class Filmed:
    """Reads pictures that are there as arrays, uint8 [H, W, 3], by camera and frame."""

    def __init__(self, pictures: dict[tuple[str, int], np.ndarray]) -> None:
        self._pictures = pictures

    def read(self, name: str, frame: int) -> np.ndarray:
        return self._pictures[name, frame]


@dataclass(frozen=True)
class Moved:
    """Masks of what changed since the frame before, in place of a motion cache."""

    names: tuple[str, ...]
    views: Views

    def mask(self, camera: int, instant: int) -> np.ndarray | None:
        now, before = (self.views.pixels(camera, at) for at in (instant, instant - 1))
        assert now is not None
        assert before is not None
        return np.asarray(np.abs(now.astype(np.int16) - before).max(axis=2) > 4)


@dataclass(frozen=True)
class Sequence3D:
    """A room in which a ball of Gaussians wanders, filmed from all around."""

    views: Views
    """Of the cameras to fit"""
    unseen: PinholeCamera
    truth: list[np.ndarray]
    """Pictures of the unseen camera, float32 [3, H, W], by instant"""
    points: Points
    """On surfaces at the first instant, half as many as Gaussians"""


def film(options: GpuOptions) -> Sequence3D:
    """Draw the sequence with the CPU's rasterizer, in bytes."""
    rng, size = np.random.default_rng(0), options.scene
    cameras = [_around(size, k, options.cameras) for k in range(options.cameras)]
    room, actor = _textured(rng, 2 * size.gaussians // 3, 3.0), _textured(rng, size.gaussians // 3, 0.5)
    pictures, truth = dict[tuple[str, int], np.ndarray](), list[np.ndarray]()
    angles = options.turn * np.arange(options.frames + 1)
    places = np.stack([0.3 * np.cos(angles), 0.3 * np.sin(angles), 0 * angles + 0.1], axis=1).astype(np.float32)
    for instant, place in enumerate(places):
        now = replace(actor, means=actor.means + place)
        both = Gaussians(*(np.concatenate(pair) for pair in zip(arrays(room), arrays(now), strict=True)))
        for camera in cameras:
            drawn = render(both, camera, options=RasterOptions(NEAR)).colour.clip(0, 1)
            if camera is cameras[-1]:
                truth.append(drawn)
            else:
                pixels = np.rint(255 * drawn).astype(np.uint8).transpose(1, 2, 0)
                pictures[camera.name, instant] = np.ascontiguousarray(pixels)
    filming = cameras[:-1]
    frames = np.repeat(np.arange(options.frames + 1)[:, None], len(filming), axis=1)
    videos = {camera.name: Path(camera.name) for camera in filming}
    reader = cast(Any, Filmed(pictures))
    views = Views(videos, frames, [LensCamera(camera) for camera in filming], reader=reader)
    xyz = np.concatenate([room.means[::2], actor.means[::2] + places[0]]).astype(np.float64)
    rgb = 0.5 + SH_BASE * np.concatenate([room.sh[::2, 0], actor.sh[::2, 0]]).astype(np.float64)
    return Sequence3D(views, cameras[-1], truth, Points(xyz, rgb))


def _around(size: FitSize, k: int, count: int) -> PinholeCamera:
    """One of the cameras on a circle of radius 2.5, which look at the middle; z is up."""
    angle = 2 * np.pi * (k + 0.5 * (k == count - 1)) / (count - 1)
    centre = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 0.6])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ centre
    focal = 0.7 * size.width
    return PinholeCamera(f"c{k}", size.width, size.height, focal, focal, size.width / 2, size.height / 2, pose)


def _textured(rng: np.random.Generator, count: int, radius: float) -> Gaussians:
    """Round Gaussians that cover a sphere, coloured in waves."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    colour = 0.5 + 0.4 * np.sin(direction @ rng.normal(0, 6, (3, 3)) + rng.uniform(0, 6, 3))
    spacing = np.full(count, 2.5 * radius / np.sqrt(count))
    return round_gaussians(radius * direction, colour, spacing, opacity=0.95, sh_degree=0)


def measure_sequence(options: GpuOptions, out: Path, clock: Callable[[], float] = lambda: np.inf) -> dict[str, Any]:
    """A keyframe and the frames after it, on both devices: seconds, PSNR of an unseen camera, bytes.

    The GPU's come first; the CPU's frames end where half of the time that is left has gone by.
    """
    sequence = film(options)
    found: dict[str, Any] = {}
    for device in ("cuda", "cpu"):
        until = clock() / 2
        key = fit_key(sequence, device, options)
        segment, figures = fit_frames(key, sequence, device, options, out, lambda: clock() < until)  # noqa: B023  # at once
        shown = [key.quantizer.decode(segment.frame(index)) for index in range(len(segment))]
        seconds = [frame["seconds"] for frame in figures]
        found[device] = {
            "keyframe_seconds": key.figures["seconds"],
            "frames": len(figures),
            "frame_seconds_median": float(np.median(seconds)) if seconds else None,
            "frame_iterations_mean": float(np.mean([frame["iterations"] for frame in figures])) if figures else None,
            "gaussians": len(segment.key),
            "psnr_db_by_frame": [_psnr(part, key.bounds.near, sequence, index) for index, part in enumerate(shown)],
            "zlib_bytes": zlib_bytes(segment),
        }
    frames = min(part["frames"] for part in found.values()) + 1
    both = [np.mean(found[device]["psnr_db_by_frame"][:frames]) for device in ("cuda", "cpu")]
    return {**found, "psnr_db_cuda_minus_cpu": float(both[0] - both[1])}


def fit_key(sequence: Sequence3D, device: str, options: GpuOptions) -> KeyState:
    """Fit all that the first instant shows, from points on surfaces, 3 cm off; without the shell, for which
    OpenCV is needed, and all else that `keyframe.fit_first` does before it fits."""
    begun, views, total = time.perf_counter(), sequence.views, options.key_iterations
    given = FitOptions(device=device)
    given = replace(given, density=replace(given.density, cap=options.scene.gaussians))
    bounds = find_bounds(views.cameras, near_share=given.near_share)
    rng, count = np.random.default_rng(1), len(sequence.points.xyz)
    xyz = sequence.points.xyz + rng.normal(0, 0.03, (count, 3))
    spacing = np.full(count, min(0.2, 2 / np.sqrt(count)) * bounds.radius)
    start = round_gaussians(xyz, sequence.points.rgb, spacing, opacity=0.3, sh_degree=0)
    solver = open_solver(Model(start), bounds, given.part(SolverOptions), rng)
    shots = find_shots(views, 0)
    floating = round(0.7 * total)
    solver.run(shots, floating, of=total, grow_from=count)
    solver.keep(solver.worth_keeping())
    solver.fix(choose_quantizer(solver.model.gaussians, bounds, 0))
    losses = solver.run(shots, total - floating, of=total)
    figures = {"seconds": time.perf_counter() - begun, "loss": sum(losses.values())}
    return KeyState(0, solver.model.gaussians, 0, solver.known_quantizer, bounds, figures)


def fit_frames(
    key: KeyState, sequence: Sequence3D, device: str, options: GpuOptions, out: Path, late: Callable[[], bool]
) -> tuple[Segment, list[dict[str, Any]]]:
    """Fit the frames, five at a time, until it is late; the last call goes on where the one before ended."""
    given = replace(FitOptions(device=device).part(FrameOptions), frame_iterations=options.frame_iterations,
                    spare=options.scene.gaussians // 40, lift=LiftOptions(enabled=False))  # fmt: skip
    motion, scratch = cast(Any, Moved(sequence.views.names, sequence.views)), out / f"scratch_{device}"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    done = 0
    while True:
        done = min(options.frames, done + 5)
        found = fit_segment(key, sequence.views, range(done + 1), motion=motion, options=given, scratch=scratch)
        if done == options.frames or late():
            shutil.rmtree(scratch)
            return found


def _psnr(gaussians: Gaussians, near: float, sequence: Sequence3D, instant: int) -> float:
    drawn = render(gaussians, sequence.unseen, options=RasterOptions(near)).colour.clip(0, 1)
    return decibels(float(np.square(drawn - sequence.truth[instant]).mean()))


def zlib_bytes(segment: Segment) -> dict[str, float]:
    """Of the keyframe's codes, and the mean of a frame's differences from the one before: no scene file, for that needs
    an encoder, but alike."""
    key = sum(len(zlib.compress(part.tobytes())) for part in (segment.key.xyz, segment.key.attributes))
    total = 0
    for index in range(1, len(segment)):
        now, before = segment.frame(index)[segment.dynamic], segment.frame(index - 1)[segment.dynamic]
        for name in ("xyz", "attributes"):
            total += len(zlib.compress((getattr(now, name) - getattr(before, name)).tobytes()))
    return {"key": key, "frame_mean": total / max(1, len(segment) - 1)}


# A profile


def measure_profile(options: GpuOptions, out: Path) -> dict[str, Any]:
    """Where host and GPU spend the time of iterations of the middle size: host_profile.txt, gpu_profile.txt."""
    size = options.sizes[len(options.sizes) // 2]
    solver, shots = made_up(size, "cuda")
    solver.fix(choose_quantizer(solver.model.gaussians, solver.bounds, 0))
    solver.run(shots, options.first, of=1000)
    host, text = cProfile.Profile(), io.StringIO()
    host.runcall(solver.run, shots, options.iterations // 2, of=1000)
    pstats.Stats(host, stream=text).sort_stats("tottime").print_stats(40)
    (out / "host_profile.txt").write_text(text.getvalue())
    if SIMULATED:
        return {"size": str(size), "gpu": "not in the simulator"}
    from torch.profiler import ProfilerActivity, profile

    begun = time.perf_counter()
    with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as seen:
        solver.run(shots, 20, of=1000)
        rest()
    seconds, events = time.perf_counter() - begun, seen.key_averages()
    (out / "gpu_profile.txt").write_text(events.table(sort_by="self_cuda_time_total", row_limit=40))
    busy = sum(event.self_device_time_total for event in events) / 1e6
    return {"size": str(size), "busy_share_while_profiled": busy / seconds}


# All of it


PARTS: Sequence[tuple[str, float, Callable[..., Any]]] = (
    ("tests", 0, measure_tests),
    ("iteration", 60, measure_iterations),
    ("profile", 30, measure_profile),
    ("pictures", 20, measure_pictures),
    ("sequence", 90, measure_sequence),
)
"""Name, seconds that must be left, and what measures"""


def machine() -> dict[str, Any]:
    """Who was measured, and by what command."""
    name = "numba's simulator" if SIMULATED else torch.cuda.get_device_name()
    versions = {"python": sys.version.split()[0], "torch": torch.__version__, "numba": numba.__version__}
    return {"device": name, "cuda": torch.version.cuda, "versions": versions, "stood_in_for": missing(),
            "command": "bench/gpu.sh " + " ".join(sys.argv[1:])}  # fmt: skip


def measure(options: GpuOptions, out: Path) -> bool:
    """Run all parts; writes `out`/gpu.json after each. Returns whether none failed."""
    begun, found, failed = time.monotonic(), {"machine": machine()}, False
    out.mkdir(parents=True, exist_ok=True)

    def left() -> float:
        return options.seconds - (time.monotonic() - begun)

    for name, needed, part in PARTS:
        if left() < needed:
            found[name] = {"skipped": f"{left():.0f} s are left, it needs {needed:.0f} s"}
        else:
            started = time.monotonic()
            try:
                given = {"clock": left} if part is measure_sequence else {}
                found[name] = {"figures": part(options, out, **given)}
            except Exception:  # whatever it is, a GPU is seldom there, and the other parts can still tell something
                failed = True
                found[name] = {"failed": traceback.format_exc()}
            found[name]["seconds"] = time.monotonic() - started
        save_json(out / "gpu.json", found)
        print(f"{name}: {found[name]}", flush=True)
    return not failed


def main(argv: Sequence[str] | None = None) -> None:
    command = parser("gpu", __doc__)
    command.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the results, runs/gpu")
    command.add_argument("--toy", action="store_true", help="a few tiny Gaussians, for numba's simulator")
    given: argparse.Namespace = command.parse_args(argv)
    if not SIMULATED and not torch.cuda.is_available():
        command.error("torch finds no CUDA device; NUMBA_ENABLE_CUDASIM=1 with --toy runs it in numba's simulator")
    sys.exit(0 if measure(TOY if given.toy else GpuOptions(), given.out) else 1)


if __name__ == "__main__":
    main()
