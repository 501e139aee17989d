"""What the key of a segment takes over from the key of an earlier one, and what it must bring itself.

A Gaussian that nothing touched between two keyframes keeps every code, so its row stands in the earlier key already.
Rows carry no names: equal codes make equal rows. A key whose reference has a reference is read through all of them,
which is why the writer bounds their number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from packuv.gaussians.codes import Codes
from packuv.gaussians.segment import Segment

NO_ROWS = np.empty(0, np.int64)
DROPPED, KEPT_STILL, KEPT_DYNAMIC = 0, 1, 2
"""What becomes of a row of the reference: it is gone, it stays and is still, it stays and may change."""

WORTH = 0.02
"""Share of its rows by which a key must shrink for one more key to be decoded on the way to it"""


def morton_codes(xyz: np.ndarray) -> np.ndarray:
    """Place of positions uint16 [N, 3] on the 3D Morton curve, uint64 [N]; bit 3 b + a is bit b of axis a."""
    spread = xyz.astype(np.uint64)
    for shift, mask in ((32, 0xFFFF00000000FFFF), (16, 0x00FF0000FF0000FF), (8, 0xF00F00F00F00F00F)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    for shift, mask in ((4, 0x30C30C30C30C30C3), (2, 0x9249249249249249)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    codes: np.ndarray = spread[:, 0] | spread[:, 1] << np.uint64(1) | spread[:, 2] << np.uint64(2)
    return codes


def row_order(xyz: np.ndarray, dynamic: np.ndarray) -> np.ndarray:
    """Order of stored rows, int64 [N]: dynamic rows first, each part along the Morton curve, ties as they came.

    With the dynamic rows in front no mask of them is stored, and a frame changes one contiguous part.
    """
    return np.argsort(morton_codes(xyz) | (~dynamic).astype(np.uint64) << np.uint64(63), kind="stable")


def assemble(reference: Codes | None, fates: np.ndarray, own: Codes, own_dynamic: int) -> Codes:
    """The key's rows in stored order.

    `fates` uint8 [rows of the reference] says what becomes of each; of `own` the first `own_dynamic` rows may change.
    """
    if reference is None:
        return own
    kept = np.flatnonzero(fates)
    xyz = np.concatenate([reference.xyz[kept], own.xyz])
    attributes = np.concatenate([reference.attributes[kept], own.attributes])
    dynamic = np.concatenate([fates[kept] == KEPT_DYNAMIC, np.arange(len(own)) < own_dynamic])
    return Codes(xyz, attributes)[row_order(xyz, dynamic)]


def match_rows(first: Codes, second: Codes) -> tuple[np.ndarray, np.ndarray]:
    """Rows with equal codes, int64 [M] twice: row of `first`, ascending, and its own row of `second`."""
    prints, others = _fingerprints(first), _fingerprints(second)
    order, other_order = np.argsort(prints, kind="stable"), np.argsort(others, kind="stable")
    prints, others = prints[order], others[other_order]
    rank = np.arange(len(prints)) - np.searchsorted(prints, prints)  # among equal rows
    place = np.searchsorted(others, prints) + rank  # the k-th of equal rows matches the k-th
    found = np.flatnonzero(place < len(others))
    found = found[others[place[found]] == prints[found]]
    here, there = order[found], other_order[place[found]]
    same = (first.xyz[here] == second.xyz[there]).all(axis=1)  # fingerprints may be equal by chance
    same &= (first.attributes[here] == second.attributes[there]).all(axis=1)
    here, there = here[same], there[same]
    ascending = np.argsort(here, kind="stable")
    return here[ascending], there[ascending]


def _fingerprints(codes: Codes) -> np.ndarray:
    """A number for each row, uint64 [N], equal for equal rows and hardly ever for others."""
    prints = np.zeros(len(codes), np.uint64)
    for column in (*codes.xyz.T, *codes.attributes.T):
        prints = (prints ^ column) * np.uint64(0x9E3779B97F4A7C15)
        prints ^= prints >> np.uint64(29)
    return prints


@dataclass(frozen=True)
class KeyPlan:
    """How one key is stored."""

    reference: int | None
    """Segment whose key it takes rows from"""
    fates: np.ndarray
    """uint8 [rows of the reference]: DROPPED, KEPT_STILL or KEPT_DYNAMIC; empty without a reference"""
    own: np.ndarray
    """int64: rows of the segment that the key's picture holds, the dynamic ones first"""
    own_dynamic: int
    order: np.ndarray
    """int64 [N]: row of the segment that each stored row holds"""


