"""A second copy of a scene's header at the end of its file, with the places of all packets.

It lies in a Void element, which Matroska's readers pass over. With it one damaged byte outside of a packet loses
nothing: neither header nor packets need the file's own structure. It also tells whether the bytes around the packets
are those that were written. docs/scene-format.md, "The second copy".
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Iterable
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
VOID_HEAD, SIZE = 9, 8
"""Bytes of the element before its content, and of the size of the segment"""
SEGMENT, _HEAD = b"\x18\x53\x80\x67", 256
"""Identifier of the element that holds all others, and within how many bytes it begins"""
UNKNOWN = (1 << 56) - 1
"""Size of a segment that was written to a pipe"""
MOST_TRACKS = 2
PIECE = 1 << 20
"""Bytes that are read at once"""
_END = struct.Struct("<32sQQ16s")
"""SHA-256 of what precedes, bytes of the deflated header and of the deflated places, and the magic"""


DAMAGED = "the second copy of its header is damaged; copy the file again while the first one is whole"
AROUND = "bytes around its pictures are not those that were written, which costs no frame; copy the file again"


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
    around: str
    """See `digest_around`; empty in files that were written without it"""
    sound: tuple[bytes, tuple[tuple[int, int], ...]]
    """What its decoder needs, and where its packets lie in the file, half-open spans; none without sound"""
    start: int
    """Where its element begins in the file"""


def append_copy(path: Path, header: bytes) -> None:
    """Add the copy of a header, the content of packuv.json, to a scene file that has none."""
    reader = Reader(path)
    try:
        spans: list[list[tuple[int, int]]] = [[] for _ in (*reader.tracks, "sound")]
        for track, found in reader.packets():
            spans[track].append(found.span(path))
        private, heard = [data.hex() for data in reader.codec_private], reader.sound_private
    finally:
        reader.close()
    sound = spans.pop()
    with path.open("r+b") as file:
        end = file.seek(0, os.SEEK_END)
        said = {
            "codec_private": private,
            "positions": [[first for first, _ in track] for track in spans],
            "around": digest_around(file, (span for track in spans for span in track), end),
            # Absent where nothing is heard, so that such scenes keep their bytes.
            **({"sound": {"codec_private": heard.hex(), "spans": sound}} if heard else {}),
        }
        element = _element(header, json.dumps(said, separators=(",", ":")).encode())
        _grow_segment(file, len(element))
        file.seek(end)
        file.write(element)


def digest_around(file: BinaryIO, packets: Iterable[tuple[int, int]], end: int) -> str:
    """SHA-256, in hex, of the bytes before `end` that lie in no packet, but for the size of the segment; packets are
    half-open spans of bytes."""
    found, place = hashlib.sha256(), 0
    at = _size_place(file)
    for start, stop in sorted([*packets, (at, at + SIZE), (end, end)]):
        file.seek(place)
        while place < start and (piece := file.read(min(PIECE, start - place))):
            found.update(piece)
            place += len(piece)
        place = max(place, stop)
    return found.hexdigest()


def segment_end(file: BinaryIO) -> int | None:
    """Where the segment ends, and with it the file; None where its size is unknown or not to be found."""
    at = _size_place(file)
    file.seek(at)
    size = int.from_bytes(file.read(SIZE)) - (1 << 56)  # of eight bytes, as FFmpeg writes it: the first one is 1
    return at + SIZE + size if at and 0 <= size < UNKNOWN else None


def _size_place(file: BinaryIO) -> int:
    """Where the size of the segment stands; 0 where no segment is found."""
    file.seek(0)
    before, found, _ = file.read(_HEAD).partition(SEGMENT)
    return len(before + found) if found else 0


def _element(header: bytes, places: bytes) -> bytes:
    packed = [zlib.compress(part, 9) for part in (header, places)]
    digest = hashlib.sha256(b"".join(packed)).digest()
    body = b"".join(packed) + _END.pack(digest, *map(len, packed), MAGIC)
    return VOID + len(body).to_bytes(7, "big") + body


def _grow_segment(file: BinaryIO, count: int) -> None:
    """Let the file's segment, which reaches to its end, take in so many bytes more."""
    end, at = segment_end(file), _size_place(file)
    assert end == os.fstat(file.fileno()).st_size, "FFmpeg writes sizes of segments so, and nothing behind one"
    file.seek(at)
    file.write((end + count - at - SIZE | 1 << 56).to_bytes(SIZE))


def read_copy(file: BinaryIO) -> Copy | None:
    """The copy, if the file ends with one; raises CopyDamageError for one whose bytes are not those that were
    written."""
    end = file.seek(0, os.SEEK_END) - _END.size
    if end < 0:
        return None
    file.seek(end)
    digest, *sizes, magic = _END.unpack(file.read())
    if magic != MAGIC:
        if _resembles(magic):
            raise CopyDamageError(DAMAGED)
        return None
    start = end - sum(sizes) - VOID_HEAD
    if start < 0 or sum(sizes) > 2 * bounds.MOST_JSON_BYTES:
        raise CopyDamageError(DAMAGED)
    file.seek(start)
    head, packed = file.read(VOID_HEAD), file.read(sum(sizes))
    if hashlib.sha256(packed).digest() != digest or head != VOID + (sum(sizes) + _END.size).to_bytes(7, "big"):
        raise CopyDamageError(DAMAGED)
    try:
        return _decode(packed[: sizes[0]], packed[sizes[0] :], start)
    except (ValueError, zlib.error):
        return None


def _resembles(magic: bytes) -> bool:
    """Whether most of its bytes are right."""
    return sum(a == b for a, b in zip(magic, MAGIC, strict=True)) > len(MAGIC) // 2


def _decode(header: bytes, places: bytes, start: int) -> Copy:
    """`start`: of the copy in the file, beyond which no packet begins."""
    said, what = bounds.fields(parse_json(_unpacked(places), "the places"), "the places"), "the places"
    private = bounds.items(bounds.field(said, "codec_private", what), "codec_private", most=MOST_TRACKS)
    tracks = bounds.items(bounds.field(said, "positions", what), "positions", most=MOST_TRACKS)
    if len(private) != len(tracks):
        raise ValueError(f"there must be a decoder for each track, but there are {len(private)} and {len(tracks)}")
    return Copy(
        _unpacked(header),
        tuple(bytes.fromhex(bounds.words(text, "codec_private")) for text in private),
        tuple(tuple(bounds.wholes(track, "positions", most=start)) for track in tracks),
        bounds.words(said.get("around", ""), "around"),
        _sound_of(said.get("sound"), start),
        start,
    )


def _sound_of(said: object, start: int) -> tuple[bytes, tuple[tuple[int, int], ...]]:
    if said is None:
        return b"", ()
    found = bounds.fields(said, "sound")
    spans = bounds.items(bounds.field(found, "spans", "sound"), "sound: spans", most=bounds.MOST_SOUND_PACKETS)
    ends = [bounds.wholes(span, "sound: spans", most=start, count=2) for span in spans]
    if (flat := [at for span in ends for at in span]) != sorted(flat):
        raise ValueError("spans of sound must follow one another")
    private = bytes.fromhex(bounds.words(bounds.field(found, "codec_private", "sound"), "sound: codec_private"))
    return private, tuple((first, stop) for first, stop in ends)


def _unpacked(packed: bytes) -> bytes:
    return zlib.decompressobj().decompress(packed, bounds.MOST_JSON_BYTES)
