"""Memory and time of a fit against the size of pictures, the number of cameras and the number of Gaussians.

    packuv bench size --captures runs/size --out bench/results/size.json
    packuv bench size --captures runs/size --out runs/size.json --sizes 1280x720 --cameras 20 --memory-gb 2,0.3

Films one capture a size with `packuv simulate`, unless it is there, and fits its backdrop, a keyframe and two frames by
few iterations, each case in a process of its own. Memory is what the process takes beyond what it takes before a fit.
Fits of so few iterations look like nothing; an iteration costs what it costs in a long fit with as many Gaussians.
"""

from __future__ import annotations

import gc
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from statistics import median
from threading import Event, Thread
from typing import Any

import llvmlite.binding
import numba
import numpy as np

from bench import command
from calibration.importers import load_rig
from packuv.budget import Budget
from packuv.fit.density import DensityOptions
from packuv.fit.frames import fit_segment
from packuv.fit.keyframe import KeyState, fit_backdrop, fit_next
from packuv.fit.options import FirstOptions, FitOptions, FrameOptions, NextOptions
from packuv.fit.start.first import ROOM, StartOptions
from packuv.fit.start.shell import ShellOptions
from packuv.footage import Views
from packuv.gaussians.floats import ATTRIBUTES
from packuv.motion import MotionCache, MotionOptions, find_background, load_stills, measure_motion, save_stills
from packuv.progress import Progress
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from tasks.stages.footage import lens_camera

INSTANTS = 3
"""A keyframe and two frames"""
MOST_CAMERAS = 88
"""Filmed; a case with fewer takes some of them, evenly"""
SAMPLING_SECONDS = 0.01
"""Between looks at the memory"""
PHASES = ("backdrop", "keyframe", "frames")
MEASURED = {
    "iteration_seconds": "CPU time of an iteration of the backdrop",
    "keyframe_seconds": "CPU time of an iteration of the keyframe",
    "frame_seconds": "CPU time of an iteration of a frame, with all else that a frame takes",
    "backdrop_bytes": "memory of the backdrop",
    "frames_bytes": "memory of the frames",
}
"""What gets exponents"""


@dataclass(frozen=True)
class Case:
    """One fit."""

    capture: str
    width: int
    height: int
    cameras: int
    gaussians: int
    """Of the backdrop, about"""
    memory_gb: float
    iterations: int
    """Of the backdrop and of each frame; a keyframe has one for each camera at least, to hold what it may"""


@dataclass(frozen=True)
class Measured:
    """What a part took."""

    seconds: float
    cpu_seconds: float
    iteration_seconds: float
    """Median, of the wall's clock"""
    iteration_cpu_seconds: float
    """Median, of all threads"""
    peak_bytes: int
    """Beyond what the process took before all fits"""


class Peak:
    """The most memory that the process takes, as it runs by."""

    def __init__(self) -> None:
        self._bytes, self._ended = resident_bytes(), Event()
        self._thread = Thread(target=self._look, daemon=True)

    def __enter__(self) -> Peak:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def bytes(self) -> int:
        return max(self._bytes, resident_bytes())

    def _look(self) -> None:
        while not self._ended.wait(SAMPLING_SECONDS):
            self._bytes = max(self._bytes, resident_bytes())


def resident_bytes() -> int:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def film(folder: Path, width: int, height: int) -> Path:
    """The capture of a size, made unless it is there."""
    path = folder / f"c{MOST_CAMERAS}_{width}x{height}"
    if not path.exists():
        steady = ClockOptions(drop_share=0.0, max_late_frames=0)
        options = SimulateOptions(
            cameras=MOST_CAMERAS,
            frames=INSTANTS,
            size=f"{width}x{height}",
            samples=1,
            truth=TruthKind.LIGHT,
            clock=steady,
        )
        simulate(path, options, lambda done, total: print(f"\r{path.name}: {done}/{total}", end="", file=sys.stderr))
    return path


def open_views(case: Case, folder: Path | None) -> Views:
    """Some cameras of the capture, evenly."""
    capture = Path(case.capture)
    rig = load_rig(capture / "calibration")
    chosen = np.linspace(0, len(rig.cameras) - 1, case.cameras).round().astype(int)
    cameras = [rig.cameras[index] for index in chosen]
    frames = np.tile(np.arange(INSTANTS)[:, None], (1, len(cameras)))
    videos = {camera.name: capture / "videos" / f"{camera.name}.mp4" for camera in cameras}
    budget = Budget(round(1e9 * case.memory_gb))
    lenses = [lens_camera(camera) for camera in cameras]
    return Views(videos, frames, lenses, max_width=case.width, budget=budget, spill=folder)


