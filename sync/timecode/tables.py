"""Tables of all kinds as columns of text: CSV with a header and without, plain numbers, JSON, NumPy's arrays."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv

from sync.timecode.labels import is_clock

CAMERA_COLUMNS = ("cam_id", "camera_id", "camera", "camera_name", "cam", "port")
NANOSECOND_LIST = "timestamp_ns"
"""Column name that a bare JSON list of whole numbers is given."""
TIME_COLUMN, INDEX_COLUMN = "timestamp", "frame"
"""Column names where a file names none"""
COMMENT = b"#"
MOST_COUNTED = 10**9
"""What is more is a time, as seconds since 1970 are"""
VERSION_2 = re.compile(rb"#\s*time(?:code|stamp) format v2", re.IGNORECASE)
"""First line of a file of milliseconds, as mkvmerge and VirtualDub write and read them"""


@dataclass(frozen=True)
class Table:
    """Columns of text, and where they come from."""

    path: Path
    columns: Mapping[str, pa.StringArray]
    lines: Sequence[bytes] | None
    """The file's lines, for messages; None for JSON"""
    named: bool = True
    """Whether the file names its columns; without names the first one here is the time"""
    whole: bool = True
    """Whether the last line has its end; a file that was cut short has not"""

    @property
    def camera(self) -> str | None:
        """Column that tells whose a row is."""
        return next((name for name in self.columns if plain(name) in CAMERA_COLUMNS), None)

    @property
    def cameras(self) -> list[str]:
        """Ids in the camera's column."""
        assert self.camera is not None
        return [str(value) for value in pc.unique(self.columns[self.camera]).to_pylist()]

    def rows_of(self, camera: str) -> np.ndarray:
        """Rows of one id in the camera's column, int64."""
        assert self.camera is not None
        return np.flatnonzero(pc.equal(self.columns[self.camera], camera).to_numpy(zero_copy_only=False))

    def filled(self, name: str) -> np.ndarray:
        """Rows that hold something in a column, int64; raises ValueError where none does."""
        rows = np.flatnonzero(pc.not_equal(self.columns[name], "").to_numpy(zero_copy_only=False))
        if not len(rows):
            raise ValueError(f"{self.path}: column {name!r} is empty; a camera needs at least one timecode")
        return rows

    def place(self, row: int) -> str:
        """Where row `row` stands, for people."""
        if self.lines is None:
            return f"{self.path}, item {row}"
        filled = [number for number, line in enumerate(self.lines, start=1) if _is_filled(line)]
        number = filled[row + self.named]
        return f"{self.path}, line {number} ({self.lines[number - 1].decode(errors='replace').strip()[:80]!r})"


