"""What a terminal sees of a run: finished stages as lines, stages under way with the time they still need."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Protocol, TextIO

from pipelines.events import Audience, Event, Forecast
from pipelines.words import LABEL_WIDTH, ending, state

LINE_SECONDS = 5.0
"""Least time between two lines of a stage where the output is not a terminal; more for what takes long"""
LINE_SHARE = 0.05
"""Least time between two lines as a share of the stage's time so far"""


class Display(Audience, Protocol):
    """An audience with something to put away."""

    def close(self) -> None: ...


class TerminalProgress:
    """An `Audience`: bars on a live terminal, few plain lines in a file, in a pipe and where no drawing is wanted."""

    def __init__(self, stream: TextIO | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        stream = sys.stdout if stream is None else stream
        self._display = _display(stream, clock)

    def began(self, label: str, forecast: Forecast) -> None:
        self._display.began(label, forecast)

    def moved(self, label: str, forecast: Forecast) -> None:
        self._display.moved(label, forecast)

    def ended(self, event: Event) -> None:
        self._display.ended(event)

    def told(self, label: str, text: str) -> None:
        self._display.told(label, text)

    def close(self) -> None:
        """Leave the terminal with whole lines only."""
        self._display.close()


def _display(stream: TextIO, clock: Callable[[], float]) -> Display:
    if not is_live(stream):
        return Lines(stream, clock)
    from pipelines.commands.bars import Bars  # loads rich, which commands that draw nothing need not wait for

    return Bars(stream, clock)


def is_live(stream: TextIO) -> bool:
    """Whether it is a terminal that can be drawn on, and its owner wants that."""
    able = os.environ.get("TERM") not in ("dumb", "unknown")
    return stream.isatty() and able and not os.environ.get("NO_COLOR")


class Lines:
    """A `Display` that writes whole lines only, not many of them."""

    def __init__(self, stream: TextIO, clock: Callable[[], float]) -> None:
        self._stream = stream
        self._clock = clock
        self._printed: dict[str, float] = {}

    def began(self, label: str, forecast: Forecast) -> None:
        self._printed[label] = self._clock()

    def moved(self, label: str, forecast: Forecast) -> None:
        now = self._clock()
        if now - self._printed[label] >= max(LINE_SECONDS, LINE_SHARE * (now - forecast.start)):
            self._printed[label] = now
            self._write(f"{label:<{LABEL_WIDTH}} {state(forecast)}")

    def ended(self, event: Event) -> None:
        self._write(ending(event))

    def told(self, label: str, text: str) -> None:
        self._write(f"{label:<{LABEL_WIDTH}} {text}")

    def close(self) -> None: ...

    def _write(self, line: str) -> None:
        self._stream.write(f"{line}\n")
        self._stream.flush()
