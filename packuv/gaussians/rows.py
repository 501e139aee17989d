"""Rows of segments: which Gaussians are there when, and how frames join into one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.segment import Segment


def first_appearance(segment: Segment) -> Codes:
    """The codes of each row in the first frame that draws it; rows that none draws keep their key."""
    xyz, attributes = segment.key.xyz.copy(), segment.key.attributes.copy()
    moving = np.flatnonzero(segment.dynamic)
    waiting = attributes[moving, OPACITY] == 0
    for frame_xyz, frame_attributes in zip(segment.xyz, segment.attributes, strict=True):
        here = waiting & (frame_attributes[:, OPACITY] > 0)
        xyz[moving[here]], attributes[moving[here]] = frame_xyz[here], frame_attributes[here]
        waiting &= ~here
    return Codes(xyz, attributes)


def with_rows(segment: Segment, rows: np.ndarray) -> Segment:
    """Only the rows of a mask, bool [N]."""
    moving = rows[segment.dynamic]
    return Segment(
        segment.first, segment.key[rows], segment.dynamic[rows], segment.xyz[:, moving], segment.attributes[:, moving]
    )


def joined_segment(first: int, frames: Sequence[Codes], rows: Sequence[np.ndarray]) -> Segment:
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


def hold_absent(segment: Segment) -> Segment:
    """The same segment, with rows that stand still while they are absent and so cost nothing to store.

    Before its birth a dynamic row carries what it is born with, after its death what it died with, and opacity code 0
    throughout. Every picture of the scene stays the same, the codes of absent rows do not: call it before codes are
    digested or compared. Rows that never appear repeat their key.
    """
    xyz = np.concatenate([segment.key.xyz[None, segment.dynamic], segment.xyz])  # [T, D, 3]
    attributes = np.concatenate([segment.key.attributes[None, segment.dynamic], segment.attributes])
    present = attributes[:, :, OPACITY] > 0  # [T, D]
    source = np.where(present, np.arange(len(present))[:, None], 0)  # [T, D]: frame whose values a row shows
    source = np.maximum.accumulate(source, axis=0)
    source = np.where(np.logical_or.accumulate(present, axis=0), source, present.argmax(axis=0))
    rows = np.arange(xyz.shape[1])
    xyz, attributes = xyz[source, rows], attributes[source, rows]
    attributes[:, :, OPACITY][~present] = 0
    key = Codes(segment.key.xyz.copy(), segment.key.attributes.copy())
    key.xyz[segment.dynamic], key.attributes[segment.dynamic] = xyz[0], attributes[0]
    return Segment(segment.first, key, segment.dynamic, xyz[1:], attributes[1:])
