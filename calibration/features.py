"""SIFT features of a picture and their matches between two pictures.

Descriptors are whole numbers and distances exact, so the same pictures give the same matches on every machine that
finds the same features.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import TypeVar

import cv2
import numpy as np
from numba import njit

_FAR = 2**30
_BLOCK = 256
"""Features whose distances to all of another picture are held at a time, 4 MB"""
Item = TypeVar("Item")
Result = TypeVar("Result")
_LENGTH = 512.0
"""Norm of a descriptor before rounding to int16"""


@dataclass(frozen=True)
class FeatureOptions:
    """How many features a picture gives."""

    max_features: int = 4096
    """The strongest are kept; matching costs its square"""
    contrast: float = 0.005
    """SIFT's contrast threshold; with the usual 0.04 plain studio walls give a fifth of the features"""

    def __post_init__(self) -> None:
        if self.max_features < 8 or not 0 < self.contrast < 1:
            raise ValueError(
                f"max_features must be at least 8 and contrast in (0, 1), not {self.max_features} and {self.contrast}"
            )


@dataclass(frozen=True)
class Features:
    """Features of one picture, sorted by place."""

    pixels: np.ndarray
    """float64 [N, 2], the distorted picture; the top-left pixel's centre is (0.5, 0.5)"""
    descriptors: np.ndarray
    """int16 [N, 128], square roots of SIFT's histogram (RootSIFT)"""
    places: np.ndarray
    """int32 [N]; features that differ only in orientation share one"""
    sizes: np.ndarray
    """float32 [N], diameter in pixels"""

    def largest(self, count: int) -> Features:
        """The `count` features of greatest diameter, which are most likely to be found again."""
        kept = np.sort(np.argsort(-self.sizes, kind="stable")[:count])
        return Features(self.pixels[kept], self.descriptors[kept], self.places[kept], self.sizes[kept])


def detect(picture: np.ndarray, *, options: FeatureOptions = FeatureOptions()) -> Features:
    """Features of an RGB picture, uint8 [H, W, 3]; the same picture gives the same bytes."""
    # Without the precise upscale OpenCV places every feature a quarter of a pixel to the lower right.
    sift = cv2.SIFT.create(
        nfeatures=options.max_features, contrastThreshold=options.contrast, enable_precise_upscale=True
    )
    keypoints, histograms = sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.int16), np.zeros(0, np.int32), np.zeros(0, np.float32))
    place = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
    rest = np.array([(keypoint.size, keypoint.angle) for keypoint in keypoints])
    order = np.lexsort((rest[:, 1], rest[:, 0], place[:, 1], place[:, 0]))  # OpenCV's threads leave no fixed order
    places = np.unique(place[order], axis=0, return_inverse=True)[1].astype(np.int32)
    return Features(place[order] + 0.5, _rooted(histograms[order]), places, rest[order, 0].astype(np.float32))


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`work` on each item, in order, by as many threads as OpenCV may use: what a job is given."""
    with ThreadPoolExecutor(max(1, cv2.getNumThreads())) as pool:
        return list(pool.map(work, items))


@dataclass(frozen=True)
class Band:
    """What epipolar geometry allows: a feature of the second picture near the line of one in the first, and back."""

    lines: np.ndarray
    """float64 [N, 3], for each feature of the first picture, the line in the second"""
    rays: np.ndarray
    """float64 [M, 3], for each feature of the second picture, (x, y, 1) in the lines' coordinates"""
    first_reach: np.ndarray
    """float64 [N], greatest |line . ray| that counts as near the line in the second picture"""
    second_reach: np.ndarray
    """float64 [M], the same for the line in the first picture"""


