"""What travels of a scene: keys in parts, the most telling first, and frames as what their neighbours do not foretell.

Integers travel, never floats made on the way. A segment's key takes the rows that it shares with an earlier one from
there, and brings the others: what moves, then what stands still by its share in the picture, then the bands of view
dependence. A frame is predicted from frames on both sides of it, never further away than a few, so that each needs few
others and damage stays where it is. docs/viewer.md gives the layout byte by byte.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from packuv.gaussians.codes import OPACITY, REST, Codes, Quantizer, attribute_count
from packuv.gaussians.uvmap import assign_slots
from packuv.gaussians.uvsize import UvOptions
from packuv.scene.sharing import KEPT_DYNAMIC, KEPT_STILL, NO_ROWS, match_rows, morton_codes
from packuv.viewer.planes import column_planes, deflated, read_columns
from packuv.viewer.source import Source, locate

SPAN = 8
"""Frames from one that is predicted from the key alone to the next"""

PART_ROWS = 16384
"""Rows of a part of a key: some 220 kB, two seconds at 1 Mbit/s"""

CACHE_BYTES = 64 << 20
"""Bodies that are kept as they are sent: a scene that is looked at is looked at again"""

KEPT_PLANS = 6
"""Segments whose order of rows is kept; a key and those that it takes rows from are at most three"""

NO_REFERENCE = 2**32 - 1


def parents(offset: int, length: int) -> tuple[int, ...]:
    """Frames of a segment of `length` from which the one at `offset` is predicted, as offsets; none of the key.

    Every `SPAN`th and the last are predicted from the key, the frame halfway between two such from both, and so on.
    """
    low = offset - offset % SPAN
    high = min(low + SPAN, length - 1)
    if offset in (low, high):
        return (0,) if offset else ()
    while offset != (middle := (low + high) // 2):
        low, high = (low, middle) if offset < middle else (middle, high)
    return low, high


def guessed(known: Sequence[Codes]) -> Codes:
    """What one frame foretells, or two: halfway between them, modulo the width in positions; half a step goes up."""
    if len(known) == 1:
        return known[0]
    before, after = known
    way = (after.xyz - before.xyz).view(np.int16).astype(np.int32)
    xyz = before.xyz + (way + 1 >> 1).astype(np.uint16)
    return Codes(xyz, (before.attributes.astype(np.uint16) + after.attributes + 1 >> 1).astype(np.uint8))


@dataclass(frozen=True)
class KeyRows:
    """The rows of a segment in the order in which the page holds them: what moves, then what stands still; of both
    first what the reference brought, in its order."""

    order: np.ndarray
    """int64 [N]: row of the source that each is"""
    dynamic: int
    """D, rows that may differ from the key within the segment"""
    reference: int | None
    """Segment whose key some rows are taken from"""
    fates: np.ndarray
    """uint8 [rows of the reference]: 0 where a row is gone, 1 where it stands still here, 2 where it moves"""

    @property
    def own(self) -> tuple[slice, slice]:
        """Rows that the segment brings itself, moving and still."""
        moving, still = ((self.fates == fate).sum() for fate in (KEPT_DYNAMIC, KEPT_STILL))
        return slice(int(moving), self.dynamic), slice(self.dynamic + int(still), len(self.order))


def turns(moving: slice, still: slice, size: int) -> list[slice]:
    """Rows of each part of a key, apart from bands: those that move, at least one part, and those that stand still."""
    parts = [slice(k, min(k + size, rows.stop)) for rows in (moving, still) for k in range(rows.start, rows.stop, size)]
    return parts if moving.start < moving.stop else [moving, *parts]


def importance(codes: Codes, quantizer: Quantizer) -> np.ndarray:
    """Opacity times the area of the largest section, float [n]: what a Gaussian adds to pictures, from somewhere."""
    gaussians = quantizer.decode(codes)
    section = np.sort(gaussians.log_scales, axis=1)[:, 1:].sum(axis=1)
    weight: np.ndarray = np.exp(section) / (1 + np.exp(-gaussians.opacity_logits))
    return weight


def _along_curve(key: Codes, rows: np.ndarray) -> np.ndarray:
    """Rows in the order of the Morton curve, on which neighbours are alike."""
    order: np.ndarray = rows[np.argsort(morton_codes(key.xyz[rows]), kind="stable")]
    return order


class Bodies:
    """The bodies of a scene, deflated; each is made once while there is room. Any thread may ask."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self._reading = threading.Lock()  # decoders keep state
        self._made: OrderedDict[tuple[object, ...], bytes] = OrderedDict()
        self._bytes = 0
        self._plans: OrderedDict[int, KeyRows] = OrderedDict()

    def part(self, segment: int, number: int) -> bytes:
        """A part of a key; raises IndexError where there is none."""
        return self._once(("part", segment, number), lambda: self._part(segment, number))

    def get_ready(self) -> None:
        """Make what the page asks for first; what is wrong with it hears who asks."""
        with suppress(ValueError, OSError):
            self.part(0, 0)

    def frame(self, frame: int) -> bytes:
        """The moving rows of a frame, less what its parents foretell; raises IndexError for a key, which has parts."""
        return self._once(("frame", frame), lambda: self._frame(frame))

    def layers(self, segment: int) -> bytes:
        """Layer of the UV map, from 1 on, that takes each row of a key, uint8 [N]; 0 where none does, or the row is
        absent there. As in the atlas of `packuv atlas` with its default size."""
        return self._once(("layers", segment), lambda: self._layers(segment))

    def parts(self, segment: int) -> int:
        """Number of parts of a segment's key."""
        with self._reading:
            return self._part_count(self._plan(segment))

    def codes(self, frame: int) -> Codes:
        """All rows of a frame in the page's order."""
        segment, _ = locate(self.source.segments, frame)
        with self._reading:
            key, dynamic = self.source.key(segment)[self._plan(segment).order], self._plan(segment).dynamic
            moving = self.source.moving(frame)[self._moving_rows(segment)]
        key.xyz[:dynamic], key.attributes[:dynamic] = moving.xyz, moving.attributes
        return key

    def _once(self, name: tuple[object, ...], make: Callable[[], bytes]) -> bytes:
        with self._reading:
            if name not in self._made:
                self._made[name] = make()
                self._bytes += len(self._made[name])
            self._made.move_to_end(name)
            while self._bytes > CACHE_BYTES and len(self._made) > 1:
                self._bytes -= len(self._made.popitem(last=False)[1])
            return self._made[name]

    def _plan(self, segment: int) -> KeyRows:
        if not 0 <= segment < len(self.source.segments):
            raise IndexError(f"segment {segment} of a scene with {len(self.source.segments)}")
        if segment not in self._plans:
            self._plans[segment] = self._planned(segment)
        self._plans.move_to_end(segment)
        while len(self._plans) > KEPT_PLANS:
            self._plans.popitem(last=False)
        return self._plans[segment]

    def _planned(self, segment: int) -> KeyRows:
        source = self.source
        reference = source.reference(segment)
        there, here, fates = NO_ROWS, NO_ROWS, np.empty(0, np.uint8)
        if reference is not None:
            before = source.key(reference)[self._plan(reference).order]
            there, here = match_rows(before, source.key(segment))
            fates = np.zeros(len(before), np.uint8)
        key, dynamic = source.key(segment), source.dynamic(segment)
        fates[there] = np.where(dynamic[here], KEPT_DYNAMIC, KEPT_STILL)
        brought = np.ones(len(key), bool)
        brought[here] = False
        moving, still = (np.flatnonzero(brought & which) for which in (dynamic, ~dynamic))
        parts = (
            here[dynamic[here]], self._by_importance(key, moving),
            here[~dynamic[here]], self._by_importance(key, still),
        )  # fmt: skip
        return KeyRows(np.concatenate(parts), int(dynamic.sum()), reference, fates)

    def _by_importance(self, key: Codes, rows: np.ndarray) -> np.ndarray:
        """Rows in parts, the most important first; within each along the Morton curve."""
        rows = rows[np.argsort(-importance(key[rows], self.source.quantizer), kind="stable")]
        turns = [rows[start : start + PART_ROWS] for start in range(0, len(rows), PART_ROWS)]
        return np.concatenate([NO_ROWS, *(_along_curve(key, turn) for turn in turns)])

    def _part_count(self, plan: KeyRows) -> int:
        degree: int = self.source.quantizer.sh_degree
        return len(turns(*plan.own, PART_ROWS)) + degree

    def _part(self, segment: int, number: int) -> bytes:
        plan = self._plan(segment)
        codes, (moving, still) = self.source.key(segment)[plan.order], plan.own
        rows, count = turns(moving, still, PART_ROWS), self._part_count(plan)
        if not 0 <= number < count:
            raise IndexError(f"part {number} of a key with {count}")
        if number >= len(rows):
            band = columns_of_band(number - len(rows) + 1)
            own = np.concatenate([codes.attributes[which, band] for which in (moving, still)])
            return deflated(column_planes(None, own, colours=0))
        part = codes[rows[number]]
        columns = column_planes(part.xyz, part.attributes[:, :REST])
        if number > 0:
            return deflated(columns)
        reference = NO_REFERENCE if plan.reference is None else plan.reference
        head = (len(codes), plan.dynamic, codes.attributes.shape[1], reference, len(plan.fates), PART_ROWS, count, 0)
        return deflated([np.array(head, "<u4"), plan.fates, *columns])

    def _frame(self, frame: int) -> bytes:
        segment, offset = locate(self.source.segments, frame)
        frames = self.source.segments[segment]
        if offset == 0:
            raise IndexError(f"frame {frame} is the key of segment {segment}")
        rows, codes = self._moving_rows(segment), self.source.moving(frame)
        known = [before[rows] for before in self._readable(frames, parents(offset, len(frames)))]
        codes, guess = codes[rows], guessed(known)
        head = np.array((segment, len(codes), codes.attributes.shape[1], len(known)), "<u4")
        # unsigned, so modulo 2^16 and 2^8
        return deflated([head, *column_planes(codes.xyz - guess.xyz, codes.attributes - guess.attributes)])

    def _moving_rows(self, segment: int) -> np.ndarray:
        """Of the source's moving rows, in their order, the one that each moving row of the page is; int64 [D]."""
        plan, dynamic = self._plan(segment), self.source.dynamic(segment)
        place: np.ndarray = (np.cumsum(dynamic) - 1)[plan.order[: plan.dynamic]]
        return place

    def _readable(self, frames: range, offsets: tuple[int, ...]) -> list[Codes]:
        """The frames of a segment at these offsets; of which one is damaged, the key alone, lest damage spread."""
        try:
            return [self.source.moving(frames.start + offset) for offset in offsets]
        except ValueError:
            return [self.source.moving(frames.start)]

    def _layers(self, segment: int) -> bytes:
        plan, quantizer = self._plan(segment), self.source.quantizer
        codes = self.source.key(segment)[plan.order]
        shown = np.flatnonzero(codes.attributes[:, OPACITY] > 0)
        points = quantizer.decode(codes[shown]).means
        slots = assign_slots(points, codes.attributes[shown, OPACITY], quantizer.centre, options=UvOptions())
        layers = np.zeros(len(codes), np.uint8)
        layers[shown] = slots.layer + 1
        return deflated([layers])


