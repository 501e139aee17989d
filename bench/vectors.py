"""Motion vectors of the codec against optical flow: which moving tiles they know of, whether M(t) and keyframes agree.

They say where a block is copied from, not where it moves; from a picture that is often not the one before, so each is
divided by the frames that lie between; where a block is coded by itself there is none.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.codec.context import Flags2

from packuv.motion.keyframes import KeyframeOptions, choose_keyframes, motion_curve
from packuv.motion.step import MotionOptions, grown, measure_step
from sync.capture import find_capture

TILE, SLOW_PX, CAMERAS = 16, 0.25, 4
"""Side of a tile, pixels; a vector that is shorter tells of no motion; cameras, spread over the rig"""


def vector_rows(capture: Path) -> Iterator[Mapping[str, Any]]:
    """A row a camera, and one for the curves of all."""
    videos = find_capture(capture).videos
    names = sorted(videos)[:: max(1, len(videos) // CAMERAS)][:CAMERAS]
    flow, codec = [], []
    for name in names:
        start = time.process_time()
        pictures, _ = _decoded(videos[name], vectors=False)
        decoding = time.process_time() - start
        start = time.process_time()
        _, found = _decoded(videos[name], vectors=True)
        exporting = time.process_time() - start
        start = time.process_time()
        steps = [measure_step(a, b, MotionOptions()) for a, b in pairwise(pictures)]
        measuring = time.process_time() - start
        height, width = pictures[0].shape
        known = [_speeds(each, height, width) for each in found[1:]]
        tiles = [_tiles(grown(step.mask, width, height, 0)) for step in steps]
        told = [_tiles(speed > SLOW_PX) for speed, _ in known]
        careful = [_tiles((speed > SLOW_PX) | ~covered) for speed, covered in known]
        moving = sum(int(tile.sum()) for tile in tiles)
        flow.append([step.magnitude for step in steps])
        codec.append([float(speed.mean()) for speed, _ in known])
        yield {
            "camera": name,
            "decoding_ms": 1e3 * decoding / len(pictures),
            "with_vectors_ms": 1e3 * exporting / len(pictures),
            "motion_ms": 1e3 * measuring / len(steps),
            "recall": sum(int((a & b).sum()) for a, b in zip(tiles, told, strict=True)) / moving,
            "recall_with_uncoded": sum(int((a & b).sum()) for a, b in zip(tiles, careful, strict=True)) / moving,
            "tiles_left": float(np.mean([tile.mean() for tile in careful])),
            "tiles_moving": float(np.mean([tile.mean() for tile in tiles])),
            "correlation": _correlation(np.array([flow[-1]]).T, np.array([codec[-1]]).T),
            "keyframes_flow": "",
            "keyframes_codec": "",
        }
    both = [np.array(list(zip(*each, strict=False))) for each in (flow, codec)]  # as long as the shortest
    chosen = [[key.instant for key in choose_keyframes(_curve(each), KeyframeOptions())] for each in both]
    blank = dict.fromkeys(("decoding_ms", "with_vectors_ms", "motion_ms", "recall", "recall_with_uncoded"), "")
    told_of = {"correlation": _correlation(*both), "keyframes_flow": str(chosen[0]), "keyframes_codec": str(chosen[1])}
    yield {"camera": "median", **blank, "tiles_left": "", "tiles_moving": "", **told_of}


def _decoded(path: Path, *, vectors: bool) -> tuple[list[np.ndarray], list[np.ndarray | None]]:
    """Grey pictures, and the vectors of each; None where it has none."""
    pictures, found = [], []
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 1
        if vectors:
            stream.codec_context.flags2 |= Flags2.export_mvs
        for frame in container.decode(stream):
            side = frame.side_data.get("MOTION_VECTORS")
            found.append(None if side is None else side.to_ndarray())
            pictures.append(frame.to_ndarray(format="gray"))
    return pictures, found


def _speeds(vectors: np.ndarray | None, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels a frame that each pixel's block was moved by, float32 [H, W], and where there is one, bool [H, W]."""
    speed, covered = np.zeros((height, width), np.float32), np.zeros((height, width), bool)
    for one in () if vectors is None else vectors:
        left, top = int(one["dst_x"]) - int(one["w"]) // 2, int(one["dst_y"]) - int(one["h"]) // 2
        block = np.s_[max(0, top) : top + int(one["h"]), max(0, left) : left + int(one["w"])]
        length = np.hypot(int(one["motion_x"]), int(one["motion_y"])) / int(one["motion_scale"])
        speed[block], covered[block] = np.maximum(speed[block], length / max(1, abs(int(one["source"])))), True
    return speed, covered


def _tiles(mask: np.ndarray) -> np.ndarray:
    """Those that a mask touches, bool; what is left over at the right and below is not counted."""
    rows, columns = mask.shape[0] // TILE, mask.shape[1] // TILE
    whole = mask[: rows * TILE, : columns * TILE]
    return np.asarray(whole.reshape(rows, TILE, columns, TILE).any(axis=(1, 3)))


def _curve(magnitudes: np.ndarray) -> np.ndarray:
    """M(t) of magnitudes [T, C]."""
    return motion_curve(magnitudes, [str(column) for column in range(magnitudes.shape[1])], KeyframeOptions())


def _correlation(flow: np.ndarray, codec: np.ndarray) -> float:
    return float(np.corrcoef(_curve(flow), _curve(codec))[0, 1])
