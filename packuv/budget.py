"""How much memory may be taken by what could be made again: pictures, layers of a backdrop, maps of lenses.

What does not fit is read or made again whenever it is needed. Results do not depend on it, times do.
"""

from __future__ import annotations

from threading import Lock

USUAL_BYTES = 2_000_000_000
"""Of one job"""


class Budget:
    """Bytes that several holders share: who comes first is served. Safe to use from several threads."""

    def __init__(self, total_bytes: int = USUAL_BYTES) -> None:
        """Raises ValueError for less than nothing."""
        if total_bytes < 0:
            raise ValueError(f"a budget needs 0 bytes or more, but is given {total_bytes}")
        self.total_bytes = total_bytes
        self._taken_bytes = 0
        self._guard = Lock()

    @property
    def free_bytes(self) -> int:
        return self.total_bytes - self._taken_bytes

    def take(self, size: int) -> bool:
        """Whether there is room for so many bytes; then they are taken."""
        with self._guard:
            if self._taken_bytes + size > self.total_bytes:
                return False
            self._taken_bytes += size
            return True

    def give(self, size: int) -> None:
        """Give bytes back."""
        with self._guard:
            self._taken_bytes -= size
