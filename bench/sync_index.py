"""How fast frames are indexed and matched: the AVL index, sortedcontainers, numpy and the merge, with equal answers.

    python -m bench.sync_index --out sync_index.json

The keys are timecodes of one camera (30 minutes at 90 frames per second unless told otherwise, with jitter and dropped
frames), the queries those of another. Every structure must give the same frames, or the run fails. Times are CPU
seconds, the best of several repeats: nothing here runs in parallel, and other work on the machine disturbs them less.
"""

from __future__ import annotations

import json
import os
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from sortedcontainers import SortedDict

from bench import command
from sync.align import AlignOptions, align, build_index, load_index, save_index
from sync.clock import ClockMode
from sync.timecode import Timecodes, read_timecodes
from sync.tree import FrameTree, merge_nearest

EPOCH_NS = 1_734_551_081_929_245_000


def camera_times(
    seed: int, frames: int, *, fps: float = 90.0, jitter_us: float = 300, drops: float = 0.001
) -> np.ndarray:
    """Timecodes as a triggered camera writes them, int64 [about frames], whole microseconds, increasing."""
    rng = np.random.default_rng(seed)
    times_us = np.arange(frames) * 1e6 / fps + rng.normal(0, jitter_us, frames) + rng.uniform(0, 3000)
    return EPOCH_NS + np.unique(np.rint(times_us[rng.random(frames) >= drops])).astype(np.int64) * 1000


def best_seconds(work: Callable[[], Any], repeats: int) -> float:
    work()  # compiles, and warms the caches
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds)


def search_sorted(keys: np.ndarray, queries: np.ndarray, tolerance: int) -> np.ndarray:
    """Positions of the nearest keys by binary search over a plain array, -1 beyond the tolerance."""
    after = np.searchsorted(keys, queries)
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(keys) - 1)
    nearest = np.where(np.abs(keys[before] - queries) <= np.abs(keys[after] - queries), before, after)
    return np.where(np.abs(keys[nearest] - queries) <= tolerance, nearest, -1)


def search_dict(index: SortedDict, queries: list[int], tolerance: int) -> list[int]:
    """The same through sortedcontainers."""
    keys, found = index.keys(), []
    for query in queries:
        at = index.bisect_left(query)
        around = keys[max(at - 1, 0) : at + 1]
        best = min(around, key=lambda key: abs(key - query))
        found.append(index[best] if abs(best - query) <= tolerance else -1)
    return found


def compare_structures(frames: int, seed: int, repeats: int) -> list[dict[str, Any]]:
    """One row per structure: nanoseconds per key to build, per query in order and at random, bytes per key."""
    keys, queries = camera_times(seed, frames), camera_times(seed + 1, frames)
    numbers = np.arange(len(keys))
    tolerance = int(1e9 / 90 / 2)
    rng = np.random.default_rng(seed)
    order, mixed = rng.permutation(len(keys)), rng.permutation(len(queries))
    expected = search_sorted(keys, queries, tolerance)
    rows = []

    def row(
        name: str,
        build: Callable[[], Any] | None,
        find: Callable[[np.ndarray], Any],
        size: float | None = None,
        *,
        any_order: bool = True,
    ) -> None:
        found = np.asarray(find(queries))
        if not np.array_equal(found, expected):
            raise AssertionError(f"{name} differs from numpy in {(found != expected).sum()} answers")
        shuffled = queries[mixed]

        def per_key(work: Callable[[], Any] | None) -> float | None:
            return None if work is None else best_seconds(work, repeats) / len(keys) * 1e9

        rows.append(
            {
                "structure": name,
                "build_ns_per_key": per_key(build),
                "query_ns_in_order": per_key(lambda: find(queries)),
                "query_ns_at_random": per_key((lambda: find(shuffled)) if any_order else None),
                "bytes_per_key": size,
            }
        )

    def insert(times: np.ndarray, values: np.ndarray) -> FrameTree:
        tree = FrameTree(times[:1], values[:1])  # a tree that holds something is added to one by one
        tree.add(times[1:], values[1:])
        return tree

    def tree_row(name: str, build: Callable[[], FrameTree]) -> None:
        tree = build()
        row(name, build, lambda times: tree.nearest(times, tolerance)[0], 21.0)

    tree_row("AVL, built from sorted", lambda: FrameTree(keys, numbers))
    tree_row("AVL, inserted in order", lambda: insert(keys, numbers))
    tree_row("AVL, inserted at random", lambda: insert(keys[order], order))
    pairs = list(zip(keys.tolist(), numbers.tolist(), strict=True))
    shuffled = [pairs[i] for i in order]
    index = SortedDict(pairs)
    by_dict = lambda times: search_dict(index, times.tolist(), tolerance)  # noqa: E731 (it is a column of the table)
    row("SortedDict, from sorted", lambda: SortedDict(pairs), by_dict)
    row("SortedDict, from shuffled", lambda: SortedDict(shuffled), by_dict)
    row("numpy searchsorted", None, lambda times: search_sorted(keys, times, tolerance), 8.0)
    row("merge", None, lambda times: merge_nearest(keys, times, tolerance)[0], 8.0, any_order=False)
    return rows


