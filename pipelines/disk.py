"""How much room a disk has, in numbers and in words."""

from __future__ import annotations

import shutil
from pathlib import Path

from tasks.artefacts.retention import files_in

BLOCK_BYTES = 512
"""Unit of st_blocks, whatever the file system's own"""


def free_bytes(path: Path) -> int:
    """On the disk where `path` is, or would be."""
    return shutil.disk_usage(_existing(path.absolute())).free


def used_bytes(folder: Path) -> int:
    """What the files in a folder take of their disk; a file that is not written yet takes nothing."""
    return sum(status.st_blocks * BLOCK_BYTES for status in files_in(folder))


def _existing(path: Path) -> Path:
    return path if path.exists() else _existing(path.parent)


def size_text(count: float) -> str:
    """Bytes for people, decimal units."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}" if unit != "B" else f"{count:.0f} B"
        count /= 1000
    return f"{count:,.1f} GB"
