"""SMPTE labels HH:MM:SS:FF, with and without dropped labels."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np

from sync.timecode.rates import NANOSECONDS, frames_to_ns

_CLOCK = re.compile(r"(\d\d):([0-5]\d):([0-5]\d)[.,](\d{3,12})")
_LABEL = re.compile(r"(\d\d):([0-5]\d):([0-5]\d)([:;.,])(\d{2,3})")


def is_label(text: str) -> bool:
    """Whether a text has the form of a label; the rate decides whether there is such a label."""
    return _LABEL.fullmatch(text) is not None and not is_clock(text)


def is_clock(text: str) -> bool:
    """Whether a text is a time of day with decimals of a second, three or more, and so no label."""
    return _CLOCK.fullmatch(text) is not None


def read_clocks(texts: Sequence[str], place: Callable[[int], str]) -> np.ndarray:
    """Times of day HH:MM:SS.fff in the order of recording to ns since midnight, over any midnights; int64 [n]."""
    found = np.empty(len(texts), np.int64)
    for row, text in enumerate(texts):
        match = _CLOCK.fullmatch(text.strip())
        if match is None or int(match[1]) > 23:
            raise ValueError(f"{place(row)}: expected a time of day as 12:34:56.789, got {text[:80]!r}")
        seconds = (int(match[1]) * 60 + int(match[2])) * 60 + int(match[3])
        found[row] = seconds * NANOSECONDS + int((match[4] + "0" * 9)[:9])
    day = 86_400 * NANOSECONDS
    steps = np.diff(found, prepend=found[:1])
    found += day * np.cumsum((steps < -(day // 2)).astype(np.int64) - (steps > day // 2))
    return found


def label_to_frame(label: str, rate: Fraction) -> int:
    """Frames since midnight of an SMPTE label HH:MM:SS:FF, or HH:MM:SS;FF with dropped labels.

    Drop-frame labels skip the first 2 (at 29.97), 4 (59.94) or 8 (119.88) labels of every minute that is not a
    multiple of ten.

    >>> label_to_frame("00:01:00;02", Fraction(30000, 1001))
    1800

    Raises:
        ValueError: not a label, or one that does not exist at this rate.
    """
    match = _LABEL.fullmatch(label.strip())
    nominal = round(rate)
    if match is None or int(match[1]) > 23 or int(match[5]) >= nominal:
        raise ValueError(f"{label!r} is no SMPTE label HH:MM:SS:FF at {rate} frames per second")
    minutes, seconds, frame = int(match[1]) * 60 + int(match[2]), int(match[3]), int(match[5])
    number = (minutes * 60 + seconds) * nominal + frame
    if match[4] == ":":
        return number
    dropped = _dropped_labels(rate)
    if minutes % 10 and seconds == 0 and frame < dropped:
        raise ValueError(f"{label!r} is a label that drop-frame counting skips")
    return number - dropped * (minutes - minutes // 10)


def frame_to_label(frame: int, rate: Fraction, *, drop_frame: bool = False) -> str:
    """The SMPTE label of a frame counted from midnight; the inverse of `label_to_frame`.

    >>> frame_to_label(1800, Fraction(30000, 1001), drop_frame=True)
    '00:01:00;02'
    """
    nominal = round(rate)
    frame %= frames_per_day(rate, drop_frame=drop_frame)
    if drop_frame:
        dropped = _dropped_labels(rate)
        tens, rest = divmod(frame, nominal * 600 - 9 * dropped)
        minutes = max(0, rest - dropped) // (nominal * 60 - dropped)  # the first minute of ten drops nothing
        frame += dropped * (9 * tens + minutes)
    seconds, frame = divmod(frame, nominal)
    hours, minutes = seconds // 3600, seconds // 60 % 60
    return f"{hours:02}:{minutes:02}:{seconds % 60:02}{';' if drop_frame else ':'}{frame:02}"


def frames_per_day(rate: Fraction, *, drop_frame: bool) -> int:
    """Labels between midnight and midnight; in drop-frame counting that is 86.4 ms less than a day."""
    return round(rate) * 86400 - (_dropped_labels(rate) * (1440 - 144) if drop_frame else 0)


def labels_to_ns(labels: Sequence[str], rate: Fraction) -> np.ndarray:
    """SMPTE labels in the order of recording to nanoseconds since midnight, int64 [n].

    A label more than half a day before the one ahead of it lies behind midnight and gets another day's frames, not
    86,400 s: labels count frames.

    Raises:
        ValueError: as `label_to_frame`; dropped and plain labels mixed.
    """
    kinds = {":" in label.strip()[8:9] for label in labels}
    if len(kinds) > 1:
        raise ValueError("labels of one camera must all be drop-frame (HH:MM:SS;FF) or all plain (HH:MM:SS:FF)")
    frames = np.array([label_to_frame(label, rate) for label in labels], dtype=np.int64)
    day = frames_per_day(rate, drop_frame=kinds == {False})
    steps = np.diff(frames, prepend=frames[:1])
    frames += day * np.cumsum((steps < -(day // 2)).astype(np.int64) - (steps > day // 2))
    return frames_to_ns(frames, rate)


def day_of(label: str, rate: Fraction) -> int:
    """Nanoseconds after which labels like this one start over."""
    return int(frames_to_ns(np.array([frames_per_day(rate, drop_frame=":" not in label.strip()[8:9])]), rate)[0])


def counting_notes(labels: Sequence[str], rate: Fraction) -> tuple[str, ...]:
    """That labels start each second early, and so count at another rate than they are taken to.

    A camera that drops frames loses some labels of a second, not the same last ones of each.
    """
    parts = [match for label in labels if (match := _LABEL.fullmatch(label.strip()))]
    last = [int(a[5]) for a, b in pairwise(parts) if a[3] != b[3]]
    highest = max((int(part[5]) for part in parts), default=0)
    if len(last) < 2 or highest + 1 >= round(rate) or sum(number == highest for number in last) * 2 <= len(last):
        return ()
    return (
        f"its labels end each second at :{highest:02}, as {highest + 1} a second do, but are counted at "
        f"{float(rate):g}; set fps in capture.toml to the rate of the labels, or export them at the video's",
    )


def read_labels(labels: Sequence[str], rate: Fraction | None, place: Callable[[int], str]) -> np.ndarray:
    """`labels_to_ns` of a file's labels; `place` says for messages where row k stands."""
    if rate is None:
        raise ValueError(f"{place(0)}: SMPTE labels need the frame rate; give it in capture.toml: fps = '30000/1001'")
    for row, label in enumerate(labels):
        try:
            label_to_frame(label, rate)
        except ValueError as error:
            raise ValueError(f"{place(row)}: {error}") from None
    return labels_to_ns(labels, rate)


def _dropped_labels(rate: Fraction) -> int:
    nominal = round(rate)
    if rate.denominator != 1001 or nominal % 30:
        raise ValueError(f"drop-frame labels exist at 29.97, 59.94 and 119.88 frames per second, but not at {rate}")
    return nominal // 15
