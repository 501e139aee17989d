"""Where a sequence is cut into segments (paper §4.2.1 and appendix "Video Keyframing").

M(t) is the mean magnitude of optical flow. Its highest peaks with a minimum separation become keyframes, because there
a model carried on from frame to frame would drift most. The paper reads one camera; the median over all cameras also
sees what that one does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from sortedcontainers import SortedList


class Reason(StrEnum):
    """Why an instant is a keyframe."""

    START = "start"
    DATE = "date"
    """Something changes for good, see `packuv.motion.patches`"""
    PEAK = "peak"
    SPLIT = "split"
    """It halves (or thirds, ...) a stretch without a peak that is longer than `max_segment`"""


@dataclass(frozen=True)
class Keyframe:
    """The first instant of a segment."""

    instant: int
    reason: Reason


@dataclass(frozen=True)
class KeyframeOptions:
    """How segments are cut. Lengths are instants."""

    camera: str | None = None
    """Take M(t) from this camera, as the paper does; None: the median over all"""
    smoothing: int = 5
    """Width of the running mean before peaks are sought: two methods of optical flow agree on few of the raw peaks"""
    separation: int = 30
    """Least distance between keyframes (the paper's theta)"""
    max_segment: int = 60
    """Longest segment: the quality of a chain of frames falls with its length"""
    peaks: int | None = None
    """At most this many peaks, the highest (the paper's m - 1); None: all that stand out"""
    prominence: float = 0.1
    """How far a peak must rise above the valleys on its sides, share of the highest M(t)"""
    promotion: float = 1.6
    """A frame whose loss after its fit exceeds that of its segment's first half `separation` of frames by this factor
    becomes a keyframe: something came into view, or the chain has drifted; 0: never"""
    seam: float = 1.6
    """A border between segments that flickers more than this times what the segment before it does is mended: the later
    segment is fitted again from the end of the earlier one, after it instead of beside it; 0: never"""

    def __post_init__(self) -> None:
        for name, factor in (("promotion", self.promotion), ("seam", self.seam)):
            if factor != 0 and not factor > 1:
                raise ValueError(f"{name} must be a factor above 1, or 0 for never, but is {factor}")
        if self.smoothing < 1 or self.smoothing % 2 == 0 or self.separation < 1 or (self.peaks or 0) < 0:
            raise ValueError(
                "smoothing must be odd and positive, separation positive and peaks not negative, but they are "
                f"{self.smoothing}, {self.separation} and {self.peaks}"
            )
        if self.max_segment < 2 * self.separation - 1:
            raise ValueError(
                f"max_segment must be at least 2 * separation - 1 = {2 * self.separation - 1}, or halves of a segment "
                f"come closer than {self.separation}, but is {self.max_segment}"
            )
        if not 0 <= self.prominence <= 1:
            raise ValueError(f"prominence is a share from 0 to 1, not {self.prominence}")


def motion_curve(magnitude: np.ndarray, names: Sequence[str], options: KeyframeOptions) -> np.ndarray:
    """M(t), float64 [T], from the magnitudes [T, C] of cameras `names`, smoothed.

    NaN marks cameras without a step to an instant; where no camera has one, M is interpolated in time, and 0 if none
    has any.
    """
    if magnitude.ndim != 2 or magnitude.shape[1] != len(names) or not magnitude.size:
        raise ValueError(f"magnitudes must be [T, {len(names)}] for {len(names)} cameras, but are {magnitude.shape}")
    if options.camera is not None and options.camera not in names:
        raise ValueError(f"no camera {options.camera!r} to take M(t) from; there are {', '.join(names)}")
    columns = magnitude if options.camera is None else magnitude[:, [list(names).index(options.camera)]]
    known = np.isfinite(columns).any(axis=1)
    if not known.any():
        return np.zeros(len(magnitude))
    curve = np.interp(np.arange(len(columns)), np.flatnonzero(known), np.nanmedian(columns[known], axis=1))
    return running_mean(curve, options.smoothing)


def running_mean(values: np.ndarray, width: int) -> np.ndarray:
    """Mean over the `width` (odd) values around each, fewer at the ends: float64 [T]."""
    half, inner = width // 2, slice(width // 2, width // 2 + len(values))
    # Sums of each window on its own, not differences of a running sum: a still stretch stays exactly 0.
    sums = np.convolve(values.astype(np.float64), np.ones(2 * half + 1))[inner]
    return sums / np.convolve(np.ones(len(values)), np.ones(2 * half + 1))[inner]


def choose_keyframes(curve: np.ndarray, options: KeyframeOptions, dates: Sequence[int] = ()) -> list[Keyframe]:
    """Keyframes of a motion curve, ascending; instant 0 is always the first, and each of the `dates` is one.

    Peaks are taken from the highest down (of equals the earlier), if they keep `separation` from all before; then
    stretches longer than `max_segment` are divided evenly. Without any motion there is one keyframe, and one a date.
    """
    if curve.ndim != 1 or not len(curve) or not (np.isfinite(curve).all() and (curve >= 0).all()):
        raise ValueError(f"a motion curve must be finite, not negative and not empty, but is {curve.shape}: {curve}")
    if any(not 0 < date < len(curve) for date in dates):
        raise ValueError(f"dates must lie after instant 0 and before {len(curve)}, but are {list(dates)}")
    fixed = [Keyframe(0, Reason.START), *(Keyframe(date, Reason.DATE) for date in sorted(dates))]
    if not curve.any():
        return fixed
    chosen, peaks = SortedList(keyframe.instant for keyframe in fixed), list[Keyframe]()
    for peak in _peaks(curve, options.prominence * curve.max()):
        if options.peaks is not None and len(peaks) >= options.peaks:
            break
        near = chosen.irange(peak - options.separation, peak + options.separation, inclusive=(False, False))
        if next(near, None) is None:
            chosen.add(peak)
            peaks.append(Keyframe(peak, Reason.PEAK))
    splits = [Keyframe(instant, Reason.SPLIT) for instant in _splits(chosen, len(curve), options.max_segment)]
    return sorted([*fixed, *peaks, *splits], key=lambda keyframe: keyframe.instant)


def segments(keyframes: Sequence[Keyframe], count: int) -> list[range]:
    """Instants of each segment, half-open, from its keyframe to the next; together they are range(count)."""
    starts = [keyframe.instant for keyframe in keyframes]
    if not starts or starts[0] != 0 or starts[-1] >= count or any(np.diff(starts) <= 0):
        raise ValueError(f"keyframes must ascend from 0 and stay below {count}, but are {starts}")
    return [range(first, last) for first, last in zip(starts, [*starts[1:], count], strict=True)]


def promoted(losses: Sequence[float], options: KeyframeOptions) -> int | None:
    """The first frame of a fitted segment that should start one of its own, or None.

    `losses` are those of the frames after the keyframe, NaN where nothing moved; frames count from the keyframe, 0.
    Both parts keep at least half of `separation`.
    """
    least = max(1, options.separation // 2)
    values = np.asarray(losses, dtype=np.float64)
    usual = values[:least][np.isfinite(values[:least])]
    if not options.promotion or not len(usual):
        return None
    high = np.flatnonzero(values > options.promotion * np.median(usual)) + 1
    high = high[(high >= least) & (high <= len(values) + 1 - least)]
    return int(high[0]) if len(high) else None


def fitting_order(pictures: Sequence[int]) -> tuple[int, list[tuple[int, int]]]:
    """Without a backdrop: the keyframe that is fitted first, and then each of the others with the one that it is
    fitted from.

    `pictures` counts the cameras that filmed each keyframe. The chain starts where most did, at the first of equals,
    because what a camera shows of the still part of a scene must be known before that part is kept; from there it
    goes to both ends.

    >>> fitting_order([8, 9, 9])
    (1, [(2, 1), (0, 1)])
    """
    anchor = max(range(len(pictures)), key=lambda index: (pictures[index], -index))
    later = [(index, index - 1) for index in range(anchor + 1, len(pictures))]
    earlier = [(index, index + 1) for index in range(anchor - 1, -1, -1)]
    return anchor, [*later, *earlier]


def _peaks(curve: np.ndarray, prominence: float) -> list[int]:
    """Local maxima that stand out, the highest first. Of a plateau the first instant counts; the ends are no peaks."""
    starts = np.flatnonzero(np.diff(curve, prepend=np.nan) != 0)  # of runs of equal values
    runs = curve[starts]
    inner = (runs[1:-1] > runs[:-2]) & (runs[1:-1] > runs[2:])
    valleys = np.maximum(_valleys(runs), _valleys(runs[::-1])[::-1])
    candidates = np.flatnonzero(inner) + 1
    candidates = candidates[runs[candidates] - valleys[candidates] >= prominence]
    return [int(starts[index]) for index in sorted(candidates, key=lambda index: (-runs[index], index))]


def _valleys(values: np.ndarray) -> np.ndarray:
    """The lowest value between each one and the last higher one before it, or the start: float64 [n]."""
    rising: list[tuple[float, float]] = []  # value, and the lowest since the one below it on the stack
    lowest = np.empty(len(values))
    for index, value in enumerate(values):
        low = value
        while rising and rising[-1][0] <= value:
            low = min(low, rising.pop()[1])
        rising.append((value, low))
        lowest[index] = low
    return lowest


def _splits(starts: Sequence[int], count: int, max_segment: int) -> list[int]:
    """Instants that divide each stretch between starts, and up to the end, evenly into pieces of `max_segment`."""
    found = []
    for first, last in zip(starts, [*starts[1:], count], strict=True):
        pieces = -(-(last - first) // max_segment)
        found += [first + (last - first) * piece // pieces for piece in range(1, pieces)]
    return found
