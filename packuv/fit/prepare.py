"""What the frames of a segment are fitted to: by camera a motion mask, optical flow and a picture.

On the CPU a picture is read when it is first drawn, since a fit uses all cores. A GPU would have to wait for it: there
threads read what the next instant needs, and send it, while this one is fitted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from packuv.each import Each, packed
from packuv.fit.shots import Sent
from packuv.footage import Views
from packuv.motion import MotionCache

Send = Callable[[np.ndarray], Sent]
"""Begins to copy an array to a GPU, as `packuv.raster.cuda.launch.send` does"""


@dataclass(frozen=True)
class Prepared:
    """What one camera tells of an instant."""

    mask: Callable[[], np.ndarray] | None
    """Gives what moved, bool [H, W]; None: nobody knows"""
    optical_flow: np.ndarray | None
    """As `MotionCache.optical_flow`; None also where it is not to be used"""
    sent: Sent | None
    """The picture, on its way to the GPU; None: it is read when it is needed"""


class Instant:
    """What all cameras tell of an instant, a row of the views."""

    def __init__(self, asked: float, row: int, cameras: Sequence[Prepared]) -> None:
        self.asked = asked
        """When the caller began to wait for it, by `time.monotonic`"""
        self.row = row
        self.masks: Sequence[np.ndarray | None] = Each(lambda index: _made(cameras[index].mask), len(cameras))
        """Bool [H, W] each, made whenever one is asked for, or None"""
        self.optical_flows = [camera.optical_flow for camera in cameras]
        self.sent = [camera.sent for camera in cameras]


def _made(mask: Callable[[], np.ndarray] | None) -> np.ndarray | None:
    return None if mask is None else mask()


@contextmanager
def prepared(
    views: Views, motion: MotionCache, rows: Sequence[int], *, flows: bool, send: Send | None, workers: int
) -> Iterator[Iterator[Instant]]:
    """The instants of some rows of the views, ascending; with `send`, the next one is prepared by so many threads while
    the caller has one. None of these runs any more when the context is left.

    Pictures on their way take nothing of the views' budget: those of two instants lie on the GPU. One that cannot be
    read, or sent, is left to whoever needs it, who hears then what is wrong. Raises what the motion cache raises.
    """

    def camera(index: int, row: int) -> Prepared:
        return _prepare(views, motion, index, row, flows=flows, send=send)

    cameras = range(len(views.cameras))
    if send is None:
        yield (Instant(time.monotonic(), row, [camera(index, row) for index in cameras]) for row in rows)
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="packuv-prepare")
    try:
        yield _ahead(rows, lambda row: [pool.submit(camera, index, row) for index in cameras])
    finally:
        pool.shutdown(cancel_futures=True)


def _ahead(rows: Sequence[int], start: Callable[[int], list[Future[Prepared]]]) -> Iterator[Instant]:
    """One instant is whole before the next begins, so that each camera's decoder goes on and never seeks."""
    coming = start(rows[0]) if rows else []
    for row, after in zip_longest(rows, rows[1:]):
        instant = Instant(time.monotonic(), row, [job.result() for job in coming])
        coming = [] if after is None else start(after)
        yield instant


def _prepare(views: Views, motion: MotionCache, index: int, row: int, *, flows: bool, send: Send | None) -> Prepared:
    place = motion.names.index(views.cameras[index].name)
    mask = motion.mask(place, row)
    flow = motion.optical_flow(place, row) if flows else None
    sent = None
    if send is not None and (mask is None or mask.any()):
        with suppress(Exception):  # see `prepared`
            pixels = views.pixels(index, row, remember=False)
            sent = None if pixels is None else _sent(send, pixels)
    return Prepared(None if mask is None else packed(mask), flow, sent)


def _sent(send: Send, pixels: np.ndarray) -> Sent:
    """Begin to send a picture, or else have it sent by whoever needs it; to read it again would be to seek."""
    try:
        return send(pixels)
    except Exception:
        return lambda: send(pixels)()