def columns_of_band(band: int) -> slice:
    """Columns of a band of view dependence, from 1 on."""
    return slice(REST + 3 * (band**2 - 1), REST + 3 * ((band + 1) ** 2 - 1))


# Reading, as the page does


@dataclass(frozen=True)
class ReadKey:
    """A key in the order of the page's rows, the D that move first."""

    codes: Codes
    dynamic: int


def reference_of(first_part: bytes) -> int | None:
    """Segment whose key the key that begins with this part takes rows from."""
    reference = int(np.frombuffer(first_part, "<u4", 1, 12)[0])
    return None if reference == NO_REFERENCE else reference


def read_key(parts: Sequence[bytes], reference: ReadKey | None) -> ReadKey:
    """A key from all its parts, inflated, and the key that it refers to. Raises ValueError where they disagree."""
    count, dynamic, columns, _, known, size, number, _ = np.frombuffer(parts[0], "<u4", 8).tolist()
    if number != len(parts) or known != (len(reference.codes) if reference else 0):
        raise ValueError(f"a key of {number} parts, {known} rows of its reference, does not go with what is here")
    fates = np.frombuffer(parts[0], np.uint8, known, 32)
    rows = KeyRows(np.arange(count), dynamic, None, fates)
    codes = Codes(np.zeros((count, 3), np.uint16), np.zeros((count, columns), np.uint8))
    for fate, start in ((KEPT_DYNAMIC, 0), (KEPT_STILL, dynamic)):
        kept = np.flatnonzero(fates == fate)
        if reference:
            codes.xyz[start : start + len(kept)] = reference.codes.xyz[kept]
            codes.attributes[start : start + len(kept)] = reference.codes.attributes[kept]
    moving, still = rows.own
    degree = next(degree for degree in range(number) if attribute_count(degree) == columns)
    for k, (body, own) in enumerate(zip(parts, turns(moving, still, size), strict=False)):
        xyz, attributes = read_columns(body, 0 if k else 32 + known, own.stop - own.start, REST)
        codes.xyz[own], codes.attributes[own, :REST] = xyz, attributes
    own_rows = np.r_[moving, still]
    for band, body in enumerate(parts[number - degree :], 1):
        where = columns_of_band(band)
        own_columns = read_columns(body, 0, len(own_rows), where.stop - where.start, positions=False, colours=0)[1]
        codes.attributes[own_rows, where] = own_columns
    return ReadKey(codes, dynamic)


def parents_of(body: bytes, offset: int, length: int) -> tuple[int, ...]:
    """Frames of its segment, as offsets, from which a frame's body, inflated, is predicted: its parents or the key."""
    return parents(offset, length) if np.frombuffer(body, "<u4", 1, 12)[0] == 2 else (0,)


def read_frame(body: bytes, known: Sequence[Codes]) -> Codes:
    """The moving rows of a frame from its body, inflated, and the frames that `parents_of` names."""
    _, count, columns, _ = np.frombuffer(body, "<u4", 4).tolist()
    guess = guessed(known)
    xyz, attributes = read_columns(body, 16, count, columns)
    return Codes(guess.xyz + xyz, guess.attributes + attributes)
