"""Decoded planes of any depth to sRGB bytes, rounded once."""

from __future__ import annotations

import re

import av
import av.video.plane
import numpy as np

from packuv.colour import srgb_from_linear
from packuv.footage.coding import Coding
from packuv.footage.transfer import BT709, Transfer, bt709_from, light_from_signal
from packuv.kernels.compile import kernel

STEPS = 1 << 16
FOOTROOM, SPAN = np.float32(0.125), np.float32(1.25)
"""Tables of signals go from -1/8 to 9/8: limited range leaves room for 7 % below black and 9 % above white. A step is
1/200 of an 8-bit code and 1/12 of a 12-bit one"""
_SUBSAMPLED = {"420": (1, 1), "422": (1, 0), "444": (0, 0), "440": (0, 1), "411": (2, 0), "410": (2, 2)}
_PLANAR = re.compile(r"(?:(yuv)[aj]?(\d{3})p|(gbra?)p|(gray))(\d+)?(?:le)?")
"""Formats whose planes are read as they are; a name without a depth has 8 bits"""


class Developer:
    """Turns the frames of one video into pictures, uint8 [H, W, 3] sRGB.

    Chroma is interpolated linearly, its samples where H.264 and HEVC put them unless told otherwise: on the left one of
    two columns, between two rows.
    """

    def __init__(self, coding: Coding, curve: Transfer) -> None:
        self.coding = coding
        gamut, signal = coding.gamut(curve), np.linspace(-FOOTROOM, SPAN - FOOTROOM, STEPS)
        light = light_from_signal(curve, signal)
        # A finished picture in its own primaries keeps its values; two curves that cancel would only round them.
        value = signal if curve is Transfer.SDR else srgb_from_linear(light)
        self._mix = np.zeros((0, 3), np.float32) if gamut == BT709 else bt709_from(gamut).astype(np.float32)
        self._light = light.astype(np.float32)
        self._byte_of_light = _rounded(srgb_from_linear(np.linspace(0, 1, STEPS)))
        self._byte_of_signal = _rounded(value)

    def picture(self, frame: av.VideoFrame) -> np.ndarray:
        """A decoded frame as uint8 [H, W, 3]; raises ValueError for a matrix that is not known."""
        kind = _PLANAR.fullmatch(frame.format.name)
        if kind is None:
            # By one thread: with several, FFmpeg 8.0's conversion of P010 now and then loses eight pixels.
            frame = frame.reformat(format="yuv444p16le" if self.coding.in_luma else "gbrp16le", threads=1)
            kind = _PLANAR.fullmatch(frame.format.name)
            assert kind is not None
        luma, sampling, _, gray, depth = kind.groups()
        planes = [_array(plane, int(depth or 8)) for plane in frame.planes[: 1 if gray else 3]]
        shift = _SUBSAMPLED[sampling] if luma else (0, 0)
        rgb = np.empty((frame.height, frame.width, 3), dtype=np.uint8)
        matrix, zero = self._matrix(int(depth or 8), luma=bool(luma), gray=bool(gray))
        first, second, third = planes if len(planes) == 3 else planes * 3
        tables = (self._byte_of_signal, self._light, self._mix, self._byte_of_light)
        _develop(first, second, third, *shift, matrix, zero, *tables, rgb)
        return rgb

    def _matrix(self, bits: int, *, luma: bool, gray: bool) -> tuple[np.ndarray, np.ndarray]:
        """float32 [3, 3] and [3]: signals of red, green and blue are matrix @ planes + zero."""
        unit = 2 ** (bits - 8)
        black, white = (0, 2**bits - 1) if self.coding.full else (16 * unit, 235 * unit)
        span = white - black
        if gray:
            matrix = np.array([[1, 0, 0]] * 3) / span
            offset = np.array([black, 0, 0])
        elif not luma:  # the planes are green, blue, red
            matrix = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]) / span
            offset = np.full(3, black)
        else:
            red, blue = self.coding.weights
            green = 1 - red - blue
            from_blue, from_red = 2 * (1 - blue), 2 * (1 - red)
            chroma = span if self.coding.full else 224 * unit
            matrix = np.array(
                [[1, 0, from_red], [1, -from_blue * blue / green, -from_red * red / green], [1, from_blue, 0]]
            ) / [span, chroma, chroma]
            offset = np.array([black, 128 * unit, 128 * unit])
        return matrix.astype(np.float32), (-matrix @ offset).astype(np.float32)


def converted(frame: av.VideoFrame) -> np.ndarray:
    """By FFmpeg, with the matrix and the range that the frame is tagged with, uint8 [H, W, 3].

    By one thread: with several, FFmpeg 8.0's conversion now and then loses pixels.
    """
    picture: np.ndarray = frame.reformat(format="rgb24", interpolation="BILINEAR", threads=1).to_ndarray()
    return picture


