"""Scenes for the viewer's tests, and a server that shows one."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from packuv.camera import PinholeCamera
from packuv.gaussians.codes import OPACITY_RANGE, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.viewer.server import ViewerServer
from packuv.viewer.source import SegmentSource, Source


def make_quantizer(sh_degree: int = 0) -> Quantizer:
    count = attribute_count(sh_degree)
    low, high = np.full(count, -1.5), np.full(count, 1.5)
    low[:3], high[:3] = -4.5, -1.5  # natural log of the scales
    low[3:6], high[3:6] = -1, 1
    low[6], high[6] = OPACITY_RANGE
    return Quantizer(np.array([0.3, -0.2, 0.1]), 1.0, np.array([2.0, 2.0, 2.0]), low, high, sh_degree)


def make_segment(
    rng: np.random.Generator, first: int, *, length: int, count: int, dynamic: float, columns: int
) -> Segment:
    moves = rng.random(count) < dynamic
    shape = (length - 1, int(moves.sum()))
    key = Codes(
        rng.integers(0, 65536, (count, 3), dtype=np.uint16), rng.integers(0, 256, (count, columns), dtype=np.uint8)
    )
    xyz = rng.integers(0, 65536, (*shape, 3), dtype=np.uint16)
    return Segment(first, key, moves, xyz, rng.integers(0, 256, (*shape, columns), dtype=np.uint8))


def make_ring(count: int = 4, width: int = 160, height: int = 120) -> tuple[PinholeCamera, ...]:
    cameras = []
    for index, angle in enumerate(np.arange(count) * 2 * np.pi / count):
        eye = np.array([5 * np.sin(angle), -1.0, 5 * np.cos(angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ eye
        cameras.append(PinholeCamera(f"cam{index}", width, height, 150.0, 140.0, width / 2 + 7, height / 2 - 4, pose))
    return tuple(cameras)


def make_source(sh_degree: int = 0, *, count: int = 300, dynamic: float = 0.3) -> SegmentSource:
    rng = np.random.default_rng(5)
    columns = attribute_count(sh_degree)
    parts = [
        make_segment(rng, first, length=length, count=count, dynamic=dynamic, columns=columns)
        for first, length in ((0, 4), (4, 1), (5, 3))
    ]
    return SegmentSource(
        tuple(parts), make_quantizer(sh_degree), Fraction(30000, 1001), make_ring(), held_out=frozenset({"cam2"})
    )


@contextlib.contextmanager
def running(source: Source) -> Iterator[ViewerServer]:
    with ViewerServer(("127.0.0.1", 0), source) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
