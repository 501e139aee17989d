"""Frame times: what the cameras record can be undone, and is, by the project's own matching."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from studio.clocks import EPOCH_NS, SECOND_NS, ClockOptions, record, tick_times, timecode_lines
from sync.align import AlignOptions, align
from sync.clock import ClockMode
from sync.timecode import read_timecodes

RATES = [Fraction(30), Fraction(30000, 1001), Fraction(25), Fraction(50), Fraction(90), Fraction(120)]


@settings(max_examples=40)
@given(
    cameras=st.integers(2, 12),
    frames=st.integers(6, 80),
    fps=st.sampled_from(RATES),
    seed=st.integers(0, 2**32),
    drops=st.floats(0, 0.5),
    late=st.integers(0, 4),
    free=st.booleans(),
)
def test_recordings_obey_their_options(cameras, frames, fps, seed, drops, late, free) -> None:
    options = ClockOptions(drops, late, 200, 300, 50, free)
    recordings = record(cameras, frames, fps, seed, options)
    ticks_ns = tick_times(frames + 1, fps)
    assert any(times.ticks[0] == 0 for times in recordings)
    for times in recordings:
        assert times.ticks[0] <= late
        assert times.ticks[-1] == frames - 1
        assert (np.diff(times.ticks) > 0).all()
        expected = np.arange(times.ticks[0], frames)
        assert np.array_equal(np.sort(np.concatenate([times.ticks, times.dropped])), expected)
        assert np.array_equal(times.times_ns, ticks_ns[times.ticks] + times.phase_ns)
        assert 0 <= times.phase_ns < SECOND_NS / fps
        assert free or times.phase_ns == 0
        assert np.array_equal(times.next_times_ns[:-1], times.times_ns[1:])
        assert times.next_times_ns[-1] == ticks_ns[frames] + times.phase_ns
        assert (np.diff(times.stamps_ns) > 0).all()
        assert (times.stamps_ns % 1000 == 0).all()
        drift_ns = (times.times_ns - EPOCH_NS) * times.drift_ppm * 1e-6
        # three standard deviations of jitter, and a microsecond for rounding
        assert np.abs(times.stamps_ns - times.times_ns - times.offset_ns - drift_ns).max() <= 601_000


@pytest.mark.parametrize("fps", RATES)
def test_ticks_are_exact(fps: Fraction) -> None:
    times = tick_times(1000, fps)
    for tick in (0, 1, 7, 500, 999):
        assert 0 <= EPOCH_NS + SECOND_NS * tick / fps - int(times[tick]) < 1


def test_timecode_files_read_back(tmp_path: Path) -> None:
    times = record(3, 50, Fraction(30), 1, ClockOptions())[1]
    (tmp_path / "cam.txt").write_text("\n".join(timecode_lines(times)) + "\n")
    codes = read_timecodes(tmp_path / "cam.txt")
    assert np.array_equal(codes.times_ns, times.stamps_ns)
    assert np.array_equal(codes.indices, np.arange(len(times.ticks)))
    assert timecode_lines(times)[3].endswith(f"_{times.first_index + 3:012d}")


@pytest.mark.parametrize("fps", [Fraction(30), Fraction(90)])
@pytest.mark.parametrize("frames", [24, 900])
def test_matching_finds_the_true_tick_of_every_frame(fps: Fraction, frames: int) -> None:
    """Late starts, drops, jitter, offset and drift as by default: every group holds frames of one tick."""
    for seed in range(5):
        recordings = record(6, frames, fps, seed, ClockOptions(drop_share=0.05))
        codes = {f"cam{k}": codes_of(times) for k, times in enumerate(recordings)}
        groups, _ = align(codes, AlignOptions(clock=ClockMode.TRIGGERED))
        order = [int(name[3:]) for name in groups.cameras]
        reference = recordings[int(groups.reference[3:])]
        for instant, frame in enumerate(groups.frames):
            ticks = {int(recordings[k].ticks[f]) for k, f in zip(order, frame, strict=True) if f >= 0}
            assert ticks == {int(reference.ticks[instant])}
        found = sum((groups.frames[:, column] >= 0).sum() for column in range(6))
        possible = sum(np.isin(times.ticks, reference.ticks).sum() for times in recordings)
        assert found == possible


def codes_of(times):
    from sync.timecode import Timecodes

    return Timecodes(times.stamps_ns, np.arange(len(times.stamps_ns), dtype=np.int64))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"drop_share": 0.6}, "dropped frames must be 0 to 0.5, but is 0.6"),
        ({"max_late_frames": -1}, "max_late_frames must be 0 or more, but is -1"),
        ({"jitter_us": -1.0}, "jitter_us must be 0 or more"),
        ({"offset_us": float("nan")}, "offset_us must be 0 or more"),
        ({"drift_ppm": 20000.0}, "drift_ppm must be at most 10000"),
    ],
)
def test_bad_options_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ClockOptions(**options)


def test_clocks_that_hide_the_tick_are_refused() -> None:
    with pytest.raises(ValueError, match=r"below half a frame, 16667 us at 30 frames per second, but is 18500 us"):
        record(2, 10, Fraction(30), 0, ClockOptions(jitter_us=6000))
    with pytest.raises(ValueError, match="starts 3 frames late records fewer than two of 4"):
        record(2, 4, Fraction(30), 0, ClockOptions())