def linear_picture(frame: av.VideoFrame, mix: np.ndarray | None) -> np.ndarray:
    """Of a frame that holds light as floating-point numbers, uint8 [H, W, 3] sRGB; light above 1 is cut off.

    `mix`, [3, 3], makes linear RGB of BT.709 of the frame's.
    """
    if frame.format.name.startswith("gray"):
        grey = frame.reformat(format="grayf32le", threads=1)
        light = np.repeat(_floats(grey.planes[0])[..., None], 3, axis=2)
    else:
        # FFmpeg names these planes green, blue, red.
        whole = frame if frame.format.name in _PLANAR_FLOATS else frame.reformat(format="gbrpf32le", threads=1)
        light = np.stack([_floats(whole.planes[plane]) for plane in (2, 0, 1)], axis=2)
    light = light if mix is None else light @ mix.T.astype(np.float32)
    picture: np.ndarray = _BYTE_OF_LIGHT[(np.clip(np.nan_to_num(light), 0, 1) * (STEPS - 1) + 0.5).astype(np.uint16)]
    return picture


def _floats(plane: av.video.plane.VideoPlane) -> np.ndarray:
    """The plane's own memory, float32 [rows, columns]."""
    memory: np.ndarray = np.frombuffer(plane, dtype="<f4")  # type: ignore[call-overload]  # a plane is a buffer
    return memory.reshape(plane.height, plane.line_size // 4)[:, : plane.width]


def _rounded(value: np.ndarray) -> np.ndarray:
    rounded: np.ndarray = np.floor(np.clip(value, 0, 1) * 255 + 0.5).astype(np.uint8)
    return rounded


def _array(plane: av.video.plane.VideoPlane, bits: int) -> np.ndarray:
    """The plane's own memory, [rows, columns] of uint8 or uint16."""
    kind = np.dtype(np.uint8 if bits == 8 else "<u2")
    memory: np.ndarray = np.frombuffer(plane, dtype=kind)  # type: ignore[call-overload]  # a plane is a buffer
    return memory.reshape(plane.height, plane.line_size // kind.itemsize)[:, : plane.width]


_PLANAR_FLOATS = ("gbrpf32le", "gbrapf32le")
_BYTE_OF_LIGHT = _rounded(srgb_from_linear(np.linspace(0, 1, STEPS)))


@kernel(fastmath=frozenset({"contract", "nnan"}))
def _develop(first, second, third, across, down, matrix, zero, byte_of_signal, light, mix, byte_of_light, rgb):
    height, width = first.shape
    rows, columns = second.shape
    scale, most, half = np.float32((STEPS - 1) / SPAN), np.float32(STEPS - 1), np.float32(0.5)
    chroma = np.empty((2, columns + 1), dtype=np.float32)
    planes = np.empty((3, columns + 1 << across), dtype=np.float32)
    steps = np.empty((3, width), dtype=np.int32)
    for y in range(height):
        # The centre of row y in rows of chroma.
        place = (y + 0.5) / (1 << down) - 0.5
        above = int(np.floor(place))
        weight = np.float32(place - above)
        upper, lower = max(above, 0), min(above + 1, rows - 1)
        for plane, source in ((0, second), (1, third)):
            for x in range(columns):
                low, high = np.float32(source[upper, x]), np.float32(source[lower, x])
                chroma[plane, x] = low + weight * (high - low)
            chroma[plane, columns] = chroma[plane, columns - 1]
        for x in range(width):
            planes[0, x] = first[y, x]
        for part in range(1 << across):
            share = np.float32(part / (1 << across))
            for plane in range(2):
                for x in range(columns):
                    low = chroma[plane, x]
                    planes[plane + 1, (x << across) + part] = low + share * (chroma[plane, x + 1] - low)
        for channel in range(3):
            p, q, r, s = matrix[channel, 0], matrix[channel, 1], matrix[channel, 2], zero[channel] + FOOTROOM
            for x in range(width):
                step = (p * planes[0, x] + q * planes[1, x] + r * planes[2, x] + s) * scale + half
                steps[channel, x] = np.int32(min(max(step, np.float32(0)), most))
        if len(mix) == 0:
            for x in range(width):
                for channel in range(3):
                    rgb[y, x, channel] = byte_of_signal[steps[channel, x]]
            continue
        for channel in range(3):
            for x in range(width):
                planes[channel, x] = light[steps[channel, x]]
        for channel in range(3):
            p, q, r = mix[channel, 0], mix[channel, 1], mix[channel, 2]
            for x in range(width):
                mixed = p * planes[0, x] + q * planes[1, x] + r * planes[2, x]
                steps[channel, x] = np.int32(min(max(mixed, np.float32(0)), np.float32(1)) * most + half)
        for x in range(width):
            for channel in range(3):
                rgb[y, x, channel] = byte_of_light[steps[channel, x]]
