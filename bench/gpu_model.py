"""What an iteration of a fit on a GPU should take, by a model: nothing here runs on one.

    NUMBA_ENABLE_CUDASIM=1 python -m bench.gpu_model --out bench/results/gpu_model

Work is counted by the CPU's rasterizer on the made-up scene of `packuv.fit.pace`: pairs of Gaussians and tiles, those
walked until pixels are opaque, and blocks of pixels blended. It becomes bytes and slots of instructions of each kernel,
and these times, by published figures of two cards and efficiencies that are assumptions, each with its reason below.
What the host does is measured here, on one core, with kernels that do nothing; handing them tensors is by others' word.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np

from bench.command import parser
from bench.idle_gpu import Watch, idle
from packuv.files import save_json
from packuv.fit.keyframe import choose_quantizer
from packuv.fit.pace import FitSize, made_up
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.raster import RasterOptions, render
from packuv.raster.bins import MASK
from packuv.raster.view import TILE
from pipelines.forecast import USUAL_MOVING, expected_iterations
from pipelines.options import compose
from sync.capture import CaptureSettings

STANDARD = FitSize(1280, 720, 60_000)
"""A backdrop of the preset `standard`"""
SIZES = (FitSize(640, 360, 60_000), STANDARD, FitSize(1600, 1000, 300_000), FitSize(1600, 1000, 500_000))
SMALL = FitSize(64, 48, 300)
"""On which the host's time is measured: it hardly depends on the size"""


CARDS = {"H100 SXM": (3.35e12, 67e12), "H200": (4.8e12, 67e12)}
"""Published: bytes a second of the memory, and operations a second in float32, a product and a sum counted as two; in
float64 they have half of that"""
STREAMED, SORTED, GATHERED = 0.7, 0.5, 0.35
"""Shares of the bandwidth: of long arrays in order, of passes that scatter, of rows that each thread reads by itself"""
ISSUED = 0.4
"""Share of the slots in which a kernel issues an instruction: blocks wait at each 32 Gaussians for their slowest warp,
and 70 registers a thread leave 24 of 64 warps"""
LEAST = 3e-6
"""Seconds that any kernel takes"""
TORCH_LAUNCH, UPLOAD = 4e-6, 10e-6
"""Seconds of the host for a kernel of torch, beside the CPU's dispatch, which is measured; and for a copy to the GPU,
by way of memory that does not move"""
NUMBA_LAUNCH, NUMBA_TENSOR, NUMBA_WRAP = 7e-6, 15e-6, 14e-6
"""Likewise of numba-cuda: 6.6 us for no array (NVIDIA/numba-cuda#288); for each array to launch, and once for each
tensor to wrap it, as 0.30.4 took here with no driver. 88 us for three arrays of CuPy (numba-cuda-mlir#90) agree"""

# Slots of a warp: 1 for arithmetic; 4 for shared memory and shuffles, 8 for exponential and reciprocal: narrower units.
TEST = 10
"""Look whether a pair reaches the warp's blocks"""
BLEND = 25 + 10 * 4 + 8
BLEND_BACKWARD = 45 + 10 * 4 + 2 * 8
ADD_OVER_WARP = 16 * (4 + 1 + 2) + 2 * 4
"""Ten sums by sixteen exchanges, of which each has two choices, and their places in shared memory"""
REDUCE = 10 * 8 * (2 * 4 + 1) / 32
"""Clear ten sums of eight warps, and add them up, of a pair"""
LIST = 150 / 4
"""Intervals and blocks of a pair, with four of a warp's threads busy: Gaussians differ in size"""
COMPARE, SLOPES = (planes * 11 * (4 + 4 + 1) * (26 / 16 + 1) / 32 for planes in (4, 3))
"""Blur so many planes of a pixel of a channel by 11 taps, from shared memory with weights from the cache"""
PROJECT, PROJECT_BACKWARD, ENCODE = 500, 1500, 400
"""Operations in float64 of a Gaussian"""
COLUMNS, SORT_PASSES = 14, 8
"""Floats of a Gaussian; passes of a sort by 8 bits each, for torch does not know that few are used"""


@dataclass(frozen=True)
class Work:
    """Of one iteration, mean of the cameras."""

    gaussians: float
    visible: float
    pairs: float
    walked: float
    """Pairs up to where their tile is opaque"""
    steps: float
    """Of a pair in a warp"""
    pixels: float


