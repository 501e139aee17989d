"""What a terminal sees of a run: finished stages as lines, stages under way with the time they still need."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from typing import TextIO

from pipelines.events import Event, Forecast

LINE_SECONDS = 5.0
"""Least time between two lines of a stage where the output is not a terminal; more for what takes long"""
LINE_SHARE = 0.05
"""Least time between two lines as a share of the stage's time so far"""
REDRAW_SECONDS = 0.2
LABEL_WIDTH = 16


class TerminalProgress:
    """An `Audience` that writes to a terminal or, line by line, to a file."""

    def __init__(self, stream: TextIO | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.stream = sys.stdout if stream is None else stream
        self._live = self.stream.isatty()
        self._clock = clock
        self._active: dict[str, Forecast] = {}
        self._printed: dict[str, float] = {}
        self._drawn = -REDRAW_SECONDS

    def began(self, label: str, forecast: Forecast) -> None:
        self._active[label], self._printed[label] = forecast, self._clock()

    def moved(self, label: str, forecast: Forecast) -> None:
        now = self._clock()
        if self._live:
            if now - self._drawn >= REDRAW_SECONDS:
                self._draw()
        elif now - self._printed[label] >= max(LINE_SECONDS, LINE_SHARE * (now - forecast.start)):
            self._printed[label] = now
            self._write(f"{label:<{LABEL_WIDTH}} {_state(forecast)}\n")

    def ended(self, event: Event) -> None:
        self._active.pop(event.label, None)
        self._clear()
        self._write(f"{event.label:<{LABEL_WIDTH}} {_outcome(event)}\n")
        self._draw()

    def close(self) -> None:
        """Leave the terminal with whole lines only."""
        self._active.clear()
        self._clear()

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


def _outcome(event: Event) -> str:
    match event.outcome:
        case "made":
            return duration(event.seconds)
        case "reused":
            return "there already"
        case "skipped":
            return f"skipped: {event.reason}"
    return "stopped" if event.stopped else "failed"


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
