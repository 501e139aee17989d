"""CSV and JSON files as columns of text."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv

CAMERA_COLUMNS = ("cam_id", "camera_id", "camera", "camera_name", "cam", "port")
NANOSECOND_LIST = "timestamp_ns"
"""Column name that a bare JSON list of numbers is given."""


@dataclass(frozen=True)
class Table:
    """Columns of text, and where they come from."""

    path: Path
    columns: Mapping[str, pa.StringArray]
    lines: Sequence[bytes] | None
    """The file's lines, for messages; None for JSON"""

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

    def place(self, row: int) -> str:
        """Where row `row` stands, for people."""
        if self.lines is None:
            return f"{self.path}, item {row}"
        filled = [number for number, line in enumerate(self.lines, start=1) if line.strip()]
        number = filled[row + 1]
        return f"{self.path}, line {number} ({self.lines[number - 1].decode(errors='replace').strip()[:80]!r})"


def csv_table(path: Path, data: bytes) -> Table:
    """A table with a header, separated by comma, semicolon or tab."""
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
    return Table(path, columns, lines)


def json_table(path: Path, data: bytes) -> Table:
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
    return Table(path, {name: pa.array(values, pa.string()) for name, values in columns.items()}, None)


def _json_text(item: Any, name: str, place: str) -> str:
    if not isinstance(item, dict) or not isinstance(item.get(name), str):
        raise ValueError(f"{place}: expected a number or text for {name!r}, got {item!r}")
    return str(item[name]).strip()


def plain(name: str) -> str:
    """Column name in lower case with underscores: 'Timestamp [ns]' is timestamp_ns."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
