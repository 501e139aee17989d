"""The rate at which the timecode track of a QuickTime or MP4 file counts, which FFmpeg does not tell.

Layout: QuickTime File Format, "Timecode sample description": after the entry's header come 4 reserved bytes, flags,
time scale, frame duration (each uint32) and the number of frames per second (uint8).
"""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

HEADER, LONG_HEADER = 8, 16
LARGEST_MOOV = 1 << 28
"""Bytes; a movie's index beyond this is not searched"""
ENTRY = struct.Struct(">4s6sHIIIIB")
"""Kind, reserved, reference, reserved, flags, time scale, frame duration, frames per second"""


def timecode_track_rate(path: Path) -> Fraction | None:
    """Labels per second, exactly; None where the file has no such track, or one that says nothing sensible."""
    try:
        with open(path, "rb") as file:
            return _rate(_movie(file))
    except (OSError, struct.error):
        return None


def _movie(file: BinaryIO) -> bytes:
    """The movie's index, wherever it stands in the file; empty where there is none."""
    while len(header := file.read(HEADER)) == HEADER:
        size, kind = struct.unpack(">I4s", header)
        read = HEADER
        if size == 1:
            (size,) = struct.unpack(">Q", file.read(LONG_HEADER - HEADER))
            read = LONG_HEADER
        if kind == b"moov":
            return file.read(min(size - read, LARGEST_MOOV))
        if size < read:  # to the end of the file
            break
        file.seek(size - read, 1)
    return b""


def _rate(movie: bytes) -> Fraction | None:
    place = movie.find(b"stsd")
    while place >= 0:
        entry = place + HEADER + 4 + 4  # version and flags, number of entries, and the entry's size
        if movie[entry : entry + 4] == b"tmcd" and len(movie) >= entry + ENTRY.size:
            *_, scale, duration, nominal = ENTRY.unpack_from(movie, entry)
            rate = Fraction(scale, duration) if duration else None
            if rate is not None and 0 < nominal == round(rate):
                return rate
        place = movie.find(b"stsd", place + 4)
    return None
