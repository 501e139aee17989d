"""When each frame was taken, read from text as int64 nanoseconds and never through floating point.

Formats (docs/capture-folder.md has examples): the rig's text lines, CSV tables, JSON lists, SMPTE labels.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
from numba import njit

from sync.tree import TIME_LIMIT_NS

NANOSECONDS = 1_000_000_000
UNIT_POWERS = {"ns": 0, "us": 3, "ms": 6, "s": 9}
"""A value in this unit is its number times 10 to this power, in nanoseconds."""

CAMERA_COLUMNS = ("cam_id", "camera_id", "camera", "camera_name", "cam", "port")
INDEX_COLUMNS = ("frame_number", "frame_index", "frame_id", "frame_no", "frame_num", "frame", "index", "idx")
TIME_WORDS = {"time", "timestamp", "timestamps", "timecode", "ts", "pts", "epoch"}
NANOSECOND_LIST = "timestamp_ns"
"""Column name that a bare JSON list of numbers is given."""

FASTEST_GAP_NS, SLOWEST_GAP_NS = 10_000, 3600 * NANOSECONDS
"""No camera of a rig films faster than 100,000 or slower than one frame an hour: beyond, the unit is misread."""

_LABEL = re.compile(r"(\d\d):([0-5]\d):([0-5]\d)([:;.,])(\d{2,3})")
_UNIT = re.compile(
    r"(?:^|_)(?:(ns|nsecs?|nanos|nanoseconds?)|(us|usecs?|micros|microseconds?)|(ms|msecs?|millis|milliseconds?)"
    r"|(s|secs?|seconds?))$"
)


@dataclass(frozen=True, eq=False)
class Timecodes:
    """The timecodes of one camera, in the order of its file."""

    times_ns: np.ndarray
    """int64 [n], nanoseconds on the camera's clock"""
    indices: np.ndarray
    """int64 [n]: frame number in the camera's video, as far as the file tells; `frame_numbers` has the last word"""

    def __post_init__(self) -> None:
        times, indices = self.times_ns, self.indices
        if times.dtype != np.int64 or times.ndim != 1 or indices.dtype != np.int64 or indices.shape != times.shape:
            raise ValueError(
                f"timecodes must be two int64 arrays [n], but are {times.dtype} {times.shape} "
                f"and {indices.dtype} {indices.shape}"
            )
        if len(times) == 0:
            raise ValueError("a camera needs at least one timecode, but has none")
        if times.min() <= -TIME_LIMIT_NS or times.max() >= TIME_LIMIT_NS:
            raise ValueError(f"timecodes must lie within 146 years of 1970, but span {times.min()} to {times.max()} ns")

    def __len__(self) -> int:
        return len(self.times_ns)

    def numbered(self, frame_count: int, *, camera: str = "") -> Timecodes:
        """The same times with the numbers of `frame_numbers`."""
        return replace(self, indices=frame_numbers(self, frame_count, camera=camera))


def frame_numbers(timecodes: Timecodes, frame_count: int, *, camera: str = "") -> np.ndarray:
    """Number in the video of each line's frame, int64 [n], for a video of `frame_count` frames.

    As many lines as frames: line k is frame k, whatever the file's index says, because rigs number the frames that
    they store. Otherwise the index counts dropped frames that the video still holds (or the file has lost lines),
    which is believed if first and last index span exactly the video. Anything else would be a guess about which
    picture belongs to which time.

    Raises:
        ValueError: neither holds.
    """
    lines = len(timecodes)
    if lines == frame_count:
        return np.arange(lines, dtype=np.int64)
    numbers = timecodes.indices - timecodes.indices[0]
    if numbers[-1] == frame_count - 1 and (np.diff(numbers) > 0).all():
        return numbers
    name = f"camera {camera!r}" if camera else "a camera"
    raise ValueError(
        f"{name} has {frame_count} frames in its video, but {lines} timecodes with indices that span "
        f"{int(numbers.max() - numbers.min()) + 1}; re-export the two together, or list the camera under "
        "'ignore' in capture.toml"
    )


