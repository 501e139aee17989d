"""Text files: the rig's lines, or one SMPTE label a line."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np

from sync.timecode.digits import parse_rig_lines
from sync.timecode.labels import is_label, read_labels
from sync.timecode.series import Timecodes, counted_from_first
from sync.tree import TIME_LIMIT_NS


def read_lines(path: Path, data: bytes, rate: Fraction | None) -> Timecodes:
    """Timecodes of a .txt file; labels need the rate."""
    first = data.split(b"\n", 1)[0].decode(errors="replace").strip()
    if not is_label(first):
        return _read_rig(path, data)
    lines = data.decode(errors="replace").rstrip().splitlines()
    return Timecodes(read_labels(lines, rate, lambda row: f"{path}, line {row + 1}"), np.arange(len(lines)))


def _read_rig(path: Path, data: bytes) -> Timecodes:
    data = data.rstrip()
    lines = data.count(b"\n") + 1
    times, indices = np.empty(lines, np.int64), np.empty(lines, np.int64)
    parsed = parse_rig_lines(np.frombuffer(data, np.uint8), times, indices, TIME_LIMIT_NS)
    if parsed < lines:
        content = data.split(b"\n")[parsed][:80].decode(errors="replace")
        raise ValueError(
            f"{path}, line {parsed + 1}: expected 'frame_<microseconds>_<12-digit index>' or, in all lines, "
            f"HH:MM:SS:FF; got {content.rstrip()!r}"
        )
    return Timecodes(times, counted_from_first(indices))
