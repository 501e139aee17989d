"""When each camera takes its frames, which it loses, and what it writes into its timecode file.

One trigger fires all cameras at even ticks. A camera starts some ticks late, loses frames, and stamps the others by a
clock of its own that is offset, drifts and jitters. Times are int64 nanoseconds since 1970 on the true clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

SECOND_NS = 1_000_000_000
EPOCH_NS = 1_735_732_800 * SECOND_NS
"""True time of tick 0: 2025-01-01, 12:00 UTC"""
WIDEST_JITTER = 3.0
"""Jitter is cut off at this many standard deviations, so that matching frames stays decidable"""


@dataclass(frozen=True)
class ClockOptions:
    """How the cameras' clocks and recorders err."""

    drop_share: float = 0.02
    """Share of frames that a camera loses; it always keeps its first and its last"""
    max_late_frames: int = 3
    """Cameras start up to this many ticks late; at least one starts with tick 0"""
    jitter_us: float = 300.0
    """Standard deviation of a timecode about the camera's clock, microseconds"""
    offset_us: float = 500.0
    """A camera's clock is ahead or behind by at most this, microseconds"""
    drift_ppm: float = 20.0
    """A camera's clock gains or loses at most this many microseconds a second"""
    free_running: bool = False
    """Cameras ignore the trigger: each takes its frames at a phase of its own between the ticks"""

    def __post_init__(self) -> None:
        if not 0 <= self.drop_share <= 0.5:
            raise ValueError(f"the share of dropped frames must be 0 to 0.5, but is {self.drop_share}")
        if self.max_late_frames < 0:
            raise ValueError(
                f"cameras cannot start early: max_late_frames must be 0 or more, but is {self.max_late_frames}"
            )
        for name in ("jitter_us", "offset_us", "drift_ppm"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be 0 or more, but is {getattr(self, name)}")
        if self.drift_ppm > 10_000:
            raise ValueError(f"drift_ppm must be at most 10000, or one per cent, but is {self.drift_ppm}")


@dataclass(frozen=True, eq=False)
class CameraTimes:
    """The frames that one camera recorded."""

    ticks: np.ndarray
    """int64 [n]: tick of each recorded frame, strictly increasing"""
    times_ns: np.ndarray
    """int64 [n]: true time at which it was exposed"""
    next_times_ns: np.ndarray
    """int64 [n]: true time of the camera's next recorded frame; for the last frame, of the tick that would follow"""
    stamps_ns: np.ndarray
    """int64 [n]: what the timecode file says, whole microseconds"""
    dropped: np.ndarray
    """int64: ticks after the camera's start that it lost"""
    first_index: int
    """Frame counter of the first recorded frame; the counter runs on over lost frames"""
    offset_ns: int
    """The camera's clock minus the true clock at tick 0"""
    drift_ppm: float
    phase_ns: int
    """Exposure after the tick; 0 unless the cameras run free"""


def tick_times(count: int, fps: Fraction) -> np.ndarray:
    """True times of ticks 0 to count - 1, int64 [count], rounded down to whole nanoseconds."""
    return np.array([EPOCH_NS + tick * SECOND_NS * fps.denominator // fps.numerator for tick in range(count)], np.int64)


def record(cameras: int, frames: int, fps: Fraction, seed: int, options: ClockOptions) -> tuple[CameraTimes, ...]:
    """What each camera records of `frames` ticks.

    Raises:
        ValueError: a camera could start too late to record two frames, or clocks err by so much that a frame's tick
            could not be told from its timecode.
    """
    if options.max_late_frames > frames - 2:
        raise ValueError(
            f"a camera that starts {options.max_late_frames} frames late records fewer than two of {frames}; "
            "use more frames or a smaller max_late_frames"
        )
    worst_us, half_us = options.offset_us + WIDEST_JITTER * options.jitter_us, float(500_000 / fps)
    if worst_us >= half_us:
        raise ValueError(
            f"offset_us + 3 jitter_us must stay below half a frame, {half_us:.0f} us at {fps} frames per second, "
            f"but is {worst_us:.0f} us"
        )
    rng = np.random.default_rng([seed, 4])
    late = rng.integers(0, options.max_late_frames + 1, cameras)
    late[rng.integers(cameras)] = 0
    return tuple(
        _record_one(int(late[camera]), frames, fps, np.random.default_rng([seed, 5, camera]), options)
        for camera in range(cameras)
    )


def timecode_lines(times: CameraTimes) -> list[str]:
    """Lines of a timecode file, `frame_<epoch microseconds>_<12-digit counter>`."""
    return [
        f"frame_{stamp // 1000}_{times.first_index + place:012d}"
        for place, stamp in enumerate(times.stamps_ns.tolist())
    ]


def _record_one(late: int, frames: int, fps: Fraction, rng: np.random.Generator, options: ClockOptions) -> CameraTimes:
    offset_ns = round(1000 * rng.uniform(-1, 1) * options.offset_us)
    drift_ppm = float(rng.uniform(-1, 1) * options.drift_ppm)
    phase_ns = int(rng.uniform(0, 1) * SECOND_NS / fps) if options.free_running else 0
    first_index = int(rng.integers(100, 5000))
    lost = rng.uniform(0, 1, frames) < options.drop_share
    lost[[late, frames - 1]] = False
    noise = np.clip(rng.normal(size=frames), -WIDEST_JITTER, WIDEST_JITTER) * 1000 * options.jitter_us
    ticks = np.flatnonzero(~lost & (np.arange(frames) >= late)).astype(np.int64)
    times = tick_times(frames + 1, fps) + phase_ns
    return CameraTimes(
        ticks=ticks,
        times_ns=times[ticks],
        next_times_ns=np.append(times[ticks[1:]], times[frames]),
        stamps_ns=_stamps(times[ticks], offset_ns, drift_ppm, noise[ticks]),
        dropped=np.flatnonzero(lost & (np.arange(frames) >= late)).astype(np.int64),
        first_index=first_index,
        offset_ns=offset_ns,
        drift_ppm=drift_ppm,
        phase_ns=phase_ns,
    )


def _stamps(times_ns: np.ndarray, offset_ns: int, drift_ppm: float, noise_ns: np.ndarray) -> np.ndarray:
    """What the camera's clock shows, rounded to microseconds, int64; only small differences pass through float."""
    error = offset_ns + (times_ns - EPOCH_NS).astype(np.float64) * (drift_ppm * 1e-6) + noise_ns
    stamps: np.ndarray = times_ns + np.rint(error).astype(np.int64)
    return (stamps + 500) // 1000 * 1000
