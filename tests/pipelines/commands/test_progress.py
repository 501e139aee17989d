"""What a run says while it works."""

from __future__ import annotations

import io
import os
import re
import sys
import threading

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

    def screen(self, width: int) -> list[str]:
        """What a person sees; the last line is where the cursor waits."""
        rows, row, column = [""], 0, 0
        for control, letter in re.findall(r"\x1b\[([?\d;]*[A-Za-z])|([^\x1b])", self.getvalue()):
            if control.endswith("A"):
                row -= int(control[:-1])
            elif control == "2K":
                rows[row] = ""
            elif letter == "\r":
                column = 0
            elif letter == "\n" or (letter and column == width):
                row, column = row + 1, 0
                rows += [""] * (row == len(rows))
            if letter and letter not in "\r\n":
                rows[row] = f"{rows[row]:<{column}}"[:column] + letter + rows[row][column + 1 :]
                column += 1
        return [text.rstrip() for text in rows[: row + 1]]


@pytest.fixture
def terminal(monkeypatch):
    """As wide as COLUMNS says, which a test may change."""
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in (("TERM", "xterm"), ("COLUMNS", "100"), ("LINES", "25")):
        monkeypatch.setenv(name, value)
    return Terminal()


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
    assert lines[0] == "fit segment 1                   10 %, 45.0 s left, 31.2 dB"
    assert lines[-3:] == [
        "fit segment 1                  50.0 s",
        "sync                           there already",
        "COLMAP                         skipped: calibration/ holds a COLMAP model",
    ]
    assert [(event.label, event.outcome) for event in shown.events] == [
        ("fit segment 1", "made"),
        ("sync", "reused"),
        ("COLMAP", "skipped"),
    ]


def test_bars_stand_below_the_lines_of_what_ended(clock, terminal):
    shown = TerminalProgress(terminal, clock=clock)
    journal = Journal(shown, clock=clock)
    for label in ("fit segment 1", "key 2"):
        journal.started(label)
    assert [line.split() for line in terminal.screen(100)] == [
        ["fit", "segment", "1", "━" * 24, "under", "way"],
        ["key", "2", "━" * 24, "under", "way"],
    ]
    for step in range(1, 31):
        clock.now += 0.5
        journal.moved("fit segment 1", step, 100, "31.2 dB [red]")
    journal.skipped("COLMAP", "calibration/ holds a [COLMAP] model")
    first, *bars = terminal.screen(100)
    assert first == "COLMAP                         skipped: calibration/ holds a [COLMAP] model"
    assert re.fullmatch(r"fit segment 1 ━{7}[╸╺]━{16}  30 % 35\.0 s left 31\.2 dB \[red\]", bars[0])
    assert bars[1].startswith("key 2         ━")
    journal.finished("key 2", Key("fit", "00"), 50.0)
    journal.failed("fit segment 1", OSError("disk full"))
    lines = [first, "key 2                          50.0 s", "fit segment 1                  failed", ""]
    assert terminal.screen(100) == lines
    journal.started("again")
    assert len(terminal.screen(100)) == len(lines)
    shown.close()
    shown.close()
    assert terminal.screen(100) == lines
    assert journal.events[-1].reason == "disk full"


@pytest.mark.parametrize("width", [1, 2, 7, 20, 40, 80])
def test_lines_are_whole_on_narrow_terminals(clock, terminal, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    shown = TerminalProgress(terminal, clock=clock)
    journal = Journal(shown, clock=clock)
    for label in ("key 1", "segment 0"):
        journal.started(label)
        for step in range(4):
            clock.now += 1
            journal.moved(label, step, 4, "a note that is so long that it has no place on any of these terminals")
    assert len(terminal.screen(width)) == 2
    reason = "a reason that is too long for most of these terminals, but told all the same"
    journal.skipped("COLMAP", reason)
    shown.close()
    assert "".join(text.strip() for text in terminal.screen(width)).replace(" ", "") == (
        f"COLMAP skipped: {reason}".replace(" ", "")
    )


def test_the_next_drawing_is_as_wide_as_the_terminal_is_then(clock, terminal, monkeypatch):
    monkeypatch.delenv("COLUMNS")
    journal = Journal(TerminalProgress(terminal, clock=clock), clock=clock)
    journal.started("key 1")
    for columns in (70, 30, 50):
        monkeypatch.setattr("os.get_terminal_size", lambda *_, size=(columns, 25): os.terminal_size(size))
        clock.now += 1
        journal.moved("key 1", 1, 4, "a note that is as wide as any of these terminals, however wide they may be made")
        assert [len(line) for line in terminal.screen(100)] == [columns]


def test_what_others_print_appears_above_the_bars(clock, terminal, monkeypatch):
    monkeypatch.setattr(sys, "stdout", terminal)
    shown = TerminalProgress(clock=clock)
    journal = Journal(shown, clock=clock)
    journal.started("key 1")
    print("a warning [of] somebody")
    warning, bar = terminal.screen(100)
    assert warning == "a warning [of] somebody"
    assert bar.startswith("key 1 ━")
    shown.close()
    assert sys.stdout is terminal
    assert terminal.screen(100) == [warning, ""]


def test_standard_output_in_a_file_stays_there(clock, terminal, monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    shown = TerminalProgress(terminal, clock=clock)
    Journal(shown, clock=clock).started("key 1")
    print('{"frames": 3}')
    assert sys.stdout.getvalue() == '{"frames": 3}\n'
    shown.close()


def test_threads_leave_the_terminal_whole(terminal):
    shown = TerminalProgress(terminal)
    journal = Journal(shown)

    def work(label: str) -> None:
        for turn in range(20):
            journal.started(f"{label} {turn}")
            for step in range(20):
                journal.moved(f"{label} {turn}", step, 20)
            journal.ended(f"{label} {turn}")

    threads = [threading.Thread(target=work, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    shown.close()
    *lines, last = terminal.screen(100)
    assert sorted(line.split("  ")[0] for line in lines) == sorted(
        f"{name} {turn}" for name in "abcd" for turn in range(20)
    )
    assert last == ""


@pytest.mark.parametrize("name", ["NO_COLOR", "TERM", "pipe"])
def test_who_wants_no_drawing_gets_the_lines_of_a_file(clock, terminal, monkeypatch, name):
    stream = io.StringIO() if name == "pipe" else terminal
    if name != "pipe":
        monkeypatch.setenv(name, "dumb")
    shown = TerminalProgress(stream, clock=clock)
    journal = Journal(shown, clock=clock)
    journal.started("key 1")
    for step in range(20):
        clock.now += 0.5
        journal.moved("key 1", step, 20, "31.2 dB")
    journal.failed("key 1", OSError("disk full"))
    shown.close()
    assert stream.getvalue() == (
        "key 1                           45 %, 5.5 s left, 31.2 dB\n"
        "key 1                           95 %, 0.5 s left, 31.2 dB\n"
        "key 1                          failed\n"
    )


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
