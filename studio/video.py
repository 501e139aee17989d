"""Pictures in linear light to H.264, the same bytes every time."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numba
import numpy as np

QUALITY_CRF = 14
"""x264's constant rate factor: about 42 dB against the rendered picture"""
REPRODUCIBLE = "threads=1:sliced-threads=0:cpu-independent=1"
"""One thread, so that rate decisions do not depend on the machine's cores; and no choice of code by the processor: that
of x264's macroblock tree for AVX-512 reads memory that nobody wrote, so that some of eight videos differed each time"""
KEYFRAME_INTERVAL = 30
BT709, LIMITED_RANGE = 1, 1
"""Code points of ITU-T H.273 and FFmpeg's colour range"""


class VideoWriter:
    """Writes one camera's pictures as MP4; use it in a `with` statement."""

    def __init__(self, path: Path, width: int, height: int, fps: Fraction) -> None:
        self._container = av.open(str(path), "w", format="mp4")
        stream = self._container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = 1 / fps
        context = stream.codec_context
        context.thread_count = 1
        context.options = {"crf": str(QUALITY_CRF), "preset": "medium", "x264-params": REPRODUCIBLE}
        context.gop_size = KEYFRAME_INTERVAL
        context.color_primaries = context.color_trc = context.colorspace = BT709
        context.color_range = LIMITED_RANGE
        self._stream, self._count, self._frame_s = stream, 0, 1 / fps

    def write(self, srgb: np.ndarray) -> None:
        """Append a picture, uint8 [H, W, 3], sRGB."""
        frame = av.VideoFrame.from_ndarray(yuv_from_srgb(srgb), format="yuv420p")
        # not the stream's unit: the muxer changes it with the header, which it writes before x264's first packet, and
        # that comes with picture 33
        frame.pts, frame.time_base = self._count, self._frame_s
        frame.colorspace, frame.color_range = BT709, LIMITED_RANGE
        self._count += 1
        self._container.mux(self._stream.encode(frame))

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._container.mux(self._stream.encode(None))
        self._container.close()


def yuv_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """BT.709 limited range, chroma averaged over 2 x 2 pixels: uint8 [H, W, 3] to planar uint8 [H * 3 / 2, W].

    Sides must be even.
    """
    height, width = srgb.shape[:2]
    planes = np.empty((height * 3 // 2, width), np.uint8)
    chroma = planes[height:].reshape(2, height // 2, width // 2)
    _to_yuv(srgb, planes[:height], chroma[0], chroma[1])
    return planes


@numba.njit(cache=True, error_model="numpy")
def _to_yuv(srgb: np.ndarray, luma: np.ndarray, blue: np.ndarray, red: np.ndarray) -> None:
    for row in range(blue.shape[0]):
        for column in range(blue.shape[1]):
            r, g, b = 0.0, 0.0, 0.0
            for y in (2 * row, 2 * row + 1):
                for x in (2 * column, 2 * column + 1):
                    pr, pg, pb = srgb[y, x, 0] / 255.0, srgb[y, x, 1] / 255.0, srgb[y, x, 2] / 255.0
                    luma[y, x] = int(16.5 + 219 * (0.2126 * pr + 0.7152 * pg + 0.0722 * pb))
                    r, g, b = r + pr / 4, g + pg / 4, b + pb / 4
            grey = 0.2126 * r + 0.7152 * g + 0.0722 * b
            blue[row, column] = int(128.5 + 224 * (b - grey) / 1.8556)
            red[row, column] = int(128.5 + 224 * (r - grey) / 1.5748)
