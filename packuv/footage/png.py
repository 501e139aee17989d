"""Whether a PNG picture is whole, by its own checksums, and how large: without decoding it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from zlib import crc32

MARK = b"\x89PNG\r\n\x1a\n"
_SIDES = struct.Struct(">II")


def png_size(file: bytes) -> tuple[int, int]:
    """Width and height; raises ValueError that says what is wrong with a picture that is not whole."""
    chunks = dict(_chunks(file))
    if len(header := chunks.get(b"IHDR", b"")) < _SIDES.size or b"IDAT" not in chunks:
        raise ValueError("it holds no picture")
    width, height = _SIDES.unpack_from(header)
    return width, height


def _chunks(file: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content, up to the chunk that ends a picture."""
    at, kind = len(MARK), b""
    while kind != b"IEND":
        (size,) = struct.unpack(">I", file[at : at + 4].rjust(4, b"\xff"))
        end = at + 8 + size
        if end + 4 > len(file):
            raise ValueError("it is cut short")
        kind = file[at + 4 : at + 8]
        if crc32(file[at + 4 : end]) != int.from_bytes(file[end : end + 4]):
            raise ValueError("its bytes are not those that were written")
        yield kind, file[at + 8 : end]
        at = end + 4
