"""Niantic's SPZ: 20 bytes a Gaussian and 3 for each SH coefficient above band 0, then gzip or zstd.

Versions 1 to 3 are one gzip stream behind a header of 16 bytes; version 4 has a plain header of 32 bytes and one zstd
stream an attribute. Inside, x points right, y up and z back (RUB); splat files and ours have y down and z forward
(RDF), so that y and z change sign on the way, and with them parts of the rotations and SH bands. Written are version 4
and version 3, which older readers know; their streams are the same.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from packuv.bounds import check_count, check_unpacked
from packuv.files import whole_file
from packuv.gaussians.floats import Gaussians, rows_of
from packuv.interchange.conventions import (
    alpha_codes,
    drop_largest,
    half_turn,
    is_drawn,
    logits_of_alpha,
    restore_largest,
    rows_out,
)

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
START_BYTES = 4096
"""Of a file, in which its header is"""
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, count, SH degree, fractional bits, flags, and the number of streams (version 4)."""
V4_HEADER_BYTES, V4_ENTRY = 32, struct.Struct("<QQ")
ANTIALIASED = 1
"""Flag: trained with the opacities of Mip-Splatting"""
HAS_EXTENSIONS = 2
"""Flag; the only extension that changes how values are read is Adobe's range of SH values."""
COLOUR_SCALE = 0.15
"""SH band 0 is stored as 0.5 + COLOUR_SCALE * value, which leaves room beyond black and white."""
MOST_FRACTIONAL_BITS = 20
"""Positions are 24-bit fixed point; finer steps than 2^-20 exceed what float32 means in a scene of some metres."""
STRAY_SHARE = 0.01
"""Of the Gaussians, at most, that are left out for lying so far away that positions of the others would be coarse:"""
COARSE = 0.25
"""in steps above this share of the median Gaussian's smallest extent"""
SH_STEPS = (8, 16)
"""Step of the SH codes written in band 1, and in the bands above, as the format's own library has it."""


def write_spz(
    path: Path, gaussians: Gaussians, *, antialiased: bool = False, keep_rows: bool = False, version: int = 4
) -> int:
    """Write an SPZ file of version 3 or 4 and return the number of drawn Gaussians in it.

    What is not drawn is left out, or has alpha 0 where rows are kept. Positions get as many fractional bits as the
    scene's extent allows; the few farthest go as what is not drawn where others would be coarse for them. Raises
    ValueError where even whole units do not reach.
    """
    mask = is_drawn(gaussians)
    mask[mask] = _near_enough(rows_of(gaussians, mask))
    kept = half_turn(rows_out(gaussians, mask, keep_rows=keep_rows))
    bits = _fractional_bits(kept.means)
    streams = [np.ascontiguousarray(stream).tobytes() for stream in _streams(kept, bits)]
    flags = ANTIALIASED if antialiased else 0
    body = (_version_3 if version == 3 else _version_4)(streams, len(kept), kept.sh_degree, bits, flags)
    with whole_file(path) as partial:
        partial.write_bytes(body)
    return int(mask.sum())


def write_spz_3(path: Path, gaussians: Gaussians, *, antialiased: bool = False, keep_rows: bool = False) -> int:
    """The same as version 3."""
    return write_spz(path, gaussians, antialiased=antialiased, keep_rows=keep_rows, version=3)


def _streams(kept: Gaussians, bits: int) -> list[np.ndarray]:
    """Positions, alphas, colours, scales, rotations and SH bands of Gaussians in the file's axes."""
    points = np.rint(kept.means.astype(np.float64) * 2**bits).astype("<i4")
    return [
        points.reshape(-1, 1).view("u1")[:, :3],
        alpha_codes(kept.opacity_logits),
        _byte(kept.sh[:, 0].astype(np.float64) * (COLOUR_SCALE * 255) + 127.5),
        _byte((kept.log_scales.astype(np.float64) + 10) * 16),
        _pack_rotation(kept.quaternions[:, [1, 2, 3, 0]]),
        _pack_bands(kept.sh[:, 1:]),
    ]


def _version_3(streams: list[bytes], *said: int) -> bytes:
    """Header and streams in one gzip stream, without a date: same scene, same bytes."""
    return gzip.compress(HEADER.pack(MAGIC, 3, *said, 0) + b"".join(streams), 6, mtime=0)


def _version_4(streams: list[bytes], *said: int) -> bytes:
    """A plain header, a table of packed and plain sizes, and one zstd stream an attribute; empty ones are left out."""
    plain = [stream for stream in streams if stream]
    packed = [pa.compress(stream, "zstd", asbytes=True) for stream in plain]
    header = HEADER.pack(MAGIC, 4, *said, len(plain)) + struct.pack("<I", V4_HEADER_BYTES)
    table = b"".join(V4_ENTRY.pack(len(small), len(stream)) for small, stream in zip(packed, plain, strict=True))
    return header.ljust(V4_HEADER_BYTES, b"\0") + table + b"".join(packed)


