"""How a command ends when a signal asks for it: once, and in peace."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
from collections.abc import Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PATIENCE = 2
"""Demands after which the next one ends the process at once"""


class Terminated(BaseException):
    """SIGTERM or SIGHUP came."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = 128 + number
        """Exit code, as a shell has it for a signal"""


@contextlib.contextmanager
def ending_gently() -> Iterator[None]:
    """Within the block the first signal raises KeyboardInterrupt or Terminated, in the main thread.

    The second one is not heard, so that run.json is written; the third ends the process at once, and with it its jobs.
    A closed terminal hangs up several times, which counts once. A signal that is ignored when the program starts, as
    by nohup, stays ignored, but for SIGTERM. After a signal this holds until the process has ended.
    """
    before = {number: signal.getsignal(number) for number in SIGNALS}
    bell = _Bell()
    for number, handler in before.items():
        if handler is not signal.SIG_IGN or number == signal.SIGTERM:
            signal.signal(number, bell)
    try:
        yield
    finally:
        if bell.demands:
            atexit.register(_ignore)  # else Python's last steps reset the handlers, and a signal changes the exit code
        else:
            for number, handler in before.items():
                signal.signal(number, handler or signal.SIG_DFL)


def _ignore() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


class _Bell:
    def __init__(self) -> None:
        self.demands = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.demands and number == signal.SIGHUP:
            return
        self.demands += 1
        if self.demands == 1:
            raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)
        if self.demands > PATIENCE:
            os._exit(128 + number)
