"""How a camera's clock runs against the reference camera's, seen through frames that both take at once.

A camera's frame stamped t was taken at t - offset - drift * (t - origin) on the reference clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from sync.tree import merge_nearest

MOST_WINDOWS = 300
"""Theil-Sen looks at all pairs of windows, so their number is bounded."""
HUBER = 1.5
"""Residuals beyond this many standard deviations count as this many; the customary 95 % efficiency is at 1.345."""
SIGNIFICANCE = 3.0
"""An offset or a drift below this many standard errors is noise and left alone."""
WIDEST_SCATTER = 0.25
"""Frames taken independently of the reference scatter evenly over a period: by 0.37 of it in the measure used here."""
FEWEST_FRAMES = 16


class ClockMode(StrEnum):
    """What the rig promises about its clocks."""

    TRUSTED = "trusted"
    """Clocks agree (PTP, genlock with common time): differences are real and passed on as sub-frame times"""
    TRIGGERED = "triggered"
    """One trigger fires all cameras: differences are offset and drift of the clocks, and are fitted and removed"""
    CONTENT = "content"
    """Times tell only how long each camera has filmed; when it began, its pictures tell"""


class ClockState(StrEnum):
    """What became of a camera's clock."""

    REFERENCE = "reference"
    TRUSTED = "trusted"
    """Measured, not corrected"""
    CORRECTED = "corrected"
    WITHIN_NOISE = "within noise"
    """Neither offset nor drift is significant; nothing corrected"""
    FREE_RUNNING = "free-running"
    """Frames do not follow the reference's trigger; nothing corrected"""
    TOO_FEW_FRAMES = "too few frames"


