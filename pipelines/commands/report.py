"""`packuv report`: the report of a run anew, two runs side by side, or all runs of an output folder."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from packuv.files import whole_file
from pipelines.commands.output import answer
from pipelines.commands.terminal import print_table
from pipelines.request import read_settings
from tasks.artefacts.recipe import OptionError, override
from tasks.report import compare
from tasks.report.dataset import Line, page_text
from tasks.report.write import JSON_NAME, PAGE_NAME

STATES = {"finished": "finished", "cancelled": "cancelled", "stopped": "cancelled"}
"""By how a run ended, what the page calls it; all else has failed"""

PARTS = {"run": dict, "summary": dict, "scores": list, "findings": list}
"""Of report.json, of every version"""


def command(arguments: argparse.Namespace) -> int:
    """Exit code 0 if what was asked for is written."""
    given = [arguments.run is not None, arguments.compare is not None, arguments.dataset is not None]
    if sum(given) != 1:
        raise ValueError("report needs the folder of a run, --compare A B or --dataset DIR, and one of them only")
    if arguments.output and not arguments.compare:
        raise ValueError("--output names the page of --compare A B; other reports lie in the folder that they are of")
    if arguments.compare:
        return _compare(arguments)
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
    if not isinstance(told, dict) or any(not isinstance(told.get(name), kind) for name, kind in PARTS.items()):
        raise ValueError(f"{file} must be a {JSON_NAME} as packuv writes it, but is none; name the folder of a run")
    return told


def _compare(arguments: argparse.Namespace) -> int:
    first, second = arguments.compare
    a, b = read_report(first), read_report(second)
    found = list(compare.differences(a, b))
    if page := arguments.output:
        with whole_file(page) as part:
            part.write_text(compare.page_text(a, b, names=(str(first), str(second))), encoding="utf-8")
    if arguments.json:
        told = {"a": str(first), "b": str(second), "page": page and str(page)}
        answer(json.dumps({**told, "differences": [vars(item) for item in found]}, indent=1))
        return 0
    table = Table("", "what", f"A  {first}", f"B  {second}", "B - A")
    for item in found:
        change = "" if item.change is None else f"{item.change:+.4g}"
        cells = (item.kind, item.name, compare.shown(item.a), compare.shown(item.b), change)
        table.add_row(*map(Text, cells))
    for name, report in (("A", a), ("B", b)):
        print(f"{name}  {compare.verdict_text(report)}")
    print_table(table) if found else print("nothing differs")
    if page:
        print(page)
    return 0


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
        figures = map(compare.shown, (line.psnr_db, line.mb_per_frame, minutes, line.findings))
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
    figures, size = report["summary"], report["summary"].get("mb_per_30_frames")
    scene = place / "scene.mkv"
    return Line(
        **line,
        psnr_db=figures.get("psnr_db"),
        ssim=figures.get("ssim"),
        unseen=bool(figures.get("held_out")),
        mb_per_frame=None if size is None else size / 30,
        frames=figures.get("frames"),
        hours=None if (seconds := figures.get("seconds")) is None else seconds / 3600,
        findings=len(report["findings"]),
        verdict=(report.get("verdict") or {}).get("text", ""),
        report=os.path.relpath(place / PAGE_NAME, folder),
        scene=os.path.relpath(scene, folder) if scene.is_file() else None,
    )