@dataclass(frozen=True)
class Host:
    """What the host does in an iteration."""

    cpu_seconds: float
    """Measured, with torch's CPU dispatch"""
    kernels: float
    """Of numba, and tensors that they are given"""
    tensors: float
    wrapped: float
    """Of these, tensors that no kernel was given before"""
    operations: float
    """Of torch, and bytes that they read and write"""
    moved_bytes: float
    uploads: float

    @property
    def seconds(self) -> float:
        launching = NUMBA_LAUNCH * self.kernels + NUMBA_TENSOR * self.tensors + NUMBA_WRAP * self.wrapped
        return self.cpu_seconds + launching + TORCH_LAUNCH * self.operations + UPLOAD * self.uploads


def count_work(size: FitSize) -> Work:
    """By the CPU's own lists."""
    solver, shots = made_up(size)
    gaussians, counted = solver.model.gaussians, []
    for shot in shots:
        kept = render(gaussians, shot.camera, options=RasterOptions(solver.bounds.near))._kept
        lists, masks = kept.lists, kept.lists.pairs[:, MASK]
        warps = np.bitwise_count((masks | masks >> 1) & 0x5555)  # each draws two blocks that lie side by side
        steps = kept.visited.sum() * warps.sum() / np.bitwise_count(masks).sum()
        walked = (kept.used_end - lists.start[:-1]).sum()
        counted.append([np.count_nonzero(lists.visible), len(masks), walked, steps])
    visible, pairs, walked, steps = np.mean(counted, axis=0).tolist()
    return Work(size.gaussians, visible, pairs, walked, steps, size.width * size.height)


def cpu_seconds(timed: int) -> float:
    """Of the host's core in an iteration of a small scene whose kernels do nothing; the least of five."""
    with idle(lambda count: np.full(count, 2, np.int32)):
        solver, shots = opened(SMALL)
        each = [[_cpu_seconds(solver, shots, count) for count in (10, 10 + timed)] for _ in range(5)]
    short, long = np.min(each, axis=0)
    return float(long - short) / timed


def count_host(size: FitSize, cpu: float, iterations: int = 8) -> Host:
    """By what a longer run does more than a short one."""
    found = []
    with idle(lambda count: np.full(count, 2, np.int32)) as launches:
        solver, shots = opened(size)
        solver.run(shots, len(shots), of=10**6)
        for count in (2, 2 + iterations):
            launches.clear()
            with Watch() as watch:
                solver.run(shots, count, of=10**6)
            torch = watch.operations.total(), watch.moved_bytes, watch.uploads
            tensors = sum(given for _, given, _ in launches), sum(new for *_, new in launches)
            found.append((len(launches), *tensors, *torch))
    return Host(cpu, *(np.subtract(found[1], found[0]) / iterations).tolist())


def opened(size: FitSize) -> tuple[Solver, list[Shot]]:
    solver, shots = made_up(size, "cuda")
    solver.fix(choose_quantizer(solver.model.gaussians, solver.bounds, 0))
    return solver, shots


def _cpu_seconds(solver: Solver, shots: list[Shot], count: int) -> float:
    begun = time.process_time()
    solver.run(shots, count, of=10**6)
    return time.process_time() - begun


def kernels(work: Work, bandwidth: float, flops: float) -> dict[str, dict[str, float]]:
    """Of each kernel the seconds that memory and arithmetic take."""
    slots, doubles = ISSUED * flops / 64, ISSUED * flops / 2
    streamed, gathered = STREAMED * bandwidth, GATHERED * bandwidth
    n, shown, pairs, pixels, row = work.gaussians, work.visible, work.pairs, work.pixels, 4 * COLUMNS
    walked = (64 + 8 + 32 + 32) * work.walked  # a record, its slot, and sectors of what lies beside
    blended = 8 * TEST * work.walked + BLEND * work.steps
    back = (8 * TEST + REDUCE) * work.walked + (BLEND_BACKWARD + ADD_OVER_WARP) * work.steps
    halo = (26 / TILE) ** 2
    found = {
        "project": (n * (row + 81), gathered, PROJECT * n, doubles),
        "count tiles": (n * 20 + shown * 64, gathered, LIST * pairs, slots),
        "list tiles": (n * 12 + shown * 64 + 16 * pairs, gathered, LIST * pairs, slots),
        "sort": (pairs * (24 + 32 * SORT_PASSES), SORTED * bandwidth, 0, slots),
        "blend": (walked + 20 * pixels, streamed, blended, slots),
        "response, both ways": (48 * pixels, streamed, 2 * pixels, slots),
        "compare": (pixels * (24 * halo + 36), streamed, 3 * COMPARE * pixels, slots),
        "slopes": (pixels * (36 * halo + 36), streamed, 3 * SLOPES * pixels, slots),
        "blend backward": (walked + 41 * work.walked + 44 * pixels, streamed, back, slots),
        "project backward": (41 * pairs + n * 17 + shown * (2 * row + 72), gathered, PROJECT_BACKWARD * shown, doubles),
        "Adam": (n + shown * (7 * row + 40), gathered, 40 * COLUMNS * shown / 32, slots),
        "guard": (n + shown * 3 * row, gathered, 10 * COLUMNS * shown / 32, slots),
        "codes": (n + shown * (2 * row + 32 * COLUMNS), gathered, ENCODE * shown, doubles),
    }
    return {name: {"memory": part[0] / part[1], "arithmetic": part[2] / part[3]} for name, part in found.items()}


