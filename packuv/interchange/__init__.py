"""Single frames to and from the files of the splat world: PLY, compressed PLY, SPZ; SOG, .splat, .ksplat (read only).

All of them are taken to have the axes of 3D Gaussian Splatting's PLY; only SPZ states its own and is turned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from packuv.bounds import MOST_SH_DEGREE
from packuv.gaussians.floats import DRAWN_LOGIT, SH_C0, Gaussians
from packuv.interchange.compressed_ply import CHUNK, unpack, write_compressed_ply
from packuv.interchange.conventions import finite
from packuv.interchange.ply import gaussians_of, read_tables, write_ply
from packuv.interchange.sog import META, read_sog
from packuv.interchange.sog import antialiased as sog_antialiased
from packuv.interchange.splat import read_ksplat, read_splat
from packuv.interchange.spz import antialiased as spz_antialiased
from packuv.interchange.spz import read_spz, write_spz

__all__ = [
    "CHUNK",
    "DRAWN_LOGIT",
    "READABLE",
    "SH_C0",
    "SplatFormat",
    "antialiased",
    "is_splats",
    "read_gaussians",
    "read_ksplat",
    "read_ply",
    "read_sog",
    "read_splat",
    "read_spz",
    "write_compressed_ply",
    "write_gaussians",
    "write_ply",
    "write_spz",
]

READABLE = (".ply", ".spz", ".sog", ".splat", ".ksplat")
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


def write_gaussians(path: Path, gaussians: Gaussians, *, kind: SplatFormat, antialiased: bool = False) -> int:
    """Write a file and return the number of Gaussians in it: absent ones and the faintest are left out.

    What was trained with the opacities of Mip-Splatting is marked so where the format can say it: in SPZ.
    """
    if kind == SplatFormat.SPZ:
        return write_spz(path, gaussians, antialiased=antialiased)
    return (write_ply if kind == SplatFormat.PLY else write_compressed_ply)(path, gaussians)


def is_splats(path: Path) -> bool:
    """Whether a path looks like one scene that `read_gaussians` takes: a file by suffix, or a folder of SOG."""
    return path.suffix.lower() in READABLE or path.name == META or (path / META).is_file()


def read_gaussians(path: Path, *, sh_degree: int | None = None) -> Gaussians:
    """Gaussians of a PLY (standard or compressed), SPZ, SOG, .splat or .ksplat file, or of an unpacked SOG folder.

    Opacities of +inf are alpha 1, scales of -inf flat; SH bands above `sh_degree` are left out. Raises
    FileNotFoundError when nothing is there, ValueError for what is damaged, of another kind, or of an SH degree that
    is not drawn.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"no splat file {path}")
    if not is_splats(path):
        raise ValueError(f"{path} is no splat file that we read: {', '.join(READABLE)}, or a folder with {META}")
    read = _READERS.get(path.suffix.lower(), read_sog)
    with np.errstate(divide="ignore", invalid="ignore"):  # logarithms of no thickness, and of what is none
        whole = finite(read(path))
    if sh_degree is not None and whole.sh_degree > sh_degree:
        whole = replace(whole, sh=np.ascontiguousarray(whole.sh[:, : (sh_degree + 1) ** 2]))
    if whole.sh_degree > MOST_SH_DEGREE:
        raise ValueError(
            f"{path} has SH of degree {whole.sh_degree}, but a scene holds {MOST_SH_DEGREE} at most; "
            f"--sh-degree {MOST_SH_DEGREE} leaves the bands above out"
        )
    return whole


def antialiased(path: Path) -> bool:
    """Whether a splat file says that it was trained with the opacities of Mip-Splatting; most formats cannot."""
    match Path(path).suffix.lower():
        case ".spz":
            return spz_antialiased(path)
        case ".ply" | ".splat" | ".ksplat":
            return False
    return sog_antialiased(path)


def read_ply(path: Path) -> Gaussians:
    """Gaussians of a 3DGS PLY, standard or compressed; columns are found by name, others are ignored.

    Of 2D Gaussians, which lack scale_2, the third axis is flat. Raises FileNotFoundError, or ValueError for a file that
    is no PLY, lacks a column, or is cut short.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is infinite, and dropped as broken
        tables = read_tables(path)
        if "vertex" not in tables:
            raise ValueError(f"{path} has no element vertex, in which Gaussians are")
        return unpack(path, tables) if "chunk" in tables else gaussians_of(path, tables["vertex"])


_READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": read_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".ksplat": read_ksplat,
}
