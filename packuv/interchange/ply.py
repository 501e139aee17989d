"""The PLY that 3D Gaussian Splatting writes, and the PLY container that the compressed form shares with it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from packuv.bounds import MOST_GAUSSIANS, MOST_SH_DEGREE, shown
from packuv.files import whole_file
from packuv.gaussians.floats import Gaussians, drawn

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
MOST_HEADER_BYTES = 1 << 20
_NAMES = {"f4": "float", "u4": "uint", "u1": "uchar"}


def write_ply(path: Path, gaussians: Gaussians) -> int:
    """Write a standard 3DGS PLY (binary, little-endian) and return the number of Gaussians in it.

    Absent Gaussians, and others too faint for any renderer (alpha below 1/255), are left out. f_rest runs channel by
    channel: all red coefficients, then green, then blue; rot is w x y z; normals are 0, as 3DGS writes them.
    """
    kept = drawn(gaussians)
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
    return len(table)


def gaussians_of(path: Path, table: np.ndarray) -> Gaussians:
    """Gaussians of the element `vertex` of a standard PLY."""
    rest = sum(name.startswith("f_rest_") for name in table.dtype.names or ())
    degree = math.isqrt(rest // 3 + 1) - 1
    if 3 * ((degree + 1) ** 2 - 1) != rest or degree > MOST_SH_DEGREE:
        raise ValueError(f"{path} has {rest} columns f_rest_*; whole SH bands need 0, 9, 24 or 45")
    dc = columns_of(path, table, [f"f_dc_{k}" for k in range(3)])
    if rest:
        higher = columns_of(path, table, [f"f_rest_{k}" for k in range(rest)]).reshape(len(table), 3, rest // 3)
    else:
        higher = np.empty((len(table), 3, 0), np.float32)
    return Gaussians(
        columns_of(path, table, ["x", "y", "z"]),
        columns_of(path, table, ["scale_0", "scale_1", "scale_2"]),
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
    """The elements of a binary PLY as structured arrays; raises ValueError for what is none or is cut short."""
    with Path(path).open("rb") as file:
        elements = _read_header(path, file)
        return {element.name: _read_table(path, file, element) for element in elements}


def columns_of(path: Path, table: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Columns by name, float32 [n, len(names)]."""
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise ValueError(f"{path} lacks the columns {missing}; is it a PLY of Gaussians?")
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    dtype: np.dtype


def _read_header(path: Path, file: BinaryIO) -> list[_Element]:
    if file.readline(8).strip() != b"ply":
        raise ValueError(f"{path} is not a PLY file")
    order = ""
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    while raw := file.readline(MOST_HEADER_BYTES):
        if file.tell() >= MOST_HEADER_BYTES:
            raise ValueError(f"{path}: a PLY header has an end within {MOST_HEADER_BYTES} bytes, but this one none")
        words = raw.decode("ascii", errors="replace").split()
        match words:
            case ["format", "binary_little_endian", _]:
                order = "<"
            case ["format", "binary_big_endian", _]:
                order = ">"
            case ["format", *rest]:
                raise ValueError(f"{path} is a PLY of format {' '.join(rest)[:40]!r}; export it as a binary PLY")
            case ["element", name, count] if count.isdecimal() and len(count) <= len(str(2**64)):
                found.append((name, int(count), []))
            case ["property", kind, name] if kind in _TYPES and found:
                found[-1][2].append((name, order + _TYPES[kind]))
            case ["end_header"]:
                return [_element(path, *parts) for parts in found]
            case ["comment" | "obj_info", *_] | []:
                continue
            case _:
                raise ValueError(f"{path}: a PLY of Gaussians has no header line {raw[:80]!r}")
    raise ValueError(f"{path}: its header has no end; the file is cut short")


def _element(path: Path, name: str, count: int, columns: list[tuple[str, str]]) -> _Element:
    names = [column for column, _ in columns]
    if len(set(names)) != len(names):
        twice = next(column for column in names if names.count(column) > 1)
        raise ValueError(f"{path}: element {shown(name)} has the column {shown(twice)} more than once")
    if count > MOST_GAUSSIANS:
        raise ValueError(f"{path}: element {shown(name)} has {count} entries, but {MOST_GAUSSIANS} is the most")
    return _Element(name, count, np.dtype(columns))


def _read_table(path: Path, file: BinaryIO, element: _Element) -> np.ndarray:
    size = element.count * element.dtype.itemsize
    there = os.fstat(file.fileno()).st_size - file.tell()
    if there < size:
        raise ValueError(
            f"{path} is cut short: element {element.name} needs {size} bytes for {element.count} entries, "
            f"but {there} are there"
        )
    data = file.read(size)
    if not size:
        return np.zeros(element.count if element.dtype.names else 0, element.dtype)
    return np.frombuffer(data, element.dtype)