def options_of(case: Case) -> FitOptions:
    """Few iterations of a fit with so many Gaussians."""
    count = case.iterations
    return FitOptions(
        iterations=round(count / 0.8),  # a tenth of them is coarse
        key_iterations=max(count, case.cameras),
        frame_iterations=count,
        key_births=max(500, case.gaussians // 10),
        # All on the shell: as thin as what is fitted long, where balls that fill the room overlap ten times as much.
        start=StartOptions(count=case.gaussians, surface_share=1.0),
        shell=ShellOptions(steps=12),  # the sweep is no iteration; its memory does not depend on this
        # So large that a backdrop may start with all of them.
        density=DensityOptions(cap=math.ceil(case.gaussians / FirstOptions.backdrop_share / ROOM), every=10**6),
    )


def measure(case: Case) -> dict[str, Any]:
    """All parts of a case, in this process."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(case, folder)
        options, start = options_of(case), resident_bytes()
        state, backdrop = timed(start, lambda progress: _backdrop(case, folder, options, progress))
        key, keyframe = timed(start, lambda progress: _keyframe(case, folder, options, state, progress))
        figures, frames = timed(start, lambda progress: _frames(case, folder, options, key, progress))
        done = sum(figure["iterations"] for figure in figures)
        return {
            **asdict(case),
            "backdrop": asdict(backdrop),
            "keyframe": asdict(keyframe),
            "frames": {  # whose ticks are frames
                **asdict(frames),
                "iteration_seconds": frames.seconds / max(1, done),
                "iteration_cpu_seconds": frames.cpu_seconds / max(1, done),
            },
            "figures": {
                "before_bytes": start,
                "gaussians": len(key.gaussians),
                "foreground": len(key.foreground),
                "tiles": median(figure.get("tiles", 0.0) for figure in figures),
                "digest": digest(key),
            },
        }


# Each part opens its views, as a job does.


def _backdrop(case: Case, folder: Path, options: FitOptions, progress: Progress) -> KeyState:
    views = open_views(case, folder)
    stills = load_stills(folder / "stills.npz", views.budget)
    return fit_backdrop(views, stills, points=None, options=options.part(FirstOptions), progress=progress)


def _keyframe(case: Case, folder: Path, options: FitOptions, state: KeyState, progress: Progress) -> KeyState:
    views = open_views(case, folder)
    stills = load_stills(folder / "stills.npz", views.budget)
    part, motion = options.part(NextOptions), MotionOptions()
    return fit_next(state, views, 0, stills=stills, motion=motion, options=part, progress=progress)


def _frames(case: Case, folder: Path, options: FitOptions, key: KeyState, progress: Progress) -> list[dict[str, Any]]:
    """Figures of the frames."""
    views, motion = open_views(case, folder), MotionCache.load(folder / "motion")
    part, instants = options.part(FrameOptions), range(INSTANTS)
    return fit_segment(key, views, instants, motion=motion, options=part, scratch=folder, progress=progress)[1]


def prepare(case: Case, folder: Path) -> None:
    """What stages before the fit leave, in a process of its own; and everything compiled in this one."""
    if "PACKUV_PREPARED" not in os.environ:
        subprocess.run(
            [sys.executable, "-m", "bench.size", "--prepare", str(folder), "--case", json.dumps(asdict(case))],
            check=True,
            env={**os.environ, "PACKUV_PREPARED": "1"},
        )
        from bench.raster import call_everything

        call_everything()
        return
    views = open_views(case, None)
    save_stills(folder / "stills.npz", find_background(views, FitOptions().background))
    measure_motion(views, folder / "motion", MotionOptions(), workers=1)


def timed(start: int, work: Callable[[Progress], Any]) -> tuple[Any, Measured]:
    """The result, time and memory of a part."""
    ticks = list[tuple[float, float]]()
    gc.collect()
    with Peak() as peak:
        began, cpu = time.perf_counter(), time.process_time()
        result = work(lambda done, total, note="": ticks.append((time.perf_counter(), time.process_time())))
        seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        most = peak.bytes
    steps = np.diff(ticks, axis=0)[len(ticks) // 2 :]  # the coarse ones, and the first of each camera, come before
    usual = np.median(steps, axis=0) if len(steps) else (seconds, cpu)
    return result, Measured(seconds, cpu, float(usual[0]), float(usual[1]), most - start)


def digest(state: KeyState) -> str:
    """Of the Gaussians: cases that differ in memory only must have the same."""
    content = sha256()
    for name in ATTRIBUTES:
        content.update(getattr(state.gaussians, name).tobytes())
    return content.hexdigest()[:16]


def exponents(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """How each measure grows: the powers of pixels, cameras and Gaussians that fit best, by least squares of logs."""
    logs = np.log([[row["width"] * row["height"], row["cameras"], row["gaussians"]] for row in rows])
    varied = [column for column in range(3) if np.ptp(logs[:, column]) > 0]
    if len(rows) <= len(varied):
        return {}
    system = np.column_stack([logs[:, varied], np.ones(len(rows))])
    names, found = ("pixels", "cameras", "gaussians"), {}
    for what, value in _columns().items():
        powers, *_ = np.linalg.lstsq(system, np.log([max(value(row), 1e-9) for row in rows]), rcond=None)
        found[what] = {names[column]: round(float(power), 2) for column, power in zip(varied, powers, strict=False)}
    return found


def _columns() -> dict[str, Callable[[Mapping[str, Any]], float]]:
    return {
        "iteration_seconds": lambda row: row["backdrop"]["iteration_cpu_seconds"],
        "keyframe_seconds": lambda row: row["keyframe"]["iteration_cpu_seconds"],
        "frame_seconds": lambda row: row["frames"]["iteration_cpu_seconds"],
        "backdrop_bytes": lambda row: row["backdrop"]["peak_bytes"],
        "frames_bytes": lambda row: row["frames"]["peak_bytes"],
    }


def run(cases: Sequence[Case]) -> dict[str, Any]:
    """All cases, one after another."""
    rows = []
    for case in cases:
        done = subprocess.run(
            [sys.executable, "-m", "bench.size", "--case", json.dumps(asdict(case))],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{case} failed:\n{done.stderr[-2000:]}")
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(line(rows[-1]), flush=True)
    compiler: Any = numba
    usual = [row for row in rows if row["memory_gb"] == max(case.memory_gb for case in cases)]
    return {
        "machine": {
            "cpu": llvmlite.binding.get_host_cpu_name(),
            "system": platform.platform(),
            "threads": compiler.config.NUMBA_NUM_THREADS,
            "load": os.getloadavg()[0],
        },
        "cases": rows,
        "exponents": exponents(usual),
    }


def line(row: Mapping[str, Any]) -> str:
    """A case, for people."""
    text = f"{row['width']}x{row['height']:<5} {row['cameras']:3} cameras {row['gaussians']:7,} Gaussians "
    text += f"{row['memory_gb']:4g} GB"
    for name in PHASES:
        part = row[name]
        text += f" | {name} {1e3 * part['iteration_cpu_seconds']:6.0f} ms {part['peak_bytes'] / 1e9:5.2f} GB"
    return text


def report(result: Mapping[str, Any]) -> Iterator[str]:
    """Lines for people."""
    for what, powers in result["exponents"].items():
        yield f"{MEASURED[what]}: " + ", ".join(f"{name}^{power}" for name, power in powers.items())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("size", __doc__)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--captures", type=Path, help="folder of the filmed captures, one a size")
    parser.add_argument("--sizes", default="640x360,1280x720,1920x1200", metavar="WxH,WxH", help="of the pictures")
    parser.add_argument("--cameras", default="20,88", metavar="N,N")
    parser.add_argument("--gaussians", default="20000,60000", metavar="N,N", help="the last one for all sizes")
    parser.add_argument("--memory-gb", default="2", metavar="GB,GB", help="budgets, each for all cases")
    parser.add_argument("--iterations", type=int, default=40, help="of the backdrop and each frame")
    parser.add_argument("--case", help="measure this one, in this process")
    parser.add_argument("--prepare", type=Path, help="folder for what the case starts from")
    given = parser.parse_args(arguments)
    if given.case:
        case = Case(**json.loads(given.case))
        prepare(case, given.prepare) if given.prepare else print(json.dumps(measure(case)))
        return
    if given.out is None or given.captures is None:
        parser.error("--out and --captures are needed")
    result = run(list(_cases(given)))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(result, indent=1) + "\n")
    print("\n".join(report(result)))


def _cases(given: Any) -> Iterator[Case]:
    """Every size with every number of cameras; fewer Gaussians at the first number of cameras only."""
    given.captures.mkdir(parents=True, exist_ok=True)
    *few, most = map(int, given.gaussians.split(","))
    cameras = [int(number) for number in given.cameras.split(",")]
    for memory in map(float, given.memory_gb.split(",")):
        for size in given.sizes.split(","):
            width, height = map(int, size.split("x"))
            capture = str(film(given.captures, width, height))
            for count in cameras:
                for gaussians in (*(few if count == cameras[0] else ()), most):
                    yield Case(capture, width, height, count, gaussians, memory, given.iterations)


if __name__ == "__main__":
    main()