def read_spz(path: Path) -> Gaussians:
    """Gaussians of an SPZ file, versions 1 to 4, turned to the axes of splat files (y down, z forward).

    Raises ValueError for what is no SPZ file, is damaged, or holds SH of a degree above 3 or a range of their own.
    """
    data = Path(path).read_bytes()
    try:
        header, streams = _open(data)
        return _gaussians(header, streams)
    except (EOFError, OSError, zlib.error, struct.error) as error:
        raise ValueError(f"{path} is no SPZ file, or damaged: {error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def antialiased(path: Path) -> bool:
    """Whether an SPZ file is marked as trained with the opacities of Mip-Splatting; a file that is none is not."""
    with Path(path).open("rb") as file:
        data = file.read(START_BYTES)
    try:
        return bool(HEADER.unpack_from(_start(data)[0])[5] & ANTIALIASED)
    except (zlib.error, struct.error):
        return False


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    degree: int
    fractional_bits: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of the streams: positions, alphas, colours, scales, rotations, SH."""
        per_row = (6 if self.version == 1 else 9, 1, 3, 3, 3 if self.version < 3 else 4)
        return tuple(n * self.count for n in (*per_row, 3 * ((self.degree + 1) ** 2 - 1)))


def _open(data: bytes) -> tuple[_Header, list[np.ndarray]]:
    """Header, and the streams as bytes."""
    start, unpacker = _start(data)
    packed = data[:2] == GZIP
    if len(start) < HEADER.size:
        raise ValueError(f"an SPZ file has a header of {HEADER.size} bytes, but this one {len(start)}; it is cut short")
    magic, version, count, degree, bits, flags, streams = HEADER.unpack_from(start)
    if magic == MAGIC and 1 <= version <= 4 and (version == 4) == packed:
        form = "one gzip stream" if version < 4 else "a plain header and streams of zstd"
        raise ValueError(
            f"SPZ of version {version} is {form}, but this file is {'' if packed else 'not '}packed by gzip"
        )
    if magic != MAGIC or not 1 <= version <= 4:
        raise ValueError(f"an SPZ file starts with {MAGIC!r} and version 1 to 4, this one with {magic!r} and {version}")
    if degree > 3:
        raise ValueError(f"it has SH of degree {degree}, but a scene holds 3 at most; convert it to a lower degree")
    if flags & HAS_EXTENSIONS:
        raise ValueError("it has extensions, which may change what its numbers mean; write it without them")
    header = _Header(version, count, degree, bits)
    size = sum(header.sizes)
    check_count(count, "it")
    check_unpacked(size, len(data), "it")
    if version == 4:
        return header, _zstd_streams(data, header, streams)
    return header, _cut(_unpacked(unpacker, size), header)


def _start(data: bytes) -> tuple[bytes, Any]:
    """The header with what follows it, and what unpacks the rest of a file that is one gzip stream."""
    unpacker = zlib.decompressobj(wbits=31)
    return (unpacker.decompress(data, HEADER.size) if data[:2] == GZIP else data), unpacker


def _unpacked(unpacker: Any, size: int) -> bytes:
    """The body, and not more of what follows it than tells that its checksum is right."""
    body: bytes = unpacker.decompress(unpacker.unconsumed_tail, size) if size else b""
    if not unpacker.eof and len(body) == size:
        more = unpacker.decompress(unpacker.unconsumed_tail, 1)
        if not more and not unpacker.eof:
            raise ValueError("the end of its gzip stream, with the checksum, is missing; it is cut short")
    return body


def _cut(body: bytes, header: _Header) -> list[np.ndarray]:
    ends = np.cumsum(header.sizes)
    if len(body) < ends[-1]:
        raise ValueError(f"{header.count} Gaussians take {ends[-1]} bytes, but {len(body)} are there; it is cut short")
    return np.split(np.frombuffer(body, np.uint8)[: ends[-1]], ends[:-1])


def _zstd_streams(data: bytes, header: _Header, count: int) -> list[np.ndarray]:
    """Streams of version 4: a table of packed and plain sizes, then the streams; empty ones are left out."""
    (table,) = struct.unpack_from("<I", data, HEADER.size)
    wanted = [size for size in header.sizes if size]
    if table < V4_HEADER_BYTES or count != len(wanted):
        raise ValueError(f"its {len(wanted)} streams cannot be found ({count} in a table at byte {table})")
    at, body = table + count * V4_ENTRY.size, b""
    for number, size in enumerate(wanted):
        packed, plain = V4_ENTRY.unpack_from(data, table + number * V4_ENTRY.size)
        if plain != size or at + packed > len(data):
            raise ValueError(f"stream {number} must hold {size} bytes, but is said to hold {plain}, or is cut short")
        body += pa.decompress(data[at : at + packed], size, "zstd", asbytes=True)
        at += packed
    return _cut(body, header)


def _gaussians(header: _Header, streams: list[np.ndarray]) -> Gaussians:
    points, alphas, colours, scales, rotations, bands = streams
    n = header.count
    dc = (colours.reshape(n, 1, 3) / 255 - 0.5) / COLOUR_SCALE
    higher = (bands.reshape(n, (header.degree + 1) ** 2 - 1, 3) - 128.0) / 128
    sh = np.concatenate([dc, higher], axis=1)
    return half_turn(
        Gaussians(
            _points(points, header).astype(np.float32),
            (scales.reshape(n, 3) / 16 - 10).astype(np.float32),
            _unpack_rotation(rotations.reshape(n, 3 if header.version < 3 else 4))[:, [3, 0, 1, 2]],
            logits_of_alpha(alphas),
            sh.astype(np.float32),
        )
    )


def _points(stream: np.ndarray, header: _Header) -> np.ndarray:
    """float64 [n, 3], RUB."""
    if header.version == 1:
        return stream.view("<f2").reshape(-1, 3).astype(np.float64)
    wide = np.zeros((3 * header.count, 4), np.uint8)
    wide[:, 1:] = stream.reshape(-1, 3)  # in the upper bytes, so that the shift back carries the sign
    return (wide.view("<i4").reshape(-1, 3) >> 8) / 2.0**header.fractional_bits


def _near_enough(gaussians: Gaussians) -> np.ndarray:
    """Mask [n] of those that keep their place in fixed point: all, or all but a few strays."""
    reach = np.abs(gaussians.means).max(axis=1, initial=0)
    if not len(reach):
        return np.ones(0, bool)
    extent = float(np.median(np.exp(np.median(gaussians.log_scales, axis=1))))
    farthest = np.sort(reach)[-1 - int(STRAY_SHARE * len(reach)) :]  # the last that stays, and whom it may cost
    all_bits, most_bits = _bits(float(farthest[-1])), _bits(float(farthest[0]))
    if 2.0**-all_bits <= COARSE * extent or most_bits == all_bits:
        return np.ones(len(reach), bool)
    near: np.ndarray = reach <= 2.0 ** (23 - most_bits) - 1
    return near


def _fractional_bits(means: np.ndarray) -> int:
    reach = float(np.abs(means).max(initial=0))
    if not reach < 2**23 - 1:
        raise ValueError(f"SPZ holds positions up to {2**23 - 1} units from the origin, but the scene reaches {reach}")
    return _bits(reach)


def _bits(reach: float) -> int:
    return min(MOST_FRACTIONAL_BITS, 23 - math.ceil(math.log2(max(reach, 1) + 1)))


def _byte(values: np.ndarray) -> np.ndarray:
    codes: np.ndarray = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return codes


def _pack_rotation(rotation: np.ndarray) -> np.ndarray:
    """x y z w [n, 4] as uint32 [n]: 2 bits name the largest component; the others take a sign and 9 bits each."""
    largest, others = drop_largest(rotation)
    size = np.minimum(np.rint(np.abs(others) * math.sqrt(2) * 511), 511).astype(np.uint32)
    codes = (others < 0).astype(np.uint32) << np.uint32(9) | size
    packed = largest.astype(np.uint32)
    for column in codes.T:
        packed = packed << np.uint32(10) | column
    return packed.astype("<u4")


def _unpack_rotation(stream: np.ndarray) -> np.ndarray:
    """Quaternions float32 [n, 4], x y z w."""
    if stream.shape[1] == 3:  # versions 1 and 2: x y z of a quaternion whose w >= 0
        return restore_largest(np.full(len(stream), 3), stream / 127.5 - 1)
    packed = np.ascontiguousarray(stream).view("<u4")[:, 0].astype(np.int64)
    codes = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    others = np.where(codes >> 9, -1, 1) * (codes & 511) / (511 * math.sqrt(2))
    return restore_largest(packed >> 30, others)


def _pack_bands(sh: np.ndarray) -> np.ndarray:
    """Coefficients above band 0 [n, k, 3] as bytes around 128, rounded to steps of which 128 is one."""
    step = np.where(np.arange(sh.shape[1]) < 3, *SH_STEPS)[:, None]
    return _byte(np.rint(sh.astype(np.float64) * 128 / step) * step + 128)
