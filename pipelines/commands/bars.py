"""A bar for each stage under way, below the lines of those that ended."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID
from rich.table import Column
from rich.text import Text

from pipelines.events import Event, Forecast
from pipelines.words import LABEL_WIDTH, ending, left, percent

REDRAW_SECONDS = 0.2
BAR_WIDTH = 24
"""Characters; it gives way where the terminal is narrow, after a longer note did"""
STYLES = {"reused": "dim", "skipped": "dim", "failed": "bold red"}


class Bars:
    """A `pipelines.commands.progress.Display` on a terminal.

    It draws when it is told something, not by a thread of its own, so that nothing writes after an interrupt.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._console = Console(file=stream, highlight=False, markup=False, emoji=False)
        self._bars = Progress(
            Words("label"),
            BarColumn(BAR_WIDTH),
            Words("percent"),
            Words("left"),
            Words("note", gives_way=True),
            console=self._console,
            auto_refresh=False,
            transient=True,
            get_time=clock,
            # What others print appears above the bars, unless it goes to a file.
            redirect_stdout=sys.stdout.isatty(),
            redirect_stderr=sys.stderr.isatty(),
        )
        self._tasks: dict[str, TaskID] = {}
        self._drawn = clock()

    def began(self, label: str, forecast: Forecast) -> None:
        if not self._tasks:
            self._bars.start()
            self._console.show_cursor()  # hidden by rich, it would stay so if the program was killed
        self._tasks[label] = self._bars.add_task("", total=None, label=label, percent="", left="", note="under way")
        self._draw()

    def moved(self, label: str, forecast: Forecast) -> None:
        self._bars.update(
            self._tasks[label],
            total=forecast.total if forecast.total > 0 else None,
            completed=forecast.done,
            percent=percent(forecast),
            left=left(forecast),
            note=forecast.note,
        )
        if self._clock() - self._drawn >= REDRAW_SECONDS:
            self._draw()

    def ended(self, event: Event) -> None:
        if (task := self._tasks.pop(event.label, None)) is not None:
            self._bars.remove_task(task)
            self._draw()
        # Not wrapped by rich: a long reason stays one line for whoever copies it.
        self._console.print(Text(ending(event), STYLES.get(event.outcome, "")), soft_wrap=True)
        if not self._tasks:
            self._bars.stop()

    def told(self, label: str, text: str) -> None:
        self._console.print(Text(f"{label:<{LABEL_WIDTH}} {text}"), soft_wrap=True)

    def close(self) -> None:
        """Take the bars away."""
        while self._tasks:
            self._bars.remove_task(self._tasks.popitem()[1])
        self._bars.stop()

    def _draw(self) -> None:
        self._drawn = self._clock()
        self._bars.refresh()


class Words(ProgressColumn):
    """A field of the stages, on one line, cut off where the terminal ends."""

    def __init__(self, field: str, *, gives_way: bool = False) -> None:
        super().__init__(Column(no_wrap=not gives_way, overflow="ellipsis"))
        self._field = field

    def render(self, task: Task) -> Text:
        return Text(task.fields[self._field], no_wrap=True)
