"""Offset and drift of clocks, against clocks that were made up."""

from fractions import Fraction

import numpy as np
import pytest

from sync.clock import Clock, ClockState, fit_clock, measure_clock
from sync.tree import merge_nearest

EPOCH = 1734551081929245000


def exposures(rng: np.random.Generator, fps: float, seconds: float, jitter_us: float) -> np.ndarray:
    """Times of a trigger, with jitter that all cameras share."""
    count = int(seconds * fps)
    return EPOCH + np.arange(count) * 1e9 / fps + rng.normal(0, jitter_us * 1e3, count)


def stamps(
    rng: np.random.Generator,
    taken: np.ndarray,
    *,
    offset_us: float = 0,
    drift_ppm: float = 0,
    jitter_us: float = 300,
    drops: float = 0.0,
    outliers: float = 0.0,
) -> np.ndarray:
    """What a camera writes down; the offset holds at the start."""
    times = taken + offset_us * 1e3 + (taken - taken[0]) * drift_ppm * 1e-6 + rng.normal(0, jitter_us * 1e3, len(taken))
    late = rng.random(len(times)) < outliers
    times[late] += rng.uniform(0, 3 * np.median(np.diff(taken)), late.sum())
    return np.unique(np.rint(times[rng.random(len(times)) >= drops]).astype(np.int64))


def offset_at_start(clock: Clock) -> float:
    return clock.offset_ns + clock.drift_ppm * 1e-6 * (EPOCH - clock.origin_ns)


