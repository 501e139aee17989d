"""Forecast against fact: what finished runs took, beside what a look at machine and capture said before.

    packuv plan CAPTURE --out runs --preset draft          looks, and remembers it where the sequence has a folder
    packuv run CAPTURE --out runs --preset draft
    packuv bench forecast runs/basketball runs/demo/studio --out bench/results/forecast.json

Runs of two minutes and more look by themselves. The forecast is made anew from what the look found, so that a change of
the model shows; `tests/pipelines/test_forecast.py` holds it to the file that is committed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench import command
from pipelines.forecast import Forecast, Machine, Size, forecast, size_of
from pipelines.options import SequenceOptions
from pipelines.probe import PROBE, Probe
from pipelines.process import find_sequence, options_of, plan_of
from pipelines.request import RunRequest
from pipelines.results import GROUPS
from tasks.artefacts.retention import RUN
from tasks.stages.encode import SCENE


def gather(folder: Path) -> tuple[dict[str, Any], SequenceOptions]:
    """Probe and facts of the run in `folder`, <out>/<sequence>, and its options. Raises FileNotFoundError where nobody
    looked."""
    run, probe = json.loads((folder / RUN).read_text()), json.loads((folder / PROBE).read_text())["found"]
    request = request_of(run)
    capture = find_sequence(request)
    size = size_of(capture, plan_of(request, capture))
    made = run["artefacts"]
    row = {
        "run": f"{run['sequence']} {request.preset}",
        "preset": request.preset,
        "settings": run["request"]["settings"],
        "size": asdict(size),
        "probe": probe,
        "seconds": {stage: round(seconds, 1) for stage, seconds in _seconds(made)},
        "minutes": round(sum(item["seconds"] for item in made) / 60, 3),
        "memory_bytes": max(item["peak_memory_bytes"] for item in made),
        "disk_bytes": sum(item["bytes"] for item in made),
        "scene_bytes": (folder / SCENE).stat().st_size,
    }
    return row, options_of(request, capture, request.preset)


def request_of(run: Mapping[str, Any]) -> RunRequest:
    """Of a run.json."""
    asked: dict[str, Any] = {name: _plain(value) for name, value in run["request"].items()}
    return RunRequest(**asked)


def _plain(value: Any) -> Any:
    """JSON has no tuples."""
    return tuple(value) if isinstance(value, list) else value


def _seconds(made: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, float]]:
    """Of each stage."""
    for stage in dict.fromkeys(GROUPS.values()):
        yield stage, sum(item["seconds"] for item in made if GROUPS[item["artefact"].partition("/")[0]] == stage)


def table(gathered: Sequence[tuple[Mapping[str, Any], SequenceOptions]]) -> str:
    """In Markdown: forecast, fact, and their ratio in per cent."""
    lines = ["| run | | forecast | fact | off by |", "|---|---|---:|---:|---:|"]
    for row, options in gathered:
        found = forecast_of(row, options)
        pairs = {stage: (seconds / 60, row["seconds"][stage] / 60) for stage, seconds in found.seconds.items()}
        pairs["all, min"] = found.minutes, row["minutes"]
        pairs["memory, GB"] = found.memory_bytes / 1e9, row["memory_bytes"] / 1e9
        pairs["disk, GB"] = found.disk_bytes / 1e9, row["disk_bytes"] / 1e9
        pairs["scene, MB"] = found.scene_bytes / 1e6, row["scene_bytes"] / 1e6
        for what, (expected, fact) in pairs.items():
            off = 100 * (expected / fact - 1)
            lines.append(f"| {row['run']} | {what} | {expected:.2f} | {fact:.2f} | {off:+.0f} % |")
    return "\n".join(lines)


def forecast_of(row: Mapping[str, Any], options: SequenceOptions) -> Forecast:
    """What the model says now of a run that `gather` told of."""
    return forecast(size_from(row["size"]), options, Machine(Probe(**row["probe"])))


def size_from(data: Mapping[str, Any]) -> Size:
    """Inverse of `dataclasses.asdict`, through JSON."""
    fitted, held_out = (tuple((width, height) for width, height in data[name]) for name in ("fitted", "held_out"))
    return Size(data["frames"], fitted, held_out, data.get("solved", False), data.get("lenses", False))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("forecast", __doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="folders of finished runs: <out>/<sequence>")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; the table goes beside it as .md")
    given = parser.parse_args(arguments)
    gathered = [gather(folder) for folder in given.runs]
    rows = [row for row, _ in gathered]
    given.out.write_text(json.dumps(rows, indent=1) + "\n")
    found = table(gathered)
    given.out.with_suffix(".md").write_text(found + "\n")
    print(found)


if __name__ == "__main__":
    main()
