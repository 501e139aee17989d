"""Invariants of keyframes and segments, and the peaks against a naive twin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from packuv.motion.keyframes import (
    Keyframe,
    KeyframeOptions,
    Reason,
    _peaks,
    choose_keyframes,
    fitting_order,
    motion_curve,
    promoted,
    running_mean,
    segments,
)

curves = st.lists(st.integers(0, 12), min_size=1, max_size=200).map(lambda v: np.array(v, dtype=np.float64))


@st.composite
def options(draw: st.DrawFn) -> KeyframeOptions:
    separation = draw(st.integers(1, 20))
    return KeyframeOptions(
        separation=separation,
        max_segment=2 * separation - 1 + draw(st.integers(0, 30)),
        peaks=draw(st.none() | st.integers(0, 5)),
        prominence=draw(st.sampled_from([0.0, 0.1, 0.5])),
    )


@given(curves, options())
def test_keyframes_keep_their_distances(curve: np.ndarray, chosen: KeyframeOptions) -> None:
    keyframes = choose_keyframes(curve, chosen)
    parts = segments(keyframes, len(curve))
    assert [instant for part in parts for instant in part] == list(range(len(curve)))
    assert keyframes[0] == Keyframe(0, Reason.START)
    assert all(keyframe.reason is not Reason.START for keyframe in keyframes[1:])
    assert all(len(part) >= chosen.separation for part in parts[:-1])
    if curve.any():
        assert max(map(len, parts)) <= chosen.max_segment
    else:
        assert len(keyframes) == 1
    peaks = [k.instant for k in keyframes if k.reason is Reason.PEAK]
    assert chosen.peaks is None or len(peaks) <= chosen.peaks
    assert all(curve[p - 1] < curve[p] for p in peaks)


@given(curves, options())
def test_no_peak_left_out_is_higher_than_all_in_its_way(curve: np.ndarray, chosen: KeyframeOptions) -> None:
    keyframes = choose_keyframes(curve, chosen)
    taken = [k.instant for k in keyframes if k.reason is not Reason.SPLIT]
    if chosen.peaks is not None and len(taken) > chosen.peaks:
        return
    for peak in _peaks(curve, chosen.prominence * curve.max()):
        near = [other for other in taken if abs(other - peak) < chosen.separation]
        assert near, f"peak {peak} was free to be taken"
        assert 0 in near or max(curve[near]) >= curve[peak]


def naive_peaks(curve: np.ndarray, prominence: float) -> set[int]:
    """Prominence by its definition: the way down before one may climb higher, on the shallower side."""
    found = set()
    for i in range(1, len(curve) - 1):
        after = next((j for j in range(i, len(curve)) if curve[j] != curve[i]), None)
        if curve[i - 1] >= curve[i] or after is None or curve[after] > curve[i]:
            continue
        left = next((j for j in range(i, -1, -1) if curve[j] > curve[i]), 0)
        right = next((j for j in range(i, len(curve)) if curve[j] > curve[i]), len(curve) - 1)
        valley = max(curve[left : i + 1].min(), curve[i : right + 1].min())
        if curve[i] - valley >= prominence:
            found.add(i)
    return found


@given(curves, st.integers(1, 12))
def test_peaks_equal_their_definition(curve: np.ndarray, prominence: int) -> None:
    peaks = _peaks(curve, prominence)
    assert set(peaks) == naive_peaks(curve, prominence)
    assert [(-curve[p], p) for p in peaks] == sorted((-curve[p], p) for p in peaks)


@given(curves, st.sampled_from([1, 3, 5, 9]))
def test_running_mean_is_the_mean_of_what_is_there(curve: np.ndarray, width: int) -> None:
    half = width // 2
    naive = [curve[max(0, t - half) : t + half + 1].mean() for t in range(len(curve))]
    assert np.allclose(running_mean(curve, width), naive, rtol=1e-12)


def test_a_known_curve() -> None:
    """Two bursts of motion and a small one, far enough apart."""
    t = np.arange(300)
    curve = sum(h * np.exp(-(((t - c) / 6) ** 2)) for h, c in ((3.0, 70), (2.0, 150), (1.5, 165), (0.1, 230)))
    found = choose_keyframes(np.asarray(curve), KeyframeOptions(max_segment=100))
    assert [(k.instant, k.reason.value) for k in found] == [(0, "start"), (70, "peak"), (150, "peak"), (225, "split")]
    single = choose_keyframes(np.asarray(curve), KeyframeOptions(max_segment=300, peaks=1))
    assert [k.instant for k in single] == [0, 70]


def test_stillness_needs_one_keyframe_and_steady_motion_is_split() -> None:
    assert choose_keyframes(np.zeros(500), KeyframeOptions()) == [Keyframe(0, Reason.START)]
    steady = choose_keyframes(np.ones(181), KeyframeOptions())
    assert [k.instant for k in steady] == [0, 45, 90, 135]
    assert {k.reason for k in steady[1:]} == {Reason.SPLIT}
    assert choose_keyframes(np.ones(1), KeyframeOptions()) == [Keyframe(0, Reason.START)]


def test_the_curve_is_the_median_of_cameras_with_a_step() -> None:
    nan = np.nan
    magnitude = np.array([[nan, nan, nan], [1, 2, 9], [nan, 4, 6], [nan, nan, nan], [3, 3, nan]])
    plain = KeyframeOptions(smoothing=1)
    assert motion_curve(magnitude, "abc", plain).tolist() == [2, 2, 5, 4, 3]
    one = KeyframeOptions(smoothing=1, camera="c")
    assert motion_curve(magnitude, "abc", one).tolist() == [9, 9, 6, 6, 6]
    assert motion_curve(np.full((4, 2), nan), "ab", plain).tolist() == [0, 0, 0, 0]


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="max_segment must be at least 2"):
        KeyframeOptions(separation=30, max_segment=58)
    with pytest.raises(ValueError, match="smoothing must be odd"):
        KeyframeOptions(smoothing=4)
    with pytest.raises(ValueError, match="no camera 'z'"):
        motion_curve(np.zeros((3, 1)), "a", KeyframeOptions(camera="z"))
    with pytest.raises(ValueError, match=r"magnitudes must be \[T, 2\]"):
        motion_curve(np.zeros((3, 1)), "ab", KeyframeOptions())
    with pytest.raises(ValueError, match="must be finite"):
        choose_keyframes(np.array([0.0, np.nan]), KeyframeOptions())
    with pytest.raises(ValueError, match="must ascend from 0"):
        segments([Keyframe(3, Reason.START)], 5)


def test_the_chain_starts_where_most_cameras_filmed_and_reaches_every_keyframe_once():
    assert fitting_order([4]) == (0, [])
    assert fitting_order([4, 4, 4]) == (0, [(1, 0), (2, 1)])
    anchor, steps = fitting_order([3, 5, 8, 8, 2])
    assert anchor == 2
    known = {anchor}
    for index, start in steps:
        assert start in known
        assert abs(index - start) == 1
        known.add(index)
    assert known == set(range(5))


def test_a_frame_far_above_its_segments_first_ones_is_promoted():
    options = KeyframeOptions(separation=8, max_segment=20, promotion=1.5)
    calm = [1.0, 1.1, 0.9, 1.0, 1.2, 1.0, 1.1, 1.0, 1.0, 1.0]
    assert promoted(calm, options) is None
    assert promoted([*calm[:6], 1.6, 2.0, *calm[8:]], options) == 7  # frame 0 is the keyframe
    assert promoted([*calm[:6], 1.6, 2.0, *calm[8:]], replace(options, promotion=0)) is None
    assert promoted([9.0, *calm[1:]], options) is None  # too near to the keyframe
    assert promoted([*calm[:-1], 9.0], options) is None  # too near to the end
    assert promoted([], options) is None


@given(st.lists(st.one_of(st.just(math.nan), st.floats(0, 10)), max_size=60), st.integers(2, 20))
def test_a_promoted_frame_leaves_two_long_parts(losses, separation):
    frame = promoted(losses, KeyframeOptions(separation=separation, max_segment=40))
    assert frame is None or separation // 2 <= frame <= len(losses) + 1 - separation // 2