def whole_rig(cameras: int, frames: int, seed: int, repeats: int) -> dict[str, float]:
    """Seconds for each step from text files to saved frame groups."""
    rig = {f"cam{number:02}": camera_times(seed + number, frames) for number in range(cameras)}
    with tempfile.TemporaryDirectory() as folder:
        files = {camera: Path(folder) / f"{camera}.txt" for camera in rig}
        for camera, times in rig.items():
            lines = (f"frame_{stamp}_{number:012d}\n" for number, stamp in enumerate((times // 1000).tolist()))
            files[camera].write_text("".join(lines))
        timecodes: dict[str, Timecodes] = {camera: read_timecodes(path) for camera, path in files.items()}
        groups, report = align(timecodes)
        out = Path(folder) / "sync"
        steps: dict[str, Callable[[], Any]] = {
            "parse": lambda: [read_timecodes(path) for path in files.values()],
            "index": lambda: build_index(timecodes),
            "align_trusted": lambda: align(timecodes),
            "align_triggered": lambda: align(timecodes, AlignOptions(clock=ClockMode.TRIGGERED)),
            "save_index": lambda: save_index(timecodes, None, out),
            "load_index": lambda: load_index(out),
            "save_groups": lambda: groups.save(out, report),
            "load_groups": lambda: type(groups).load(out),
        }
        seconds = {name: best_seconds(work, repeats) for name, work in steps.items()}
        sizes = {name: (out / name).stat().st_size for name in ("groups.arrow", "sync.json")}
        with get_context("spawn").Pool(1, maxtasksperchild=1) as fresh:
            peaks = {
                f"{mode} peak bytes": fresh.apply(peak_bytes, (Path(folder), mode))
                for mode in (ClockMode.TRUSTED, ClockMode.TRIGGERED)
            }
    count = sum(len(codes) for codes in timecodes.values())
    return {"timecodes": count, **seconds, **{f"{name} bytes": size for name, size in sizes.items()}, **peaks}


def peak_bytes(folder: Path, clock: ClockMode) -> int:
    """Most memory that this process, a fresh one, held once the files of a folder are parsed, aligned and saved."""
    timecodes = {path.stem: read_timecodes(path) for path in sorted(folder.glob("*.txt"))}
    groups, report = align(timecodes, AlignOptions(clock=clock))
    out = folder / clock
    groups.save(out, report)
    save_index(timecodes, report.clocks, out)
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def print_tables(rows: list[dict[str, Any]], rig: dict[str, float]) -> None:
    print(f"{'structure':28}{'build':>10}{'in order':>12}{'at random':>12}{'bytes/key':>12}   (ns per key or query)")
    for each in rows:
        values = [
            each[name] for name in ("build_ns_per_key", "query_ns_in_order", "query_ns_at_random", "bytes_per_key")
        ]
        cells = ["-" if value is None else f"{value:.1f}" for value in values]
        print(f"{each['structure']:28}{cells[0]:>10}{cells[1]:>12}{cells[2]:>12}{cells[3]:>12}")
    print()
    for name, value in rig.items():
        whole = name == "timecodes" or name.endswith("bytes")
        print(
            f"{name:28}{value:>14,.0f}"
            if whole
            else f"{name:28}{value:>12.3f} s {value / rig['timecodes'] * 1e9:9.1f} ns/line"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("sync_index", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="where the JSON goes")
    parser.add_argument("--frames", type=int, default=162_000, help="frames per camera")
    parser.add_argument("--cameras", type=int, default=8, help="cameras of the whole rig")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    rows = compare_structures(args.frames, args.seed, args.repeats)
    rig = whole_rig(args.cameras, args.frames, args.seed, args.repeats)
    print_tables(rows, rig)
    machine = {"cpu": platform.processor() or platform.machine(), "cores": os.cpu_count(), "load": os.getloadavg()[0]}
    versions = {name: version(name) for name in ("numpy", "numba", "pyarrow", "sortedcontainers")}
    options = {"frames": args.frames, "cameras": args.cameras, "repeats": args.repeats, "seed": args.seed}
    data = {"options": options, "machine": machine, "versions": versions, "structures": rows, "rig": rig}
    args.out.write_text(json.dumps(data, indent=1))


if __name__ == "__main__":
    main()
