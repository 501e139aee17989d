"""The formats of other programs, each in one row of one table: how it is read and written, and what it cannot hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from packuv.gaussians.floats import Gaussians
from packuv.interchange.clip import Clip
from packuv.interchange.compressed_ply import unpack, write_compressed_ply
from packuv.interchange.fourdgs import write_fourdgs
from packuv.interchange.gltf import write_gltf
from packuv.interchange.ply import gaussians_of, read_tables, write_ply
from packuv.interchange.sog import antialiased as sog_antialiased
from packuv.interchange.sog import read_sog
from packuv.interchange.sog_writer import write_sog
from packuv.interchange.splat import read_ksplat, read_splat, write_splat
from packuv.interchange.spz import antialiased as spz_antialiased
from packuv.interchange.spz import read_spz, write_spz, write_spz_3
from packuv.interchange.usd import write_usd


class SplatFormat(StrEnum):
    """What a scene of another program is kept in."""

    PLY = "ply"
    """Standard 3D Gaussian Splatting, exact"""
    COMPRESSED_PLY = "compressed-ply"
    """SuperSplat's, 16 bytes a Gaussian"""
    SPZ = "spz"
    """Niantic's, version 4, 20 bytes a Gaussian before zstd"""
    SPZ_3 = "spz3"
    """The same as version 3, by gzip, for older readers"""
    SOG = "sog"
    """PlayCanvas's, WebP pictures in an archive"""
    SPLAT = "splat"
    """32 bytes a Gaussian, as the first web viewers had it"""
    KSPLAT = "ksplat"
    """GaussianSplats3D's"""
    GLTF = "gltf"
    """glTF with KHR_gaussian_splatting, float32"""
    USD = "usd"
    """OpenUSD's ParticleField3DGaussianSplat, float32, a sequence in one file"""
    FOURDGS = "4dgs"
    """A sequence in one file, Gaussians with windows of time"""

    @property
    def door(self) -> Door:
        return DOORS[self]

    @property
    def suffix(self) -> str:
        """Of the files that are written, with its dot."""
        return self.door.suffixes[0]


@dataclass(frozen=True)
class Door:
    """One format: what is None it cannot do, or we cannot."""

    suffixes: tuple[str, ...]
    """Of its files, the one that we write first"""
    lacks: str
    """What it cannot hold of what we write, a sentence"""
    read: Callable[[Path], Gaussians] | None = None
    mark: Callable[[Path], bool] | None = None
    """Whether a file says that it was trained with the opacities of Mip-Splatting; its `write` takes `antialiased`"""
    write: Callable[..., int] | None = None
    """Of a path and the Gaussians of a frame, with `keep_rows`: the number of drawn Gaussians in the file"""
    write_clip: Callable[[Path, Clip], int] | None = None
    """Of a path and frames: the number of drawn Gaussians in all of them"""
    sounds: bool = False
    """Whether it holds what was heard meanwhile, too"""

    @property
    def is_written(self) -> bool:
        return self.write is not None or self.write_clip is not None

    @property
    def endings(self) -> tuple[str, ...]:
        """What names of its files end in at least: x.ply may be a compressed one."""
        return tuple(dict.fromkeys(f".{suffix.rpartition('.')[2]}" for suffix in self.suffixes))


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


_SPZ = "SPZ rounds positions to 24 bits, log scales to sixteenths, colours to 8 bits, and cuts SH to -1..1"
DOORS: dict[SplatFormat, Door] = {
    SplatFormat.PLY: Door((".ply",), "PLY keeps a frame exactly, but not its time", read_ply, write=write_ply),
    SplatFormat.COMPRESSED_PLY: Door(
        (".compressed.ply",),
        "compressed PLY rounds positions and scales to 11 bits of their chunk's range, all else to 8 to 10",
        read_ply,
        write=write_compressed_ply,
    ),
    SplatFormat.SPZ: Door((".spz",), _SPZ, read_spz, spz_antialiased, write_spz),
    SplatFormat.SPZ_3: Door((".spz",), _SPZ, read_spz, spz_antialiased, write_spz_3),
    SplatFormat.SOG: Door(
        (".sog",),
        "SOG rounds positions to 16 bits, all else to 8, and has 65,536 sets of SH above band 0 at most",
        read_sog,
        sog_antialiased,
        write_sog,
    ),
    SplatFormat.SPLAT: Door(
        (".splat",),
        ".splat holds no SH above band 0, no colours beyond 0..1, and 8 bits of colours and rotations",
        read_splat,
        write=write_splat,
    ),
    SplatFormat.KSPLAT: Door((".ksplat",), "", read_ksplat),
    SplatFormat.GLTF: Door((".glb",), "glTF keeps a frame exactly, but not its time", write=write_gltf),
    SplatFormat.USD: Door(
        (".usdc", ".usda", ".usd"),
        "USD keeps frames and times exactly, but not which Gaussian is which, unless rows are kept",
        write_clip=write_usd,
    ),
    SplatFormat.FOURDGS: Door(
        (".4dgs",),
        ".4dgs rounds to steps that its header declares, SH above band 0 to bytes over -4..4, and cuts colours to 0..1",
        write_clip=write_fourdgs,
        sounds=True,
    ),
}
WRITTEN = tuple(kind for kind, door in DOORS.items() if door.is_written)
READABLE = tuple(dict.fromkeys(door.endings[0] for door in DOORS.values() if door.read))
"""Suffixes of the files that `read_gaussians` takes, besides meta.json."""


def format_of(path: Path) -> SplatFormat | None:
    """The format that a file's name tells, of several that share a suffix the first; None where it tells none."""
    named = [(len(end), kind) for kind in SplatFormat for end in kind.door.suffixes if path.name.lower().endswith(end)]
    longest = max((length for length, _ in named), default=0)
    return next((kind for length, kind in named if length == longest), None)
