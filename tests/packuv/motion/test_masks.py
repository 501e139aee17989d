"""Masks by kernels against plain twins: OpenCV's components, NumPy's median and arithmetic."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from packuv.motion.masks import beyond, change, connected, filled

PLANES = st.tuples(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))


def plain_connected(low: np.ndarray, high: np.ndarray, least_area: int) -> np.ndarray:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(low.astype(np.uint8), connectivity=8)
    keep = np.zeros(count, dtype=bool)
    keep[labels[high]] = True
    keep &= stats[:, cv2.CC_STAT_AREA] >= least_area
    keep[0] = False
    return keep[labels]


def plain_filled(outline: np.ndarray, moving: np.ndarray, hole_share: float) -> np.ndarray:
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~outline).astype(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    inside = (np.bincount(labels[moving], minlength=count) > 0.5 * area) & (area <= hole_share * outline.size)
    inside[0] = True
    return inside[labels]


@given(PLANES, st.integers(1, 30))
def test_components_that_count_are_those_of_opencv(plane, least_area):
    height, width, seed, share = plane
    rng = np.random.default_rng(seed)
    low = rng.random((height, width)) < share
    high = low & (rng.random((height, width)) < 0.1)
    assert np.array_equal(connected(low, high, least_area), plain_connected(low, high, least_area))


@given(PLANES, st.sampled_from([0.01, 0.1, 1.0]))
def test_holes_that_are_filled_are_those_of_opencv(plane, hole_share):
    height, width, seed, share = plane
    rng = np.random.default_rng(seed)
    outline, moving = rng.random((height, width)) < share, rng.random((height, width)) < 0.6
    given_outline = outline.copy()
    assert np.array_equal(filled(outline, moving, hole_share), plain_filled(outline, moving, hole_share))
    assert np.array_equal(outline, given_outline)


@given(PLANES)
def test_a_change_is_what_differs_from_the_median_change(plane):
    height, width, seed, share = plane
    rng = np.random.default_rng(seed)
    before, after = rng.integers(0, 1 + int(255 * share), (2, height, width), dtype=np.uint8)
    difference = after.astype(np.float32) - before
    difference -= np.median(difference[::2, ::2])
    assert np.array_equal(change(before, after), difference)
    assert not change(before, before).any()


@given(PLANES)
def test_the_noise_that_a_change_must_exceed_grows_with_the_slope(plane):
    height, width, seed, _ = plane
    rng = np.random.default_rng(seed)
    size = rng.exponential(3, (height, width)).astype(np.float32)
    across, down = (rng.integers(-1020, 1021, (2, height, width)) / 8).astype(np.float32)  # as Sobel's are
    score = size / (0.9 + 0.02 * np.hypot(across, down))
    low, high = beyond(size, across, down, noise=0.9, low=2.0, high=6.0)
    assert np.array_equal(low, score > 2)
    assert np.array_equal(high, score > 6)