def read_timecodes(
    path: Path, *, camera: str | None = None, rate: Fraction | None = None, column: str | None = None
) -> Timecodes:
    """Read one camera's timecodes from a .txt, .csv or .json file.

    Args:
        path: the file; docs/capture-folder.md describes the formats.
        camera: whose rows to take from a table that holds several cameras.
        rate: frames per second, needed for SMPTE labels only.
        column: name of the time column, where a table has more than one.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a line that does not parse, with file, number and content; a table that leaves a choice open.
    """
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    if not data.strip():
        raise ValueError(f"{path} is empty; a camera needs at least one timecode")
    kind = path.suffix.lower()
    if kind == ".txt":
        timecodes = _read_text(path, data, rate)
    elif kind in (".csv", ".json"):
        table = _csv_table(path, data) if kind == ".csv" else _json_table(path, data)
        timecodes = _from_table(table, _rows_of(table, camera), rate, column)
    else:
        raise ValueError(f"timecodes are read from .txt, .csv or .json, but {path.name!r} is none of these")
    _check_gaps(path, timecodes)
    return timecodes


def read_shared_timecodes(
    path: Path, cameras: Sequence[str], *, rate: Fraction | None = None, column: str | None = None
) -> dict[str, Timecodes]:
    """Read the timecodes of several cameras from the one CSV table that they share.

    Raises:
        ValueError: as `read_timecodes`, or two cameras would take the same rows.
    """
    table = _csv_table(path, path.read_bytes().removeprefix(b"\xef\xbb\xbf"))
    if table.camera is None:
        raise ValueError(f"{path} is shared by all cameras, so one of its columns must be {_either(CAMERA_COLUMNS)}")
    ids = [str(value) for value in pc.unique(table.columns[table.camera]).to_pylist()]
    chosen = {camera: match_camera(camera, ids) for camera in cameras}
    for name in chosen.values():
        twins = [other for other in cameras if chosen[other] == name]
        if len(twins) > 1:
            raise ValueError(f"{path}: rows of {name!r} would serve cameras {twins}; give the rows the videos' names")
    found = {camera: _from_table(table, _rows_with(table, name), rate, column) for camera, name in chosen.items()}
    for timecodes in found.values():
        _check_gaps(path, timecodes)
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


def parse_rate(value: int | str | float | Decimal | Fraction) -> Fraction:
    """Frames per second, exactly; 23.976, 29.97 and the like mean n * 1000 / 1001.

    >>> parse_rate("29.97"), parse_rate("60000/1001"), parse_rate(25)
    (Fraction(30000, 1001), Fraction(60000, 1001), Fraction(25, 1))
    """
    try:
        rate = Fraction(str(value))
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"a frame rate is a number such as 30, 29.97 or '30000/1001', but is {value!r}") from None
    if not 0 < rate <= 100_000:
        raise ValueError(f"a frame rate lies between 0 and 100000 frames per second, but is {value!r}")
    ntsc = Fraction(round(rate * 1001 / 1000) * 1000, 1001)
    # 0.004 takes in 23.98 for 23.976..., and leaves whole rates alone, which are 0.02 away at the nearest
    return ntsc if rate.denominator != 1 and abs(rate - ntsc) < Fraction(4, 1000) else rate


# SMPTE labels


