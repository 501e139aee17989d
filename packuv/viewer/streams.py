"""A scene's integers as two video streams that browsers decode bit by bit: VP9 or AV1, lossless, data in luma only.

The key stream has a picture for each segment, the delta stream one for every other frame: what to add to the dynamic
rows of the frame before. Chroma is 128 throughout. docs/viewer.md describes pictures and files.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Any, BinaryIO

import av
import numpy as np

from packuv.gaussians.codes import Codes
from packuv.scene.mosaic import NEUTRAL
from packuv.threads import ordinary_schedule

TILE = 16
"""Rows fill square tiles of this side; neighbours in a scene's order are neighbours in space"""
MOST_PIXELS = 16384
"""Longest side of a picture: what browsers' decoders take"""
_IVF_FRAME = struct.Struct("<IQ")
_VP9_LEVELS = (
    (10, 36864), (11, 73728), (20, 122880), (21, 245760), (30, 552960), (31, 983040), (40, 2228224), (50, 8912896),
    (60, 35651584),
)  # fmt: skip
"""Level times ten, and its largest picture in pixels"""


class WebCodec(StrEnum):
    """How the streams are coded."""

    VP9 = "vp9"
    AV1 = "av1"


@dataclass(frozen=True)
class Sheet:
    """How byte planes tile a picture: plane p at (p % across, p // across), row i in the same cell of each.

    Not a scene file's `Mosaic`, whose Hilbert blocks, FFV1 slices, missing planes and flags are that file's own: any
    page can find a cell here by three divisions, and every plane is there.
    """

    planes: int
    tiles_across: int
    """Size of a plane, in tiles"""
    tiles_down: int

    @classmethod
    def of(cls, capacity: int, planes: int) -> Sheet:
        """Nearly square planes that hold `capacity` rows; raises ValueError where the picture would be too large."""
        tiles = max(1, -(-capacity // TILE**2))
        across = math.isqrt(tiles - 1) + 1
        sheet = cls(planes, across, -(-tiles // across))
        if max(sheet.width, sheet.height) > MOST_PIXELS:
            raise ValueError(
                f"{capacity} rows of {planes} bytes take a picture of {sheet.width}x{sheet.height}, but browsers "
                f"decode up to {MOST_PIXELS} pixels a side; fit fewer Gaussians or a lower SH degree"
            )
        return sheet

    @property
    def across(self) -> int:
        """Planes side by side."""
        return math.isqrt(self.planes - 1) + 1

    @property
    def width(self) -> int:
        return max(64, self.across * self.tiles_across * TILE)

    @property
    def height(self) -> int:
        return max(64, -(-self.planes // self.across) * self.tiles_down * TILE)

    def cells(self, count: int) -> np.ndarray:
        """Flat picture index of each plane's cell of each row, int64 [planes, count]."""
        row, plane = np.arange(count), np.arange(self.planes)[:, None]
        tile_y, tile_x = np.divmod(row // TILE**2, self.tiles_across)
        y, x = np.divmod(row % TILE**2, TILE)
        plane_y, plane_x = np.divmod(plane, self.across)
        top = plane_y * self.tiles_down * TILE + tile_y * TILE + y
        cells: np.ndarray = top * self.width + plane_x * self.tiles_across * TILE + tile_x * TILE + x
        return cells

    def draw(self, rows: np.ndarray) -> np.ndarray:
        """The picture, uint8 [height, width], of byte planes [planes, n]; all else is 128."""
        picture = np.full(self.height * self.width, NEUTRAL, np.uint8)
        picture[self.cells(rows.shape[1])] = rows
        return picture.reshape(self.height, self.width)

    def read(self, picture: np.ndarray, count: int) -> np.ndarray:
        """Byte planes uint8 [planes, count] of a picture."""
        return picture.reshape(-1).take(self.cells(count))

    def to_json(self) -> dict[str, int]:
        return {**vars(self), "tile": TILE, "across": self.across, "width": self.width, "height": self.height}


# Rows as bytes


def code_planes(codes: Codes) -> np.ndarray:
    """High bytes of x y z, low bytes, attributes: uint8 [6 + A, N]."""
    return np.concatenate([codes.xyz.T >> 8, codes.xyz.T & 255, codes.attributes.T]).astype(np.uint8)


def codes_of_planes(planes: np.ndarray) -> Codes:
    """Inverse of `code_planes`."""
    xyz = planes[:3].astype(np.uint16) << 8 | planes[3:6]
    return Codes(np.ascontiguousarray(xyz.T), np.ascontiguousarray(planes[6:].T))


def delta_planes(now: Codes, last: Codes) -> np.ndarray:
    """What to add to `last` for `now`, modulo 2^16 and 2^8, each byte around 128: uint8 [6 + A, D]."""
    step = Codes(now.xyz - last.xyz + np.uint16(257 * NEUTRAL), now.attributes - last.attributes + np.uint8(NEUTRAL))
    return code_planes(step)


def add_planes(last: Codes, planes: np.ndarray) -> Codes:
    """Inverse of `delta_planes`."""
    step = codes_of_planes(planes)
    return Codes(last.xyz + step.xyz - np.uint16(257 * NEUTRAL), last.attributes + step.attributes - np.uint8(NEUTRAL))


# Streams


class StreamWriter:
    """Codes pictures into an IVF file, a packet each; notes where each packet lies."""

    def __init__(self, file: BinaryIO, sheet: Sheet, codec: WebCodec, rate: Fraction) -> None:
        self._file, self._sheet, self._codec = file, sheet, codec
        self._context = _encoder(sheet, codec, rate)
        self._fourcc = {WebCodec.VP9: b"VP90", WebCodec.AV1: b"AV01"}[codec]
        file.write(self._head(rate, 0))
        self._rate, self._given = rate, 0
        self.packets: list[tuple[int, int]] = []
        """Offset and size of each packet's data"""
        self.keys: list[int] = []
        """Numbers of the packets from which decoding can start"""
        self.codec_string = ""

    def add(self, planes: np.ndarray, *, starts: bool) -> None:
        """Code a picture of byte planes; one that starts can be decoded without those before."""
        luma = self._sheet.draw(planes)
        chroma = np.full((luma.shape[0] // 2, luma.shape[1]), NEUTRAL, np.uint8)
        frame = av.VideoFrame.from_ndarray(np.concatenate([luma, chroma]), format="yuv420p")
        frame.pts, frame.time_base = self._given, 1 / self._rate
        if starts:
            frame.pict_type = av.video.frame.PictureType.I
        self._given += 1
        self._write(self._context.encode(frame))

    def close(self) -> None:
        """Code what is under way, and complete the file's header. Raises RuntimeError where packets are missing."""
        self._write(self._context.encode(None))
        if len(self.packets) != self._given:
            raise RuntimeError(f"the {self._codec} encoder gave {len(self.packets)} packets for {self._given} pictures")
        self._file.seek(0)
        self._file.write(self._head(self._rate, self._given))
        self._file.seek(0, 2)

    def _write(self, packets: list[Any]) -> None:
        for packet in packets:
            data = bytes(packet)
            self._file.write(_IVF_FRAME.pack(len(data), len(self.packets)))
            if not self.packets:
                self.codec_string = codec_string(data, self._sheet, self._codec)
            if packet.is_keyframe:
                self.keys.append(len(self.packets))
            self.packets.append((self._file.tell(), len(data)))
            self._file.write(data)

    def _head(self, rate: Fraction, count: int) -> bytes:
        sizes = (self._sheet.width, self._sheet.height, rate.numerator, rate.denominator, count, 0)
        return b"DKIF" + struct.pack("<HH4sHHIIII", 0, 32, self._fourcc, *sizes)

    def to_json(self) -> dict[str, Any]:
        return {"codec": self.codec_string, **self._sheet.to_json(), "packets": self.packets, "keys": self.keys}


def _encoder(sheet: Sheet, codec: WebCodec, rate: Fraction) -> Any:
    """An encoder that gives one packet a picture, in order."""
    name, options = {
        WebCodec.VP9: (
            "libvpx-vp9",
            {"lossless": "1", "deadline": "good", "cpu-used": "5", "auto-alt-ref": "0", "lag-in-frames": "0"},
        ),
        WebCodec.AV1: ("libsvtav1", {"preset": "8", "svtav1-params": "lossless=1:pred-struct=1:lp=2"}),
    }[codec]
    context = av.CodecContext.create(name, "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width, context.height, context.pix_fmt = sheet.width, sheet.height, "yuv420p"
    context.time_base, context.framerate = 1 / rate, rate
    context.gop_size = 10_000
    context.options = options
    with ordinary_schedule():
        context.open(strict=False)
    return context


def codec_string(first: bytes, sheet: Sheet, codec: WebCodec) -> str:
    """What a browser wants to know of a stream before it decodes it, of its first packet."""
    if codec is WebCodec.VP9:
        level = next((number for number, pixels in _VP9_LEVELS if sheet.width * sheet.height <= pixels), 62)
        return f"vp09.00.{level}.08"
    profile, level = _av1_sequence(first)
    return f"av01.{profile}.{level:02d}M.08"


def _av1_sequence(data: bytes) -> tuple[int, int]:
    """Profile and level of an AV1 sequence header (AV1 specification, 5.5), without timing information."""
    at = 0
    while data[at] >> 3 & 15 != 1:  # skip to the OBU of type 1
        at += 2 + data[at + 1]  # the temporal delimiter before it is short
    bits = int.from_bytes(data[at + 2 : at + 10], "big")  # after the OBU's header and its size of one byte
    profile, timing = bits >> 61, bits >> 58 & 1
    if timing:
        raise RuntimeError("the AV1 encoder wrote timing information, after which the level is not looked for")
    return profile, bits >> 35 & 31  # after 3 + 1 + 1 + 1 + 1 + 5 + 12 bits


def read_stream(file: BinaryIO, entry: Mapping[str, Any], codec: WebCodec) -> Iterator[np.ndarray]:
    """The pictures of a stream, uint8 [height, width], from the packets that the index names."""
    context = av.CodecContext.create({WebCodec.VP9: "vp9", WebCodec.AV1: "libdav1d"}[codec], "r")
    assert isinstance(context, av.VideoCodecContext)
    for offset, size in entry["packets"]:
        file.seek(offset)
        yield from map(_luma, context.decode(av.Packet(file.read(size))))
    yield from map(_luma, context.decode(None))


def _luma(frame: Any) -> np.ndarray:
    plane = frame.planes[0]
    return np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width].copy()
