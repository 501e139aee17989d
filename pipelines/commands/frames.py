"""Frames of a scene that a command is asked for; raises ValueError where the scene lacks them."""

from __future__ import annotations


def frames_of(count: int, asked: tuple[int, int | None]) -> range:
    """The half-open range of a scene with `count` frames, to its end where no stop is asked for.

    >>> frames_of(5, (2, None))
    range(2, 5)
    """
    first, stop = asked
    chosen = range(first, count if stop is None else stop)
    if not chosen or first < 0 or chosen.stop > count:
        raise ValueError(f"the scene has frames 0 to {count - 1}, but {first}:{chosen.stop} is asked for")
    return chosen


def check_frame(count: int, frame: int) -> None:
    """One frame of a scene with `count` frames."""
    if not 0 <= frame < count:
        raise ValueError(f"the scene has frames 0 to {count - 1}, but frame {frame} is asked for")