def label_to_frame(label: str, rate: Fraction) -> int:
    """Frames since midnight of an SMPTE label HH:MM:SS:FF, or HH:MM:SS;FF with dropped labels.

    Drop-frame labels skip the first 2 (at 29.97), 4 (59.94) or 8 (119.88) labels of every minute that is not a
    multiple of ten.

    >>> label_to_frame("00:01:00;02", Fraction(30000, 1001))
    1800

    Raises:
        ValueError: not a label, or one that does not exist at this rate.
    """
    match = _LABEL.fullmatch(label.strip())
    nominal = round(rate)
    if match is None or int(match[1]) > 23 or int(match[5]) >= nominal:
        raise ValueError(f"{label!r} is no SMPTE label HH:MM:SS:FF at {rate} frames per second")
    minutes, seconds, frame = int(match[1]) * 60 + int(match[2]), int(match[3]), int(match[5])
    number = (minutes * 60 + seconds) * nominal + frame
    if match[4] == ":":
        return number
    dropped = _dropped_labels(rate)
    if minutes % 10 and seconds == 0 and frame < dropped:
        raise ValueError(f"{label!r} is a label that drop-frame counting skips")
    return number - dropped * (minutes - minutes // 10)


def frame_to_label(frame: int, rate: Fraction, *, drop_frame: bool = False) -> str:
    """The SMPTE label of a frame counted from midnight; the inverse of `label_to_frame`.

    >>> frame_to_label(1800, Fraction(30000, 1001), drop_frame=True)
    '00:01:00;02'
    """
    nominal = round(rate)
    frame %= frames_per_day(rate, drop_frame=drop_frame)
    if drop_frame:
        dropped = _dropped_labels(rate)
        tens, rest = divmod(frame, nominal * 600 - 9 * dropped)
        minutes = max(0, rest - dropped) // (nominal * 60 - dropped)  # the first minute of ten drops nothing
        frame += dropped * (9 * tens + minutes)
    seconds, frame = divmod(frame, nominal)
    hours, minutes = seconds // 3600, seconds // 60 % 60
    return f"{hours:02}:{minutes:02}:{seconds % 60:02}{';' if drop_frame else ':'}{frame:02}"


def frames_per_day(rate: Fraction, *, drop_frame: bool) -> int:
    """Labels between midnight and midnight; in drop-frame counting that is 86.4 ms less than a day."""
    return round(rate) * 86400 - (_dropped_labels(rate) * (1440 - 144) if drop_frame else 0)


def labels_to_ns(labels: Sequence[str], rate: Fraction) -> np.ndarray:
    """SMPTE labels in the order of recording to nanoseconds since midnight, int64 [n].

    A label more than half a day before the one ahead of it lies behind midnight and gets another day's frames, not
    86,400 s: labels count frames.

    Raises:
        ValueError: as `label_to_frame`; dropped and plain labels mixed.
    """
    kinds = {":" in label.strip()[8:9] for label in labels}
    if len(kinds) > 1:
        raise ValueError("labels of one camera must all be drop-frame (HH:MM:SS;FF) or all plain (HH:MM:SS:FF)")
    frames = np.array([label_to_frame(label, rate) for label in labels], dtype=np.int64)
    day = frames_per_day(rate, drop_frame=kinds == {False})
    steps = np.diff(frames, prepend=frames[:1])
    frames += day * np.cumsum((steps < -(day // 2)).astype(np.int64) - (steps > day // 2))
    return frames_to_ns(frames, rate)


def frames_to_ns(frames: np.ndarray, rate: Fraction) -> np.ndarray:
    """Start of each frame at a constant rate, int64 ns, rounded half up."""
    return ticks_to_ns(frames, 1 / rate)


def ticks_to_ns(ticks: np.ndarray, unit_s: Fraction) -> np.ndarray:
    """Integer ticks of `unit_s` seconds each to int64 ns, rounded half up, without overflow on the way."""
    scale = unit_s * NANOSECONDS
    whole, rest = np.divmod(np.asarray(ticks, dtype=np.int64), scale.denominator)
    part = (2 * rest * (scale.numerator % scale.denominator) + scale.denominator) // (2 * scale.denominator)
    return whole * scale.numerator + rest * (scale.numerator // scale.denominator) + part


def _dropped_labels(rate: Fraction) -> int:
    nominal = round(rate)
    if rate.denominator != 1001 or nominal % 30:
        raise ValueError(f"drop-frame labels exist at 29.97, 59.94 and 119.88 frames per second, but not at {rate}")
    return nominal // 15


# Text files


def _read_text(path: Path, data: bytes, rate: Fraction | None) -> Timecodes:
    first = data.split(b"\n", 1)[0].decode(errors="replace").strip()
    if not _LABEL.fullmatch(first):
        return _read_rig(path, data)
    lines = data.decode(errors="replace").rstrip().splitlines()
    return Timecodes(_labels(lines, rate, lambda row: f"{path}, line {row + 1}"), np.arange(len(lines)))


def _read_rig(path: Path, data: bytes) -> Timecodes:
    data = data.rstrip()
    lines = data.count(b"\n") + 1
    times, indices = np.empty(lines, np.int64), np.empty(lines, np.int64)
    parsed = _parse_rig(np.frombuffer(data, np.uint8), times, indices)
    if parsed < lines:
        content = data.split(b"\n")[parsed][:80].decode(errors="replace")
        raise ValueError(
            f"{path}, line {parsed + 1}: expected 'frame_<microseconds>_<12-digit index>' or, in all lines, "
            f"HH:MM:SS:FF; got {content.rstrip()!r}"
        )
    return Timecodes(times, _from_first(indices))


def _from_first(indices: np.ndarray) -> np.ndarray:
    """A file's index counted from its first line; lines are counted instead if the index does not increase.

    An index that starts over (camera restarted, two takes in one file) numbers no frames.
    """
    numbers = indices - indices[0]
    return numbers if (np.diff(numbers) > 0).all() else np.arange(len(numbers), dtype=np.int64)


@njit(cache=True, error_model="numpy")
def _parse_rig(data: np.ndarray, times: np.ndarray, indices: np.ndarray) -> int:
    """Parse lines into ns and index; the number of good lines before the first bad one.

    The index must have its 12 digits, so that a last line cut short by a crash is not taken for frame 0.
    """
    size, at = data.size, 0
    for line in range(times.size):
        for letter in (102, 114, 97, 109, 101, 95):  # frame_
            if at >= size or data[at] != letter:
                return line
            at += 1
        time, digits, at = _digits(data, at, 16)
        if digits == 0 or at >= size or data[at] != 95 or time >= TIME_LIMIT_NS // 1000:
            return line
        index, digits, at = _digits(data, at + 1, 13)
        if at < size and data[at] == 13:
            at += 1
        if digits != 12 or (at < size and data[at] != 10):
            return line
        at += 1
        times[line] = time * 1000
        indices[line] = index
    return times.size


@njit(cache=True, error_model="numpy")
def _digits(data: np.ndarray, at: int, most: int) -> tuple[int, int, int]:
    """Value of up to `most` digits from `at`, how many there are, and where they end."""
    value, start = 0, at
    while at < data.size and at - start < most and 48 <= data[at] <= 57:
        value = value * 10 + (data[at] - 48)
        at += 1
    return value, at - start, at


# Tables


@dataclass(frozen=True)
class _Table:
    """Columns of text, and where they come from."""

    path: Path
    columns: Mapping[str, pa.StringArray]
    lines: Sequence[bytes] | None
    """The file's lines, for messages; None for JSON"""

    @property
    def camera(self) -> str | None:
        return next((name for name in self.columns if _plain(name) in CAMERA_COLUMNS), None)

    def place(self, row: int) -> str:
        """Where row `row` stands, for people."""
        if self.lines is None:
            return f"{self.path}, item {row}"
        filled = [number for number, line in enumerate(self.lines, start=1) if line.strip()]
        number = filled[row + 1]
        return f"{self.path}, line {number} ({self.lines[number - 1].decode(errors='replace').strip()[:80]!r})"


def _csv_table(path: Path, data: bytes) -> _Table:
    lines = data.splitlines()
    header = lines[0].decode(errors="replace") if lines else ""
    if not re.search("[A-Za-z]", header):
        raise ValueError(f"{path}: the first line must name the columns, but is {header[:80]!r}")
    delimiter = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: two columns bear one name in {header[:80]!r}")
    try:
        table = pcsv.read_csv(
            pa.BufferReader(data),
            # a row number in messages needs the serial reader
            read_options=pcsv.ReadOptions(column_names=names, skip_rows=1, use_threads=False),
            parse_options=pcsv.ParseOptions(delimiter=delimiter),
            convert_options=pcsv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid as error:
        raise ValueError(f"{path} is no table of {len(names)} columns: {error}") from None
    if len(table) == 0:
        raise ValueError(f"{path} has a header but no rows; a camera needs at least one timecode")
    columns = {name: pc.utf8_trim_whitespace(pa.concat_arrays(table[name].chunks)) for name in names}
    return _Table(path, columns, lines)


def _json_table(path: Path, data: bytes) -> _Table:
    """A list of numbers (ns) or labels, or a list of objects; numbers stay text on the way in."""
    try:
        items = json.loads(data, parse_int=str, parse_float=str, parse_constant=str)
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}") from None
    if not isinstance(items, list) or not items:
        raise ValueError(f"{path} must hold a list of nanoseconds or of objects, with at least one item")
    if not isinstance(items[0], dict):
        name = "timecode" if isinstance(items[0], str) and ":" in items[0] else NANOSECOND_LIST
        items = [{name: item} for item in items]
    columns: dict[str, list[str]] = {name: [] for name in items[0]}
    for number, item in enumerate(items):
        for name, values in columns.items():
            values.append(_json_text(item, name, f"{path}, item {number}"))
    return _Table(path, {name: pa.array(values, pa.string()) for name, values in columns.items()}, None)


def _json_text(item: Any, name: str, place: str) -> str:
    if not isinstance(item, dict) or not isinstance(item.get(name), str):
        raise ValueError(f"{place}: expected a number or text for {name!r}, got {item!r}")
    return str(item[name]).strip()


def _rows_of(table: _Table, camera: str | None) -> np.ndarray | None:
    """Rows of one camera, or None where the whole table is one camera's."""
    if table.camera is None:
        return None
    ids = [str(value) for value in pc.unique(table.columns[table.camera]).to_pylist()]
    if camera is None and len(ids) > 1:
        raise ValueError(f"{table.path} holds cameras {sorted(ids)}; say which one to read")
    return _rows_with(table, match_camera(camera, ids) if camera is not None and len(ids) > 1 else ids[0])


def _rows_with(table: _Table, name: str) -> np.ndarray:
    assert table.camera is not None
    return np.flatnonzero(pc.equal(table.columns[table.camera], name).to_numpy(zero_copy_only=False))


def _from_table(table: _Table, rows: np.ndarray | None, rate: Fraction | None, column: str | None) -> Timecodes:
    """Timecodes of the given rows; None means all, in file order.

    Rows of a table for several cameras come in any order (caliscope writes them as they arrive): they are put in
    order of their frame index, or of their time where there is no index of its own for every row.
    """
    time = _time_column(table, column)
    index = next((name for word in INDEX_COLUMNS for name in table.columns if _plain(name) == word), None)
    chosen = np.arange(len(table.columns[time])) if rows is None else rows
    times = _times(table, time, chosen, rate)
    indices = _numbers(table, index, chosen, 0, integer=True) if index else None
    if rows is not None:
        unique = indices is not None and len(np.unique(indices)) == len(indices)
        order = np.argsort(times if indices is None or not unique else indices, kind="stable")
        times = times[order]
        indices = None if indices is None else indices[order]
    return Timecodes(times, _from_first(np.arange(len(times)) if indices is None else indices))


def _time_column(table: _Table, column: str | None) -> str:
    if column is not None:
        if column not in table.columns:
            raise ValueError(f"{table.path} has no column {column!r}; it has {list(table.columns)}")
        return column
    fits = [name for name in table.columns if TIME_WORDS & set(_plain(name).split("_"))]
    if len(fits) != 1:
        found = f"{len(fits)} of them: {fits}" if fits else "none"
        raise ValueError(
            f"{table.path}: one column must hold the time, but among {list(table.columns)} there are {found}; "
            "name it in capture.toml: timecode_column = '...'"
        )
    return fits[0]


def _times(table: _Table, name: str, rows: np.ndarray, rate: Fraction | None) -> np.ndarray:
    values = table.columns[name].take(pa.array(rows))
    first = values[0].as_py()
    if _LABEL.fullmatch(first):
        return _labels(values.to_pylist(), rate, lambda row: table.place(int(rows[row])))
    return _numbers(table, name, rows, UNIT_POWERS[_unit(table.path, name, values, first)])


def _unit(path: Path, name: str, values: pa.StringArray, first: str) -> str:
    """Unit of a column: said by its name, else decimals are seconds, else the size of an epoch time tells."""
    named = _UNIT.search(_plain(name))
    if named is not None:
        return tuple(UNIT_POWERS)[next(group for group in range(4) if named[group + 1])]
    if _plain(name) == "frame_time" or pc.any(pc.match_substring(values, ".")).as_py():
        return "s"
    digits = len(first.lstrip("+-0")) if first.lstrip("+-").isdecimal() else 0
    if digits not in (10, 13, 16, 19):
        raise ValueError(f"{path}: the unit of column {name!r} is open; rename it to {name}_ns, _us, _ms or _s")
    return {10: "s", 13: "ms", 16: "us", 19: "ns"}[digits]


def _numbers(table: _Table, name: str, rows: np.ndarray, power: int, *, integer: bool = False) -> np.ndarray:
    """Column of decimal text times 10 to `power`, int64 [len(rows)]; digits beyond are rounded half away from 0."""
    values = table.columns[name].take(pa.array(rows))
    _, offsets, data = values.buffers()
    ends = np.frombuffer(offsets, np.int32)[: len(values) + 1]
    text = np.frombuffer(data, np.uint8) if data is not None and data.size else np.zeros(1, np.uint8)
    out = np.empty(len(values), np.int64)
    good = _parse_decimals(text, ends, power, integer, out)
    if good < len(values):
        wanted = "a whole number" if integer else "a number"
        raise ValueError(
            f"{table.place(int(rows[good]))}: expected {wanted} in column {name!r}, got {values[good].as_py()!r}"
        )
    return out


@njit(cache=True, error_model="numpy")
def _parse_decimals(data: np.ndarray, ends: np.ndarray, power: int, integer: bool, out: np.ndarray) -> int:
    """[+-]digits[.digits][e[+-]digits] times 10 to `power`; the number of good rows before the first bad one."""
    digits = np.empty(64, np.uint8)
    for row in range(out.size):
        at, end = ends[row], ends[row + 1]
        negative = at < end and data[at] == 45
        if at < end and (data[at] == 45 or data[at] == 43):
            at += 1
        count, point, at = _mantissa(data, at, end, digits)
        if count == 0 or (integer and point >= 0):
            return row
        exponent, ok = _exponent(data, at, end)
        if not ok:
            return row
        keep = (count if point < 0 else point) + exponent + power
        value = _leading(digits, count, keep)
        if value < 0:
            return row
        out[row] = -value if negative else value
    return out.size


@njit(cache=True, error_model="numpy")
def _mantissa(data: np.ndarray, at: int, end: int, digits: np.ndarray) -> tuple[int, int, int]:
    """Digits up to the exponent into `digits`: how many (0 if too many or none), how many before the point, the end."""
    count, point = 0, -1
    while at < end:
        byte = data[at]
        if byte == 46 and point < 0:
            point = count
        elif 48 <= byte <= 57:
            if count == digits.size:
                return 0, point, at
            digits[count] = byte - 48
            count += 1
        else:
            break
        at += 1
    return count, point, at


@njit(cache=True, error_model="numpy")
def _exponent(data: np.ndarray, at: int, end: int) -> tuple[int, bool]:
    """Value of an exponent that reaches from `at` to `end`, and whether nothing else stands there."""
    if at == end:
        return 0, True
    if data[at] != 101 and data[at] != 69:
        return 0, False
    at += 1
    sign = -1 if at < end and data[at] == 45 else 1
    if at < end and (data[at] == 45 or data[at] == 43):
        at += 1
    value, count, stop = _digits(data, at, 3)
    return sign * value, count > 0 and stop == end


@njit(cache=True, error_model="numpy")
def _leading(digits: np.ndarray, count: int, keep: int) -> int:
    """The first `keep` of `count` digits as a number, rounded by the next digit; -1 beyond the limit of times."""
    value = 0
    for place in range(keep):
        value = value * 10 + (digits[place] if place < count else 0)
        if value >= TIME_LIMIT_NS // 10 and place + 1 < keep:
            return -1
    if 0 <= keep < count and digits[keep] >= 5:
        value += 1
    return value if value < TIME_LIMIT_NS else -1


def _labels(labels: Sequence[str], rate: Fraction | None, place: Any) -> np.ndarray:
    if rate is None:
        raise ValueError(f"{place(0)}: SMPTE labels need the frame rate; give it in capture.toml: fps = '30000/1001'")
    for row, label in enumerate(labels):
        try:
            label_to_frame(label, rate)
        except ValueError as error:
            raise ValueError(f"{place(row)}: {error}") from None
    return labels_to_ns(labels, rate)


def _check_gaps(path: Path, timecodes: Timecodes) -> None:
    """Refuse a unit that no camera fits, by the gaps between the first thousand lines."""
    gaps = np.abs(np.diff(timecodes.times_ns[:1000]))
    gaps = gaps[gaps > 0]
    median = int(np.median(gaps)) if len(gaps) else FASTEST_GAP_NS
    if not FASTEST_GAP_NS <= median <= SLOWEST_GAP_NS:
        raise ValueError(f"{path}: frames would be {median} ns apart, so the unit is another; name it in the column")


def _plain(name: str) -> str:
    """Column name in lower case with underscores: 'Timestamp [ns]' is timestamp_ns."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _either(names: Sequence[str]) -> str:
    return ", ".join(names[:-1]) + " or " + names[-1]
