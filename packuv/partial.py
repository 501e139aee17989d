"""The name of a file or folder that is not whole yet. Light to import, since the command line does."""

from __future__ import annotations

import os
import threading
from pathlib import Path


def partial_path(path: Path, suffix: str = "") -> Path:
    """Where to write what will get the name `path`: beside it, and used by no other process or thread."""
    return path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.partial{suffix}")
