"""When each frame was taken, read from text as int64 nanoseconds and never through floating point.

Formats (docs/capture-folder.md has examples): the rig's text lines, CSV tables, JSON lists, SMPTE labels.
"""

from sync.timecode.labels import day_of, frame_to_label, frames_per_day, label_to_frame, labels_to_ns
from sync.timecode.rates import NANOSECONDS, frames_to_ns, parse_rate, ticks_to_ns
from sync.timecode.read import SUFFIXES, match_camera, read_shared_timecodes, read_timecodes
from sync.timecode.series import Timecodes, frame_numbers, together

__all__ = [
    "NANOSECONDS",
    "SUFFIXES",
    "Timecodes",
    "day_of",
    "frame_numbers",
    "frame_to_label",
    "frames_per_day",
    "frames_to_ns",
    "label_to_frame",
    "labels_to_ns",
    "match_camera",
    "parse_rate",
    "read_shared_timecodes",
    "read_timecodes",
    "ticks_to_ns",
    "together",
]