def csv_table(path: Path, data: bytes, column: str | None = None) -> Table:
    """A table with a header, separated by comma, semicolon or tab; without a header, as `number_table`. Comments may
    stand before the header."""
    lines = data.splitlines()
    first = next((number for number, line in enumerate(lines) if _is_filled(line)), 0)
    header = lines[first].decode(errors="replace") if lines else ""
    if not re.search("[A-Za-z]", _EXPONENT.sub("", header)) or header.startswith("#") or _ISO_START.match(header):
        return number_table(path, data, column)
    delimiter = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: two columns bear one name in {header[:80]!r}")
    try:
        table = pcsv.read_csv(
            pa.BufferReader(data),
            # a row number in messages needs the serial reader
            read_options=pcsv.ReadOptions(column_names=names, skip_rows=first + 1, use_threads=False),
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
    return Table(path, columns, lines, whole=data.endswith((b"\n", b"\r")))


def number_table(path: Path, data: bytes, column: str | None = None) -> Table:
    """Lines of values without a header, comments aside: times alone, a counted index and times, or times and whatever
    follows, as in TUM's trajectories. Where that leaves a choice, `column` is the number of the time's, from 1.

    Raises ValueError for a choice that is left open, or a line with fewer columns than the first.
    """
    lines = data.splitlines()
    rows = [line.decode(errors="replace").strip() for line in lines if _is_filled(line)]
    if not rows:
        raise ValueError(f"{path} holds no line with a time; a camera needs at least one timecode")
    split = _splitter(rows)
    cells = [split(row) for row in rows]
    wide = len(cells[0])
    whole = data.endswith((b"\n", b"\r"))
    short = next((row for row, cell in enumerate(cells) if len(cell) < wide), None)
    table = Table(path, {}, lines, named=False, whole=whole)
    if short is not None:
        raise ValueError(f"{table.place(short)}: expected {wide} columns as in the first line, got {len(cells[short])}")
    counted = _is_counted([cell[0] for cell in cells[:3]], wide)
    place = _column_number(path, column, wide) if column is not None else int(counted)
    if column is None and wide > 1 and not counted and path.suffix.lower() in (".csv", ".tsv", ".npy"):
        raise ValueError(
            f"{path} has {wide} columns and no header; say which holds the time in capture.toml: timecode_column = '1' "
            "for the first, or give it a first line with names"
        )
    version_2 = bool(VERSION_2.match(data))
    name = f"{TIME_COLUMN}_ms" if version_2 else TIME_COLUMN
    columns = {name: pa.array([cell[place] for cell in cells], pa.string())}
    if counted and place:
        columns[INDEX_COLUMN] = pa.array([cell[0] for cell in cells], pa.string())
    return Table(path, columns, lines, named=False, whole=whole)


def npy_table(path: Path, data: bytes, column: str | None = None) -> Table:
    """An array [n] of times, as `numpy.save` writes it, or [n, columns] as `number_table`; floats by their shortest
    text."""
    try:
        values = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path} is no array that numpy can load: {error}") from None
    fits = isinstance(values, np.ndarray) and values.ndim in (1, 2) and values.dtype.kind in "iufM" and values.size
    if not fits:
        shape = getattr(values, "shape", "no array")
        raise ValueError(f"{path} must hold an array [n] of times, or [n, 2] of a count and times, but holds {shape}")
    if values.ndim == 2 and values.shape[1] > 1:
        return _rows_table(path, values.tolist(), column)
    values = values.ravel()
    if values.dtype.kind == "M":
        values = values.astype("datetime64[ns]").astype(np.int64)
        return Table(path, {NANOSECOND_LIST: pa.array([str(value) for value in values], pa.string())}, None)
    text = [str(value) for value in values.tolist()]
    if values.dtype.kind == "f":
        text = [value if "." in value or "e" in value else f"{value}.0" for value in text]
    return Table(path, {TIME_COLUMN: pa.array(text, pa.string())}, None)


def json_table(path: Path, data: bytes, column: str | None = None) -> Table:
    """A list of whole numbers (ns), other times or labels, of objects, or of lists; an object of lists, one a column,
    of times by frame number, or that has such a list; or an object a line. Numbers stay text on the way in."""
    items = _json_items(path, data)
    if isinstance(items, dict):
        items = _as_list(path, items)
    if not isinstance(items, list) or not items:
        raise ValueError(f"{path} must hold a list of nanoseconds, of objects or of lists, with at least one item")
    if isinstance(items[0], list):
        return _rows_table(path, items, column)
    if not isinstance(items[0], dict):
        items = [{_list_name(items): item} for item in items]
    columns: dict[str, list[str]] = {name: [] for name in items[0]}
    for number, item in enumerate(items):
        for name, values in columns.items():
            values.append(_json_text(item, name, f"{path}, item {number}"))
    return Table(path, {name: pa.array(values, pa.string()) for name, values in columns.items()}, None)


