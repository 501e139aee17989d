"""Which Gaussian of a frame is which of the frame before, where files do not say: frames become segments.

Frames of one length are taken row by row, as programs write them that move or edit one set of Gaussians. Otherwise
equal codes are the same Gaussian, and the rest dies and is born. Wrong guesses cost bytes, never values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from packuv.gaussians.codes import Codes
from packuv.gaussians.rows import joined_segment
from packuv.gaussians.segment import Segment

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
        return joined_segment(first, self._frames, self._rows)


def equal_codes(codes: Codes, others: Codes) -> np.ndarray:
    """Row of `others` with the same codes as each row of `codes`, int64 [n], -1 where there is none.

    No row of `others` serves twice: among equals the first goes with the first.
    """
    return equal_rows(_as_bytes(codes), _as_bytes(others))


def equal_rows(values: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The same of rows of any kind, each as one value of bytes, [n]."""
    both = np.concatenate([values, others])
    _, group = np.unique(both, return_inverse=True)
    ours, theirs = (_numbered(part, len(both)) for part in (group[: len(values)], group[len(values) :]))
    _, row, other = np.intersect1d(ours, theirs, assume_unique=True, return_indices=True)
    found = np.full(len(values), -1, np.int64)
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
