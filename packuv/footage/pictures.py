"""Frames that are pictures in a folder: PNG of 8 and 16 bits, JPEG, EXR, turned as Exif says."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np

from packuv.footage.coding import Coding
from packuv.footage.damage import Damage, DamagedPictureError
from packuv.footage.develop import Developer, converted, linear_picture
from packuv.footage.jpeg import jpeg_fault
from packuv.footage.transfer import BT709, D65, Primaries, Transfer, bt709_from
from packuv.footage.turn import Turn, exif_orientation

PICTURE_SUFFIXES = frozenset({".exr", ".jpeg", ".jpg", ".png"})
"""As `sync.pictures` has them, which also says what names may be"""
SAME_XY = 2e-3
"""Difference of chromaticities that is none: files hold them with three or four digits"""


def picture_names(folder: Path) -> list[str]:
    """Names of a folder's pictures by frame: in natural order, those that are empty or have no number left out.

    `sync.pictures.list_pictures` has the same ones and checks that their numbers grow.
    """
    with os.scandir(folder) as entries:
        found = [entry.name for entry in entries if _is_frame(entry.name) and entry.is_file() and entry.stat().st_size]
    return sorted(found, key=lambda name: _natural(os.path.splitext(name)[0]))


class PictureDecoder:
    """The pictures of one folder by number of the frame."""

    def __init__(
        self,
        folder: Path,
        names: Sequence[str],
        damage: dict[int, Damage],
        *,
        said: Transfer | None,
        careful: bool = False,
    ) -> None:
        """What is found damaged goes into `damage`, by number of the frame; `careful` looks into JPEG data as well."""
        self._folder, self._names, self._damage = folder, names, damage
        self._said, self._careful = said, careful
        self._developers: dict[Coding, Developer] = {}

    def read(self, frame: int) -> tuple[np.ndarray, float]:
        """A picture, uint8 [H, W, 3], and its number; raises DamagedPictureError where it cannot be decoded, ValueError
        where it cannot be shown."""
        path = self._folder / self._names[frame]
        file = path.read_bytes()
        try:
            decoded = _decoded(path, file)
        except DamagedPictureError:
            self._damage[frame] = Damage.LOST
            raise
        if decoded.is_corrupt or (self._careful and file[:2] == b"\xff\xd8" and jpeg_fault(file)):
            self._damage[frame] = Damage.CONCEALED
        return Turn.of_orientation(exif_orientation(file)).shown(self._picture(decoded, file)), float(frame)

    def _picture(self, frame: av.VideoFrame, file: bytes) -> np.ndarray:
        coding = Coding.of_frame(frame)
        if coding.floating:
            primaries = _exr_primaries(file)
            return linear_picture(frame, None if primaries is None else bt709_from(primaries))
        if coding.plain(self._said):
            return converted(frame)
        if coding not in self._developers:
            self._developers[coding] = Developer(coding, coding.curve(self._said))
        return self._developers[coding].picture(frame)


def first_coding(folder: Path, names: Sequence[str]) -> Coding:
    """How the first picture that can be decoded is coded; raises ValueError where none can."""
    last: Exception | None = None
    for name in names:
        try:
            return Coding.of_frame(_decoded(folder / name, (folder / name).read_bytes()))
        except DamagedPictureError as error:
            last = error
    raise ValueError(f"{folder} holds no picture that can be decoded") from last


def _decoded(path: Path, file: bytes) -> av.VideoFrame:
    kinds = {b"\x89PNG": "png", b"v/1\x01": "exr"}
    codec = av.CodecContext.create(kinds.get(file[:4], "mjpeg"), "r")
    assert isinstance(codec, av.VideoCodecContext)
    codec.thread_count = 1
    try:
        frames = codec.decode(av.Packet(file)) or codec.decode(None)
    except av.FFmpegError as error:
        raise DamagedPictureError(f"{path} cannot be decoded ({error.strerror})") from error
    if not frames:
        raise DamagedPictureError(f"{path} holds no picture")
    return frames[0]


def _exr_primaries(file: bytes) -> Primaries | None:
    """Those of an EXR file that differ from BT.709; raises ValueError where their white is not D65."""
    at, said = 8, b""
    while at < len(file) and file[at]:
        name_end = file.index(b"\0", at)
        kind_end = file.index(b"\0", name_end + 1)
        size = int.from_bytes(file[kind_end + 1 : kind_end + 5], "little")
        begin = kind_end + 5
        if file[at:name_end] == b"chromaticities" and size == 32:
            said = file[begin : begin + size]
        at = begin + size
    if not said:
        return None
    *points, white = np.frombuffer(said, "<f4").astype(float).reshape(4, 2)
    if np.abs(white - D65).max() > SAME_XY:
        raise ValueError(
            f"its white is {white[0]:.4f}, {white[1]:.4f}, but must be D65; convert it, for instance with "
            "oiiotool --colorconvert ACES2065-1 lin_rec709"
        )
    red, green, blue = ((float(x), float(y)) for x, y in points)
    found: Primaries = (red, green, blue)
    return None if np.abs(np.array(found) - BT709).max() <= SAME_XY else found


def _is_frame(name: str) -> bool:
    stem, suffix = os.path.splitext(name)
    return not name.startswith(".") and suffix.lower() in PICTURE_SUFFIXES and any(map(str.isdecimal, stem))


def _natural(stem: str) -> list[tuple[int, int, str]]:
    parts = re.findall(r"\d+|\D+", stem)
    return [(0, int(part), part) if part[0].isdecimal() else (1, 0, part.casefold()) for part in parts]
