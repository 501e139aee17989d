"""Videos whose planes are given to the code, so that what a picture must be follows from a formula."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

Tags = tuple[int, int, int, int]
"""Matrix, range, transfer, primaries, in the codes of ITU-T H.273"""
UNTAGGED: Tags = (2, 0, 2, 2)
SUBSAMPLED = {"420": (1, 1), "422": (1, 0), "444": (0, 0), "440": (0, 1)}


def filled(name: str, planes: Sequence[np.ndarray], tags: Tags = UNTAGGED) -> av.VideoFrame:
    """A frame of the pixel format `name` that holds exactly these planes."""
    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, name)
    for plane, values in zip(frame.planes, planes, strict=True):
        memory = np.frombuffer(plane, dtype=np.uint8).reshape(plane.height, plane.line_size)
        rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
        memory[:, : rows.shape[1]] = rows
    frame.colorspace, frame.color_range, frame.color_trc, frame.color_primaries = tags
    return frame


def write_planes(
    path: Path,
    name: str,
    frames: Sequence[Sequence[np.ndarray]],
    tags: Tags = UNTAGGED,
    *,
    codec: str = "ffv1",
    options: Mapping[str, str] | None = None,
) -> Path:
    """Write frames of planes at 30 a second; lossless with the default codec."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = frames[0][0].shape
        stream.pix_fmt, stream.options = name, dict(options or {})
        context = stream.codec_context
        context.colorspace, context.color_range, context.color_trc, context.color_primaries = tags
        for number, planes in enumerate(frames):
            frame = filled(name, planes, tags)
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def shapes(sampling: str, height: int, width: int) -> list[tuple[int, int]]:
    """Rows and columns of the three planes."""
    across, down = SUBSAMPLED[sampling]
    chroma = ((height + (1 << down) - 1) >> down, (width + (1 << across) - 1) >> across)
    return [(height, width), chroma, chroma]
