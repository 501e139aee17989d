"""A second copy of a scene's header at the end of its file, with the places of all packets.

It lies in a Void element, which Matroska's readers pass over. With it one damaged byte outside of a packet loses
nothing: neither header nor packets need the file's own structure. docs/scene-format.md, "The second copy".
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from packuv import bounds
from packuv.files import parse_json
from packuv.scene.matroska import Reader

MAGIC = b"packuv-copy\0\0\0\0\0"
"""The last bytes of a file"""
VOID = b"\xec\x01"
"""Identifier of the element, and the first of the eight bytes of its size"""
SEGMENT, _HEAD = b"\x18\x53\x80\x67", 256
"""Identifier of the element that holds all others, and within how many bytes it begins"""
MOST_TRACKS = 2
_END = struct.Struct("<32sQQ16s")
"""SHA-256 of what precedes, bytes of the deflated header and of the deflated places, and the magic"""


DAMAGED = "the second copy of its header is damaged; copy the file again while the first one is whole"


class CopyDamageError(ValueError):
    """The copy is there, but is not what was written."""


@dataclass(frozen=True)
class Copy:
    """What the copy says."""

    header: bytes
    """The attachment packuv.json"""
    codec_private: tuple[bytes, ...]
    """Of each track: what its decoder needs"""
    positions: tuple[tuple[int, ...], ...]
    """Of each track's packets: where they begin in the file"""


def append_copy(path: Path, header: bytes) -> None:
    """Add the copy of a header, the content of packuv.json, to a scene file that has none."""
    reader = Reader(path)
    try:
        positions: list[list[int]] = [[] for _ in reader.tracks]
        for track, found in reader.packets():
            positions[track].append(found.span(path)[0])
        private = [data.hex() for data in reader.codec_private]
    finally:
        reader.close()
    places = json.dumps({"codec_private": private, "positions": positions}, separators=(",", ":")).encode()
    packed = [zlib.compress(part, 9) for part in (header, places)]
    digest = hashlib.sha256(b"".join(packed)).digest()
    body = b"".join(packed) + _END.pack(digest, *map(len, packed), MAGIC)
    element = VOID + len(body).to_bytes(7, "big") + body
    with path.open("r+b") as file:
        _grow_segment(file, len(element))
        file.seek(0, os.SEEK_END)
        file.write(element)


def _grow_segment(file: BinaryIO, count: int) -> None:
    """Let the file's segment, which reaches to its end, take in so many bytes more; its size has 8 bytes."""
    start = file.read(_HEAD)
    at = start.index(SEGMENT) + len(SEGMENT)
    size = int.from_bytes(start[at + 1 : at + 8], "big")
    assert start[at] == 1, "FFmpeg writes sizes of segments so"
    assert at + 8 + size == os.fstat(file.fileno()).st_size, "nothing lies behind a segment"
    file.seek(at)
    file.write((size + count | 1 << 56).to_bytes(8, "big"))


def read_copy(file: BinaryIO) -> Copy | None:
    """The copy, if the file ends with one; raises CopyDamageError for one whose bytes are not those that were
    written."""
    end = file.seek(0, os.SEEK_END) - _END.size
    if end < 0:
        return None
    file.seek(end)
    digest, *sizes, magic = _END.unpack(file.read())
    if magic != MAGIC:
        return None
    if sum(sizes) > min(end, 2 * bounds.MOST_JSON_BYTES):
        raise CopyDamageError(DAMAGED)
    file.seek(end - sum(sizes))
    packed = file.read(sum(sizes))
    if hashlib.sha256(packed).digest() != digest:
        raise CopyDamageError(DAMAGED)
    try:
        return _decode(packed[: sizes[0]], packed[sizes[0] :], end)
    except (ValueError, zlib.error):
        return None


def _decode(header: bytes, places: bytes, end: int) -> Copy:
    """`end`: of the file, beyond which no packet begins."""
    said, what = bounds.fields(parse_json(_unpacked(places), "the places"), "the places"), "the places"
    private = bounds.items(bounds.field(said, "codec_private", what), "codec_private", most=MOST_TRACKS)
    tracks = bounds.items(bounds.field(said, "positions", what), "positions", most=MOST_TRACKS)
    if len(private) != len(tracks):
        raise ValueError(f"there must be a decoder for each track, but there are {len(private)} and {len(tracks)}")
    return Copy(
        _unpacked(header),
        tuple(bytes.fromhex(bounds.words(text, "codec_private")) for text in private),
        tuple(tuple(bounds.wholes(track, "positions", most=end)) for track in tracks),
    )


def _unpacked(packed: bytes) -> bytes:
    return zlib.decompressobj().decompress(packed, bounds.MOST_JSON_BYTES)
