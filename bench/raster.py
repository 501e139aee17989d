"""Speed of the CPU rasterizer, the photometric loss and Adam: where an iteration's time goes, and what the CPU can do.

    python -m bench.raster --out runs/raster.json                          # a made-up room
    python -m bench.raster --ply scene.ply --out runs/raster.json          # a trained scene
    python -m bench.raster --device cuda --out runs/raster.json            # and that iteration on a GPU, by gsplat too

Times are the least and the median of several repetitions, milliseconds. With one thread they are CPU time, which other
processes disturb least; with more they are wall time. Compare rows of one run.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np
from numba import njit

from bench import command
from packuv import raster
from packuv.camera import PinholeCamera
from packuv.fit.adam import AdamState, adam_step
from packuv.fit.device import choose_device
from packuv.fit.labels import LabelOptions, count_hits
from packuv.fit.losses import PhotometricOptions, photometric_loss
from packuv.gaussians.floats import Gaussians, arrays, rows_of
from packuv.interchange import read_ply
from packuv.kernels.simd import fma, splat, sum_lanes
from packuv.raster import (
    Arena,
    Gradients,
    RasterOptions,
    Rendering,
    bins,
    blend,
    compose,
    cpu,
    gradients,
    lists,
    merge,
    render,
    tile_shape,
)

STAGES = (
    (lists, "project"),
    (bins, "drawn"),
    (bins, "sort_by_depth"),
    (bins, "running_sum"),
    (bins, "find_tiles"),
    (bins, "count_pairs"),
    (bins, "start_tiles"),
    (bins, "scatter_pairs"),
    (blend, "fill"),
    (blend, "blend"),
    (blend, "blend_backward"),
    (cpu, "project_backward"),
)
"""Kernels of a rendering and its gradients, in order"""
LAYER_STAGES = (
    *STAGES[: STAGES.index((blend, "blend"))],
    (merge, "blend_over"),
    (merge, "blend_over_backward"),
    (cpu, "project_backward"),
)
"""The same over a layer"""
FORWARD_FLOPS, BACKWARD_FLOPS = 34, 58
"""Floating-point operations per pixel and Gaussian in the loops over blocks; fused ones count two, comparisons none"""


@dataclass(frozen=True)
class BenchOptions:
    """What is measured."""

    count: int = 60_000
    """Gaussians of the made-up room"""
    width: int = 640
    height: int = 360
    sh_degree: int = 3
    """Of the made-up room"""
    views: int = 27
    """Cameras of the labels"""
    repeats: int = 15
    """Repetitions of every measurement"""
    shares: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1, 0.05)
    """Shares of active tiles, one rectangle each; the same share of rows may change"""
    changing: int = 4_000
    """Gaussians of two figures in the made-up room that are drawn over a layer of the others"""
    layer_tiles: float = 0.34
    """Share of active tiles then"""
    seed: int = 0


# -- scenes -----------------------------------------------------------------------------------------------------------


def room(options: BenchOptions) -> Gaussians:
    """Gaussians on the walls of a room two units across, three in ten inside, near ones near in memory."""
    rng, count = np.random.default_rng(options.seed), options.count
    means = rng.uniform(-1, 1, (count, 3))
    axis, wall = rng.integers(0, 3, count), rng.random(count) < 0.7
    means[wall, axis[wall]] = np.sign(means[wall, axis[wall]])
    means[~wall] *= 0.5
    cells = (((means + 1) * 8).astype(int) * (1, 16, 256)).sum(1)
    order = np.argsort(cells, kind="stable")
    coefficients = rng.normal(size=(count, (options.sh_degree + 1) ** 2, 3)) * 0.2
    scales = np.log(0.012) + 0.6 * rng.normal(size=(count, 3))
    logits = rng.normal(size=count) * 1.5 + 0.5
    arrays = (means, scales, rng.normal(size=(count, 4)), logits, coefficients)
    return Gaussians(*(np.ascontiguousarray(array[order], np.float32) for array in arrays))


def with_figures(options: BenchOptions) -> tuple[Gaussians, Gaussians]:
    """The room without some of its Gaussians, and these on the skins of two standing figures."""
    rng, whole = np.random.default_rng(options.seed), room(options)
    rows = np.sort(rng.choice(options.count, options.changing, replace=False))
    skin = rng.normal(size=(options.changing, 3))
    skin *= np.array([0.12, 0.4, 0.12]) / np.linalg.norm(skin, axis=1, keepdims=True)
    places = np.array([[-0.3, 0.1, 0.1], [0.35, 0.1, -0.2]])
    whole.means[rows] = skin + places[rng.integers(0, 2, options.changing)]
    return rows_of(whole, np.delete(np.arange(options.count), rows)), rows_of(whole, rows)


def room_camera(options: BenchOptions) -> PinholeCamera:
    """Before one wall, looking at the opposite one."""
    return _camera(np.array([0, 0, 0.95]), 0.625 * options.width, options)


def trained_camera(gaussians: Gaussians, options: BenchOptions) -> PinholeCamera:
    """Sees a trained scene (y down) whole, from its front."""
    low, high = np.percentile(gaussians.means, [2, 98], axis=0)
    return _camera(-(low + high) / 2 + (0, 0, 1.3 * float(np.max(high - low))), options.height, options)


def _camera(translation: np.ndarray, focal: float, options: BenchOptions) -> PinholeCamera:
    pose, width, height = np.eye(4), options.width, options.height
    pose[:3, 3] = translation
    return PinholeCamera("bench", width, height, focal, focal, width / 2, height / 2, pose)


# -- measuring --------------------------------------------------------------------------------------------------------


Clock = Callable[[], float]


def timed(clock: Clock, samples: list[float], work: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call something, and note how many milliseconds it took."""
    start = clock()
    result = work(*arguments, **options)
    samples.append(1e3 * (clock() - start))
    return result


