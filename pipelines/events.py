"""What happens in a run: stages under way with the time they still need, and stages that ended.

A run tells its `Journal`, which remembers; whoever watches, as the terminal does, is an `Audience` of the journal.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from tasks.artefacts.jobs import CancelledError
from tasks.artefacts.store import Key

SURE_AFTER_SECONDS = 2.0
"""No forecast from a shorter observation"""


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
    stopped: bool = False
    """Failed because somebody asked for an end"""

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


class Audience(Protocol):
    """Watches a journal; called by one thread at a time."""

    def began(self, label: str, forecast: Forecast) -> None: ...

    def moved(self, label: str, forecast: Forecast) -> None: ...

    def ended(self, event: Event) -> None:
        """Also of a stage that never began, since it is skipped."""

    def told(self, label: str, text: str) -> None:
        """Something to know that is no stage."""


class Journal:
    """A `tasks.artefacts.workshop.Listener` that remembers. Safe to call from threads."""

    def __init__(self, *audience: Audience, clock: Callable[[], float] = time.monotonic) -> None:
        self.events: list[Event] = []
        """Every stage that ended, in order"""
        self._audience = audience
        self._clock = clock
        self._active: dict[str, Forecast] = {}
        self._lock = threading.RLock()
        self._ended = threading.Condition(self._lock)

    @contextmanager
    def heard_by(self, audience: Audience) -> Iterator[None]:
        """Have one more audience for a while."""
        with self._lock:
            self._audience += (audience,)
        try:
            yield
        finally:
            with self._lock:
                self._audience = tuple(other for other in self._audience if other is not audience)

    def told(self, label: str, text: str) -> None:
        """Something to know that is no stage."""
        with self._lock:
            for audience in self._audience:
                audience.told(label, text)

    def started(self, label: str, forecast: Forecast | None = None) -> None:
        with self._lock:
            self._active[label] = forecast or Forecast(self._clock())
            for audience in self._audience:
                audience.began(label, self._active[label])

    def moved(self, label: str, done: float, total: float, note: str = "") -> None:
        with self._lock:
            if forecast := self._active.get(label):
                forecast.update(self._clock(), done, total, note)
                for audience in self._audience:
                    audience.moved(label, forecast)

    def waiting(self, label: str) -> None:
        self.moved(label, 0, 0, "waiting for another packuv that makes the same")

    def finished(self, label: str, key: Key, seconds: float) -> None:
        self._end(Event(label, "reused" if key.reused else "made", seconds, key))

    def ended(self, label: str) -> None:
        """Something that makes no artefact is done."""
        self._end(Event(label, "made", self._seconds(label)))

    def skipped(self, label: str, reason: str) -> None:
        self._end(Event(label, "skipped", 0.0, reason=reason))

    def failed(self, label: str, error: BaseException) -> None:
        stopped = isinstance(error, (CancelledError, KeyboardInterrupt))
        self._end(Event(label, "failed", self._seconds(label), reason=str(error), stopped=stopped))

    def wait_until_idle(self, seconds: float) -> bool:
        """Return when no stage is under way, or after this time; whether none is."""
        with self._ended:
            return self._ended.wait_for(lambda: not self._active, timeout=seconds)

    def _seconds(self, label: str) -> float:
        with self._lock:
            return self._clock() - self._active[label].start if label in self._active else 0.0

    def _end(self, event: Event) -> None:
        with self._lock:
            self._active.pop(event.label, None)
            self.events.append(event)
            self._ended.notify_all()
            for audience in self._audience:
                audience.ended(event)
