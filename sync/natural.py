"""Natural order: digits count as numbers, whatever the case."""

from __future__ import annotations

import re


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that reads digits as numbers, and upper case as lower case.

    >>> sorted(["cam10", "CAM2", "cam1b"], key=natural_key)
    ['cam1b', 'CAM2', 'cam10']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), part) if part[0].isdecimal() else (1, 0, part.casefold()) for part in parts)