def match(
    first: Features,
    second: Features,
    *,
    ratio: float,
    band: Band | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # int32 [K, 2], indices into first and second; int32 [K], squared distances
    """Mutual nearest neighbours whose runner-up, in both directions, is at least 1 / ratio times as far.

    With a band, only pairs inside it compete. Costs 4 ns for each pair without a band.
    """
    if not len(first.pixels) or not len(second.pixels):
        return np.zeros((0, 2), np.int32), np.zeros(0, np.int32)
    descriptors = first.descriptors, second.descriptors
    if band is None:
        rows, columns = _all_rivals(*descriptors)
    else:
        rows, columns = _rivals(*descriptors, band.lines, band.rays, band.first_reach, band.second_reach)
    ahead, back = rows[:, 0], columns[:, 0]
    index = np.arange(len(rows))
    clear = (rows[:, 1] < ratio**2 * rows[:, 2]) & (columns[ahead, 1] < ratio**2 * columns[ahead, 2])
    kept = (ahead >= 0) & (back[ahead] == index) & clear
    return np.stack([index[kept], ahead[kept]], axis=1).astype(np.int32), rows[kept, 1]


def pairs_by_look(
    features: Mapping[str, Features], *, ratio: float, exhaustive: int = 40, partners: int = 12, probes: int = 256
) -> list[tuple[str, str]]:
    """Pairs of pictures worth matching when no poses are known, in the order of `features`.

    Up to `exhaustive` pictures all pairs; beyond that, for each picture the `partners` with which its `probes` largest
    features match most often.
    """
    names = list(features)
    if len(names) <= exhaustive:
        return list(combinations(names, 2))
    few = [features[name].largest(probes) for name in names]
    votes = np.zeros((len(names), len(names)), np.int64)
    for a, b in combinations(range(len(names)), 2):
        votes[a, b] = votes[b, a] = len(match(few[a], few[b], ratio=ratio)[0])
    best = np.argsort(-votes, axis=1, kind="stable")[:, :partners]
    chosen = {(min(a, b), max(a, b)) for a, row in enumerate(best) for b in row.tolist() if votes[a, b] > 0}
    return [(names[a], names[b]) for a, b in sorted(chosen)]


def _rooted(histograms: np.ndarray) -> np.ndarray:
    sums = np.maximum(histograms.sum(axis=1, keepdims=True), 1e-9)
    rooted: np.ndarray = np.rint(np.sqrt(histograms / sums) * _LENGTH).astype(np.int16)
    return rooted


def _all_rivals(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `_rivals` returns where every pair competes."""
    mine, others = (np.square(side.astype(np.int64)).sum(axis=1) for side in (first, second))
    # Sums of whole numbers are exact in any order as long as none can leave the mantissa (Cauchy and Schwarz).
    exact = np.float32 if mine.max() * others.max() < 2**48 else np.float64
    a, b = first.astype(exact), np.ascontiguousarray(second.astype(exact).T)
    rows, columns = _nobody(len(first)), _nobody(len(second))
    for start in range(0, len(first), _BLOCK):
        _compete(a[start : start + _BLOCK] @ b, start, mine, others, rows, columns)
    return rows, columns


def _nobody(count: int) -> np.ndarray:
    rivals = np.full((count, 3), _FAR, np.int32)
    rivals[:, 0] = -1
    return rivals


@njit(cache=True, error_model="numpy", nogil=True)
def _compete(dots, start, first_squares, second_squares, rows, columns):  # type: ignore[no-untyped-def]
    """Enter the distances of features from `start` on of the first picture to all of the second."""
    for i in range(len(dots)):
        for j in range(dots.shape[1]):
            distance = np.int32(first_squares[start + i] + second_squares[j] - 2 * np.int64(dots[i, j]))
            _enter(rows, start + i, distance, j)
            _enter(columns, j, distance, start + i)


@njit(cache=True, error_model="numpy", nogil=True)
def _enter(rivals, one, distance, other):  # type: ignore[no-untyped-def]
    """Put a distance among the two least."""
    if distance < rivals[one, 1]:
        rivals[one, 2], rivals[one, 1], rivals[one, 0] = rivals[one, 1], distance, other
    elif distance < rivals[one, 2]:
        rivals[one, 2] = distance


@njit(cache=True, error_model="numpy", nogil=True)
def _rivals(
    first: np.ndarray,
    second: np.ndarray,
    lines: np.ndarray,
    rays: np.ndarray,
    first_reach: np.ndarray,
    second_reach: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """For each feature: index of its nearest in the other picture (-1 for none), squared distances of the two nearest.

    Returns int32 [N, 3] and [M, 3]. A tie goes to the lower index. Descriptors have about the same norm, but their
    squares are summed all the same, because rounding moves it by a fraction of a percent.
    """
    rows = np.full((len(first), 3), _FAR, np.int32)
    columns = np.full((len(second), 3), _FAR, np.int32)
    rows[:, 0], columns[:, 0] = -1, -1
    squares = np.zeros(len(second), np.int32)
    for j in range(len(second)):
        for k in range(128):
            squares[j] += np.int32(second[j, k]) * np.int32(second[j, k])
    for i in range(len(first)):
        square = np.int32(0)
        for k in range(128):
            square += np.int32(first[i, k]) * np.int32(first[i, k])
        for j in range(len(second)):
            offset = abs(lines[i, 0] * rays[j, 0] + lines[i, 1] * rays[j, 1] + lines[i, 2] * rays[j, 2])
            if offset > first_reach[i] or offset > second_reach[j]:
                continue
            dot = np.int32(0)
            for k in range(128):
                dot += np.int32(first[i, k]) * np.int32(second[j, k])
            distance = square + squares[j] - 2 * dot
            if distance < rows[i, 1]:
                rows[i, 2], rows[i, 1], rows[i, 0] = rows[i, 1], distance, j
            elif distance < rows[i, 2]:
                rows[i, 2] = distance
            if distance < columns[j, 1]:
                columns[j, 2], columns[j, 1], columns[j, 0] = columns[j, 1], distance, i
            elif distance < columns[j, 2]:
                columns[j, 2] = distance
    return rows, columns
