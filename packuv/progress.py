"""Who is told how far a long piece of work is."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Hears what is done, what there is to do, and at times a note for people."""

    def __call__(self, done: float, total: float, note: str = "") -> None: ...


def no_progress(done: float, total: float, note: str = "") -> None:
    """For callers who do not watch."""


def part_of(progress: Progress, begin: float, total: float) -> Progress:
    """Of work of `total` steps the piece after step `begin`, which counts its own."""
    return lambda done, _total, note="": progress(begin + done, total, note)


class Ticks:
    """Counts work done and tells whoever asked."""

    def __init__(self, progress: Progress, total: int, done: int = 0) -> None:
        self._progress, self._total, self._done = progress, total, done

    def advance(self, count: int = 1) -> None:
        self._done += count
        self._progress(self._done, self._total)
