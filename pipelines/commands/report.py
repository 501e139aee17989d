"""`packuv report`: the report of a run anew, two runs side by side, or all runs of an output folder."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from packuv.files import whole_file
from pipelines.commands.output import answer
from pipelines.commands.terminal import print_table
from pipelines.request import read_settings
from tasks.artefacts.recipe import OptionError, override
from tasks.report.dataset import Line, page_text
from tasks.report.write import JSON_NAME, PAGE_NAME

FIGURES = {
    "psnr_db": "PSNR, dB",
    "psnr_moving_db": "PSNR where it moves, dB",
    "psnr_still_db": "PSNR where it is still, dB",
    "foreground_db": "PSNR of the foreground, dB",
    "foreground_ssim": "SSIM of the foreground",
    "foreground_lpips": "LPIPS of the foreground",
    "ssim": "SSIM",
    "fitted_psnr_db": "PSNR of fitted cameras, dB",
    "fitted_gap_db": "fitted above unseen cameras, dB",
    "tof_px": "tOF, px",
    "flicker": "flicker",
    "lpips": "LPIPS",
    "mb_per_30_frames": "MB per 30 frames",
    "frames": "frames",
    "seconds": "total time, s",
    "peak_memory_bytes": "peak memory, bytes",
    "scored_cameras": "scored cameras",
    "held_out": "held-out cameras",
    "verified": "decodes exactly",
}
"""Of a summary, as the comparison calls them"""


STATES = {"finished": "finished", "cancelled": "cancelled", "stopped": "cancelled"}
"""By how a run ended, what the page calls it; all else has failed"""


def command(arguments: argparse.Namespace) -> int:
    """Exit code 0 if what was asked for is written."""
    given = [arguments.run is not None, arguments.compare is not None, arguments.dataset is not None]
    if sum(given) != 1:
        raise ValueError("report needs the folder of a run, --compare A B or --dataset DIR, and one of them only")
    if arguments.compare:
        return _compare(*arguments.compare, as_json=arguments.json)
    if arguments.dataset:
        return _dataset(arguments.dataset, as_json=arguments.json)
    return _again(arguments)


def _again(arguments: argparse.Namespace) -> int:
    from pipelines.results import collect, remains_in  # takes seconds, which a comparison need not wait for
    from tasks.report.findings import findings
    from tasks.report.verdict import verdict
    from tasks.report.write import write_report

    settings = read_settings(None, arguments.set)
    if other := sorted(set(settings) - {"report"}):
        raise OptionError(f"only report.NAME may be set without another run, but got {', '.join(other)}")
    kept = remains_in(arguments.run)
    kept = replace(kept, options=override(kept.options, settings))
    limits, content = kept.options.report, collect(kept)
    files = write_report(content, arguments.run, limits=limits)
    judged = verdict(content, limits, findings(content, limits))
    told = {"verdict": judged.text, "report": str(files.page)}
    answer(json.dumps(told, indent=1) if arguments.json else f"{judged.text}\n{files.page}")
    return 0


@dataclass(frozen=True)
class Difference:
    """Something in which two runs differ; None where a run lacks it."""

    kind: str
    """setting, version, stage version, figure, camera or finding"""
    name: str
    a: Any
    b: Any


def read_report(path: Path) -> dict[str, Any]:
    """report.json of a run, given as this file or its folder.

    Raises FileNotFoundError or ValueError for what is none.
    """
    file = path / JSON_NAME if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"{path} must be the folder of a run or its {JSON_NAME}, but there is no {file}")
    try:
        told = json.loads(file.read_text())
    except ValueError:
        told = None
    if not (isinstance(told, dict) and isinstance(told.get("run"), dict) and isinstance(told.get("summary"), dict)):
        raise ValueError(f"{file} must be a {JSON_NAME} as packuv writes it, but is none; name the folder of a run")
    return told


def differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[Difference]:
    """What differs between two reports: settings, versions, of stages too, figures, cameras' scores, findings; in this
    order."""
    for kind, name in (("setting", "options"), ("version", "versions")):
        yield from _fields(kind, _flat(a["run"][name] or {}), _flat(b["run"][name] or {}))
    yield from _fields("stage version", *(report["run"].get("stage_versions", {}) for report in (a, b)))
    figures = [{told: report["summary"].get(name) for name, told in FIGURES.items()} for report in (a, b)]
    yield from _fields("figure", *figures)
    yield from _fields("camera", _levels(a), _levels(b))
    texts = [[finding["text"] for finding in report["findings"]] for report in (a, b)]
    only = [[text for text in own if text not in other] for own, other in (texts, texts[::-1])]
    yield from (Difference("finding", "", first, second) for first, second in zip_longest(*only))


def _fields(kind: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[Difference]:
    for name in dict.fromkeys([*a, *b]):
        if a.get(name) != b.get(name):
            yield Difference(kind, name, a.get(name), b.get(name))


def _flat(tree: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= _flat(value, f"{place}{name}.") if isinstance(value, Mapping) else {f"{place}{name}": value}
    return found


def _levels(report: Mapping[str, Any]) -> dict[str, float]:
    """Mean PSNR of each scored camera, dB."""
    levels: dict[str, list[float]] = {}
    for score in report["scores"]:
        levels.setdefault(f"PSNR of {score['camera']}, dB", []).append(score["psnr_db"])
    return {name: sum(own) / len(own) for name, own in levels.items()}


def _compare(first: Path, second: Path, *, as_json: bool) -> int:
    a, b = read_report(first), read_report(second)
    found = list(differences(a, b))
    if as_json:
        answer(json.dumps({"a": str(first), "b": str(second), "differences": [vars(item) for item in found]}, indent=1))
        return 0
    table = Table("", "what", f"A  {first}", f"B  {second}", "B - A")
    for item in found:
        table.add_row(*(Text(cell) for cell in (item.kind, item.name, _shown(item.a), _shown(item.b), _change(item))))
    for name, report in (("A", a), ("B", b)):
        print(f"{name}  {(report.get('verdict') or {'text': 'written before there were verdicts'})['text']}")
    print_table(table) if found else print("nothing differs")
    return 0


def _shown(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _change(item: Difference) -> str:
    numbers = [value for value in (item.a, item.b) if isinstance(value, (int, float)) and not isinstance(value, bool)]
    return f"{numbers[1] - numbers[0]:+.4g}" if len(numbers) == 2 and item.kind in ("figure", "camera") else ""


def _dataset(folder: Path, *, as_json: bool) -> int:
    """All sequences of an output folder in one table and one page, report.html."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}; --dataset needs the output folder of a batch or of several runs")
    lines = [_line(path.parent, folder) for path in sorted(folder.glob("*/run.json"))]
    if not lines:
        raise FileNotFoundError(f"{folder} must be the output folder of runs, with <sequence>/run.json, but has none")
    page = folder / PAGE_NAME
    with whole_file(page) as part:
        text = page_text(folder.resolve().name, lines, subtitle=f"{len(lines)} sequences in {folder}", goes_on=False)
        part.write_text(text, encoding="utf-8")
    if as_json:
        answer(json.dumps({"page": str(page), "sequences": [vars(line) for line in lines]}, indent=1))
        return 0
    table = Table("sequence", "state", "PSNR, dB", "MB a frame", "time, min", "findings", "verdict")
    for line in sorted(lines, key=lambda line: (line.rank, line.psnr_db or 0, line.name)):
        minutes = None if line.hours is None else 60 * line.hours
        figures = map(_shown, (line.psnr_db, line.mb_per_frame, minutes, line.findings))
        cells = (line.name, line.status, *figures, line.verdict or line.reason)
        table.add_row(*(Text(cell) for cell in cells))
    print_table(table)
    print(page)
    return 0


