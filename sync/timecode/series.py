"""The timecodes of one camera, and which frames of its video they belong to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sync.tree import TIME_LIMIT_NS


@dataclass(frozen=True, eq=False)
class Timecodes:
    """The timecodes of one camera, in the order of its file."""

    times_ns: np.ndarray
    """int64 [n], nanoseconds on the camera's clock"""
    indices: np.ndarray
    """int64 [n]: frame number in the camera's video, as far as the file tells; `frame_numbers` has the last word"""

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


def counted_from_first(indices: np.ndarray) -> np.ndarray:
    """A file's index counted from its first line; lines are counted instead if the index does not increase.

    An index that starts over (camera restarted, two takes in one file) numbers no frames.
    """
    numbers = indices - indices[0]
    return numbers if (np.diff(numbers) > 0).all() else np.arange(len(numbers), dtype=np.int64)
