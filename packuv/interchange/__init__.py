"""Frames of scenes to and from the files of the splat world; `formats` lists them all.

All are taken to have the axes of 3D Gaussian Splatting's PLY, but for those that state their own, which are turned.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from packuv.bounds import MOST_SH_DEGREE
from packuv.gaussians.floats import DRAWN_LOGIT, SH_C0, Gaussians
from packuv.interchange.compressed_ply import CHUNK, write_compressed_ply
from packuv.interchange.conventions import finite
from packuv.interchange.formats import DOORS, READABLE, WRITTEN, SplatFormat, format_of, read_ply
from packuv.interchange.ply import write_ply
from packuv.interchange.sog import META, read_sog
from packuv.interchange.sog_writer import write_sog
from packuv.interchange.splat import read_ksplat, read_splat, write_splat
from packuv.interchange.spz import read_spz, write_spz

__all__ = [
    "CHUNK",
    "DOORS",
    "DRAWN_LOGIT",
    "READABLE",
    "SH_C0",
    "WRITTEN",
    "SplatFormat",
    "antialiased",
    "format_of",
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
    "write_sog",
    "write_splat",
    "write_spz",
]


def write_gaussians(
    path: Path, gaussians: Gaussians, *, kind: SplatFormat, antialiased: bool = False, keep_rows: bool = False
) -> int:
    """Write a frame as a file and return the number of drawn Gaussians in it.

    Absent ones and the faintest are left out, or have alpha 0 where rows are kept. What was trained with the opacities
    of Mip-Splatting is marked so where the format can say it: in SPZ and SOG. Raises ValueError for formats of
    sequences, and of those that are only read.
    """
    door = kind.door
    if door.write is None:
        raise ValueError(f"{kind} is no format that one frame is written in; choose of {', '.join(WRITTEN)}")
    marks = {"antialiased": antialiased} if door.mark else {}
    return door.write(path, gaussians, keep_rows=keep_rows, **marks)


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
    read = _kind_of(path).door.read or read_sog
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
    mark = _kind_of(Path(path)).door.mark
    return mark is not None and mark(path)


def _kind_of(path: Path) -> SplatFormat:
    """The format of what `is_splats`: by its name, and of folders SOG."""
    return format_of(path) or SplatFormat.SOG
