"""Fits that must not break: absurd Gaussians, odd pictures, other units of length, and a sequence of many frames.

    python -m bench.stress_fit --out runs/stress_fit.json --frames 1000

Everything is tiny (96x64 pictures of a few hundred Gaussians), so that a thousand frames take minutes. The sequence is
a ball that moves through a still cloud, fitted as the pipeline does: each segment from a keyframe that goes on from the
end of the segment before, or from the keyframe before (--side-by-side); PSNR, number of Gaussians and memory are noted
along the way.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import av
import numpy as np

from bench import command
from packuv.budget import Budget
from packuv.camera import PinholeCamera
from packuv.fit.density import DensityOptions
from packuv.fit.frames import fit_segment
from packuv.fit.keyframe import choose_quantizer, fit_backdrop, fit_next
from packuv.fit.model import Model
from packuv.fit.options import FitOptions
from packuv.fit.seam import tail
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.fit.start.bounds import Bounds, find_bounds
from packuv.fit.start.first import StartOptions, round_gaussians
from packuv.footage import LensCamera, Views
from packuv.gaussians.floats import ATTRIBUTES, Gaussians
from packuv.metrics import psnr
from packuv.motion import MotionCache, MotionOptions, find_background, measure_motion
from packuv.raster import RasterOptions, render

WIDTH, HEIGHT = 96, 64
CACHE_BYTES = 8 << 20
"""Of decoded pictures; the default of 1 GiB would hold the whole sequence, and memory would grow until then"""
UNSEEN = "unseen"
"""A camera between the others that is never fitted"""
MOTION = MotionOptions(width=96, flow_width=96, least_area_px=4, closing_px=1, dilation_px=1)


@dataclass(frozen=True)
class StressOptions:
    """What is run."""

    frames: int = 1000
    segment: int = 25
    """Frames from one keyframe to the next"""
    cameras: int = 6
    side_by_side: bool = False
    """Fit keyframes from one another"""
    iterations: int = 40
    """Of each case"""
    seconds: float = np.inf
    """No new segment is begun after this time; the result tells how many frames were fitted"""
    fit: FitOptions = field(
        default_factory=lambda: FitOptions(
            iterations=150,
            key_iterations=24,
            frame_iterations=12,
            spare=40,
            key_births=40,
            near_jitter=0.0,
            start=StartOptions(count=400),
            density=DensityOptions(cap=600, every=25),
        )
    )


# -- scenes -----------------------------------------------------------------------------------------------------------


def ring_cameras(count: int, *, turn: float = 0.0, scale: float = 1.0) -> list[PinholeCamera]:
    """Cameras on a circle of radius 4 that look at the origin; `turn` is a share of the step between two of them."""
    return [_camera(f"cam{index}", 2 * np.pi * (index + turn) / count, index, scale) for index in range(count)]


def _camera(name: str, angle: float, index: int, scale: float) -> PinholeCamera:
    origin = 4 * scale * np.array([np.cos(angle), np.sin(angle), 0.35 * (-1) ** index])
    forward = -origin / np.linalg.norm(origin)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ origin
    return PinholeCamera(name, WIDTH, HEIGHT, WIDTH * 1.1, WIDTH * 1.1, WIDTH / 2, HEIGHT / 2, pose)


def cloud(count: int = 250, *, seed: int = 5, sh_degree: int = 0, scale: float = 1.0) -> Gaussians:
    """Still Gaussians around the origin."""
    rng = np.random.default_rng(seed)
    xyz, rgb = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0.3], rng.random((count, 3))
    return round_gaussians(scale * xyz, rgb, scale * rng.uniform(0.05, 0.2, count), opacity=0.9, sh_degree=sh_degree)


def ball_scene(instant: int) -> Gaussians:
    """The cloud, and a red ball that goes to and fro above it, once in 40 frames."""
    still = cloud()
    place = np.array([[0.7 * np.sin(2 * np.pi * instant / 40), 0.0, 0.75]])
    ball = round_gaussians(place, np.array([[1, 0.1, 0.1]]), np.array([0.2]), opacity=0.9, sh_degree=0)
    return Gaussians(*(np.concatenate([getattr(g, name) for g in (still, ball)]) for name in ATTRIBUTES))


def film(
    folder: Path,
    cameras: Sequence[PinholeCamera],
    frames: int,
    scene: Callable[[int], Gaussians] = ball_scene,
    missing: Sequence[tuple[int, int]] = (),
) -> Views:
    """Lossless videos of a scene under `folder`; (instant, camera) pairs in `missing` have no picture."""
    for camera in cameras:
        with av.open(str(folder / f"{camera.name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "bgr0"
            for instant in range(frames):
                pixels = np.rint(np.clip(picture_of(scene(instant), camera), 0, 1) * 255).astype(np.uint8)
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels.transpose(1, 2, 0)), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    numbers = np.tile(np.arange(frames)[:, None], (1, len(cameras)))
    for instant, index in missing:
        numbers[instant, index] = -1
    videos = {camera.name: folder / f"{camera.name}.mkv" for camera in cameras}
    return Views(videos, numbers, [LensCamera(camera) for camera in cameras], budget=Budget(CACHE_BYTES))


def picture_of(gaussians: Gaussians, camera: PinholeCamera, *, near: float = 0.1) -> np.ndarray:
    """float32 [3, H, W]"""
    return np.array(render(gaussians, camera, options=RasterOptions(near)).colour)


# -- single fits ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What a fit of one case came to."""

    first_loss: float
    last_loss: float
    guarded: int
    """Times that the guard stepped in"""
    finite: bool
    """Whether every value of every Gaussian is"""


