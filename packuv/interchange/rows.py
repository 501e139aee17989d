"""Which Gaussian of a frame is which of the frame before, where files do not say: frames become segments.

Frames of one length are taken row by row, as programs write them that move or edit one set of Gaussians. Otherwise
equal codes are the same Gaussian, and the rest dies and is born. Wrong guesses cost bytes, never values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from packuv.quantize import OPACITY, Codes
from packuv.segment import Segment

GROWTH = 1.5
"""A segment ends before its rows outnumber its first frame's by more than this: the frames have too little in common"""


def segments_of(frames: Iterable[Codes], *, longest: int) -> Iterator[Segment]:
    """Join frames to segments of at most `longest` frames; every frame's drawn Gaussians stay the same, as a set.

    Holds one segment in memory. Raises ValueError for a frame without Gaussians.
    """
    first, current = 0, _Rows()
    for number, codes in enumerate(frames):
        if not len(codes):
            raise ValueError(f"frame {number} holds no Gaussians that can be drawn; leave it out")
        if len(current) == longest or not current.add(codes):
            yield current.segment(first)
            first, current = number, _Rows()
            current.add(codes)
    if len(current):
        yield current.segment(first)


class _Rows:
    """The frames of one segment so far, and the row of each of their Gaussians."""

    def __init__(self) -> None:
        self._frames: list[Codes] = []
        self._rows: list[np.ndarray] = []  # of each frame int64 [n]
        self._count = 0

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, codes: Codes) -> bool:
        """Take a frame in, unless it has too little in common with those before."""
        rows = self._match(codes)
        count = max(self._count, int(rows.max()) + 1)
        if self._frames and count > GROWTH * len(self._frames[0]):
            return False
        self._frames.append(codes)
        self._rows.append(rows)
        self._count = count
        return True

    def _match(self, codes: Codes) -> np.ndarray:
        if not self._frames:
            return np.arange(len(codes))
        if len(codes) == len(self._frames[-1]):
            return self._rows[-1]
        same = equal_codes(codes, self._frames[-1])  # [n]: its row in the last frame, or -1
        rows = np.where(same >= 0, self._rows[-1][same], -1)
        born = rows < 0
        rows[born] = self._count + np.arange(born.sum())
        return rows

    def segment(self, first: int) -> Segment:
        return segment_of(first, self._frames, self._rows)


def segment_of(first: int, frames: Sequence[Codes], rows: Sequence[np.ndarray]) -> Segment:
    """Frames as a segment, given the row of each of their Gaussians, int64 [n] a frame, none twice in a frame.

    A row that is absent has opacity code 0, and otherwise what it had when it was last there, or will first have.
    """
    count = 1 + max(int(of_frame.max(initial=0)) for of_frame in rows)
    xyz = np.zeros((len(frames), count, 3), np.uint16)
    attributes = np.zeros((len(frames), count, frames[0].attributes.shape[1]), np.uint8)
    shown = np.zeros(count, bool)
    for time, (codes, here) in enumerate(zip(frames, rows, strict=True)):
        if time:
            xyz[time], attributes[time] = xyz[time - 1], attributes[time - 1]
            attributes[time, :, OPACITY] = 0
        xyz[time, here], attributes[time, here] = codes.xyz, codes.attributes
        born = here[~shown[here]]  # what waits for its birth repeats itself, and so costs nothing to store
        xyz[:time, born], attributes[:time, born] = xyz[time, born], attributes[time, born]
        attributes[:time, born, OPACITY] = 0
        shown[here] = True
    dynamic = ((xyz != xyz[0]).any(axis=2) | (attributes != attributes[0]).any(axis=2)).any(axis=0)
    return Segment(first, Codes(xyz[0], attributes[0]), dynamic, xyz[1:, dynamic], attributes[1:, dynamic])


def equal_codes(codes: Codes, others: Codes) -> np.ndarray:
    """Row of `others` with the same codes as each row of `codes`, int64 [n], -1 where there is none.

    No row of `others` serves twice: among equals the first goes with the first.
    """
    both = np.concatenate([_as_bytes(codes), _as_bytes(others)])
    _, group = np.unique(both, return_inverse=True)
    ours, theirs = (_numbered(part, len(both)) for part in (group[: len(codes)], group[len(codes) :]))
    _, row, other = np.intersect1d(ours, theirs, assume_unique=True, return_indices=True)
    found = np.full(len(codes), -1, np.int64)
    found[row] = other
    return found


def _as_bytes(codes: Codes) -> np.ndarray:
    """Each row as one value, [n]."""
    rows = np.concatenate([codes.xyz.view(np.uint8).reshape(len(codes), 6), codes.attributes], axis=1)
    return np.ascontiguousarray(rows).view(f"V{rows.shape[1]}")[:, 0]


def _numbered(group: np.ndarray, limit: int) -> np.ndarray:
    """A number for each member of a group, int64 [n]: group times limit plus its place among the group's members."""
    order = np.argsort(group, kind="stable")
    ordered = group[order]
    place = np.arange(len(group)) - np.searchsorted(ordered, ordered)
    numbered = np.empty(len(group), np.int64)
    numbered[order] = ordered * limit + place
    return numbered
