"""Signals: one sentence, one code, and what has to be written is written."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
from signal import SIG_IGN, SIGHUP, SIGINT, SIGTERM, getsignal, signal

import pytest

from pipelines.ending import SIGNALS, Terminated, ending_gently
from tests.support.places import ROOT

PAUSE_SECONDS = 0.05
PROGRAM = """
import sys, time
from pipelines import cli

def work(arguments):
    try:
        print("begun", flush=True)
        time.sleep(60)
    finally:
        time.sleep({ending})
        print("written", flush=True)

cli._load = lambda name: work
sys.exit(cli.main(["run", "capture", "--out", "runs"]))
"""


def program(ending: float = 0.5) -> list[str]:
    return [sys.executable, "-c", PROGRAM.format(ending=ending)]


def told(*signals: int, ending: float = 0.5, **settings) -> tuple[int, str, str]:
    """Exit code, output and errors of a command that is sent these signals."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(program(ending), cwd=ROOT, text=True, **pipes, **settings) as process:
        process.stdout.readline()
        for number in signals:
            process.send_signal(number)
            time.sleep(PAUSE_SECONDS)
        output, errors = process.communicate(timeout=60)
    return process.returncode, output, errors


@pytest.mark.parametrize(
    ("signals", "code", "sentence"),
    [
        ([SIGINT], 130, "stopped"),
        ([SIGINT, SIGINT], 130, "stopped"),
        ([SIGTERM, SIGINT], 143, "ended by SIGTERM"),
        ([SIGHUP], 129, "ended by SIGHUP"),
        ([SIGHUP, SIGHUP, SIGHUP, SIGTERM], 129, "ended by SIGHUP"),
    ],
)
def test_one_sentence_and_a_whole_ending(signals, code, sentence):
    assert told(*signals) == (code, "written\n", f"packuv: {sentence}; the same command goes on from here\n")


def test_the_third_demand_ends_at_once():
    start = time.monotonic()
    assert told(SIGINT, SIGINT, SIGTERM, ending=60) == (143, "", "")
    assert time.monotonic() - start < 30


def test_nohup_stays_in_force():
    code, output, errors = told(SIGHUP, SIGTERM, preexec_fn=lambda: signal(SIGHUP, SIG_IGN))
    assert (code, output) == (143, "written\n")
    assert "SIGTERM" in errors


def test_a_signal_while_python_ends_changes_nothing():
    late = "import atexit, os; atexit.register(lambda: [os.kill(os.getpid(), number) for number in (1, 2, 2, 15)]);"
    first = PROGRAM.format(ending=0).replace("time.sleep(60)", "os.kill(os.getpid(), 15)")
    done = subprocess.run([sys.executable, "-c", late + first], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (143, 1)


def test_a_terminal_that_vanishes_hangs_up_and_nothing_is_said():
    child, terminal = pty.fork()
    if not child:
        os.chdir(ROOT)
        os.execv(sys.executable, program())
    seen = b""
    while b"begun" not in seen:
        seen += os.read(terminal, 4096)
    os.close(terminal)  # the kernel sends SIGHUP; writing fails with EIO
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 129


def test_handlers_come_back():
    before = [getsignal(number) for number in SIGNALS]
    with ending_gently():
        assert len({getsignal(number) for number in SIGNALS}) == 1
    assert [getsignal(number) for number in SIGNALS] == before
    assert Terminated(SIGHUP).code == 129
