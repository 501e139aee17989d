"""Where the bits of a scene file go: what its coder spends on each channel, beside entropies of the same bytes."""

from __future__ import annotations

import numpy as np

from packuv.gaussians.segment import Segment
from packuv.scene import Tolerance
from packuv.scene.matroska import Encoder, VideoTrack
from packuv.scene.mosaic import NEUTRAL, Mosaic
from packuv.scene.stream import changes, channel_names, key_rows

SLICES = 4
"""The fewest that FFmpeg's coder has for a large picture"""
NEAR = 8
"""Residuals beyond are one class each way, as a context"""


def channel_bits(segment: Segment) -> dict[str, dict[str, dict[str, float]]]:
    """Bits a row of the key, and of the frame in the middle after it, by channel; rows as they are in a scene file.

    `ffv1` is the channel's plane coded alone, `entropy` that of its bytes without context, `given_above` in the context
    of the byte of the row before it, `given_last` of the row's own one in the last frame. All rows that may move count.
    """
    found = {"key": _of(key_rows(segment.key))}
    if len(segment) > 2:
        frames = _residuals(segment, len(segment) // 2 + 1)
        found["change"] = _of(frames[-1], frames[-2])
    return found


def _residuals(segment: Segment, count: int) -> list[np.ndarray]:
    """Bytes [D, channels] of the first `count` frames after the key, those that are not stored included."""
    stored, frames = np.zeros(segment.xyz.shape[1], np.uint8), []
    for change, _ in changes(segment, Tolerance()):
        stored = stored ^ change.toggled
        frames.append(np.full((len(stored), change.rows.shape[1]), NEUTRAL, np.uint8))
        frames[-1][stored > 0] = change.rows
        if len(frames) == count:
            break
    return frames


def _of(rows: np.ndarray, last: np.ndarray | None = None) -> dict[str, dict[str, float]]:
    names = channel_names(round(((rows.shape[1] - 13) / 3) ** 0.5) - 1)
    found = {}
    for channel, name in enumerate(names):
        values = rows[:, channel]
        bits = {
            "ffv1": _coded(values),
            "entropy": entropy(values, np.zeros_like(values)),
            "given_above": entropy(values[1:], _classes(values[:-1])),
        }
        if last is not None:
            bits["given_last"] = entropy(values, _classes(last[:, channel]))
        found[name] = {key: round(value, 3) for key, value in bits.items()}
    return found


def _classes(values: np.ndarray) -> np.ndarray:
    """Few contexts of bytes, by their distance from the neutral one."""
    return np.asarray(np.clip(values.astype(np.int64) - NEUTRAL, -NEAR, NEAR) + NEAR)


def entropy(values: np.ndarray, context: np.ndarray) -> float:
    """Bits a byte of `values` uint8 [n], where the context [n], small whole numbers, is known.

    A table of counts looks more regular than what it counts; Miller and Madow's correction is made for that.
    """
    counts = np.zeros((int(context.max()) + 1, 256))
    np.add.at(counts, (context, values), 1)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    bits = -(counts * np.log2(np.where(share > 0, share, 1))).sum()
    freedom = np.maximum((counts > 0).sum(axis=1) - 1, 0).sum()
    return float((bits + freedom / (2 * np.log(2))) / len(values))


def _coded(values: np.ndarray) -> float:
    mosaic = Mosaic.of(len(values), (0,), 1)
    picture = mosaic.draw(values[:, None])
    packet = Encoder(VideoTrack("channel", mosaic.width, mosaic.height, SLICES)).encode(picture)
    return len(packet) * 8 / len(values)