def summary(samples: Sequence[float]) -> dict[str, float]:
    return {"min_ms": round(min(samples), 3), "median_ms": round(float(np.median(samples)), 3)}


@contextmanager
def stage_times(clock: Clock, stages: Sequence[tuple[Any, str]] = STAGES) -> Iterator[dict[str, list[float]]]:
    """Times of every kernel that a rendering calls, by name."""
    times: dict[str, list[float]] = {name: [] for _, name in stages}
    kernels = [getattr(module, name) for module, name in stages]
    for (module, name), kernel in zip(stages, kernels, strict=True):
        setattr(module, name, partial(timed, clock, times[name], kernel))
    try:
        yield times
    finally:
        for (module, name), kernel in zip(stages, kernels, strict=True):
            setattr(module, name, kernel)


class Iteration:
    """One camera's iteration of a fit, again and again."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: PinholeCamera,
        options: BenchOptions,
        clock: Clock,
        device: str = "cpu",
        renderer: Any = raster,
    ) -> None:
        rng = np.random.default_rng(options.seed)
        self.gaussians, self.camera, self.clock, self.renderer = gaussians, camera, clock, renderer
        self.target = rng.random((3, camera.height, camera.width)).astype(np.float32)
        self.work, self.raster = Arena(), RasterOptions(near=0.05, device=device)
        self.parameters = [getattr(gaussians, f.name).copy() for f in fields(Gaussians)]
        self.states = [AdamState.zeros(array) for array in self.parameters]
        self.times: dict[str, list[float]] = {name: [] for name in ("forward", "loss", "backward", "adam")}

    def run(self, tiles: np.ndarray | None = None, rows: np.ndarray | None = None) -> Rendering:
        """Render, compare, differentiate, step; the times go to `times`."""
        clock, times, target = self.clock, self.times, self.target
        drawn: Rendering = timed(
            clock,
            times["forward"],
            self.renderer.render,
            self.gaussians,
            self.camera,
            options=self.raster,
            arena=self.work,
            tiles=tiles,
        )
        loss = timed(
            clock, times["loss"], photometric_loss, drawn.colour, target, options=PhotometricOptions(), tiles=tiles
        )
        found = timed(clock, times["backward"], self.renderer.gradients, drawn, loss.gradient, rows=rows)
        visible = drawn.visible > 0
        timed(clock, times["adam"], self._step, found, visible if rows is None else visible & rows)
        return drawn

    def _step(self, found: Gradients, rows: np.ndarray) -> None:
        for field, values, state in zip(fields(Gaussians), self.parameters, self.states, strict=True):
            adam_step(values, getattr(found, field.name), state, rate=1e-6, rows=rows)

    def summary(self) -> dict[str, Any]:
        return {name: summary(samples) for name, samples in self.times.items()}


def measure_iteration(
    gaussians: Gaussians, camera: PinholeCamera, options: BenchOptions, threads: int
) -> dict[str, Any]:
    """An iteration at full picture, and its stages."""
    numba.set_num_threads(threads)
    clock = time.process_time if threads == 1 else time.perf_counter
    iteration = Iteration(gaussians, camera, options, clock)
    with stage_times(clock) as stages:
        for _ in range(options.repeats):
            drawn = iteration.run()
    per_repeat = {name: np.reshape(samples, (options.repeats, -1)).sum(1).tolist() for name, samples in stages.items()}
    return {
        "threads": threads,
        "clock": clock.__name__,
        "visible": int((drawn.visible > 0).sum()),
        "pairs": drawn.pair_count,
        "evaluations": drawn.evaluation_count,
        "iteration": iteration.summary(),
        "stages": {name: summary(samples) for name, samples in per_repeat.items()},
    }


def measure_device(gaussians: Gaussians, camera: PinholeCamera, options: BenchOptions, device: str) -> dict[str, Any]:
    """An iteration and the labels of a frame where `device` draws and counts, wall time, copies to and fro included."""
    iteration = Iteration(gaussians, camera, options, time.perf_counter, device)
    mask = np.random.default_rng(options.seed).random((camera.height, camera.width)) < 0.01
    cameras, masks, labels = [camera] * options.views, [mask] * options.views, list[float]()
    for _ in range(options.repeats + 1):
        iteration.run()
        timed(
            time.perf_counter,
            labels,
            count_hits,
            gaussians,
            cameras,
            masks,
            near=0.05,
            options=LabelOptions(),
            device=device,
        )
    for samples in (*iteration.times.values(), labels):
        del samples[0]  # compiles
    return {"device": device, "iteration": iteration.summary(), "labels": summary(labels), "views": options.views}


def measure_devices(
    gaussians: Gaussians, camera: PinholeCamera, options: BenchOptions, devices: Sequence[str]
) -> list[dict[str, Any]]:
    """Each device's, and gsplat's where both a GPU and gsplat are there."""
    measured = [measure_device(gaussians, camera, options, name) for name in devices]
    if "cuda" in devices and importlib.util.find_spec("gsplat"):
        measured.append(measure_yardstick(gaussians, camera, options))
    return measured


def measure_yardstick(
    gaussians: Gaussians, camera: PinholeCamera, options: BenchOptions, device: str = "cuda"
) -> dict[str, Any]:
    """The iteration with gsplat in place of the CUDA rasterizer."""
    from bench import yardstick

    iteration = Iteration(gaussians, camera, options, time.perf_counter, device, yardstick)
    for _ in range(options.repeats + 1):
        iteration.run()
    for samples in iteration.times.values():
        del samples[0]  # compiles
    return {"device": f"{device} by gsplat", "iteration": iteration.summary()}


def measure_shares(gaussians: Gaussians, camera: PinholeCamera, options: BenchOptions) -> list[dict[str, Any]]:
    """Cost of an iteration against the share of active tiles, one thread."""
    numba.set_num_threads(1)
    rng, out = np.random.default_rng(options.seed), []
    for share in options.shares:
        tiles, rows = _rectangle(tile_shape(camera), share), rng.random(len(gaussians)) < share
        iteration = Iteration(gaussians, camera, options, time.process_time)
        for _ in range(options.repeats):
            drawn = iteration.run(tiles, rows)
        out.append(
            {
                "tiles": float(tiles.mean()),
                "rows": float(rows.mean()),
                "evaluations": drawn.evaluation_count,
                **iteration.summary(),
            }
        )
    return out


def measure_layer(options: BenchOptions, threads: int) -> dict[str, Any]:
    """A picture and its gradients of two figures over a layer, and of all Gaussians in one set, by turns."""
    numba.set_num_threads(threads)
    clock = time.process_time if threads == 1 else time.perf_counter
    (still, changing), camera = with_figures(options), room_camera(options)
    whole = Gaussians(*(np.concatenate(pair) for pair in zip(arrays(still), arrays(changing), strict=True)))
    rows, tiles = np.arange(len(whole)) >= len(still), _rectangle(tile_shape(camera), options.layer_tiles)
    given: dict[str, Any] = {"options": RasterOptions(near=0.05), "tiles": tiles}
    slopes = np.random.default_rng(options.seed).normal(size=(3, camera.height, camera.width)).astype(np.float32)
    one, over = Passes(clock, slopes), Passes(clock, slopes)
    layer, composing, kernels = compose(still, camera, **given), list[float](), dict[str, list[float]]()
    for _ in range(options.repeats):
        timed(clock, composing, compose, still, camera, **given)
        one.run(whole, camera, rows, **given)
        with stage_times(clock, LAYER_STAGES) as stages:
            drawn = over.run(changing, camera, None, over=layer, **given)
        for name, samples in stages.items():
            kernels.setdefault(name, []).append(sum(samples))
    ratio = sum(float(np.median(v)) for v in one.times) / sum(float(np.median(v)) for v in over.times)
    return {
        "threads": threads,
        "clock": clock.__name__,
        "compose": summary(composing),
        "layer_megabytes": round(layer.nbytes / 1e6, 1),
        "layer_pairs": len(layer.pairs),
        "pairs": drawn.pair_count,
        "evaluations": drawn.evaluation_count,
        "in_one_set": [summary(samples) for samples in one.times],
        "over_the_layer": [summary(samples) for samples in over.times],
        "ratio_of_medians": round(ratio, 2),
        "stages": {name: summary(samples) for name, samples in kernels.items()},
    }


class Passes:
    """Pictures and their gradients, with the times of both."""

    def __init__(self, clock: Clock, slopes: np.ndarray) -> None:
        self.clock, self.slopes, self.work = clock, slopes, Arena()
        self.times: tuple[list[float], list[float]] = ([], [])

    def run(self, gaussians: Gaussians, camera: PinholeCamera, rows: np.ndarray | None, **options: Any) -> Rendering:
        drawn: Rendering = timed(self.clock, self.times[0], render, gaussians, camera, arena=self.work, **options)
        timed(self.clock, self.times[1], gradients, drawn, self.slopes, rows=rows)
        return drawn


def _rectangle(shape: tuple[int, int], share: float) -> np.ndarray:
    """A centred rectangle of that share of all tiles."""
    tiles = np.zeros(shape, bool)
    height, width = (round(size * share**0.5) for size in shape)
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2
    tiles[top : top + height, left : left + width] = True
    return tiles


@njit(error_model="numpy")
def _multiply_and_add(count: int, start: np.float32) -> Any:
    a, b, c, d, e = splat(start), splat(2 * start), splat(3 * start), splat(4 * start), splat(5 * start)
    x, y = splat(np.float32(0.999)), splat(start)
    for _ in range(count):
        a, b, c, d, e = fma(a, x, y), fma(b, x, y), fma(c, x, y), fma(d, x, y), fma(e, x, y)
    return sum_lanes(a + b + c + d + e)


def peak_gflops(repeats: int) -> float:
    """What one thread reaches with independent fused multiply-adds and nothing else."""
    count, samples = 1_000_000, list[float]()
    _multiply_and_add(1, np.float32(0.5))
    for _ in range(repeats):
        timed(time.process_time, samples, _multiply_and_add, count, np.float32(0.5))
    return count * 5 * 16 * 2 / min(samples) / 1e6


FIRST_CALLS = """
import time
start = time.process_time()
from bench.raster import call_everything
imported, wall = time.process_time() - start, time.perf_counter()
call_everything()
print(imported, time.perf_counter() - wall, time.process_time() - start)
"""


def call_everything() -> None:
    """One small iteration: everything gets compiled."""
    options = BenchOptions(count=100, width=64, height=48)
    Iteration(room(options), room_camera(options), options, time.process_time).run()


def measure_compiler() -> dict[str, dict[str, float]]:
    """Seconds until everything has run once in a new process, with an empty and with a full cache."""
    out = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("cold", "warm"):
            run = subprocess.run(
                [sys.executable, "-c", FIRST_CALLS],
                env={**os.environ, "NUMBA_CACHE_DIR": folder},
                capture_output=True,
                text=True,
                check=True,
            )
            names = ("import_cpu_seconds", "first_calls_wall_seconds", "cpu_seconds")
            values = [round(float(word), 2) for word in run.stdout.split()]
            out[name] = dict(zip(names, values, strict=True))
    return out


def throughput(measured: dict[str, Any], peak: float) -> dict[str, dict[str, float]]:
    """Evaluations per second and core of both loops over blocks, and their share of the measured peak."""
    out = {}
    for name, flops in (("blend", FORWARD_FLOPS), ("blend_backward", BACKWARD_FLOPS)):
        rate = measured["evaluations"] / measured["stages"][name]["min_ms"] / 1e6 / measured["threads"]
        out[name] = {"evaluations_1e9_per_core_second": round(rate, 3), "share_of_peak": round(rate * flops / peak, 3)}
    return out


def run(options: BenchOptions, ply: Path | None = None, device: str = "cpu") -> dict[str, Any]:
    """All measurements. Raises ValueError for a GPU that cannot be used."""
    devices = sorted({"cpu", choose_device(device)})
    gaussians = read_ply(ply) if ply else room(options)
    camera = trained_camera(gaussians, options) if ply else room_camera(options)
    call_everything()
    peak = peak_gflops(options.repeats)
    compiler: Any = numba  # whose stubs leave these two out
    iterations = [
        measure_iteration(gaussians, camera, options, n) for n in sorted({1, compiler.config.NUMBA_NUM_THREADS})
    ]
    return {
        "options": asdict(options),
        "scene": ply.name if ply else "room",
        "gaussians": len(gaussians),
        "machine": {
            "cpu": llvmlite.binding.get_host_cpu_name(),
            "system": platform.platform(),
            "threading_layer": compiler.threading_layer(),
            "load": os.getloadavg()[0],
        },
        "peak_gflops_per_core": round(peak, 1),
        "iterations": iterations,
        "throughput": [throughput(measured, peak) for measured in iterations],
        "layer": [measure_layer(options, n) for n in sorted({1, compiler.config.NUMBA_NUM_THREADS})],
        "active_tiles": measure_shares(gaussians, camera, options),
        "compiler": measure_compiler(),
        "devices": measure_devices(gaussians, camera, options, devices),
    }


def report(result: dict[str, Any]) -> Iterator[str]:
    """Lines for people."""
    yield f"{result['scene']}, {result['gaussians']:,} Gaussians, {result['machine']}"
    yield f"peak {result['peak_gflops_per_core']} GFLOP/s a core"
    for measured, rates in zip(result["iterations"], result["throughput"], strict=True):
        yield f"{measured['threads']} threads ({measured['clock']}), {measured['pairs']:,} pairs; ms, least / median"
        for name, value in {**measured["iteration"], **{f"  {k}": v for k, v in measured["stages"].items()}}.items():
            yield f"  {name:20} {value['min_ms']:8.2f} {value['median_ms']:8.2f}"
        for name, rate in rates.items():
            speed, share = rate.values()
            yield f"  {name}: {speed} G evaluations/s/core, {share:.0%} of peak"
    parts = ("forward", "loss", "backward", "adam")
    yield f"active tiles: {', '.join(parts)} (ms, least)"
    for row in result["active_tiles"]:
        yield f"  {row['tiles']:6.1%} " + " ".join(f"{row[name]['min_ms']:8.2f}" for name in parts)
    for row in result["layer"]:
        yield (
            f"two figures over a layer, {row['threads']} threads ({row['clock']}): {row['ratio_of_medians']} times as "
            f"fast as in one set; the layer takes {row['layer_megabytes']} MB, {row['compose']['median_ms']} ms"
        )
        for name in ("in_one_set", "over_the_layer"):
            yield f"  {name:20} " + " ".join(f"{part['median_ms']:8.2f}" for part in row[name])
        for name, value in row["stages"].items():
            yield f"    {name:20} {value['min_ms']:8.2f} {value['median_ms']:8.2f}"
    for row in result["devices"]:
        labels = {f"labels in {row['views']} views": row["labels"]} if "labels" in row else {}
        columns = {**row["iteration"], **labels}
        yield f"{row['device']}, wall: " + ", ".join(f"{name} {v['median_ms']:.2f}" for name, v in columns.items())
    yield f"first calls: cold {result['compiler']['cold']}, warm {result['compiler']['warm']}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("raster", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--ply", type=Path, help="a trained scene instead of the made-up room")
    parser.add_argument("--size", default="640x360", help="of the picture, WxH")
    parser.add_argument("--count", type=int, default=BenchOptions.count, help="Gaussians of the made-up room")
    parser.add_argument("--repeats", type=int, default=BenchOptions.repeats)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="cpu", help="measured beside the CPU")
    given = parser.parse_args(arguments)
    width, height = map(int, given.size.split("x"))
    result = run(
        BenchOptions(count=given.count, width=width, height=height, repeats=given.repeats), given.ply, given.device
    )
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(result, indent=1) + "\n")
    print("\n".join(report(result)))


if __name__ == "__main__":
    main()
