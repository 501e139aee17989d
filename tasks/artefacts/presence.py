"""Who is at work in a folder that several machines share.

The kernel's locks tell it on one machine, at once. Over a network they may reach no further than the machine, or not be
there at all; so whoever works also leaves a file or folder that bears their name, and renews its time. The time is the
file server's own, since clocks of machines differ. Of a process of this machine the table of processes tells whether it
has ended; of others, and of one that was stopped, the silence does.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import secrets
import socket
import tempfile
import threading
import time
from pathlib import Path
from types import TracebackType

BEAT_SECONDS = 10.0
"""Between two renewals"""
LOOK_SECONDS = 2.0
"""Between two looks at whether somebody else took over"""
LEASE_SECONDS = 120.0
"""After such a silence somebody counts as gone: an NFS client may tell for a minute what it knew (`acregmax`), and one
renewal may be late"""


class LostError(RuntimeError):
    """Somebody else took over, because this process was silent for too long."""


@functools.cache
def machine() -> str:
    """Where numbers of processes mean the same: this machine since its start, or this container of it."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text() + os.readlink("/proc/self/ns/pid")
    except OSError:
        boot = socket.gethostname()
    return hashlib.sha256(boot.encode()).hexdigest()[:12]


def own_name() -> str:
    """A name that nobody else has, and that tells which process of which machine has it."""
    host = "".join(c if c.isalnum() else "_" for c in socket.gethostname())
    return f"{host}-{machine()}-{os.getpid()}-{_started(os.getpid())}-{secrets.token_hex(4)}"


def is_name(text: str) -> bool:
    """Whether `own_name` gave it, on whichever machine."""
    return bool(_parts(text)[0])


def is_here(name: str) -> bool:
    """Whether a name is that of a process of this machine."""
    return _parts(name)[0] == machine()


def is_ended(name: str) -> bool:
    """Whether this machine knows that the process which had this name has ended."""
    where, pid, started = _parts(name)
    return where == machine() and (_started(pid) != started or started < 0)


def is_alive(path: Path, name: str | None = None) -> bool:
    """Whether whoever keeps this file or folder is at work; by default its name is theirs."""
    if is_ended(path.name if name is None else name):
        return False
    try:
        return clock(path.parent) - path.stat().st_mtime < LEASE_SECONDS
    except FileNotFoundError:
        return False


def clock(folder: Path) -> float:
    """Seconds since the epoch, as the server of this folder has them.

    That something is made and removed here has the system forget what it thought it knew of the folder. Who may not
    write here gets this machine's time.
    """
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".clock-") as file:
            os.utime(file.fileno())
            return os.fstat(file.fileno()).st_mtime
    except OSError:
        return time.time()


def look_afresh(folder: Path) -> None:
    """Have the next look at what is in a folder ask the server, where it is on one."""
    clock(folder)


class Beat:
    """Renews the time of a file or folder while the block runs."""

    def __init__(self, path: Path, *, again: bool = False) -> None:
        """`again`: a file that somebody removed, because this process was silent for too long, is made again."""
        self.path = path
        self._again = again
        self._due = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="beat", daemon=True)

    def __enter__(self) -> Beat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    @property
    def lost(self) -> bool:
        """Whether it was taken away; looks now."""
        try:
            os.utime(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return True
        except OSError:  # the server is away for a while
            return False
        return False

    def check(self) -> None:
        """Raise LostError if it was taken away; looks now and then."""
        if time.monotonic() >= self._due:
            self._due = time.monotonic() + LOOK_SECONDS
            if self.lost:
                raise LostError(f"{self.path} was taken over by somebody else")

    def _renew(self) -> None:
        while not self._stop.wait(BEAT_SECONDS):
            if self.lost:
                if not self._again:
                    return
                with contextlib.suppress(OSError):
                    self.path.touch()


def _parts(name: str) -> tuple[str, int, int]:
    """Machine, process and when it started; nobody's where the name is none."""
    parts = name.rsplit("-", 4)
    if len(parts) == 5 and parts[2].isdigit() and parts[3].lstrip("-").isdigit():
        return parts[1], int(parts[2]), int(parts[3])
    return "", 0, -1


def _started(pid: int) -> int:
    """When a process started, in the kernel's ticks; -1 for one that has ended. Elsewhere than on Linux 0 will do."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return -1 if fields[0] in "ZX" else int(fields[19])
    except FileNotFoundError:
        pass
    if Path("/proc/self/stat").exists():
        return -1
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return -1
    except PermissionError:
        pass
    return 0
