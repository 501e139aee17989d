"""Files that are whole or absent: written beside, synced, renamed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Readable JSON, keys in the given order."""
    _write(path, lambda file: file.write(json.dumps(data, indent=1).encode()))


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Arrays by name, not compressed."""
    _write(path, lambda file: np.savez(file, **dict(arrays)))  # type: ignore[arg-type]


def _write(path: Path, fill: Callable[[BinaryIO], Any]) -> None:
    partial = path.with_name(f".{path.name}.partial")
    with open(partial, "wb") as file:
        fill(file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)