def fit_case(
    start: Gaussians,
    cameras: Sequence[PinholeCamera],
    targets: Sequence[np.ndarray],
    *,
    iterations: int,
    near_share: float = 0.02,
    quantized: bool = False,
) -> Outcome:
    """Fit from `start` to the targets, in floats or through codes."""
    bounds = find_bounds(cameras, near_share=near_share)
    options = FitOptions(
        sh_degree=start.sh_degree, near_jitter=0.0, random_background=False, opacity_weight=0.01, scale_weight=0.01
    )
    solver = Solver(Model(start), bounds, options, np.random.default_rng(0))
    if quantized:
        solver.fix(choose_quantizer(solver.model.gaussians, bounds, start.sh_degree))
    shots = [Shot(camera, target) for camera, target in zip(cameras, targets, strict=True)]
    first = solver.run(shots, len(shots), of=iterations)
    last = solver.run(shots, iterations - len(shots), of=iterations)
    finite = all(np.isfinite(getattr(solver.model.gaussians, name)).all() for name in ATTRIBUTES)
    return Outcome(first["photometric"], last["photometric"], solver.guarded, finite)


def absurd_starts(cameras: Sequence[PinholeCamera]) -> Iterator[tuple[str, Gaussians]]:
    """A sound cloud of which every third Gaussian is absurd, by name."""
    third = slice(None, None, 3)
    for name, column, value in (
        ("huge scales", "log_scales", 8.0),
        ("scales beyond the exponent", "log_scales", 200.0),
        ("tiny scales", "log_scales", -30.0),
        ("needles", "log_scales", [-25.0, -25.0, 1.0]),
        ("saturated opacity", "opacity_logits", 60.0),
        ("no opacity", "opacity_logits", -60.0),
        ("zero quaternions", "quaternions", 0.0),
        ("long quaternions", "quaternions", 1e15),
        ("not a number", "means", np.nan),
        ("infinite colours", "sh", np.inf),
        ("glaring colours", "sh", 1e3),
    ):
        start = jittered(cloud())
        getattr(start, column)[third] = value
        yield name, start
    for name, distance in (
        ("behind the camera", -0.5),
        ("on the camera's plane", 0.0),
        ("at the lens", 1e-6),
        ("before the near plane", 0.05),
        ("just behind the near plane", 0.09),
    ):
        start = jittered(cloud())
        rows = np.arange(0, len(start), 3)
        chosen = [cameras[int(row) % len(cameras)] for row in rows]
        start.means[rows] = [camera.centre + distance * camera.forward for camera in chosen]
        yield name, start


