"""Natural order: digits count as numbers."""

from __future__ import annotations

import re


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that reads digits as numbers.

    >>> sorted(["cam10", "cam2", "cam1b"], key=natural_key)
    ['cam1b', 'cam2', 'cam10']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), part) if part[0].isdecimal() else (1, 0, part) for part in parts)
