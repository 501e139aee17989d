"""The files of web viewers: `.splat` of 32 bytes a Gaussian, and `.ksplat` of GaussianSplats3D, which is only read.

Both hold standard deviations themselves, colours and alpha as bytes, and quaternions w x y z.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from packuv.bounds import MOST_SH_DEGREE, check_count
from packuv.files import whole_file
from packuv.gaussians.floats import SH_C0, Gaussians, arrays
from packuv.interchange.conventions import alpha_codes, is_drawn, logits_of_alpha, rows_out, unit

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def write_splat(path: Path, gaussians: Gaussians, *, keep_rows: bool = False) -> int:
    """Write a `.splat` file and return the number of drawn Gaussians in it; SH above band 0 does not go along.

    What is not drawn is left out, or has alpha 0 where rows are kept.
    """
    mask = is_drawn(gaussians)
    kept = rows_out(gaussians, mask, keep_rows=keep_rows)
    rows = np.empty(len(kept), _ROW)
    rows["means"], rows["scales"] = kept.means, np.exp(kept.log_scales)
    rows["colour"][:, :3] = np.rint(255 * np.clip(0.5 + SH_C0 * kept.sh[:, 0].astype(np.float64), 0, 1))
    rows["colour"][:, 3] = alpha_codes(kept.opacity_logits)
    rows["rotation"] = np.clip(np.rint(unit(kept.quaternions) * 128 + 128), 0, 255)
    with whole_file(path) as partial:
        partial.write_bytes(rows.tobytes())
    return int(mask.sum())


def read_splat(path: Path) -> Gaussians:
    """Gaussians of a `.splat` file, SH degree 0: rows of position, standard deviations, r g b alpha, w x y z.

    Raises ValueError for a file that is not whole rows.
    """
    data = Path(path).read_bytes()
    if len(data) % _ROW.itemsize:
        raise ValueError(
            f"{path} must hold {_ROW.itemsize} bytes for each Gaussian, but has {len(data)}; it is cut short, or is "
            "no .splat file"
        )
    check_count(len(data) // _ROW.itemsize, str(path))
    rows = np.frombuffer(data, _ROW)
    rotation = (rows["rotation"].astype(np.float32) - 128) / 128
    return _gaussians(rows["means"], rows["scales"], rotation, rows["colour"], np.empty((len(rows), 0, 3)))


def _gaussians(
    means: np.ndarray, scales: np.ndarray, quaternions: np.ndarray, colour: np.ndarray, bands: np.ndarray
) -> Gaussians:
    """From standard deviations, r g b alpha in bytes, and SH bands above 0 [n, coefficients, 3]."""
    dc = (colour[:, None, :3] / 255 - 0.5) / SH_C0
    return Gaussians(
        means.astype(np.float32),
        np.log(scales.astype(np.float32)),
        quaternions.astype(np.float32),
        logits_of_alpha(colour[:, 3]),
        np.concatenate([dc, bands], axis=1).astype(np.float32),
    )


# .ksplat: a header, a header for each section, and the sections: buckets, then rows.

_HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "level", "least_sh", "most_sh"],
        "formats": ["u1", "u1", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 20, 36, 40],
        "itemsize": 4096,
    }
)
_SECTION = np.dtype(
    {
        "names": [
            "there",
            "count",
            "bucket_size",
            "buckets",
            "block",
            "bucket_bytes",
            "range",
            "full",
            "partial",
            "sh",
        ],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)
_LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Kinds of positions, of scales and rotations, and of SH, at each level of compression"""
_RANGES = (1, 32767, 32767)
"""Of positions, by level, where the section names none"""
_SH_REACH = 1.5
"""Of SH in bytes, where the header names none"""
_CENTRE_BYTES = 12
_MOST_SECTIONS = 4096


@dataclass(frozen=True)
class _Section:
    """What the header of a section says."""

    count: int
    """Rows that are there for; `there` of them are filled"""
    there: int
    degree: int
    bucket_size: int
    buckets: int
    full: int
    partial: int
    bucket_bytes: int
    step: float
    """Of positions within a block, world"""
    middle: int
    """The code of a block's centre"""

    @property
    def rows_at(self) -> int:
        """Bytes before the rows: lengths of the buckets that are not full, and centres of all."""
        return 4 * self.partial + self.bucket_bytes * self.buckets

    def row(self, level: int) -> np.dtype:
        position, float_kind, sh = _LEVELS[level]
        fields = [("means", position, 3), ("scales", float_kind, 3), ("rotation", float_kind, 4), ("colour", "u1", 4)]
        if self.degree:
            fields.append(("sh", sh, 3 * ((self.degree + 1) ** 2 - 1)))
        return np.dtype(fields)


