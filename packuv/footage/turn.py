"""How stored pictures are turned to be shown: by a video's display matrix, by a picture's Exif orientation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import av
import numpy as np

_ORIENTATION = 0x0112
_SHORT = 3


@dataclass(frozen=True)
class Turn:
    """Rows and columns exchanged first, then either of them reversed."""

    transposed: bool = False
    rows_reversed: bool = False
    columns_reversed: bool = False

    def shown(self, picture: np.ndarray) -> np.ndarray:
        """[H, W, ...] as it is meant to be seen; the same array where nothing is turned."""
        if self == Turn():
            return picture
        turned = picture.swapaxes(0, 1) if self.transposed else picture
        turned = turned[:: -1 if self.rows_reversed else 1, :: -1 if self.columns_reversed else 1]
        return np.ascontiguousarray(turned)

    @classmethod
    def of_frame(cls, frame: av.VideoFrame) -> Turn:
        """By the display matrix of a decoded frame, to the nearest quarter."""
        with suppress(ValueError):  # PyAV 18 does not know every kind of data that FFmpeg 8 attaches
            matrix: Any = frame.side_data.get("DISPLAYMATRIX")
            if matrix is not None:
                a, b, _, c, d, *_ = np.frombuffer(bytes(matrix), np.int32).tolist()
                # A point (x, y) is shown at (a x + c y, b x + d y).
                if abs(b) + abs(c) > abs(a) + abs(d):
                    return cls(True, rows_reversed=b < 0, columns_reversed=c < 0)
                return cls(False, rows_reversed=d < 0, columns_reversed=a < 0)
        quarter = round(frame.rotation / 90) % 4
        return (cls(), cls(True, True, False), cls(False, True, True), cls(True, False, True))[quarter]

    @classmethod
    def of_orientation(cls, code: int) -> Turn:
        """By the orientation of Exif, 1 to 8; other codes say nothing."""
        return _BY_CODE.get(code, cls())


_BY_CODE = {
    2: Turn(False, False, True),
    3: Turn(False, True, True),
    4: Turn(False, True, False),
    5: Turn(True, False, False),
    6: Turn(True, False, True),
    7: Turn(True, True, True),
    8: Turn(True, True, False),
}


def exif_orientation(file: bytes) -> int:
    """The orientation that a JPEG or PNG file names; 1, upright, where it names none."""
    for tiff in _exif(file):
        with suppress(IndexError):
            return _orientation(tiff)
    return 1


def _exif(file: bytes) -> Iterator[bytes]:
    """Exif's TIFF structure."""
    if file.startswith(b"\x89PNG"):
        at = 8
        while at + 8 <= len(file):
            size = int.from_bytes(file[at : at + 4])
            if file[at + 4 : at + 8] == b"eXIf":
                yield file[at + 8 : at + 8 + size]
            at += size + 12
        return
    at = 2
    while file[at : at + 1] == b"\xff" and file[at + 1 : at + 2] != b"\xda":
        size = int.from_bytes(file[at + 2 : at + 4])
        if file[at + 1] == 0xE1 and file[at + 4 : at + 10] == b"Exif\0\0":
            yield file[at + 10 : at + 2 + size]
        at += 2 + max(size, 2)


def _orientation(tiff: bytes) -> int:
    order = "little" if tiff[:2] == b"II" else "big"

    def number(at: int, size: int) -> int:
        if at + size > len(tiff):
            raise IndexError
        return int.from_bytes(tiff[at : at + size], "little" if order == "little" else "big")

    directory = number(4, 4)
    for entry in range(directory + 2, directory + 2 + 12 * number(directory, 2), 12):
        if number(entry, 2) == _ORIENTATION and number(entry + 2, 2) == _SHORT:
            return number(entry + 8, 2)
    return 1
