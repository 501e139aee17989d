"""The PLY that 3D Gaussian Splatting writes, and the PLY container that the compressed form shares with it.

Read are both byte orders and ASCII, 2D Gaussians, and files with other elements, as faces, beside the Gaussians.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from packuv.bounds import MOST_GAUSSIANS, shown
from packuv.files import whole_file
from packuv.gaussians.floats import Gaussians
from packuv.interchange.conventions import is_drawn, rows_out

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
MOST_HEADER_BYTES = 1 << 20
_ELEMENTS = ("vertex", "chunk", "sh")
"""What Gaussians are in; nothing else is read"""
_NAMES = {"f4": "float", "u4": "uint", "u1": "uchar"}


def write_ply(path: Path, gaussians: Gaussians, *, keep_rows: bool = False) -> int:
    """Write a standard 3DGS PLY (binary, little-endian) and return the number of drawn Gaussians in it.

    Absent Gaussians, and others too faint for any renderer (alpha below 1/255), are left out, or have alpha 0 where
    rows are kept. f_rest runs channel by
    channel: all red coefficients, then green, then blue; rot is w x y z; normals are 0, as 3DGS writes them.
    """
    mask = is_drawn(gaussians)
    kept = rows_out(gaussians, mask, keep_rows=keep_rows)
    sh = kept.sh  # [n, coefficients, 3]
    rest = [sh[:, k, channel] for channel in range(3) for k in range(1, sh.shape[1])]
    columns = [
        *zip(("x", "y", "z"), kept.means.T, strict=True),
        *((name, np.zeros(len(kept))) for name in ("nx", "ny", "nz")),
        *((f"f_dc_{k}", sh[:, 0, k]) for k in range(3)),
        *((f"f_rest_{k}", column) for k, column in enumerate(rest)),
        ("opacity", kept.opacity_logits),
        *((f"scale_{k}", column) for k, column in enumerate(kept.log_scales.T)),
        *((f"rot_{k}", column) for k, column in enumerate(kept.quaternions.T)),
    ]
    table = np.empty(len(kept), [(name, "<f4") for name, _ in columns])
    for name, column in columns:
        table[name] = column
    write_tables(path, {"vertex": table})
    return int(mask.sum())


def gaussians_of(path: Path, table: np.ndarray) -> Gaussians:
    """Gaussians of the element `vertex` of a standard PLY; the third log scale of 2D ones, which lack it, is -inf."""
    names = table.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    degree = math.isqrt(rest // 3 + 1) - 1
    if 3 * ((degree + 1) ** 2 - 1) != rest:
        raise ValueError(f"{path} has {rest} columns f_rest_*; whole SH bands need 0, 9, 24, 45 or 72")
    dc = columns_of(path, table, [f"f_dc_{k}" for k in range(3)])
    if rest:
        higher = columns_of(path, table, [f"f_rest_{k}" for k in range(rest)]).reshape(len(table), 3, rest // 3)
    else:
        higher = np.empty((len(table), 3, 0), np.float32)
    axes = [f"scale_{k}" for k in range(2 if "scale_1" in names and "scale_2" not in names else 3)]
    scales = np.full((len(table), 3), -np.inf, np.float32)
    scales[:, : len(axes)] = columns_of(path, table, axes)
    return Gaussians(
        columns_of(path, table, ["x", "y", "z"]),
        scales,
        columns_of(path, table, ["rot_0", "rot_1", "rot_2", "rot_3"]),
        columns_of(path, table, ["opacity"])[:, 0],
        np.ascontiguousarray(np.concatenate([dc[:, :, None], higher], axis=2).transpose(0, 2, 1)),
    )


# The container


def write_tables(path: Path, tables: Mapping[str, np.ndarray]) -> None:
    """Write structured arrays of little-endian float32, uint32 and uint8 as elements of a binary PLY."""
    header = ["ply", "format binary_little_endian 1.0"]
    for name, table in tables.items():
        header.append(f"element {name} {len(table)}")
        header += [f"property {_NAMES[kind.str[1:]]} {column}" for column, kind in _fields(table)]
    with whole_file(path) as partial, partial.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        for table in tables.values():
            file.write(table.tobytes())


def _fields(table: np.ndarray) -> list[tuple[str, np.dtype]]:
    return [(name, table.dtype[name]) for name in table.dtype.names or ()]


def read_tables(path: Path) -> dict[str, np.ndarray]:
    """The elements of a PLY that Gaussians are in, as structured arrays.

    Others are passed over. Raises ValueError for what is no PLY or is cut short.
    """
    with Path(path).open("rb") as file:
        ascii_rows, elements = _read_header(path, file)
        wanted = {element.name for element in elements if element.name in _ELEMENTS}
        tables: dict[str, np.ndarray] = {}
        for element in elements:
            if len(tables) == len(wanted):
                break
            if element.name not in wanted:
                _pass_over(path, file, element, ascii_rows)
            else:
                tables[element.name] = (_read_rows if ascii_rows else _read_table)(path, file, element)
    return tables


def columns_of(path: Path, table: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Columns by name, float32 [n, len(names)]."""
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise ValueError(f"{path} lacks the columns {missing}; is it a PLY of Gaussians?")
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


@dataclass(frozen=True)
class _Column:
    name: str
    kind: str
    """Of a value, as NumPy names it"""
    length: str = ""
    """Kind of the length of a list; none for a single value"""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    columns: tuple[_Column, ...]

    @property
    def dtype(self) -> np.dtype:
        return np.dtype([(column.name, column.kind) for column in self.columns])


