"""The timecodes of one camera, and which frames of its video they belong to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sync.timecode.rates import NANOSECONDS
from sync.tree import TIME_LIMIT_NS

CYCLES = tuple(1 << bits for bits in (16, 24, 30, 31, 32, 33, 40, 48))
"""Numbers at which counters start over"""
DAY_NS = 86_400 * NANOSECONDS
CLOCK_CYCLES_NS = tuple(seconds * NANOSECONDS for seconds in (60, 128, 3600, 7 * 86_400))
"""After which clocks begin at 0 that have no minutes, hours or weeks; 128 s are those of FireWire's cameras"""
LONGEST_STALL = 10
"""Frame periods that may pass while a counter starts over"""
FEWEST_PERIODS = 100
"""Frame periods in a turn of a counter: a shorter one numbers something else"""


@dataclass(frozen=True, eq=False)
class Timecodes:
    """The timecodes of one camera, in the order of its file."""

    times_ns: np.ndarray
    """int64 [n], nanoseconds on the camera's clock"""
    indices: np.ndarray
    """int64 [n]: frame number in the camera's video, as far as the file tells; `frame_numbers` has the last word"""
    cycle_ns: int = 0
    """After so long the numbers start over, as labels do at midnight and counters when they are full; 0: never"""
    source: str = ""
    """Where they come from, for people"""
    labelled: bool = False
    """Whether they are labels, which count frames"""
    notes: tuple[str, ...] = ()
    """What had to be assumed or mended to read them, likewise"""

    def __post_init__(self) -> None:
        times, indices = self.times_ns, self.indices
        if times.dtype != np.int64 or times.ndim != 1 or indices.dtype != np.int64 or indices.shape != times.shape:
            raise ValueError(
                f"timecodes must be two int64 arrays [n], but are {times.dtype} {times.shape} "
                f"and {indices.dtype} {indices.shape}"
            )
        if len(times) == 0:
            raise ValueError("a camera needs at least one timecode, but has none")
        if times.min() <= -TIME_LIMIT_NS or times.max() >= TIME_LIMIT_NS:
            raise ValueError(f"timecodes must lie within 146 years of 1970, but span {times.min()} to {times.max()} ns")

    def __len__(self) -> int:
        return len(self.times_ns)

    def moved(self, by_ns: int) -> Timecodes:
        """The same with so much added to the times."""
        return replace(self, times_ns=self.times_ns + by_ns) if by_ns else self

    def begun(self, start_ns: int, told: str) -> Timecodes:
        """The same counted from the first one, which was filmed at `start_ns`; `told` says who says so."""
        return replace(self, times_ns=self.times_ns - self.times_ns.min() + start_ns, source=told)

    def noting(self, *notes: str) -> Timecodes:
        """The same with more to say."""
        return replace(self, notes=(*self.notes, *notes)) if notes else self

    def numbered(self, frame_count: int, *, camera: str = "") -> Timecodes:
        """The same times with the numbers of `frame_numbers`."""
        return replace(self, indices=frame_numbers(self, frame_count, camera=camera))


def frame_numbers(timecodes: Timecodes, frame_count: int, *, camera: str = "") -> np.ndarray:
    """Number in the video of each line's frame, int64 [n], for a video of `frame_count` frames.

    As many lines as frames: line k is frame k, whatever the file's index says, because rigs number the frames that
    they store. Otherwise the index counts dropped frames that the video still holds (or the file has lost lines),
    which is believed if first and last index span exactly the video. Anything else would be a guess about which
    picture belongs to which time.

    Raises:
        ValueError: neither holds.
    """
    lines = len(timecodes)
    if lines == frame_count:
        return np.arange(lines, dtype=np.int64)
    numbers: np.ndarray = timecodes.indices - timecodes.indices[0]
    if numbers[-1] == frame_count - 1 and (np.diff(numbers) > 0).all():
        return numbers
    name = f"camera {camera!r}" if camera else "a camera"
    raise ValueError(
        f"{name} has {frame_count} frames in its video, but {lines} timecodes with indices that span "
        f"{int(numbers.max() - numbers.min()) + 1}; re-export the two together, or list the camera under "
        "'ignore' in capture.toml"
    )