def jittered(gaussians: Gaussians, *, scale: float = 1.0) -> Gaussians:
    """The same Gaussians a little out of place, grey, so that a fit has something to do."""
    noise = np.random.default_rng(1).normal(size=gaussians.means.shape) * 0.03 * scale
    return replace(gaussians, means=(gaussians.means + noise).astype(np.float32), sh=gaussians.sh * np.float32(0.5))


def run_cases(options: StressOptions) -> dict[str, dict[str, Any]]:
    """Every case in floats and through codes, and what each came to."""
    cameras = ring_cameras(options.cameras)
    targets = [picture_of(cloud(), camera) for camera in cameras]
    shape = (3, HEIGHT, WIDTH)
    out = {}
    for quantized in (False, True):
        kind = "codes" if quantized else "floats"
        for name, start in absurd_starts(cameras):
            out[f"{name}, {kind}"] = fit_case(
                start, cameras, targets, iterations=options.iterations, quantized=quantized
            )
        for name, value in (("black pictures", 0.0), ("white pictures", 1.0), ("grey pictures", 0.5)):
            even = [np.full(shape, value, np.float32)] * len(cameras)
            out[f"{name}, {kind}"] = fit_case(
                jittered(cloud()), cameras, even, iterations=options.iterations, quantized=quantized
            )
        for scale in (1.0, 1e6, 1e-3):
            out[f"scene times {scale:g}, {kind}"] = fit_scaled(
                scale, iterations=options.iterations, count=options.cameras, quantized=quantized
            )
    return {name: asdict(outcome) for name, outcome in out.items()}


def fit_scaled(scale: float, *, iterations: int, count: int, quantized: bool = False) -> Outcome:
    """The same scene and the same fit in another unit of length."""
    cameras = ring_cameras(count, scale=scale)
    targets = [picture_of(cloud(scale=scale), camera, near=0.1 * scale) for camera in cameras]
    start = jittered(cloud(scale=scale), scale=scale)
    return fit_case(start, cameras, targets, iterations=iterations, quantized=quantized)


# -- the sequence -----------------------------------------------------------------------------------------------------


def fit_sequence(
    views: Views, motion: MotionCache, scratch: Path, options: StressOptions, *, judges: Sequence[PinholeCamera]
) -> dict[str, list[Any]]:
    """Fit all segments; per frame the PSNR of the codes on the judges' cameras, dB; per segment count and memory.

    Each segment starts at a keyframe of its own, as in the pipeline: side by side all from the backdrop.
    """
    started = time.monotonic()
    stills = find_background(views, options.fit.background)
    backdrop = end = fit_backdrop(views, stills, points=None, options=options.fit)
    found: dict[str, list[Any]] = {"psnr_db": [], "gaussians": [], "changed": [], "memory_mb": []}
    starts = range(0, len(views), options.segment)
    for start in starts:
        if time.monotonic() - started > options.seconds:
            break
        key = fit_next(end, views, start, stills=stills, motion=MOTION, options=options.fit)
        folder = scratch / f"segment{start}"
        folder.mkdir()
        instants = range(start, min(start + options.segment, len(views)))
        segment, _ = fit_segment(key, views, instants, motion=motion, options=options.fit, scratch=folder)
        end = backdrop if options.side_by_side else tail(key, segment)
        for index, instant in enumerate(instants):
            shown = key.quantizer.decode(segment.frame(index))
            found["psnr_db"].append(_score(shown, instant, judges, key.bounds))
        found["gaussians"].append(len(segment.key))
        found["changed"].append(int(segment.dynamic.sum()))
        found["memory_mb"].append(round(own_memory_mb(), 1))
    return found


