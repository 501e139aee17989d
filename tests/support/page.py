"""The page's side of what travels, written from docs/viewer.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from packuv.gaussians.codes import Codes

Get = Callable[[str], bytes]
"""The body of an address, inflated"""


class Page:
    """Frames of a scene from its bodies."""

    def __init__(self, described: Mapping[str, Any], get: Get) -> None:
        self._get, self._columns = get, described["columns"]
        self._lengths = [(segment["first"], segment["length"]) for segment in described["segments"]]
        self.keys: dict[int, tuple[Codes, int]] = {}

    def key(self, segment: int) -> tuple[Codes, int]:
        """All rows, and how many may move."""
        if segment not in self.keys:
            self.keys[segment] = self._key(segment)
        return self.keys[segment]

    def _key(self, segment: int) -> tuple[Codes, int]:
        first = self._get(f"segments/{segment}/0.bin")
        count, dynamic, columns, reference, known, part_rows, parts, nothing = np.frombuffer(first, "<u4", 8).tolist()
        assert (columns, nothing) == (self._columns, 0)
        fates = np.frombuffer(first, np.uint8, known, 32)
        still_taken, moving_taken = (int((fates == fate).sum()) for fate in (1, 2))
        xyz, attributes = np.zeros((count, 3), np.uint16), np.zeros((count, columns), np.uint8)
        if reference != 2**32 - 1:
            before = self.key(reference)[0]
            assert len(before) == known
            for fate, start, size in ((2, 0, moving_taken), (1, dynamic, still_taken)):
                xyz[start : start + size] = before.xyz[fates == fate]
                attributes[start : start + size] = before.attributes[fates == fate]
        degree = int(((columns - 7) / 3) ** 0.5) - 1
        ranges = (moving_taken, dynamic), (dynamic + still_taken, count)
        starts = [(s, min(s + part_rows, end)) for start, end in ranges for s in range(start, end, part_rows)]
        if moving_taken == dynamic:
            starts.insert(0, (dynamic, dynamic))
        assert parts == len(starts) + degree
        for number, (start, end) in enumerate(starts):
            body = self._get(f"segments/{segment}/{number}.bin")[0 if number else 32 + known :]
            xyz[start:end], attributes[start:end, :10] = columns_of(body, end - start, 3, 10, colours=7)
        own = np.r_[moving_taken:dynamic, dynamic + still_taken : count]
        for band in range(1, degree + 1):
            body = self._get(f"segments/{segment}/{len(starts) + band - 1}.bin")
            place = slice(10 + 3 * (band**2 - 1), 10 + 3 * ((band + 1) ** 2 - 1))
            attributes[own, place] = columns_of(body, len(own), 0, 3 * (2 * band + 1), colours=0)[1]
        return Codes(xyz, attributes), dynamic

    def frame(self, frame: int) -> Codes:
        """All rows of a frame."""
        segment = max(k for k, (first, _) in enumerate(self._lengths) if first <= frame)
        key, dynamic = self.key(segment)
        moving = self._moving(segment, frame - self._lengths[segment][0])
        codes = Codes(key.xyz.copy(), key.attributes.copy())
        codes.xyz[:dynamic], codes.attributes[:dynamic] = moving.xyz, moving.attributes
        return codes

    def _moving(self, segment: int, offset: int) -> Codes:
        key, dynamic = self.key(segment)
        if offset == 0:
            return key[:dynamic]
        body = self._get(f"frames/{self._lengths[segment][0] + offset}.bin")
        number, count, columns, known = np.frombuffer(body, "<u4", 4).tolist()
        assert (number, count, columns) == (segment, dynamic, self._columns)
        before = [self._moving(segment, k) for k in (halves(offset, self._lengths[segment][1]) if known == 2 else (0,))]
        xyz, attributes = columns_of(body[16:], count, 3, columns, colours=7)
        if known == 1:
            return Codes(before[0].xyz + xyz, before[0].attributes + attributes)
        way = (before[1].xyz.astype(int) - before[0].xyz + 32768) % 65536 - 32768
        halfway = (before[0].attributes.astype(int) + before[1].attributes + 1) // 2
        guess = before[0].xyz + np.floor((way + 1) / 2).astype(int)
        return Codes(((guess + xyz) % 65536).astype(np.uint16), ((halfway + attributes) % 256).astype(np.uint8))


def halves(offset: int, length: int) -> tuple[int, int]:
    """Frames on both sides from which the one at `offset` is predicted."""
    low, high = offset // 8 * 8, min(offset // 8 * 8 + 8, length - 1)
    while (low + high) // 2 != offset:
        if offset < (low + high) // 2:
            high = (low + high) // 2
        else:
            low = (low + high) // 2
    return low, high


def columns_of(body: bytes, count: int, axes: int, columns: int, *, colours: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [count, axes] and attributes [count, columns] without their filters."""
    filters = list(body[: axes + columns])
    planes = np.frombuffer(body, np.uint8, -1, axes + columns).reshape(2 * axes + columns, count).astype(int)
    xyz, attributes = np.zeros((count, axes), int), np.zeros((count, columns), int)
    for axis in range(axes):
        folded = 256 * planes[2 * axis] + planes[2 * axis + 1]
        values = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
        xyz[:, axis] = np.cumsum(values) if filters[axis] & 1 else values
    for column in range(columns):
        values = planes[2 * axes + column]
        attributes[:, column] = np.cumsum(values) if filters[axes + column] & 1 else values
    for column in range(colours, columns):
        if filters[axes + column] & 2:
            attributes[:, column] += attributes[:, colours + (column - colours) // 3 * 3 + 1]
    return (xyz % 65536).astype(np.uint16), (attributes % 256).astype(np.uint8)


def tables_of(described: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Positions float32 [3, 65536] and attributes float32 [A, 256] that the page looks codes up in."""
    rules, positions = described["tables"], np.empty((3, 65536), np.float32)
    for axis, half in enumerate(rules["growth"]):
        power = half
        for k in range(32768):
            away = rules["unit"] * (power - 1)
            positions[axis, 32768 + k] = described["centre"][axis] + away
            positions[axis, 32767 - k] = described["centre"][axis] - away
            power *= half * half
    for axis, code, value in rules["except"]:
        positions[axis, code] = value
    steps = [[low + code * step for code in range(256)] for low, step in zip(rules["low"], rules["step"], strict=True)]
    return positions, np.array(steps, np.float32)