@pytest.mark.parametrize(
    ("fps", "seconds", "offset_us", "drift_ppm", "noise", "worst_offset_us", "worst_drift_ppm"),
    [
        # bounds are about four standard errors as the fit itself states them
        (30, 300, 3000, 20, {}, 60, 0.3),
        (30, 300, -4000, -80, {"drops": 0.01}, 60, 0.3),
        (30, 300, 2000, 50, {"jitter_us": 1500, "drops": 0.05, "outliers": 0.02}, 300, 1.5),
        (90, 60, 1000, 300, {"drops": 0.01, "outliers": 0.01}, 60, 1.5),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_a_triggered_clock_is_recovered(
    fps: float,
    seconds: float,
    offset_us: float,
    drift_ppm: float,
    noise: dict,
    worst_offset_us: float,
    worst_drift_ppm: float,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    taken = exposures(rng, fps, seconds, 200)
    reference = stamps(rng, taken, **noise)
    camera = stamps(rng, taken, offset_us=offset_us, drift_ppm=drift_ppm, **noise)
    clock = fit_clock(reference, camera, int(1e9 / fps))
    assert clock.state is ClockState.CORRECTED
    assert abs(clock.drift_ppm - drift_ppm) < worst_drift_ppm
    assert abs(offset_at_start(clock) - offset_us * 1e3) < worst_offset_us * 1e3
    assert abs(clock.drift_ppm - drift_ppm) < 5 * clock.drift_error_ppm
    corrected = clock.to_reference(camera)
    assert (np.diff(corrected) > 0).all()
    positions, residuals = merge_nearest(corrected, reference, int(5e8 / fps))
    assert abs(np.median(residuals[positions >= 0])) < worst_offset_us * 1e3


def test_stated_errors_are_the_errors_made() -> None:
    """Jitter that lasts for frames (an autoregressive process) must widen the errors, too."""
    misses = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        taken = exposures(rng, 30, 100, 0)
        lasting = np.zeros(len(taken))
        for i in range(1, len(taken)):
            lasting[i] = 0.9 * lasting[i - 1] + rng.normal(0, 100e3)
        camera = stamps(rng, taken + lasting, offset_us=2000, drift_ppm=100)
        clock = fit_clock(stamps(rng, taken), camera, 33_333_333)
        misses.append((clock.drift_ppm - 100) / clock.drift_error_ppm)
    # 1 if the errors are right; 30 draws scatter by 13 %, few windows add some
    assert 0.7 < np.sqrt(np.mean(np.square(misses))) < 1.5


def test_a_drift_below_its_noise_is_left_alone() -> None:
    zeros = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        taken = exposures(rng, 90, 10, 0)
        clock = fit_clock(stamps(rng, taken), stamps(rng, taken, offset_us=1000, drift_ppm=1), 11_111_111)
        zeros += clock.drift_ppm == 0
        assert clock.state is ClockState.CORRECTED  # the offset is 50 times its error
        assert abs(clock.offset_ns - 1e6) < 150e3
        assert clock.drift_error_ppm > 1
    assert zeros >= 17


def test_a_clock_without_error_is_left_alone() -> None:
    rng = np.random.default_rng(0)
    taken = exposures(rng, 30, 60, 0)
    camera = stamps(rng, taken)
    clock = fit_clock(stamps(rng, taken), camera, 33_333_333)
    assert clock.state is ClockState.WITHIN_NOISE
    assert clock.to_reference(camera) is camera


def test_perfect_stamps_give_no_correction_from_rounding() -> None:
    taken = EPOCH + np.arange(2000, dtype=np.int64) * 33_333_333
    assert fit_clock(taken, taken, 33_333_333).state is ClockState.WITHIN_NOISE


def test_a_free_running_camera_is_recognised() -> None:
    rng = np.random.default_rng(2)
    reference = stamps(rng, exposures(rng, 50, 60, 0), jitter_us=100)
    gaps = rng.normal(20e6, 1.5e6, 3000)  # phase wanders by itself
    camera = (EPOCH + np.cumsum(gaps)).astype(np.int64)
    clock = fit_clock(reference, camera, 20_000_000)
    assert clock.state is ClockState.FREE_RUNNING
    assert clock.to_reference(camera) is camera


def test_whole_frames_are_taken_from_the_start() -> None:
    """300 ppm gain nine frames in 10 minutes at 50 fps; the clocks agree at the start."""
    rng = np.random.default_rng(3)
    taken = exposures(rng, 50, 600, 100)
    camera = stamps(rng, taken, offset_us=-5000, drift_ppm=300)
    clock = fit_clock(stamps(rng, taken), camera, 20_000_000)
    assert abs(offset_at_start(clock) + 5e6) < 100e3
    assert clock.to_reference(camera)[-1] - taken[-1] < 3e6


@pytest.mark.parametrize("count", [1, 2, 5, 15])
def test_few_frames_are_no_clock(count: int) -> None:
    times = EPOCH + np.arange(count, dtype=np.int64) * 33_333_333
    assert fit_clock(times, times + 5000, 33_333_333).state is ClockState.TOO_FEW_FRAMES
    assert measure_clock(times, times - times).state is ClockState.TOO_FEW_FRAMES


def test_measuring_reports_and_corrects_nothing() -> None:
    rng = np.random.default_rng(4)
    times = EPOCH + np.arange(3000, dtype=np.int64) * 33_333_333
    residuals = (2e6 + (times - times[1500]) * 40e-6 + rng.normal(0, 1e5, 3000)).astype(np.int64)
    clock = measure_clock(times, residuals)
    assert clock.state is ClockState.TRUSTED
    assert abs(clock.offset_ns - 2e6) < 5 * clock.offset_error_ns
    assert abs(clock.drift_ppm - 40) < 5 * clock.drift_error_ppm
    assert clock.to_reference(times) is times


def test_correction_is_exact_to_a_nanosecond() -> None:
    """Against rational arithmetic, over a day."""
    clock = Clock(ClockState.CORRECTED, EPOCH, offset_ns=12345.0, drift_ppm=150.0)
    camera = EPOCH + np.linspace(-43200, 43200, 500).astype(np.int64) * 10**9 + 123_456_789
    drift = Fraction(150, 10**6)
    exact = [EPOCH + (int(time) - EPOCH - 12345) / (1 + drift) for time in camera]
    assert max(abs(int(got) - want) for got, want in zip(clock.to_reference(camera), exact, strict=True)) <= 1


def test_clocks_survive_json() -> None:
    clock = Clock(ClockState.CORRECTED, EPOCH, 1.5, 0.25, -3.125, 0.5, 1000.0)
    assert Clock.from_json(clock.to_json()) == clock