@dataclass
class _Ancestor:
    """A key on the way to the last one, to which the next may refer."""

    number: int
    key: Codes
    first_bill: int | None = None
    """Rows that the first key which referred to it had to bring"""
    overspent: int = 0
    """Rows that later ones brought beyond that, because this key ages"""


class KeyPlanner:
    """Plans the keys of a sequence, one after the other; the same segments give the same plans.

    A key refers to the last one, or where that is as far from the root as `reach` allows, to an earlier one on the
    way. The older that gets, the more rows its heirs must bring. Once they have brought more than it would have cost
    to renew it, the next key refers to the one before it, and is its successor. Holds `reach` keys at most.
    """

    def __init__(self, reach: int) -> None:
        self._reach = reach
        self._way: list[_Ancestor] = []  # from the root to the last segment
        self._count = 0

    def plan(self, segment: Segment) -> KeyPlan:
        """Plan the key of the next segment."""
        heirs = self._way[: self._reach - 1]
        matches = [match_rows(ancestor.key, segment.key) for ancestor in heirs]
        bills = [len(segment.key), *(len(segment.key) - len(there) for there, _ in matches)]
        depth = self._depth(bills, heirs)
        if depth == 0:
            plan = _plan(segment, None, 0, (NO_ROWS, NO_ROWS))
        else:
            parent = heirs[depth - 1]
            _book(parent, bills[depth])
            plan = _plan(segment, parent.number, len(parent.key), matches[depth - 1])
        self._way = [*heirs[:depth], _Ancestor(self._count, segment.key[plan.order])]
        self._count += 1
        return plan

    def _depth(self, bills: Sequence[int], heirs: Sequence[_Ancestor]) -> int:
        """How many keys lie before this one; `bills` are the rows to bring at every possible depth."""
        depth = len(heirs)
        while depth and bills[depth - 1] - bills[depth] < max(heirs[depth - 1].overspent, WORTH * bills[0]):
            depth -= 1
        return depth


def _book(parent: _Ancestor, bill: int) -> None:
    if parent.first_bill is None:
        parent.first_bill = bill
    parent.overspent += max(0, bill - parent.first_bill)


def _plan(segment: Segment, reference: int | None, rows: int, matches: tuple[np.ndarray, np.ndarray]) -> KeyPlan:
    there, here = matches  # rows of the reference, rows of the segment
    fates = np.zeros(rows, np.uint8)
    fates[there] = np.where(segment.dynamic[here], KEPT_DYNAMIC, KEPT_STILL)
    brought = np.ones(len(segment.key), bool)
    brought[here] = False
    own = np.flatnonzero(brought)
    own = own[row_order(segment.key.xyz[own], segment.dynamic[own])]
    together = np.concatenate([here, own])
    order = together[row_order(segment.key.xyz[together], segment.dynamic[together])]
    return KeyPlan(reference, fates, own, int(segment.dynamic[own].sum()), order)


class KeyReplay:
    """Plans the keys of a sequence again, with references that are known; holds those that are yet referred to."""

    def __init__(self, references: Sequence[int | None]) -> None:
        self._references = references
        self._last = {reference: number for number, reference in enumerate(references)}
        self._keys: dict[int, Codes] = {}
        self._count = 0

    def plan(self, segment: Segment) -> KeyPlan:
        """Plan the key of the next segment."""
        number, reference = self._count, self._references[self._count]
        matches, rows = (NO_ROWS, NO_ROWS), 0
        if reference is not None:
            matches, rows = match_rows(self._keys[reference], segment.key), len(self._keys[reference])
        plan = _plan(segment, reference, rows, matches)
        self._keys = {key: codes for key, codes in self._keys.items() if self._last[key] > number}
        if number in self._last:
            self._keys[number] = segment.key[plan.order]
        self._count += 1
        return plan


def stored_segments(segments: Iterable[Segment], *, references: Sequence[int | None]) -> Iterator[Segment]:
    """Segments with their rows as a scene file returns them, whose segments have these references."""
    replay = KeyReplay(references)
    return (reordered(segment, replay.plan(segment).order) for segment in segments)


def reordered(segment: Segment, order: np.ndarray) -> Segment:
    """The same segment with row order[i] as row i; `order` must put the dynamic rows first."""
    place = np.cumsum(segment.dynamic) - 1  # [N]: dynamic row -> its place in segment.xyz
    count = int(segment.dynamic.sum())
    moving = place[order[:count]]
    return replace(
        segment,
        key=segment.key[order],
        dynamic=np.arange(len(order)) < count,
        xyz=segment.xyz[:, moving],
        attributes=segment.attributes[:, moving],
    )
