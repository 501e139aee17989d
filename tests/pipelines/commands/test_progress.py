"""What a run says while it works."""

from __future__ import annotations

import io

import pytest

from pipelines.commands.progress import LINE_SECONDS, TerminalProgress
from pipelines.events import Forecast, Journal
from tasks.artefacts.store import Key


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock():
    return Clock()


def test_file_gets_few_whole_lines(clock):
    stream = io.StringIO()
    terminal = TerminalProgress(stream, clock=clock)
    shown = Journal(terminal, clock=clock)
    shown.started("fit segment 1")
    for step in range(1, 101):
        clock.now += 0.5
        shown.moved("fit segment 1", step, 100, "31.2 dB")
    shown.finished("fit segment 1", Key("fit", "00"), 50.0)
    shown.finished("sync", Key("sync", "00", reused=True), 0.0)
    shown.skipped("COLMAP", "calibration/ holds a COLMAP model")
    lines = stream.getvalue().splitlines()
    assert len(lines) == 50 / LINE_SECONDS + 3  # LINE_SHARE comes into play after 100 seconds
    assert lines[0] == "fit segment 1     10 %, 45.0 s left, 31.2 dB"
    assert lines[-3:] == [
        "fit segment 1    50.0 s",
        "sync             there already",
        "COLMAP           skipped: calibration/ holds a COLMAP model",
    ]
    assert [(event.label, event.outcome) for event in shown.events] == [
        ("fit segment 1", "made"),
        ("sync", "reused"),
        ("COLMAP", "skipped"),
    ]


def test_terminal_ends_with_whole_lines_only(clock, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    stream = Terminal()
    terminal = TerminalProgress(stream, clock=clock)
    shown = Journal(terminal, clock=clock)
    for label in ("key 1", "segment 0"):
        shown.started(label)
        shown.moved(label, 1, 4, "a note that is long")
        clock.now += 1
    shown.failed("segment 0", OSError("disk full"))
    terminal.close()
    drawn = stream.getvalue().split("\r\x1b[K")
    assert drawn[-1] == ""
    assert all(len(text) < 40 for text in drawn if not text.endswith("\n"))
    assert [text for text in drawn if text.endswith("\n")] == ["segment 0        failed\n"]
    assert shown.events[0].reason == "disk full"


def test_forecast_counts_from_where_a_resumed_stage_began():
    forecast = Forecast(0.0)
    forecast.update(10.0, 80, 100, "")
    assert forecast.remaining_seconds() is None
    forecast.update(20.0, 90, 100, "")
    assert forecast.remaining_seconds() == pytest.approx(10.0)


def test_forecast_follows_a_change_of_pace():
    forecast = Forecast(0.0)
    for second in range(101):
        forecast.update(float(second), second if second <= 50 else 50 + (second - 50) / 10, 100, "")
    assert forecast.remaining_seconds() == pytest.approx(450.0)
