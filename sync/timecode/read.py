"""Timecode files of all kinds: one camera's own file, or a table that cameras share."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from sync.timecode.columns import table_timecodes
from sync.timecode.lines import read_lines
from sync.timecode.rates import NANOSECONDS
from sync.timecode.series import Timecodes
from sync.timecode.tables import CAMERA_COLUMNS, Table, csv_table, json_table, npy_table, number_table

FASTEST_GAP_NS, SLOWEST_GAP_NS = 10_000, 3600 * NANOSECONDS
"""No camera of a rig films faster than 100,000 or slower than one frame an hour: beyond, the unit is misread."""


SUFFIXES = (".csv", ".tsv", ".txt", ".log", ".json", ".jsonl", ".npy")
"""Of files with timecodes"""


_UNIT_END = re.compile("[ _]?[\\[(]?(?<=[ _\\[(])(?:ns|[u\u00b5\u03bc]s|ms|s)[\\])]?$")
"""Of a column that is named after a camera: cam01_us, cam01 [us]"""


def read_timecodes(
    path: Path,
    *,
    camera: str | None = None,
    rate: Fraction | None = None,
    column: str | None = None,
    period_ns: int | None = None,
    others: Collection[str] = (),
) -> Timecodes:
    """Read one camera's timecodes from a file with one of `SUFFIXES`.

    Args:
        path: the file; docs/capture-folder.md describes the formats.
        camera: whose rows to take from a table that holds several cameras.
        rate: frames per second, needed for SMPTE labels only.
        column: name of the time column, where a table has more than one; its number, from 1, where it has no header.
        period_ns: time between two frames of the video, by which the unit is told where nothing names it.
        others: cameras of which it is said if all rows bear the name of one.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a line that does not parse, with file, number and content; a table that leaves a choice open.
    """
    data = read_text_bytes(path)
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise ValueError(f"timecodes are read from {_either(SUFFIXES)}, but {path.name!r} is none of these")
    timecodes = read_lines(path, data, rate) if kind in (".txt", ".log") else None
    if timecodes is None:
        table = _table(path, kind, data, column)
        timecodes = table_timecodes(table, _rows_of(table, camera), rate, column, period_ns)
        timecodes = timecodes.noting(*_strange_rows(table, camera, others))
    _check_gaps(path, timecodes)
    return timecodes


def _table(path: Path, kind: str, data: bytes, column: str | None) -> Table:
    match kind:
        case ".json" | ".jsonl":
            return json_table(path, data, column)
        case ".npy":
            return npy_table(path, data, column)
        case ".txt" | ".log":
            return number_table(path, data, column)
    return csv_table(path, data, column)


def read_text_bytes(path: Path) -> bytes:
    """What a file holds, text in UTF-16 and marks of byte order made plain UTF-8; raises ValueError if it is empty."""
    data = path.read_bytes()
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        data = data.decode("utf-16", errors="replace").encode()
    elif b"\0" in data[:2]:  # without a mark
        data = data.decode("utf-16-be" if data[0] == 0 else "utf-16-le", errors="replace").encode()
    data = data.removeprefix(b"\xef\xbb\xbf")
    if not data.strip():
        raise ValueError(f"{path} is empty; a camera needs at least one timecode")
    return data


def read_shared_timecodes(
    path: Path,
    cameras: Sequence[str],
    *,
    rates: Mapping[str, Fraction | None] | None = None,
    column: str | None = None,
    period_ns: Mapping[str, int] | None = None,
) -> dict[str, Timecodes]:
    """Read the timecodes of several cameras from the one CSV table that they share: a row for each frame that tells
    whose it is, or a column for each camera.

    Raises:
        ValueError: as `read_timecodes`, or two cameras would take the same rows.
    """
    table, periods, rates = csv_table(path, read_text_bytes(path)), period_ns or {}, rates or {}
    by_column = table.camera is None
    columns = {_UNIT_END.sub("", name): name for name in table.columns} | {name: name for name in table.columns}
    ids = list(columns) if by_column else table.cameras
    if by_column and not any(_is_camera(camera, ids) for camera in cameras):
        raise ValueError(
            f"{path} is shared by all cameras, so one of its columns must be {_either(CAMERA_COLUMNS)}, or it must "
            f"have a column of times for each camera; it has {list(table.columns)[:8]}"
        )
    chosen = {camera: match_camera(camera, ids) for camera in cameras}
    for name in chosen.values():
        twins = [other for other in cameras if chosen[other] == name]
        if len(twins) > 1:
            raise ValueError(f"{path}: rows of {name!r} would serve cameras {twins}; give the rows the videos' names")
    found = {}
    for camera, name in chosen.items():
        rows, times = (table.filled(columns[name]), columns[name]) if by_column else (table.rows_of(name), column)
        found[camera] = table_timecodes(table, rows, rates.get(camera), times, periods.get(camera))
        _check_gaps(path, found[camera])
    return found


def match_camera(camera: str, ids: Sequence[str]) -> str:
    """Which of a table's camera ids means `camera`: the same text, else the number that ends the name.

    >>> match_camera("cam_03", ["1", "2", "3"])
    '3'

    Raises:
        ValueError: none or several fit.
    """
    if camera in ids:
        return camera
    number = re.search(r"\d+$", camera)
    fits = [name for name in ids if number and name.isdecimal() and int(name) == int(number[0])]
    if len(fits) != 1:
        raise ValueError(f"camera {camera!r} must be one of the table's cameras {sorted(ids)}, or end in its number")
    return fits[0]


def _is_camera(camera: str, ids: Sequence[str]) -> bool:
    try:
        match_camera(camera, ids)
    except ValueError:
        return False
    return True


def _rows_of(table: Table, camera: str | None) -> np.ndarray | None:
    """Rows of one camera, or None where the whole table is one camera's."""
    if table.camera is None:
        return None
    ids = table.cameras
    if camera is None and len(ids) > 1:
        raise ValueError(f"{table.path} holds cameras {sorted(ids)}; say which one to read")
    return table.rows_of(match_camera(camera, ids) if camera is not None and len(ids) > 1 else ids[0])


def _strange_rows(table: Table, camera: str | None, others: Collection[str]) -> Iterator[str]:
    """That the rows are those of another camera, by what they say."""
    ids = [] if table.camera is None else table.cameras
    if len(ids) == 1 and ids[0] != camera and ids[0] in others:
        yield f"the rows of {table.path.name} say that they are those of {ids[0]}; they are taken for {camera}'s"


def _check_gaps(path: Path, timecodes: Timecodes) -> None:
    """Refuse a unit that no camera fits, by the gaps between the first thousand lines."""
    gaps = np.abs(np.diff(timecodes.times_ns[:1000]))
    gaps = gaps[gaps > 0]
    median = int(np.median(gaps)) if len(gaps) else FASTEST_GAP_NS
    if not FASTEST_GAP_NS <= median <= SLOWEST_GAP_NS:
        raise ValueError(f"{path}: frames would be {median} ns apart, so the unit is another; name it in the column")


def _either(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + " or " + names[-1]
