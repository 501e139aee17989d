"""Which column of a table holds the time, in which unit, and its numbers as int64 ns."""

from __future__ import annotations

import re
from collections.abc import Sequence, Set
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sync.timecode.digits import parse_decimals
from sync.timecode.labels import counting_notes, day_of, is_clock, is_label, read_clocks, read_labels
from sync.timecode.series import DAY_NS, Timecodes, counted_from_first, unwrapped, wrap_notes
from sync.timecode.tables import Table, plain, whole
from sync.tree import TIME_LIMIT_NS

UNIT_POWERS = {"ns": 0, "us": 3, "ms": 6, "s": 9}
"""A value in this unit is its number times 10 to this power, in nanoseconds."""

INDEX_COLUMNS = ("frame_number", "frame_index", "frame_id", "frame_no", "frame_num", "frame", "index", "idx")
TIME_WORDS = {"time", "timestamp", "timestamps", "timecode", "ts", "pts", "epoch"}
SHORT_TIME_WORDS = {"t", "datetime", "utc"}
"""That name a time where no column has one of the others"""

SOME = 1000
"""Rows that tell of all"""
FEWEST_ROWS = 4
"""From which on a last line can be held against the others"""
LIKE = 4
"""Digits that a number which lost its end has in common with the one before"""
STALL = 1000.0
"""Usual gaps that may lie before a last line"""
NEAR = 2.0
"""Factor either way by which times may be further apart than the frames of the video: cameras drop frames"""
_ISO = re.compile(r"(\d{4}[-/]\d\d[-/]\d\d)[T ](\d\d:\d\d:\d\d)([.,]\d{1,12})?\s*(Z|[+-]\d\d(?::?\d\d)?)?")

_UNIT = re.compile(
    r"(?:^|_)(?:(ns|nsecs?|nanos|nanoseconds?)|(us|usecs?|micros|microseconds?)|(ms|msecs?|millis|milliseconds?)"
    r"|(s|secs?|seconds?))$"
)


def table_timecodes(
    table: Table, rows: np.ndarray | None, rate: Fraction | None, column: str | None, period_ns: int | None = None
) -> Timecodes:
    """Timecodes of the given rows; None means all, in file order.

    Rows of a table for several cameras come in any order (caliscope writes them as they arrive): they are put in
    order of their frame index, or of their time where there is no index of its own for every row.
    """
    time = _time_column(table, column)
    index = next((name for word in INDEX_COLUMNS for name in table.columns if plain(name) == word), None)
    chosen = np.arange(len(table.columns[time])) if rows is None else rows
    read = _times(table, time, chosen, rate, period_ns)
    times = read.times_ns
    _check_last(table, time, times)
    indices = _numbers(table, index, chosen, 0, integer=True) if index else None
    unique = indices is not None and len(np.unique(indices)) == len(indices)
    if rows is not None or (indices is not None and unique and np.ptp(indices) == len(indices) - 1):
        order = np.argsort(times if indices is None or not unique else indices, kind="stable")
        times = times[order]
        indices = None if indices is None else indices[order]
    cycle, notes = read.cycle_ns, read.notes
    if read.unit_ns:
        times, cycle, wraps = unwrapped(times, read.unit_ns)
        notes += wrap_notes(wraps, cycle)
    numbers = counted_from_first(np.arange(len(times)) if indices is None else indices)
    return Timecodes(times, numbers, cycle, labelled=read.labelled, notes=notes)


@dataclass(frozen=True)
class _Read:
    """A column of times as it stands in the file."""

    times_ns: np.ndarray
    unit_ns: int = 0
    """Of its numbers; 0 where they are no counter"""
    cycle_ns: int = 0
    labelled: bool = False
    notes: tuple[str, ...] = ()


