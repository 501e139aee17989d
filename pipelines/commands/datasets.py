"""`packuv manifest`: what a data set holds, as a file and as a table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from pipelines.commands.terminal import print_facts, print_table, shown
from pipelines.dataset import survey
from pipelines.disk import size_text
from pipelines.manifest import Entry, Manifest, Row, update
from pipelines.words import duration


def manifest(arguments: argparse.Namespace) -> int:
    """Exit code 0 if a sequence of the data set can be processed."""
    path = arguments.output
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file in it, as {path / 'manifest.parquet'}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no folder {path.parent} to write {path.name} in; make it first")
    with shown(arguments, "captures") as progress:
        found = survey(arguments.dataset, progress=progress)
    with shown(arguments, "videos") as progress:
        made = update(path, found, progress=progress)
    entries = made.sequences
    if arguments.json:
        print_facts(_facts(made, entries), True, str)
    else:
        print_table(_table(entries))
        for entry in entries:
            for problem in dict.fromkeys(row.problem for row in entry.rows if row.problem is not None):
                print(_visible(f"{entry.sequence}: {problem}"))
        print(_visible(f"{path}: {_totals(entries)}"))
    if found.unreadable:
        _warn(f"{len(found.unreadable)} folders cannot be read, as {found.unreadable[0]}")
    problems = [entry.problem for entry in entries if entry.problem is not None]
    if len(problems) == len(entries):
        raise ValueError(f"none of {len(entries)} captures can be processed; the first: {problems[0]}")
    if problems:
        _warn(f"{len(problems)} of {len(entries)} captures have problems")
    return 0


def _warn(text: str) -> None:
    print(f"packuv: {_visible(text)}", file=sys.stderr)


def _facts(made: Manifest, entries: Sequence[Entry]) -> dict[str, Any]:
    return {"dataset": str(made.dataset), "sequences": [_entry_facts(entry) for entry in entries]}


def _entry_facts(entry: Entry) -> dict[str, Any]:
    return {
        "sequence": entry.sequence,
        "capture": str(entry.capture),
        "tags": entry.tags,
        "problem": entry.problem,
        "cameras": [
            {name: value for name, value in vars(row).items() if name not in ("sequence", "capture", "tags")}
            for row in entry.rows
            if row.camera is not None
        ],
    }


def _table(entries: Iterable[Entry]) -> Table:
    table = Table("sequence", "cameras", "frames", "size", "fps", "time", "calibration", "tags", "problem")
    for entry in entries:
        cells = [entry.sequence, *_figures(entry.rows), ", ".join(entry.tags), _at_fault(entry.rows)]
        table.add_row(*(Text(_visible(cell)) for cell in cells), style=None if entry.problem is None else "yellow")
    return table


def _at_fault(rows: Sequence[Row]) -> str:
    """The cameras with a problem; what it is has no room in a table."""
    return ", ".join(row.camera or "capture" for row in rows if row.problem is not None)


def _figures(rows: Sequence[Row]) -> list[str]:
    """Cameras, frames, size, frame rate, time and calibration."""
    cameras = [row for row in rows if row.camera is not None]
    if not cameras:
        return [""] * 6
    frames = sorted({row.frames for row in cameras if row.frames is not None})
    sizes = {f"{row.width}x{row.height}": None for row in cameras if row.width is not None}
    rates = {row.fps: None for row in cameras if row.fps is not None}
    seconds = [row.duration_s for row in cameras if row.duration_s is not None]
    return [
        str(len(cameras)),
        f"{frames[0]}" if len(frames) == 1 else f"{frames[0]} to {frames[-1]}" if frames else "",
        ", ".join(sizes),
        ", ".join(rates),
        duration(max(seconds)) if seconds else "",
        cameras[0].calibration or "solve",
    ]


def _totals(entries: Sequence[Entry]) -> str:
    rows = [row for entry in entries for row in entry.rows if row.camera is not None]
    frames = sum(row.frames or 0 for row in rows)
    seconds = sum(max(row.duration_s or 0 for row in entry.rows) for entry in entries)
    size = size_text(sum(row.bytes or 0 for row in rows))
    return f"{len(entries)} sequences of {duration(seconds)}, {len(rows)} videos, {frames:,} frames, {size}"


def _visible(text: str) -> str:
    """Names of folders may hold what a terminal obeys."""
    return "".join(character if character.isprintable() else "?" for character in text)