def _score(gaussians: Gaussians, instant: int, judges: Sequence[PinholeCamera], bounds: Bounds) -> float:
    truth = ball_scene(instant)
    drawn = [(picture_of(gaussians, camera, near=bounds.near), picture_of(truth, camera)) for camera in judges]
    return float(np.mean([psnr(np.clip(shown, 0, 1), np.clip(wanted, 0, 1)) for shown, wanted in drawn]))


def own_memory_mb() -> float:
    """Memory of this process now, without the files that it has mapped (flow), which the system may drop."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) * 1024 / 1e6


def drift_db(values: Sequence[float], width: int = 50) -> float:
    """Mean of the first `width` frames less that of the last; positive where quality falls."""
    return float(np.mean(values[:width]) - np.mean(values[-width:]))


def run_sequence(options: StressOptions) -> dict[str, Any]:
    """Film, measure motion, fit, judge on fitted cameras and an unseen one."""
    cameras = ring_cameras(options.cameras)
    unseen = replace(ring_cameras(options.cameras, turn=0.5)[0], name=UNSEEN)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        views = film(folder, cameras, options.frames)
        (folder / "motion").mkdir()
        measure_motion(views, folder / "motion", options=MOTION)
        motion = MotionCache.load(folder / "motion")
        started = time.monotonic()
        found = fit_sequence(views, motion, folder, options, judges=[unseen])
    values = found["psnr_db"]
    return {
        "frames": len(values),
        "segment": options.segment,
        "side_by_side": options.side_by_side,
        "fit_seconds": round(time.monotonic() - started, 1),
        "unseen_psnr_db": {
            "mean": round(float(np.mean(values)), 3),
            "least": round(min(values), 3),
            "first_50": round(float(np.mean(values[:50])), 3),
            "last_50": round(float(np.mean(values[-50:])), 3),
            "drift": round(drift_db(values), 3),
        },
        "per_segment": {
            "psnr_db": [
                round(float(np.mean(values[i : i + options.segment])), 2)
                for i in range(0, len(values), options.segment)
            ],
            **{name: column for name, column in found.items() if name != "psnr_db"},
        },
    }


def report(result: Mapping[str, Any]) -> Iterator[str]:
    """Lines for people."""
    for name, outcome in result["cases"].items():
        yield (
            f"{name:44} loss {outcome['first_loss']:.4f} -> {outcome['last_loss']:.4f}, "
            f"{outcome['guarded']} guarded{'' if outcome['finite'] else ', NOT FINITE'}"
        )
    sequence = result["sequence"]
    quality, memory = sequence["unseen_psnr_db"], sequence["per_segment"]["memory_mb"]
    yield (
        f"{sequence['frames']} frames in {sequence['fit_seconds']} s: unseen camera {quality['mean']} dB, drift "
        f"{quality['drift']} dB from the first to the last 50 frames"
    )
    yield f"Gaussians per segment {sequence['per_segment']['gaussians']}, memory {memory[0]} -> {memory[-1]} MB"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("stress_fit", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--frames", type=int, default=StressOptions.frames)
    parser.add_argument("--segment", type=int, default=StressOptions.segment)
    parser.add_argument("--seconds", type=float, default=StressOptions.seconds, help="begin no segment after this time")
    parser.add_argument("--side-by-side", action="store_true", help="fit keyframes from one another")
    given = parser.parse_args(arguments)
    options = StressOptions(given.frames, given.segment, side_by_side=given.side_by_side, seconds=given.seconds)
    sequence = run_sequence(options)
    result = {
        "options": vars(given) | {"out": given.out.name},
        "load": os.getloadavg()[0],
        "cases": run_cases(options),
        "sequence": sequence,
    }
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(result, indent=1) + "\n")
    print("\n".join(report(result)))


if __name__ == "__main__":
    main()
