"""Single frames to and from the files of the splat world: the PLY that 3D Gaussian Splatting writes.

`read_ply` also takes SuperSplat's compressed PLY (chunks of 256 Gaussians, 16 bytes each).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from packuv.quantize import Gaussians

DRAWN_LOGIT = -math.log(254)
"""Logit of alpha 1/255: renderers skip Gaussians below it, and so `write_ply` leaves them out."""
SH_C0 = 0.5 / math.sqrt(math.pi)
"""SH basis function of band 0."""
CHUNK = 256
"""Gaussians per chunk of a compressed PLY."""

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


def write_ply(path: Path, gaussians: Gaussians) -> int:
    """Write a standard 3DGS PLY (binary, little-endian) and return the number of Gaussians in it.

    Absent Gaussians, and others too faint for any renderer (alpha below 1/255), are left out. f_rest runs channel by
    channel: all red coefficients, then green, then blue; rot is w x y z; normals are 0, as 3DGS writes them.
    """
    drawn = gaussians.opacity_logits >= DRAWN_LOGIT
    sh = gaussians.sh[drawn]  # [n, coefficients, 3]
    means = gaussians.means[drawn]
    rest = [sh[:, k, channel] for channel in range(3) for k in range(1, sh.shape[1])]
    columns = [
        *zip(("x", "y", "z"), means.T, strict=True),
        *((name, np.zeros(len(means))) for name in ("nx", "ny", "nz")),
        *((f"f_dc_{k}", sh[:, 0, k]) for k in range(3)),
        *((f"f_rest_{k}", column) for k, column in enumerate(rest)),
        ("opacity", gaussians.opacity_logits[drawn]),
        *((f"scale_{k}", column) for k, column in enumerate(gaussians.log_scales[drawn].T)),
        *((f"rot_{k}", column) for k, column in enumerate(gaussians.quaternions[drawn].T)),
    ]
    table = np.empty(len(means), [(name, "<f4") for name, _ in columns])
    for name, column in columns:
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [*(f"property float {name}" for name, _ in columns), "end_header\n"]
    with Path(path).open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.tobytes())
    return len(table)


def read_ply(path: Path) -> Gaussians:
    """Gaussians of a 3DGS PLY, standard or compressed; columns are found by name, others are ignored.

    Raises FileNotFoundError, or ValueError for a file that is no binary PLY, lacks a column, or is cut short.
    """
    with Path(path).open("rb") as file:
        elements = _read_header(path, file)
        tables = {element.name: _read_table(path, file, element) for element in elements}
    if "vertex" not in tables:
        raise ValueError(f"{path} has no element vertex, but {sorted(tables)}")
    if "chunk" in tables:
        return _unpack(path, tables)
    return _from_columns(path, tables["vertex"])


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    dtype: np.dtype


def _read_header(path: Path, file: BinaryIO) -> list[_Element]:
    if file.readline().strip() != b"ply":
        raise ValueError(f"{path} is not a PLY file")
    order = ""
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    for raw in file:
        words = raw.decode("ascii", errors="replace").split()
        match words:
            case ["format", "binary_little_endian", _]:
                order = "<"
            case ["format", "binary_big_endian", _]:
                order = ">"
            case ["format", *rest]:
                raise ValueError(f"{path} is a PLY of format {' '.join(rest)!r}; export it as a binary PLY")
            case ["element", name, count] if count.isdecimal():
                found.append((name, int(count), []))
            case ["property", kind, name] if kind in _TYPES and found:
                found[-1][2].append((name, order + _TYPES[kind]))
            case ["end_header"]:
                return [_Element(name, count, np.dtype(fields)) for name, count, fields in found]
            case ["comment" | "obj_info", *_] | []:
                continue
            case _:
                raise ValueError(f"{path}: a PLY of Gaussians has no header line {raw[:80]!r}")
    raise ValueError(f"{path}: its header has no end; the file is cut short")


def _read_table(path: Path, file: BinaryIO, element: _Element) -> np.ndarray:
    size = element.count * element.dtype.itemsize
    data = file.read(size)
    if len(data) != size:
        raise ValueError(
            f"{path} is cut short: element {element.name} needs {size} bytes for {element.count} entries, "
            f"but {len(data)} are there"
        )
    return np.frombuffer(data, element.dtype)


def _columns(path: Path, table: np.ndarray, names: list[str]) -> np.ndarray:
    """Columns by name, float32 [n, len(names)]."""
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise ValueError(f"{path} lacks the columns {missing}; is it a PLY of Gaussians?")
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)


def _from_columns(path: Path, table: np.ndarray) -> Gaussians:
    rest = sum(name.startswith("f_rest_") for name in table.dtype.names or ())
    degree = math.isqrt(rest // 3 + 1) - 1
    if 3 * ((degree + 1) ** 2 - 1) != rest:
        raise ValueError(f"{path} has {rest} columns f_rest_*; whole SH bands need 0, 9, 24 or 45")
    dc = _columns(path, table, [f"f_dc_{k}" for k in range(3)])
    if rest:
        higher = _columns(path, table, [f"f_rest_{k}" for k in range(rest)]).reshape(len(table), 3, rest // 3)
    else:
        higher = np.empty((len(table), 3, 0), np.float32)
    return Gaussians(
        _columns(path, table, ["x", "y", "z"]),
        _columns(path, table, ["scale_0", "scale_1", "scale_2"]),
        _columns(path, table, ["rot_0", "rot_1", "rot_2", "rot_3"]),
        _columns(path, table, ["opacity"])[:, 0],
        np.ascontiguousarray(np.concatenate([dc[:, :, None], higher], axis=2).transpose(0, 2, 1)),
    )


# Compressed PLY


def _unpack(path: Path, tables: dict[str, np.ndarray]) -> Gaussians:
    """Gaussians of a compressed PLY; its SH bands above 0, if any, are 8-bit in element sh."""
    vertex, chunk = tables["vertex"], tables["chunk"]
    if len(chunk) * CHUNK < len(vertex):
        raise ValueError(f"{path} has {len(chunk)} chunks of {CHUNK} for {len(vertex)} Gaussians")
    fields = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    if any(name not in (vertex.dtype.names or ()) or vertex.dtype[name].kind != "u" for name in fields):
        raise ValueError(f"{path} lacks the packed columns {fields} of a compressed PLY")
    position, rotation, scale, colour = (vertex[name].astype(np.int64) for name in fields)
    colour_and_alpha = np.stack([colour >> shift & 255 for shift in (24, 16, 8, 0)], axis=1) / 255
    # Older files keep colours in 0..1 instead of a range per chunk.
    ranged = "min_r" in (chunk.dtype.names or ())
    rgb = _in_chunk(path, chunk, colour_and_alpha[:, :3], ("r", "g", "b")) if ranged else colour_and_alpha[:, :3]
    alpha = np.clip(colour_and_alpha[:, 3], 0.5 / 255, 1 - 0.5 / 255)  # 0 and 255 mean their cell, not infinity
    dc = ((rgb - 0.5) / SH_C0)[:, None]  # [n, 1, 3]
    sh = np.concatenate([dc, _packed_bands(path, tables.get("sh"), len(vertex))], axis=1)
    return Gaussians(
        _in_chunk(path, chunk, _three(position), ("x", "y", "z")).astype(np.float32),
        _in_chunk(path, chunk, _three(scale), ("scale_x", "scale_y", "scale_z")).astype(np.float32),
        _largest_dropped(rotation).astype(np.float32),
        np.log(alpha / (1 - alpha)).astype(np.float32),
        sh.astype(np.float32),
    )


def _three(packed: np.ndarray) -> np.ndarray:
    """11, 10 and 11 bits, from the top, as shares of their range, [n, 3]."""
    return np.stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _in_chunk(path: Path, chunk: np.ndarray, share: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Shares [n, 3] of the ranges that each row's chunk states."""
    of_row = np.arange(len(share)) // CHUNK
    low = _columns(path, chunk, [f"min_{name}" for name in names]).astype(np.float64)[of_row]
    high = _columns(path, chunk, [f"max_{name}" for name in names]).astype(np.float64)[of_row]
    return low * (1 - share) + high * share


