"""What a terminal sees of a run: finished stages as lines, stages under way with the time they still need."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TextIO

from tasks.jobs import CancelledError
from tasks.store import Key

LINE_SECONDS = 5.0
"""Least time between two lines of a stage where the output is not a terminal; more for what takes long"""
LINE_SHARE = 0.05
"""Least time between two lines as a share of the stage's time so far"""
REDRAW_SECONDS = 0.2
SURE_AFTER_SECONDS = 2.0
"""No forecast from a shorter observation"""
LABEL_WIDTH = 16


@dataclass(frozen=True)
class Event:
    """One stage that came to an end."""

    label: str
    outcome: str
    """made, reused, skipped or failed"""
    seconds: float
    key: Key | None = None
    reason: str = ""
    """Why it was skipped or failed"""

    def to_json(self) -> dict[str, Any]:
        """For run.json and `--json`."""
        key = {"artefact": str(self.key)} if self.key else {}
        reason = {"reason": self.reason} if self.reason else {}
        return {"stage": self.label, "outcome": self.outcome, "seconds": round(self.seconds, 3), **key, **reason}


class Forecast:
    """Remaining time at the pace of the later half of what was watched.

    A resumed stage is not thought fast for what an earlier run did, and a change of pace is followed.
    """

    def __init__(self, start: float) -> None:
        self.start = start
        self.done, self.total, self.note = 0.0, 0.0, ""
        self._seen: deque[tuple[float, float]] = deque()
        self._first: float | None = None

    def update(self, now: float, done: float, total: float, note: str) -> None:
        self._first = now if self._first is None else self._first
        self.done, self.total, self.note = done, total, note
        self._seen.append((now, done))
        while len(self._seen) > 2 and self._seen[1][0] <= (self._first + now) / 2:
            self._seen.popleft()

    def remaining_seconds(self) -> float | None:
        """None until there is a pace to go by."""
        if self._first is None:
            return None
        (then, before), (now, done) = self._seen[0], self._seen[-1]
        if now - self._first < SURE_AFTER_SECONDS or done <= before:
            return None
        return max(0.0, (self.total - done) * (now - then) / (done - before))


class TerminalProgress:
    """A `tasks.workshop.Listener` that writes to a terminal or, line by line, to a file. Safe to call from threads."""

    def __init__(self, stream: TextIO | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.stream = sys.stdout if stream is None else stream
        self.events: list[Event] = []
        """Every stage that ended, in order"""
        self._live = self.stream.isatty()
        self._clock = clock
        self._active: dict[str, Forecast] = {}
        self._printed: dict[str, float] = {}
        self._drawn = -REDRAW_SECONDS
        self._lock = threading.RLock()

    def started(self, label: str) -> None:
        with self._lock:
            self._active[label] = Forecast(self._clock())
            self._printed[label] = self._clock()

    def moved(self, label: str, done: float, total: float, note: str) -> None:
        with self._lock:
            if label in self._active:
                self._active[label].update(self._clock(), done, total, note)
                self._show(label)

    def waiting(self, label: str) -> None:
        self.moved(label, 0, 0, "waiting for another packuv that makes the same")

    def finished(self, label: str, key: Key, seconds: float) -> None:
        outcome = "reused" if key.reused else "made"
        text = "there already" if key.reused else duration(seconds)
        self._end(Event(label, outcome, seconds, key), text)

    def ended(self, label: str) -> None:
        """Something that makes no artefact is done."""
        with self._lock:
            seconds = self._clock() - self._active[label].start
            self._end(Event(label, "made", seconds), duration(seconds))

    def skipped(self, label: str, reason: str) -> None:
        self._end(Event(label, "skipped", 0.0, reason=reason), f"skipped: {reason}")

    def failed(self, label: str, error: BaseException) -> None:
        with self._lock:
            start = self._active[label].start if label in self._active else self._clock()
            text = "stopped" if isinstance(error, (CancelledError, KeyboardInterrupt)) else "failed"
            self._end(Event(label, "failed", self._clock() - start, reason=str(error)), text)

    def say(self, text: str) -> None:
        """A line of its own."""
        with self._lock:
            self._clear()
            self._write(text + "\n")
            self._draw()

    def close(self) -> None:
        """Leave the terminal with whole lines only."""
        with self._lock:
            self._active.clear()
            self._clear()

    def _end(self, event: Event, text: str) -> None:
        with self._lock:
            self._active.pop(event.label, None)
            self.events.append(event)
            self.say(f"{event.label:<{LABEL_WIDTH}} {text}")

    def _show(self, label: str) -> None:
        now = self._clock()
        if self._live:
            if now - self._drawn >= REDRAW_SECONDS:
                self._draw()
        elif now - self._printed[label] >= max(LINE_SECONDS, LINE_SHARE * (now - self._active[label].start)):
            self._printed[label] = now
            self._write(f"{label:<{LABEL_WIDTH}} {_state(self._active[label])}\n")

    def _draw(self) -> None:
        if self._live and self._active:
            self._drawn = self._clock()
            width = shutil.get_terminal_size().columns - 1
            parts = [f"{label} {_state(forecast)}" for label, forecast in self._active.items()]
            self._write("\r\x1b[K" + " · ".join(parts)[:width])

    def _clear(self) -> None:
        if self._live:
            self._write("\r\x1b[K")

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()


def _state(forecast: Forecast) -> str:
    parts = []
    if forecast.total > 0:
        parts.append(f"{100 * forecast.done / forecast.total:3.0f} %")
    remaining = forecast.remaining_seconds()
    if remaining is not None:
        parts.append(f"{duration(remaining)} left")
    if forecast.note:
        parts.append(forecast.note)
    return ", ".join(parts) or "under way"


def duration(seconds: float) -> str:
    """A length of time for people.

    >>> [duration(s) for s in (0.04, 9.96, 75, 3720)]
    ['0.0 s', '10.0 s', '1 min 15 s', '1 h 02 min']
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