def unwrapped(times_ns: np.ndarray, unit_ns: int) -> tuple[np.ndarray, int, int]:
    """Times of a counter that starts over when it is full, carried on; int64 [n] in units of `unit_ns` nanoseconds.

    A step back counts as a full counter if the time goes on, after one of `CYCLES` or a day, by what ten frames take at
    most, or after one of `CLOCK_CYCLES_NS` where all times lie in a single one. Anything else that runs backwards is
    left as it is.

    Returns:
        The times, after how many ns the counter starts over (0: it did not), and how often it did.
    """
    steps = np.diff(times_ns)
    forward = steps[steps > 0]
    period = int(np.median(forward)) if len(forward) else 0
    least, most = times_ns.min(initial=0), times_ns.max(initial=0)
    within = [cycle for cycle in CLOCK_CYCLES_NS if least >= 0 and most < cycle]
    for cycle in sorted({*(bits * unit_ns for bits in CYCLES), DAY_NS, *within}):
        if not FEWEST_PERIODS * period <= cycle < TIME_LIMIT_NS or not period:
            continue
        wraps = (steps < 0) & (steps + cycle > 0) & (steps + cycle <= LONGEST_STALL * period)
        if wraps.any():
            return times_ns + cycle * np.concatenate([[0], np.cumsum(wraps)]), cycle, int(wraps.sum())
    return times_ns, 0, 0


def wrap_notes(wraps: int, cycle_ns: int) -> tuple[str, ...]:
    """That a counter started over, for people."""
    times = "once" if wraps == 1 else f"{wraps} times"
    return (f"its counter starts over every {cycle_ns / NANOSECONDS:.6g} s, {times} here; carried on",) if wraps else ()


def together(timecodes: Mapping[str, Timecodes]) -> dict[str, Timecodes]:
    """The same with all cameras in one turn of the cycle that their times have in common, such as one night.

    Cameras that began before midnight keep their times, those that began after it get a day more. Left alone are
    cameras whose numbers start over after different times, and beginnings that are spread over more than half a turn.
    """
    cycles = Counter(codes.cycle_ns for codes in timecodes.values() if codes.cycle_ns)
    if not cycles:
        return dict(timecodes)
    ((cycle, _),) = cycles.most_common(1)
    if len(cycles) > 1:
        odd = (
            "its times start over after {:.6g} s, those of most cameras after {:.6g} s: are its labels drop-frame and "
            "the others not, or of another rate?"
        )
        return {
            camera: codes.noting(odd.format(codes.cycle_ns / NANOSECONDS, cycle / NANOSECONDS))
            if codes.cycle_ns not in (0, cycle)
            else codes
            for camera, codes in timecodes.items()
        }
    starts = np.array([int(codes.times_ns[0]) for codes in timecodes.values()])
    places = np.sort(starts % cycle)
    gaps = np.diff(places, append=places[0] + cycle)
    first = int(places[(int(gaps.argmax()) + 1) % len(places)])
    if cycle - int(gaps.max()) > cycle // 2:
        return dict(timecodes)
    turns = (first + (starts - first) % cycle - starts) // cycle
    turns -= turns.min()
    return {
        camera: _later(codes, int(turn), cycle) for (camera, codes), turn in zip(timecodes.items(), turns, strict=True)
    }


def _later(codes: Timecodes, turns: int, cycle: int) -> Timecodes:
    if turns == 0:
        return codes
    note = f"its times start over every {cycle / NANOSECONDS:.6g} s, and it began after that had happened"
    return replace(codes, times_ns=codes.times_ns + turns * cycle).noting(note)


def counted_from_first(indices: np.ndarray) -> np.ndarray:
    """A file's index counted from its first line; lines are counted instead if the index does not increase.

    An index that starts over (camera restarted, two takes in one file) numbers no frames.
    """
    numbers = indices - indices[0]
    return numbers if (np.diff(numbers) > 0).all() else np.arange(len(numbers), dtype=np.int64)
