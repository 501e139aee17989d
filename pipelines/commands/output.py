"""Standard output and standard error that never stop the work: where they lead nowhere, printing ends, nothing else.

A reader may leave, as `head` does, a terminal may vanish with its ssh connection, the disk of a log file may be full,
and whoever starts a program may have closed the streams before.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

LEFT = frozenset({errno.EPIPE, errno.EIO, errno.ECONNRESET})
"""Nobody reads any more: the pipe's end is closed, the terminal is gone"""


@contextlib.contextmanager
def lasting_output() -> Iterator[None]:
    """Within the block, sys.stdout and sys.stderr are outlets; what they hold back is written at its end."""
    _fill_standard_descriptors()
    before = sys.stdout, sys.stderr
    outlets = [Outlet(stream) for stream in before]
    sys.stdout, sys.stderr = (cast(TextIO, outlet) for outlet in outlets)
    try:
        yield
    finally:
        for outlet in outlets:
            outlet.flush()  # here, for what cannot be written would become exit code 120 when Python ends
        sys.stdout, sys.stderr = before


def answer(text: str) -> None:
    """Print what a command was asked for.

    Raises OSError where that could not be written, as on a full disk; a reader that left has had enough.
    """
    print(text)
    check_written()


def check_written() -> None:
    """Raise OSError if something on standard output could not be written, unless its reader left."""
    sys.stdout.flush()
    problem = getattr(sys.stdout, "problem", None)
    if isinstance(problem, OSError) and problem.errno not in LEFT:
        raise OSError(problem.errno, f"cannot write to standard output: {problem.strerror}")


class Outlet(io.TextIOBase):
    """A stream for text that takes everything; after the first problem it leads to /dev/null."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.problem: Exception | None = None
        """Why nothing is written any more"""

    def write(self, text: str) -> int:
        if self._stream is not None:
            with self._lasting():
                try:
                    self._stream.write(text)
                except UnicodeEncodeError:  # a folder's name in another encoding, a bar on a Latin-1 terminal
                    self._stream.write(text.encode("ascii", "backslashreplace").decode())
        return len(text)

    def flush(self) -> None:
        if self._stream is not None:
            with self._lasting():
                self._stream.flush()

    def isatty(self) -> bool:
        return self._stream is not None and not self._stream.closed and self._stream.isatty()

    def fileno(self) -> int:
        if self._stream is None:
            raise io.UnsupportedOperation("closed before the program started")
        return self._stream.fileno()

    def writable(self) -> bool:
        return True

    @property
    def encoding(self) -> str:  # type: ignore[override]  # an attribute there
        return getattr(self._stream, "encoding", None) or "utf-8"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _lasting(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as problem:  # ValueError: somebody closed the file
            self.problem = self.problem or problem
            with contextlib.suppress(OSError, ValueError):
                _lead_nowhere(self.fileno())


def _lead_nowhere(descriptor: int) -> None:
    """Everything that is written there, also by native code and from buffers, disappears from now on."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _fill_standard_descriptors() -> None:
    """Open what is closed of 0, 1, 2: the next file would get that number, and with it what native code prints."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # which gets the lowest free number, this one
