"""Single frames to and from the files of the splat world: PLY, compressed PLY, SPZ, and SOG (read only).

All of them are taken to have the axes of 3D Gaussian Splatting's PLY; only SPZ states its own and is turned.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

import numpy as np

from packuv.gaussians.floats import DRAWN_LOGIT, SH_C0, Gaussians
from packuv.interchange.compressed_ply import CHUNK, unpack, write_compressed_ply
from packuv.interchange.ply import gaussians_of, read_tables, write_ply
from packuv.interchange.sog import META, read_sog
from packuv.interchange.spz import read_spz, write_spz

__all__ = [
    "CHUNK",
    "DRAWN_LOGIT",
    "READABLE",
    "SH_C0",
    "SplatFormat",
    "is_splats",
    "read_gaussians",
    "read_ply",
    "read_sog",
    "read_spz",
    "write_compressed_ply",
    "write_gaussians",
    "write_ply",
    "write_spz",
]

READABLE = (".ply", ".spz", ".sog")
"""Suffixes of the files that `read_gaussians` takes, besides meta.json."""


class SplatFormat(StrEnum):
    """What a frame can be written as."""

    PLY = "ply"
    """Standard 3D Gaussian Splatting, exact"""
    COMPRESSED_PLY = "compressed-ply"
    """SuperSplat's, 16 bytes a Gaussian"""
    SPZ = "spz"
    """Niantic's, 20 bytes a Gaussian before gzip"""

    @property
    def suffix(self) -> str:
        return {SplatFormat.PLY: ".ply", SplatFormat.COMPRESSED_PLY: ".compressed.ply", SplatFormat.SPZ: ".spz"}[self]


_WRITERS: dict[SplatFormat, Callable[[Path, Gaussians], int]] = {
    SplatFormat.PLY: write_ply,
    SplatFormat.COMPRESSED_PLY: write_compressed_ply,
    SplatFormat.SPZ: write_spz,
}


def write_gaussians(path: Path, gaussians: Gaussians, *, kind: SplatFormat) -> int:
    """Write a file and return the number of Gaussians in it: absent ones and the faintest are left out."""
    return _WRITERS[kind](path, gaussians)


def is_splats(path: Path) -> bool:
    """Whether a path looks like one scene that `read_gaussians` takes: a file by suffix, or a folder of SOG."""
    return path.suffix.lower() in READABLE or path.name == META or (path / META).is_file()


def read_gaussians(path: Path) -> Gaussians:
    """Gaussians of a PLY (standard or compressed), SPZ or SOG file, or of an unpacked SOG folder.

    Raises FileNotFoundError when nothing is there, ValueError for what is damaged or of another kind.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no splat file {path}")
    if not is_splats(path):
        raise ValueError(f"{path} is no splat file that we read: {', '.join(READABLE)}, or a folder with {META}")
    match path.suffix.lower():
        case ".ply":
            return read_ply(path)
        case ".spz":
            return read_spz(path)
    return read_sog(path)


def read_ply(path: Path) -> Gaussians:
    """Gaussians of a 3DGS PLY, standard or compressed; columns are found by name, others are ignored.

    Raises FileNotFoundError, or ValueError for a file that is no binary PLY, lacks a column, or is cut short.
    """
    tables = read_tables(path)
    if "vertex" not in tables:
        raise ValueError(f"{path} has no element vertex, but {sorted(tables)[:8]}")
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is infinite, and dropped as broken
        return unpack(path, tables) if "chunk" in tables else gaussians_of(path, tables["vertex"])