def _json_items(path: Path, data: bytes) -> Any:
    """What a file of JSON holds, or one of an object a line, as a list."""

    def parse(text: bytes) -> Any:
        return json.loads(text, parse_int=str, parse_float=str, parse_constant=str)

    lines = [line for line in data.splitlines() if line.strip()]
    try:
        if len(lines) > 1 and lines[0].startswith(b"{") and lines[0].rstrip().endswith(b"}"):
            return [parse(line) for line in lines]
        return parse(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no JSON: {error}") from None


def _as_list(path: Path, items: Mapping[str, Any]) -> list[Any]:
    """The rows of an object: of columns, of times by frame number, or of one list of objects beside other facts."""
    lists = {name: values for name, values in items.items() if isinstance(values, list)}
    if len(lists) == 1 and all(isinstance(item, dict) for values in lists.values() for item in values):
        return next(iter(lists.values()))
    if items and all(name.isdecimal() and isinstance(value, str) for name, value in items.items()):
        rows = sorted(items.items(), key=lambda item: int(item[0]))
        return [{INDEX_COLUMN: name, _list_name([value for _, value in rows]): value} for name, value in rows]
    if not lists or len({len(values) for values in lists.values()}) != 1:
        raise ValueError(
            f"{path} must hold a list, lists of one length, one a column, or times by frame number, but holds "
            f"{list(items)[:8]}"
        )
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def _rows_table(path: Path, rows: Sequence[Any], column: str | None) -> Table:
    """As `number_table`, of lists."""
    text = "\n".join("\t".join(str(cell) for cell in row) if isinstance(row, list) else "" for row in rows)
    return number_table(path, text.encode() + b"\n", column)


def _list_name(items: Sequence[Any]) -> str:
    """Of the column that a bare list is."""
    text = [item for item in items if isinstance(item, str)]
    if text and ":" in text[0]:
        return "timecode"
    decimal = any("." in item or "-" in item[1:] for item in text)  # or a date
    return TIME_COLUMN if decimal else NANOSECOND_LIST


def _is_filled(line: bytes) -> bool:
    """Whether a line holds values."""
    return bool(line.strip()) and not line.lstrip().startswith(COMMENT)


def _splitter(rows: Sequence[str]) -> Callable[[str], list[str]]:
    """How lines fall into columns: by semicolon, tab or comma, else by space. A single comma a line, before which the
    number stays the same here and there, is a decimal one."""
    first = rows[0]
    for delimiter in (";", "\t"):
        if delimiter in first:
            return lambda row: [cell.strip() for cell in row.split(delimiter)]
    if is_clock(first):
        return lambda row: [row]
    if "," in first and not _has_decimal_comma(rows):
        return lambda row: [cell.strip() for cell in row.split(",")]
    if _ISO_START.match(first):
        return lambda row: [row]
    return str.split


def _has_decimal_comma(rows: Sequence[str]) -> bool:
    parts = [row.split(",") for row in rows[:1000]]
    if any(len(part) != 2 or not part[0].lstrip("+-").isdecimal() or not part[1].isdecimal() for part in parts):
        return False
    return any(before[0] == after[0] for before, after in pairwise(parts))


def _is_counted(first: Sequence[str], wide: int) -> bool:
    """Whether lines begin with a count, of which these are the first: 0 or 1, 2, ...; of two columns also from
    elsewhere, and as floats (`numpy.savetxt`)."""
    if wide != 2:
        return wide > 1 and list(first) in (["0", "1", "2"], ["1", "2", "3"])
    values = [whole(cell) for cell in first]
    if len(values) < 3 or not all(value.isdecimal() for value in values):
        return False
    return int(values[0]) < MOST_COUNTED and all(int(b) == int(a) + 1 for a, b in pairwise(values))


def whole(cell: str) -> str:
    """A whole number that is written as a float without its decimals, anything else as it is."""
    return str(int(float(cell))) if _FLOAT.fullmatch(cell) and float(cell).is_integer() else cell


def _column_number(path: Path, column: str, wide: int) -> int:
    if not column.isdecimal() or not 1 <= int(column) <= wide:
        raise ValueError(
            f"{path} has no header, so timecode_column must be the number of a column, 1 to {wide}, but is {column!r}"
        )
    return int(column) - 1


def _json_text(item: Any, name: str, place: str) -> str:
    if not isinstance(item, dict) or not isinstance(item.get(name), str):
        raise ValueError(f"{place}: expected a number or text for {name!r}, got {item!r}")
    return str(item[name]).strip()


_EXPONENT = re.compile(r"\d[eE][+-]?\d")
_MICRO = re.compile("[\u00b5\u03bc\ufffd](?=s)")
"""The micro sign and the Greek letter, and what becomes of them where a file is in no Unicode"""
_ISO_START = re.compile(r"\d{4}[-/]\d\d[-/]\d\d[T ]\d\d:\d\d")
_FLOAT = re.compile(r"\d+\.\d*(?:e\+\d\d)?")


def plain(name: str) -> str:
    """Column name in lower case with underscores: 'Timestamp [ns]' is timestamp_ns, 'Time (\u00b5s)' time_us."""
    return re.sub(r"[^a-z0-9]+", "_", _MICRO.sub("u", name.lower())).strip("_")
