"""What a finished run measured, in one file: error of unseen cameras, time of every fit, memory, size.

    packuv run CAPTURE --out runs --preset draft --frames 0:150 --hold-out cam05,cam14,cam23
    packuv bench sequence runs/basketball --out bench/results/basketball_draft.json

Seconds and memory are those of the artefacts of the run, whenever they were made.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
import pyarrow.ipc

from bench import command
from tasks.artefacts.retention import RUN

_KEY_FIGURES = ("seconds", "iterations", "gaussians", "changed", "saturated", "guarded")
_POINTS_IN_TIME = 11


def gather(folder: Path) -> dict[str, Any]:
    """Figures of the run in `folder`, <out>/<sequence>. Raises ValueError if the run has not been scored."""
    run = json.loads((folder / RUN).read_text())
    parts = {stage: list(paths) for stage, paths in _artefacts(folder, run)}
    if "evaluate" not in parts:
        raise ValueError(f"{folder} must hold a run that went on to its scores, but has none; run it again to its end")
    metrics = json.loads((parts["evaluate"][0] / "metrics.json").read_text())
    keys = sorted((json.loads((path / "key.json").read_text()) for path in parts["key"]), key=lambda k: k["instant"])
    backdrop = [json.loads((path / "key.json").read_text())["figures"] for path in parts.get("backdrop", [])]
    return {
        "request": {name: run["request"][name] for name in ("preset", "settings", "frames", "hold_out", "seed")},
        "packuv": run["packuv"],
        "cpus": os.cpu_count(),
        "machine": platform.machine(),
        "seconds": {stage: round(sum(_of(run, stage, "seconds")), 1) for stage in parts},
        "peak_memory_bytes": max(value for stage in parts for value in _of(run, stage, "peak_memory_bytes")),
        "scores": {name: metrics[name] for name in ("mean", "by_camera", "seam")},
        **_over_time(parts["evaluate"][0] / "metrics.arrow"),
        "frames": metrics["frames"],
        "bytes": metrics["bytes"],
        "backdrop": {name: backdrop[0].get(name) for name in _KEY_FIGURES} if backdrop else None,
        "keyframes": {k["instant"]: {name: k["figures"].get(name) for name in _KEY_FIGURES} for k in keys},
        "transition_frames": _transitions(parts["segment"]),
    }


def _artefacts(folder: Path, run: Mapping[str, Any]) -> Iterator[tuple[str, Iterator[Path]]]:
    names = [item["artefact"] for item in run["artefacts"]]
    for stage in dict.fromkeys(name.partition("/")[0] for name in names):
        yield stage, (folder / "store" / name for name in names if name.partition("/")[0] == stage)


def _of(run: Mapping[str, Any], stage: str, field: str) -> Iterator[float]:
    """A field of every artefact of a stage."""
    return (item[field] or 0 for item in run["artefacts"] if item["artefact"].startswith(f"{stage}/"))


def _over_time(path: Path) -> dict[str, dict[int, float]]:
    """PSNR of some frames, dB: raw, calibrated, own gain, moving and still; means over the cameras that filmed them."""
    rows = pyarrow.ipc.open_file(path).read_all().to_pylist()
    names = [name for name in rows[0] if name.startswith("psnr") and name.endswith("_db")]
    return {f"{name}_over_time": _some(rows, name) for name in names}


def _some(rows: Sequence[Mapping[str, Any]], name: str) -> dict[int, float]:
    by_frame: dict[int, list[float]] = {}
    for row in rows:
        if row[name] is not None:
            by_frame.setdefault(row["frame"], []).append(row[name])
    frames = sorted(by_frame)
    chosen = np.linspace(0, len(frames) - 1, min(_POINTS_IN_TIME, len(frames))).round().astype(int)
    return {frames[i]: round(mean(by_frame[frames[i]]), 2) for i in chosen}


def _transitions(segments: Sequence[Path]) -> dict[str, float]:
    """Time and work of the frames between keyframes; frames without motion count too."""
    frames = [frame for path in segments for frame in json.loads((path / "fit.json").read_text())["frames"]]
    if not frames:
        return {"frames": 0}
    seconds = [frame["seconds"] for frame in frames]
    return {
        "frames": len(frames),
        "median_seconds": round(median(seconds), 2),
        "p95_seconds": round(float(np.quantile(seconds, 0.95)), 2),
        "median_iterations": median(frame["iterations"] for frame in frames),
        "median_active_tiles": round(median(frame.get("tiles", 0.0) for frame in frames), 3),
        "median_dynamic": median(frame["dynamic"] for frame in frames),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("sequence", __doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run: <out>/<sequence>")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    given = parser.parse_args(arguments)
    figures = gather(given.run)
    given.out.write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures["scores"]["mean"]), json.dumps(figures["transition_frames"]), sep="\n")


if __name__ == "__main__":
    main()