@dataclass(frozen=True)
class Clock:
    """Offset and drift of a camera's clock against the reference clock, with standard errors."""

    state: ClockState
    origin_ns: int
    """Reference time at which the offset holds: the middle of the frames in common"""
    offset_ns: float = 0.0
    """Camera's time minus reference time; in triggered mode known only up to whole frame periods, see `fit_clock`"""
    offset_error_ns: float = 0.0
    drift_ppm: float = 0.0
    """Microseconds that the camera gains per second"""
    drift_error_ppm: float = 0.0
    scatter_ns: float = 0.0
    """Robust standard deviation of single frames about the fit"""

    @property
    def corrects(self) -> bool:
        """Whether `to_reference` changes anything."""
        return self.state is ClockState.CORRECTED

    def to_reference(self, times_ns: np.ndarray) -> np.ndarray:
        """Camera times to reference times, int64 [n] -> int64 [n]; the same unless the clock is corrected.

        Only the small correction goes through floating point: its error is below 1 ns for any recording up to a day.
        """
        if not self.corrects:
            return times_ns
        since = (times_ns - self.origin_ns).astype(np.float64) - self.offset_ns
        rate = self.drift_ppm * 1e-6
        return times_ns - np.rint(self.offset_ns + since * (rate / (1 + rate))).astype(np.int64)

    def to_json(self) -> dict[str, Any]:
        return {
            "state": str(self.state),
            "origin_ns": self.origin_ns,
            "offset_ns": self.offset_ns,
            "offset_error_ns": self.offset_error_ns,
            "drift_ppm": self.drift_ppm,
            "drift_error_ppm": self.drift_error_ppm,
            "scatter_ns": self.scatter_ns,
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Clock:
        return cls(**{**data, "state": ClockState(data["state"])})


def measure_clock(times_ns: np.ndarray, residuals_ns: np.ndarray) -> Clock:
    """Robust line through the residuals of matched frames, for trusted clocks: reported, never applied.

    Args:
        times_ns: int64 [n], reference times of the matched frames, in order.
        residuals_ns: int64 [n], the camera's times minus these.
    """
    if len(times_ns) < FEWEST_FRAMES:
        return Clock(ClockState.TOO_FEW_FRAMES, int(times_ns[0]) if len(times_ns) else 0)
    origin = _middle(times_ns)
    line = _robust_line((times_ns - origin).astype(np.float64), residuals_ns.astype(np.float64))
    return _clock(ClockState.TRUSTED, origin, line)


def fit_clock(reference_ns: np.ndarray, camera_ns: np.ndarray, period_ns: int) -> Clock:
    """Clock of a camera that fires with the reference, from the two cameras' timecodes alone.

    Residuals of nearest frames jump by a period whenever the drift has grown by one, so a first estimate averages
    them on the circle in short windows, unwraps, and takes the median slope of all pairs of windows (Theil-Sen). Then
    frames are matched again under the estimate, and a robust line is fitted to what is left, three times over.

    Periodic frames cannot tell a whole period of offset from none. The clocks are taken to agree within half a
    period where the two recordings first overlap; from there on the drift is followed over any number of periods.

    Args:
        reference_ns: int64 [n], strictly increasing.
        camera_ns: int64 [m], strictly increasing.
        period_ns: time between two frames.

    Returns:
        A clock that corrects nothing if the frames do not follow one trigger, are too few, or show no offset and
        drift above their noise. A drift below its noise is set to 0 and the offset fitted alone.
    """
    rough = _guess(reference_ns, camera_ns, period_ns)
    if rough is None:
        return Clock(ClockState.TOO_FEW_FRAMES, int(reference_ns[0]))
    origin, offset, drift = rough
    line = _refine(reference_ns, camera_ns, period_ns, origin, offset, drift)
    if line is None:
        return Clock(ClockState.TOO_FEW_FRAMES, origin)
    if line.scatter > WIDEST_SCATTER * period_ns:
        return _clock(ClockState.FREE_RUNNING, origin, line)
    if abs(line.drift) < SIGNIFICANCE * line.drift_error:
        level = _refine(reference_ns, camera_ns, period_ns, origin, line.offset, 0.0, level=True)
        line = line if level is None else replace(level, drift_error=line.drift_error)
    significant = line.drift != 0 or abs(line.offset) > SIGNIFICANCE * line.offset_error
    return _clock(ClockState.CORRECTED if significant else ClockState.WITHIN_NOISE, origin, line)


def guess_drift(reference_ns: np.ndarray, camera_ns: np.ndarray, period_ns: int) -> float:
    """First estimate of `fit_clock`, ns gained per ns: a hundredth of its cost. 0 for too few frames."""
    rough = _guess(reference_ns, camera_ns, period_ns)
    return 0.0 if rough is None else rough[2]


def _guess(reference_ns: np.ndarray, camera_ns: np.ndarray, period_ns: int) -> tuple[int, float, float] | None:
    """Origin, offset there and drift; None for too few frames."""
    positions, residuals = merge_nearest(camera_ns, reference_ns, period_ns)
    matched = positions >= 0
    times = reference_ns[matched]
    if len(times) < FEWEST_FRAMES:
        return None
    origin = _middle(times)
    x = (times - origin).astype(np.float64)
    return origin, *_rough_line(x, residuals[matched].astype(np.float64), period_ns)


@dataclass(frozen=True)
class _Line:
    """offset + drift * x, in ns and ns per ns."""

    offset: float
    offset_error: float
    drift: float
    drift_error: float
    scatter: float


def _clock(state: ClockState, origin: int, line: _Line) -> Clock:
    return Clock(state, origin, line.offset, line.offset_error, line.drift * 1e6, line.drift_error * 1e6, line.scatter)


def _middle(times_ns: np.ndarray) -> int:
    return int(times_ns[0]) + int(times_ns[-1] - times_ns[0]) // 2


def _windows(x: np.ndarray) -> np.ndarray:
    """Starts of about equal runs of frames: 8 or more each, at most 2 s long unless that makes too many."""
    span_s = (x[-1] - x[0]) / 1e9
    count = int(np.clip(span_s / 2, 20, MOST_WINDOWS))
    count = max(1, min(count, len(x) // 8))
    return np.arange(count) * len(x) // count


def _rough_line(x: np.ndarray, residuals: np.ndarray, period: int) -> tuple[float, float]:
    """Offset and drift from residuals that are known modulo the period only."""
    starts = _windows(x)
    counts = np.diff(starts, append=len(x))
    turns = np.add.reduceat(np.exp(2j * np.pi * residuals / period), starts)
    phases = np.unwrap(np.angle(turns) / (2 * np.pi) * period, period=period)
    middles = np.add.reduceat(x, starts) / counts
    if len(starts) < 2:
        return float(phases[0]), 0.0
    first, second = np.triu_indices(len(starts), 1)
    drift = float(np.median((phases[second] - phases[first]) / (middles[second] - middles[first])))
    return float(np.median(phases - drift * middles)), drift


def _refine(
    reference: np.ndarray,
    camera: np.ndarray,
    period: int,
    origin: int,
    offset: float,
    drift: float,
    *,
    level: bool = False,
) -> _Line | None:
    """Match under the estimate, fit what is left, add it; up to three times. None if too few frames match."""
    line = None
    for _ in range(3):
        corrected = Clock(ClockState.CORRECTED, origin, offset, drift_ppm=drift * 1e6).to_reference(camera)
        positions, residuals = merge_nearest(corrected, reference, period // 2)
        matched = positions >= 0
        if matched.sum() < FEWEST_FRAMES:
            return None
        x = (reference[matched] - origin).astype(np.float64)
        left = _robust_line(x, residuals[matched].astype(np.float64), level=level)
        offset, drift = offset + left.offset, drift + left.drift
        line = _Line(offset, left.offset_error, drift, left.drift_error, left.scatter)
        if abs(left.offset) < 0.1 * left.offset_error and abs(left.drift) <= 0.1 * left.drift_error:
            break  # the frames would be matched as they are
    return line


def _robust_line(x: np.ndarray, y: np.ndarray, *, level: bool = False) -> _Line:
    """Huber's line through [n] points, or the constant if `level`; errors allow for jitter that lasts.

    Scores are summed per window before they are squared (a cluster-robust sandwich), so jitter that is alike from
    frame to frame widens the errors as it should.
    """
    basis = np.ones((len(x), 1)) if level else np.stack([np.ones_like(x), x], axis=1)
    scale = np.abs(basis).max(axis=0)
    basis = basis / np.maximum(scale, 1)
    solution = np.zeros(basis.shape[1])
    solution[0] = np.median(y)
    for _ in range(12):
        error = y - basis @ solution
        scatter = 1.4826 * float(np.median(np.abs(error))) + 0.5  # ns; stamps are whole, so half a ns is their floor
        weight = np.minimum(1, HUBER * scatter / np.maximum(np.abs(error), 1e-9))
        weighted = basis * weight[:, None]
        step = np.linalg.lstsq(weighted.T @ basis, weighted.T @ error, rcond=None)[0]
        solution = solution + step
        if np.abs(step).max() < 0.01 * scatter / np.sqrt(len(x)):  # a hundredth of the offset's own error
            break
    error = y - basis @ solution
    errors = _standard_errors(basis, error, HUBER * scatter, _windows(x)) / np.maximum(scale, 1)
    solution = solution / np.maximum(scale, 1)
    if level:
        return _Line(float(solution[0]), float(errors[0]), 0.0, 0.0, scatter)
    return _Line(float(solution[0]), float(errors[0]), float(solution[1]), float(errors[1]), scatter)


def _standard_errors(basis: np.ndarray, error: np.ndarray, bound: float, starts: np.ndarray) -> np.ndarray:
    """Standard error of each coefficient [k] of a Huber fit, by windows that begin at `starts`.

    Stamps are rounded to whole ns, which adds 1/12 ns^2 to the variance of each.
    """
    inside = np.abs(error) <= bound
    bread = np.linalg.pinv(basis[inside].T @ basis[inside])
    scores = np.add.reduceat(basis * np.clip(error, -bound, bound)[:, None], starts, axis=0)
    windows = max(len(starts), 3)
    spread = bread @ (scores.T @ scores) @ bread * windows / (windows - 2)
    return np.sqrt(np.diag(spread) + np.diag(bread) / 12)
