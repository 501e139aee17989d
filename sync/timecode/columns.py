"""Which column of a table holds the time, in which unit, and its numbers as int64 ns."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sync.timecode.digits import parse_decimals
from sync.timecode.labels import is_label, read_labels
from sync.timecode.series import Timecodes, counted_from_first
from sync.timecode.tables import Table, plain
from sync.tree import TIME_LIMIT_NS

UNIT_POWERS = {"ns": 0, "us": 3, "ms": 6, "s": 9}
"""A value in this unit is its number times 10 to this power, in nanoseconds."""

INDEX_COLUMNS = ("frame_number", "frame_index", "frame_id", "frame_no", "frame_num", "frame", "index", "idx")
TIME_WORDS = {"time", "timestamp", "timestamps", "timecode", "ts", "pts", "epoch"}

_UNIT = re.compile(
    r"(?:^|_)(?:(ns|nsecs?|nanos|nanoseconds?)|(us|usecs?|micros|microseconds?)|(ms|msecs?|millis|milliseconds?)"
    r"|(s|secs?|seconds?))$"
)


def table_timecodes(table: Table, rows: np.ndarray | None, rate: Fraction | None, column: str | None) -> Timecodes:
    """Timecodes of the given rows; None means all, in file order.

    Rows of a table for several cameras come in any order (caliscope writes them as they arrive): they are put in
    order of their frame index, or of their time where there is no index of its own for every row.
    """
    time = _time_column(table, column)
    index = next((name for word in INDEX_COLUMNS for name in table.columns if plain(name) == word), None)
    chosen = np.arange(len(table.columns[time])) if rows is None else rows
    times = _times(table, time, chosen, rate)
    indices = _numbers(table, index, chosen, 0, integer=True) if index else None
    if rows is not None:
        unique = indices is not None and len(np.unique(indices)) == len(indices)
        order = np.argsort(times if indices is None or not unique else indices, kind="stable")
        times = times[order]
        indices = None if indices is None else indices[order]
    return Timecodes(times, counted_from_first(np.arange(len(times)) if indices is None else indices))


def _time_column(table: Table, column: str | None) -> str:
    if column is not None:
        if column not in table.columns:
            raise ValueError(f"{table.path} has no column {column!r}; it has {list(table.columns)}")
        return column
    fits = [name for name in table.columns if TIME_WORDS & set(plain(name).split("_"))]
    if len(fits) != 1:
        found = f"{len(fits)} of them: {fits}" if fits else "none"
        raise ValueError(
            f"{table.path}: one column must hold the time, but among {list(table.columns)} there are {found}; "
            "name it in capture.toml: timecode_column = '...'"
        )
    return fits[0]


def _times(table: Table, name: str, rows: np.ndarray, rate: Fraction | None) -> np.ndarray:
    values = table.columns[name].take(pa.array(rows))
    first = values[0].as_py()
    if is_label(first):
        return read_labels(values.to_pylist(), rate, lambda row: table.place(int(rows[row])))
    return _numbers(table, name, rows, UNIT_POWERS[_unit(table.path, name, values, first)])


def _unit(path: Path, name: str, values: pa.StringArray, first: str) -> str:
    """Unit of a column: said by its name, else decimals are seconds, else the size of an epoch time tells."""
    named = _UNIT.search(plain(name))
    if named is not None:
        return tuple(UNIT_POWERS)[next(group for group in range(4) if named[group + 1])]
    if plain(name) == "frame_time" or pc.any(pc.match_substring(values, ".")).as_py():
        return "s"
    digits = len(first.lstrip("+-0")) if first.lstrip("+-").isdecimal() else 0
    if digits not in (10, 13, 16, 19):
        raise ValueError(f"{path}: the unit of column {name!r} is open; rename it to {name}_ns, _us, _ms or _s")
    return {10: "s", 13: "ms", 16: "us", 19: "ns"}[digits]


def _numbers(table: Table, name: str, rows: np.ndarray, power: int, *, integer: bool = False) -> np.ndarray:
    """Column of decimal text times 10 to `power`, int64 [len(rows)]; digits beyond are rounded half away from 0."""
    values = table.columns[name].take(pa.array(rows))
    _, offsets, data = values.buffers()
    ends = np.frombuffer(offsets, np.int32)[: len(values) + 1]
    text = np.frombuffer(data, np.uint8) if data is not None and data.size else np.zeros(1, np.uint8)
    out = np.empty(len(values), np.int64)
    good = parse_decimals(text, ends, power, integer, TIME_LIMIT_NS, out)
    if good < len(values):
        wanted = "a whole number" if integer else "a number"
        raise ValueError(
            f"{table.place(int(rows[good]))}: expected {wanted} in column {name!r}, got {values[good].as_py()!r}"
        )
    return out