def _largest_dropped(packed: np.ndarray) -> np.ndarray:
    """Quaternions [n, 4], w x y z: 2 bits name the largest component, 10 bits each hold the others in order."""
    others = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    others = (others - 0.5) * math.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    place = np.arange(4) - (np.arange(4) > (packed >> 30)[:, None])  # [n, 4]: column of `others`
    quaternions = np.take_along_axis(others, np.minimum(place, 2), axis=1)
    np.put_along_axis(quaternions, (packed >> 30)[:, None], largest[:, None], axis=1)
    return quaternions


def _packed_bands(path: Path, table: np.ndarray | None, count: int) -> np.ndarray:
    """SH bands above 0, [n, coefficients, 3], of bytes that span -4..4."""
    if table is None:
        return np.empty((count, 0, 3))
    names = [f"f_rest_{k}" for k in range(len(table.dtype.names or ()))]
    if len(table) != count or len(names) not in (9, 24, 45):
        raise ValueError(f"{path}: element sh has {len(table)} rows of {len(names)} columns for {count} Gaussians")
    codes = _columns(path, table, names)
    share = np.select([codes == 0, codes == 255], [0.0, 1.0], (codes + 0.5) / 256)
    values = (share - 0.5) * 8
    return values.reshape(count, 3, -1).transpose(0, 2, 1)
