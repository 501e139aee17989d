"""How long a data set still takes, judged by the sequences that ran."""

from __future__ import annotations

from collections.abc import Iterable

from pipelines.events import Forecast

MOST_SHARE = 0.97
"""Of a sequence that takes longer than expected"""


class Pace:
    """Seconds that a frame takes, as far as is known."""

    def __init__(self, earlier: Iterable[tuple[float, int]] = ()) -> None:
        """`earlier`: seconds and frames of sequences that other runs made with the same settings."""
        self._earlier = [(seconds, frames) for seconds, frames in earlier if frames]
        self._own: list[tuple[float, int]] = []

    def ended(self, seconds: float, frames: int) -> None:
        """A sequence came to its end."""
        if frames:
            self._own.append((seconds, frames))

    def expected_seconds(self, frames: int) -> float | None:
        """What so many frames take; None before anything is known."""
        known = self._own or self._earlier
        total = sum(count for _, count in known)
        return frames * sum(seconds for seconds, _ in known) / total if total else None


class Headway(Forecast):
    """How far a batch is, in frames, with a remaining time of its own: sequences end seldom, and side by side."""

    def __init__(self, start: float, pace: Pace, at_once: int) -> None:
        super().__init__(start)
        self._pace, self._at_once = pace, at_once
        self._left: float | None = None

    def look(self, waiting: Iterable[int], running: Iterable[tuple[float, int]]) -> float:
        """Note what is left, as frames of sequences that wait, and seconds so far and frames of those that run.

        Returns frames of running sequences that are done by now, as they are expected to go.
        """
        rest, done = [], 0.0
        for seconds, frames in running:
            expected = self._pace.expected_seconds(frames)
            if expected is None:
                self._left = None
                return 0.0
            rest.append(max(expected - seconds, (1 - MOST_SHARE) * expected))
            done += frames * min(seconds / expected, MOST_SHARE) if expected else 0.0
        later = self._pace.expected_seconds(sum(waiting))
        at_once = len(rest) or self._at_once  # a pool may have taken fewer than are there for it
        self._left = None if later is None else max([(later + sum(rest)) / at_once, *rest])
        return done

    def remaining_seconds(self) -> float | None:
        return self._left