def _read_header(path: Path, file: BinaryIO) -> tuple[bool, list[_Element]]:
    """Whether rows are text, and the elements."""
    if file.readline(8).strip() != b"ply":
        raise ValueError(f"{path} is not a PLY file")
    order, ascii_rows = "<", False
    found: list[tuple[str, int, list[_Column]]] = []
    while raw := file.readline(MOST_HEADER_BYTES):
        if file.tell() >= MOST_HEADER_BYTES:
            raise ValueError(f"{path}: a PLY header has an end within {MOST_HEADER_BYTES} bytes, but this one none")
        words = raw.decode("ascii", errors="replace").split()
        match words:
            case ["format", "binary_little_endian", _]:
                order = "<"
            case ["format", "binary_big_endian", _]:
                order = ">"
            case ["format", "ascii", _]:
                ascii_rows = True
            case ["format", *rest]:
                raise ValueError(f"{path} is a PLY of format {' '.join(rest)[:40]!r}; export it as a binary PLY")
            case ["element", name, count] if count.isdecimal() and len(count) <= len(str(2**64)):
                found.append((name, int(count), []))
            case ["property", kind, name] if kind in _TYPES and found:
                found[-1][2].append(_Column(name, order + _TYPES[kind]))
            case ["property", "list", size, kind, name] if {size, kind} <= _TYPES.keys() and found:
                found[-1][2].append(_Column(name, order + _TYPES[kind], order + _TYPES[size]))
            case ["end_header"]:
                return ascii_rows, [_element(path, *parts) for parts in found]
            case ["comment" | "obj_info", *_] | []:
                continue
            case _:
                raise ValueError(f"{path}: a PLY of Gaussians has no header line {raw[:80]!r}")
    raise ValueError(f"{path}: its header has no end; the file is cut short")


def _element(path: Path, name: str, count: int, columns: list[_Column]) -> _Element:
    names = [column.name for column in columns]
    if len(set(names)) != len(names):
        twice = next(column for column in names if names.count(column) > 1)
        raise ValueError(f"{path}: element {shown(name)} has the column {shown(twice)} more than once")
    if count > MOST_GAUSSIANS:
        raise ValueError(f"{path}: element {shown(name)} has {count} entries, but {MOST_GAUSSIANS} is the most")
    if name in _ELEMENTS and any(column.length for column in columns):
        raise ValueError(f"{path}: element {name} of a PLY of Gaussians has single values, but this one has a list")
    return _Element(name, count, tuple(columns))


def _read_table(path: Path, file: BinaryIO, element: _Element) -> np.ndarray:
    dtype = element.dtype
    data = _read(path, file, element, element.count * dtype.itemsize)
    if not data:
        return np.zeros(element.count if dtype.names else 0, dtype)
    return np.frombuffer(data, dtype)


def _read(path: Path, file: BinaryIO, element: _Element, size: int) -> bytes:
    there = os.fstat(file.fileno()).st_size - file.tell()
    if there < size:
        raise ValueError(
            f"{path} is cut short: element {element.name} needs {size} bytes for {element.count} entries, "
            f"but {there} are there"
        )
    return file.read(size)


def _read_rows(path: Path, file: BinaryIO, element: _Element) -> np.ndarray:
    """Of an ASCII PLY: a line an entry."""
    dtype = element.dtype
    if not element.count or not dtype.names:
        return np.zeros(element.count if dtype.names else 0, dtype)
    lines = _lines(file, element.count)
    try:
        rows = np.loadtxt(lines, np.float64, comments=None, ndmin=2) if lines else np.empty((0, 0))
    except ValueError:
        raise ValueError(
            f"{path}: element {element.name} must hold {element.count} lines of {len(dtype.names)} numbers, but one of "
            "them has other words or another number of them; it is damaged or cut short"
        ) from None
    if rows.shape != (element.count, len(dtype.names)):
        raise ValueError(
            f"{path} is cut short: element {element.name} needs {element.count} lines of {len(dtype.names)} numbers, "
            f"but {rows.shape[0]} of {rows.shape[1]} are there"
        )
    table = np.empty(element.count, dtype)
    for name, column in zip(dtype.names, rows.T, strict=True):
        table[name] = column
    return table


def _lines(file: BinaryIO, count: int) -> list[bytes]:
    """So many lines, or as many as there are; blank ones are none."""
    return list(islice((line for line in file if line.strip()), count))


def _pass_over(path: Path, file: BinaryIO, element: _Element, ascii_rows: bool) -> None:
    """What stands before the Gaussians and is none of them; lists must be of one length, as those of triangles are."""
    if ascii_rows:
        _lines(file, element.count)
        return
    if not element.count:
        return
    dtype, lengths = _dtype_of_first(path, file, element)
    rows = np.frombuffer(_read(path, file, element, element.count * dtype.itemsize), dtype)
    if any((rows[name] != length).any() for name, length in lengths.items()):
        raise ValueError(
            f"{path}: element {element.name} has lists of different lengths before the Gaussians; leave it out"
        )


def _dtype_of_first(path: Path, file: BinaryIO, element: _Element) -> tuple[np.dtype, dict[str, int]]:
    """What the first entry takes, and the lengths of its lists by the name of the column that holds them."""
    start, fields, lengths = file.tell(), list[tuple[str, str]](), dict[str, int]()
    for number, column in enumerate(element.columns):
        if column.length:
            name, kind = f"length {number}", np.dtype(column.length)
            lengths[name] = max(0, int(np.frombuffer(_read(path, file, element, kind.itemsize), kind)[0]))
            _read(path, file, element, lengths[name] * np.dtype(column.kind).itemsize)
            fields += [(name, column.length), (f"list {number}", f"{lengths[name]}{column.kind}")]
        else:
            _read(path, file, element, np.dtype(column.kind).itemsize)
            fields.append((f"value {number}", column.kind))
    file.seek(start)
    return np.dtype(fields), lengths
