"""Chains of matches through several pictures: one scene point's features, at most one in each camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Link:
    """Matches between two cameras, by index into the rig's cameras and the pictures' places."""

    first: int
    second: int
    places: np.ndarray
    """int32 [K, 2], `Features.places` in first and second"""
    distances: np.ndarray
    """float32 [K], squared descriptor distances; near ones are linked first"""


def chain(links: Sequence[Link], place_counts: Mapping[int, int], *, min_views: int) -> tuple[np.ndarray, ...]:
    """Tracks of at least `min_views` cameras: point, camera, place, int32 [M] each, sorted by point and camera.

    Matches join in order of distance, and one that would give a track two features of a camera is left out, so every
    track has each camera at most once. Costs O(matches log matches).
    """
    starts = _starts(place_counts)
    ends = [
        (distance, starts[link.first] + first, starts[link.second] + second)
        for link in links
        for (first, second), distance in zip(link.places.tolist(), link.distances.tolist(), strict=True)
    ]
    forest = _Forest(starts, place_counts)
    for _, first, second in sorted(ends):
        forest.join(first, second)
    return forest.tracks(min_views)


def _starts(place_counts: Mapping[int, int]) -> dict[int, int]:
    """Node number of each camera's first place."""
    starts, total = {}, 0
    for camera, count in sorted(place_counts.items()):
        starts[camera], total = total, total + count
    return starts


class _Forest:
    """Disjoint sets of places; each root knows its cameras as a bit mask."""

    def __init__(self, starts: Mapping[int, int], place_counts: Mapping[int, int]) -> None:
        self._camera = np.repeat(list(starts), [place_counts[camera] for camera in starts]).astype(np.int32)
        places = [np.arange(place_counts[camera], dtype=np.int32) for camera in starts]
        self._place = np.concatenate([np.empty(0, np.int32), *places])
        self._parent = list(range(len(self._camera)))
        self._seen_by = [1 << camera for camera in self._camera.tolist()]

    def root(self, node: int) -> int:
        while self._parent[node] != node:
            self._parent[node] = self._parent[self._parent[node]]
            node = self._parent[node]
        return node

    def join(self, first: int, second: int) -> None:
        a, b = sorted((self.root(first), self.root(second)))
        if a != b and not self._seen_by[a] & self._seen_by[b]:
            self._parent[b] = a
            self._seen_by[a] |= self._seen_by[b]

    def tracks(self, min_views: int) -> tuple[np.ndarray, ...]:
        roots = np.array([self.root(node) for node in range(len(self._parent))], dtype=np.int64)
        _, inverse, counts = np.unique(roots, return_inverse=True, return_counts=True)
        kept = np.flatnonzero(counts[inverse] >= min_views)
        kept = kept[np.lexsort((self._camera[kept], inverse[kept]))]
        point = np.unique(inverse[kept], return_inverse=True)[1].astype(np.int32)
        return point, self._camera[kept], self._place[kept]