def model(size: FitSize, card: str, work: Work, host: Host) -> dict[str, Any]:
    """Milliseconds of an iteration and its parts."""
    bandwidth, flops = CARDS[card]
    found = kernels(work, bandwidth, flops)
    launches = LEAST * (host.operations + 2 + SORT_PASSES)  # a sort is one operation of many kernels
    found["torch"] = {"memory": host.moved_bytes / (STREAMED * bandwidth), "launches": launches}
    times = {name: 1000 * max(LEAST, *cost.values()) for name, cost in found.items()}
    parts = {name: {"ms": times[name], "binds": max(cost, key=cost.__getitem__)} for name, cost in found.items()}
    gpu, cpu = sum(times.values()), 1000 * host.seconds
    return {"size": str(size), "parts": parts, "gpu_ms": gpu, "host_ms": cpu, "least_ms": max(gpu, cpu),
            "most_ms": gpu + cpu}  # fmt: skip


def aims(found: Mapping[str, Any]) -> dict[str, float]:
    """Seconds of the first fit and of a frame of the preset `standard`, at most, from its iteration; without density,
    labels, pictures, and other fits at its side. A frame draws a share of the tiles."""
    options, tiles = compose("standard", CaptureSettings(), {}), 0.07 + 0.93 * USUAL_MOVING
    frame = expected_iterations(options) * (found["host_ms"] + tiles * found["gpu_ms"]) / 1000
    return {"first_fit_seconds": options.fit.iterations * found["most_ms"] / 1000, "frame_seconds": frame}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """In Markdown: a column for each size."""
    cells = [["ms", *(row["size"] for row in rows)], ["---"] * (len(rows) + 1)]
    for part in rows[0]["parts"]:
        cells.append([part, *("{ms:.3f} {binds}".format(**row["parts"][part]) for row in rows)])
    for name, key in (("all of the GPU", "gpu_ms"), ("host", "host_ms"), ("**iteration**, side by side", "least_ms"),
                      ("one after the other", "most_ms")):  # fmt: skip
        cells.append([name, *(f"{row[key]:.2f}" for row in rows)])
    shares = [[row["gpu_ms"] / row[key] for key in ("most_ms", "least_ms")] for row in rows]
    cells.append(["GPU in use", *(f"{least:.0%} to {most:.0%}" for least, most in shares)])
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def measure(sizes: Sequence[FitSize], out: Path, timed: int) -> None:
    """Writes OUT.json and OUT.md; the second size is that of `standard`."""
    cpu = cpu_seconds(timed)
    given = [(size, count_work(size), count_host(size, cpu)) for size in sizes]
    found = {name: [model(size, name, work, host) for size, work, host in given] for name in CARDS}
    counted = [{"size": str(size), "work": asdict(work), "host": asdict(host)} for size, work, host in given]
    standard = {name: aims(rows[1]) for name, rows in found.items()}
    save_json(out.with_suffix(".json"), {"counted": counted, "model": found, "standard": standard})
    text = "\n".join(f"{card}\n\n{table(rows)}\n" for card, rows in found.items())
    out.with_suffix(".md").write_text(text)
    print(text, standard, sep="\n")


def main(argv: Sequence[str] | None = None) -> None:
    command = parser("gpu_model", __doc__)
    command.add_argument("--out", type=Path, default=Path("runs/gpu_model"), help="of .json and .md, runs/gpu_model")
    command.add_argument("--toy", action="store_true", help="tiny scenes, to see that it runs")
    given: argparse.Namespace = command.parse_args(argv)
    if not cast(Any, numba.config).ENABLE_CUDASIM:
        command.error("kernels that do nothing need numba's simulator: set NUMBA_ENABLE_CUDASIM=1")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    measure([SMALL, FitSize(96, 64, 500)] if given.toy else SIZES, given.out, 20 if given.toy else 200)


if __name__ == "__main__":
    main()