def read_ksplat(path: Path) -> Gaussians:
    """Gaussians of a `.ksplat` file, version 0.1, any level of compression.

    Raises ValueError for another version, a file that is cut short, or sections of different SH degrees.
    """
    data = Path(path).read_bytes()
    if len(data) < _HEADER.itemsize:
        raise ValueError(f"{path} must have a header of {_HEADER.itemsize} bytes, but has {len(data)} in all")
    header = np.frombuffer(data, _HEADER, 1)[0]
    version, level = (int(header["major"]), int(header["minor"])), int(header["level"])
    if version != (0, 1) or level >= len(_LEVELS):
        raise ValueError(
            f"{path} must be KSPLAT of version 0.1 and level 0 to {len(_LEVELS) - 1}, but says version "
            f"{version[0]}.{version[1]} and level {level}"
        )
    reach = tuple(float(header[name]) or sign * _SH_REACH for name, sign in (("least_sh", -1), ("most_sh", 1)))
    parts = [
        _rows(path, data, at, section, level, reach)
        for at, section in _sections(path, data, int(header["sections"]), level)
    ]
    degrees = sorted({part.sh_degree for part in parts})
    if len(degrees) != 1:
        raise ValueError(f"{path} must have sections of one SH degree, but has {degrees or 'no sections'}")
    return Gaussians(*map(np.concatenate, zip(*map(arrays, parts), strict=True)))


def _sections(path: Path, data: bytes, count: int, level: int) -> Iterator[tuple[int, _Section]]:
    """Where each section begins, and what it holds."""
    at = _HEADER.itemsize + count * _SECTION.itemsize
    if count > _MOST_SECTIONS or len(data) < at:
        raise ValueError(
            f"{path} must hold the headers of {count} sections, but has {len(data)} bytes; it is cut short"
        )
    for said in np.frombuffer(data, _SECTION, count, _HEADER.itemsize):
        number = {name: int(said[name]) for name in _SECTION.names or () if name != "block"}
        middle = number["range"] or _RANGES[level]
        section = _Section(
            count=number["count"],
            there=number["there"],
            degree=number["sh"],
            bucket_size=number["bucket_size"],
            buckets=number["buckets"],
            full=number["full"],
            partial=number["partial"],
            bucket_bytes=number["bucket_bytes"],
            step=float(said["block"]) / 2 / middle,
            middle=middle,
        )
        check_count(section.count, f"{path}: a section")
        if section.degree > MOST_SH_DEGREE or section.there > section.count:
            raise ValueError(
                f"{path} must have SH of degree 0 to {MOST_SH_DEGREE} and no more Gaussians than room, but has degree "
                f"{section.degree} and {section.there} in a section for {section.count}"
            )
        size = section.rows_at + section.row(level).itemsize * section.count
        if at + size > len(data) or (section.buckets and section.bucket_bytes != _CENTRE_BYTES):
            raise ValueError(
                f"{path} must hold a section of {size} bytes at {at}, but has {len(data)}; it is cut short"
            )
        yield at, section
        at += size


def _rows(path: Path, data: bytes, at: int, section: _Section, level: int, reach: tuple[float, ...]) -> Gaussians:
    rows = np.frombuffer(data, section.row(level), section.there, at + section.rows_at)
    means = rows["means"].astype(np.float32)
    if level:
        centres = np.frombuffer(data, "<f4", 3 * section.buckets, at + 4 * section.partial).reshape(-1, 3)
        lengths = np.frombuffer(data, "<u4", section.partial, at)
        means = (means - section.middle) * section.step + centres[_bucket_of(path, section, lengths)]
    bands = np.empty((len(rows), 0, 3))
    if section.degree:
        bands = _bands(rows["sh"].astype(np.float32), section.degree)
        if level == 2:
            bands = bands / 255 * (reach[1] - reach[0]) + reach[0]
    return _gaussians(means, rows["scales"], rows["rotation"], rows["colour"], bands)


def _bucket_of(path: Path, section: _Section, lengths: np.ndarray) -> np.ndarray:
    """The bucket of each row, int64 [there]: full ones first, then those whose lengths are given."""
    sizes = np.concatenate([np.full(min(section.full, section.buckets), section.bucket_size), lengths]).astype(np.int64)
    if len(sizes) > section.buckets or not section.there <= sizes.sum() <= section.count:
        raise ValueError(
            f"{path} must have buckets for {section.there} Gaussians, but {section.buckets} hold {sizes.sum()}"
        )
    return np.repeat(np.arange(len(sizes)), sizes)[: section.there]


def _bands(sh: np.ndarray, degree: int) -> np.ndarray:
    """Bands above 0 [n, coefficients, 3] of values that run band by band, and in a band channel by channel."""
    ends = [3 * ((band + 1) ** 2 - 1) for band in range(degree + 1)]
    parts = [sh[:, low:high].reshape(len(sh), 3, (high - low) // 3) for low, high in pairwise(ends)]
    return np.concatenate(parts, axis=2).transpose(0, 2, 1)