def _check_last(table: Table, name: str, times: np.ndarray) -> None:
    """Refuse a last line that lost some of its digits: it has no end, or begins as the one before does."""
    values = table.columns[name]
    if len(values) < FEWEST_ROWS or len(times) != len(values):
        return
    steps = np.diff(times)
    usual = float(np.median(np.abs(steps[:-1])))
    last, before = values[-1].as_py(), values[-2].as_py()
    alike = next((at for at, (a, b) in enumerate(zip(last, before, strict=False)) if a != b), len(last))
    lost = len(last) < len(before) and (not table.whole or alike >= max(LIKE, len(last) // 2))
    if lost and not 0 < steps[-1] <= STALL * max(usual, 1.0):
        raise ValueError(
            f"{table.place(len(values) - 1)}: the last line is cut short: its time has fewer digits than the one "
            "before and does not go on from it; copy the file again, or remove that line and the video's last frame"
        )


def _time_column(table: Table, column: str | None) -> str:
    if not table.named:  # and so the time was chosen
        return next(iter(table.columns))
    if column is not None:
        if column not in table.columns:
            raise ValueError(f"{table.path} has no column {column!r}; it has {list(table.columns)}")
        return column
    fits = next(filter(None, (_named(table, words) for words in (TIME_WORDS, SHORT_TIME_WORDS))), [])
    if len(fits) != 1:
        found = f"{len(fits)} of them: {fits}" if fits else "none"
        raise ValueError(
            f"{table.path}: one column must hold the time, but among {list(table.columns)} there are {found}; "
            "name it in capture.toml: timecode_column = '...'"
        )
    return fits[0]


def _named(table: Table, words: Set[str]) -> list[str]:
    """Columns with one of these words in their names."""
    return [name for name in table.columns if words & set(plain(name).split("_"))]


def _times(table: Table, name: str, rows: np.ndarray, rate: Fraction | None, period_ns: int | None) -> _Read:
    values = table.columns[name].take(pa.array(rows))
    first = values[0].as_py()
    if is_label(first):
        times = read_labels(values.to_pylist(), rate, lambda row: table.place(int(rows[row])))
        assert rate is not None
        notes = counting_notes(values.to_pylist(), rate)
        return _Read(times, cycle_ns=day_of(first, rate), labelled=True, notes=notes)
    if is_clock(first):
        return _Read(read_clocks(values.to_pylist(), lambda row: table.place(int(rows[row]))), cycle_ns=DAY_NS)
    if _ISO.fullmatch(first):
        return _Read(_calendar(table, rows, values.to_pylist()))
    unit, notes = _unit(table, name, rows, values, first, period_ns)
    power = UNIT_POWERS[unit]
    return _Read(_numbers(table, name, rows, power), 10**power, notes=notes)


def _calendar(table: Table, rows: np.ndarray, values: Sequence[str]) -> np.ndarray:
    """ISO 8601 dates with times to ns since 1970, int64 [n]; without a zone they are taken for UTC."""
    found = np.empty(len(values), np.int64)
    for row, value in enumerate(values):
        match = _ISO.fullmatch(value)
        try:
            if match is None:
                raise ValueError
            zone = (match[4] or "Z").replace("Z", "+00:00")
            moment = datetime.fromisoformat(
                f"{match[1].replace('/', '-')}T{match[2]}{zone if len(zone) > 3 else zone + ':00'}"
            )
        except ValueError:
            raise ValueError(
                f"{table.place(int(rows[row]))}: expected a date and time as 2026-11-28T12:34:56.789, got {value!r}"
            ) from None
        part = int(((match[3] or "")[1:] + "0" * 9)[:9])
        since = moment - datetime(1970, 1, 1, tzinfo=UTC)
        found[row] = (since.days * 86_400 + since.seconds) * 1_000_000_000 + part
    return found


def _unit(
    table: Table, name: str, rows: np.ndarray, values: pa.StringArray, first: str, period_ns: int | None
) -> tuple[str, tuple[str, ...]]:
    """Unit of a column, and what to say of it: its name tells, else the video's frame rate, else decimals are seconds,
    else the size of an epoch time tells."""
    named = _UNIT.search(plain(name))
    if named is not None:
        return tuple(UNIT_POWERS)[next(group for group in range(4) if named[group + 1])], ()
    usual = _usual_unit(name, values, first)
    fitting = _fitting_units(table, name, rows[:SOME], period_ns)
    if len(fitting) == 1 and fitting[0] != usual:
        assert period_ns is not None
        note = f"its times are taken for {fitting[0]}, since its video has a frame every {period_ns / 1e6:.4g} ms"
        return fitting[0], (note,) if usual else ()
    if usual is None:
        how = f"rename it to {name}_ns" if table.named else f"begin the file with a line that says {name}_ns"
        raise ValueError(f"{table.path}: the unit of column {name!r} is open; {how}, _us, _ms or _s")
    return usual, ()


def _usual_unit(name: str, values: pa.StringArray, first: str) -> str | None:
    """By what such numbers mostly are; None where they may be anything."""
    if plain(name) == "frame_time" or pc.any(pc.match_substring_regex(values, "[.,]")).as_py():
        return "s"
    digits = len(first.lstrip("+-0")) if first.lstrip("+-").isdecimal() else 0
    return {10: "s", 13: "ms", 16: "us", 19: "ns"}.get(digits)


def _fitting_units(table: Table, name: str, rows: np.ndarray, period_ns: int | None) -> list[str]:
    """Units in which the numbers are about as far apart as the frames of the video."""
    if not period_ns:
        return []
    try:  # as floats, whose last digits no unit depends on
        values = np.array(_with_points(table.columns[name].take(pa.array(rows))).to_pylist(), np.float64)
    except ValueError:
        return []
    steps = np.abs(np.diff(values))
    gap = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    found = {unit: gap * 10.0**power for unit, power in UNIT_POWERS.items()}
    return [unit for unit, step in found.items() if period_ns / NEAR <= step <= period_ns * NEAR]


def _numbers(table: Table, name: str, rows: np.ndarray, power: int, *, integer: bool = False) -> np.ndarray:
    """Column of decimal text times 10 to `power`, int64 [len(rows)]; digits beyond are rounded half away from 0."""
    values = _with_points(table.columns[name].take(pa.array(rows)))
    if integer and pc.any(pc.match_substring(values, ".")).as_py():
        values = pa.array([whole(value) for value in values.to_pylist()], pa.string())
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


def _with_points(values: pa.StringArray) -> pa.StringArray:
    """Decimal commas as points; a column that has both is left as it is."""
    some = values.slice(0, SOME)
    if pc.any(pc.match_substring(some, ",")).as_py() and not pc.any(pc.match_substring(some, ".")).as_py():
        return pc.replace_substring(values, ",", ".")
    return values