def _line(place: Path, folder: Path) -> Line:
    """What is known of one sequence; its report counts only where the last run came to its end."""
    try:
        run = json.loads((place / "run.json").read_text())
        status = STATES.get(run["outcome"], "failed")
        line = {"name": run["sequence"], "status": status, "reason": run["reason"], "finished": run["finished"]}
    except (ValueError, KeyError, TypeError):
        return Line(place.name, "failed", reason="its run.json is none that packuv writes")
    if status != "finished":
        return Line(**line)
    try:
        report = read_report(place)
    except (ValueError, FileNotFoundError) as error:
        return Line(**{**line, "status": "failed", "reason": str(error)})
    figures, size = report["summary"], report["summary"]["mb_per_30_frames"]
    scene = place / "scene.mkv"
    return Line(
        **line,
        psnr_db=figures["psnr_db"],
        ssim=figures["ssim"],
        unseen=bool(figures["held_out"]),
        mb_per_frame=None if size is None else size / 30,
        frames=figures["frames"],
        hours=None if figures["seconds"] is None else figures["seconds"] / 3600,
        findings=len(report["findings"]),
        verdict=(report.get("verdict") or {}).get("text", ""),
        report=os.path.relpath(place / PAGE_NAME, folder),
        scene=os.path.relpath(scene, folder) if scene.is_file() else None,
    )
