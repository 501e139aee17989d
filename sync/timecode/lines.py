"""Text files of the rig's lines, or of one SMPTE label a line."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import numpy as np

from sync.timecode.digits import parse_rig_lines
from sync.timecode.labels import counting_notes, day_of, is_label, read_labels
from sync.timecode.series import Timecodes, counted_from_first, unwrapped, wrap_notes
from sync.tree import TIME_LIMIT_NS

MICROSECOND_NS = 1000
_NUMBERS = re.compile(r"\s*(?:#|[+-]?\.?\d)")
"""How a line begins that holds numbers, or a comment before them"""


def read_lines(path: Path, data: bytes, rate: Fraction | None) -> Timecodes | None:
    """Timecodes of a text file of the rig's lines or of labels, which need the rate; None for one of anything else."""
    first = data.split(b"\n", 1)[0].decode(errors="replace").strip()
    if is_label(first):
        lines = data.decode(errors="replace").rstrip().splitlines()
        times = read_labels(lines, rate, lambda row: f"{path}, line {row + 1}")
        assert rate is not None
        notes = counting_notes(lines, rate)
        return Timecodes(times, np.arange(len(lines)), day_of(first, rate), labelled=True, notes=notes)
    return None if _NUMBERS.match(first) else _read_rig(path, data)


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
    times, cycle, wraps = unwrapped(times, MICROSECOND_NS)
    return Timecodes(times, counted_from_first(indices), cycle, notes=wrap_notes(wraps, cycle))
