"""Linear timecode (LTC) on a sound track: SMPTE ST 12-1, 80 bits a frame, each a wave that turns at its borders, a one
in its middle, too."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path

import av
import numpy as np

from sync.timecode import NANOSECONDS, frame_to_label, labels_to_ns

RATE = 48_000
"""Samples a second that are read"""
LOOK_S, BLOCK_S = 10.0, 60.0
"""Of a track, in which there must be labels for it to be read to its end; and what is read at once then"""
FEWEST_LABELS = 10
LONG_S = 16.5 / RATE
"""Between half a bit at 24 frames a second, 260 us, and a whole one at 30, 417 us"""
LONGEST_S = 2 * LONG_S
"""Longer than any bit: silence, or something else"""
WHILE = RATE // 20
"""Samples in which a wave's middle and height are measured"""
HYSTERESIS, QUIET = 0.1, 0.2
"""Of the wave's height about there, which noise does not cross; and of its greatest height, below which it is silent"""
BITS = 80
SYNC = np.array([0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 1], np.uint8)
"""The last bits of a frame"""
DROP_RATE = Fraction(30000, 1001)
RATES = (Fraction(24000, 1001), Fraction(24), Fraction(25), DROP_RATE, Fraction(30))
LAST_FRAME = 23
"""Of a second at the lowest rate"""
DROP_FLAG = 10
FIELDS = {"hours": (48, 56, 2), "minutes": (32, 40, 3), "seconds": (16, 24, 3), "frames": (0, 8, 2)}
"""First bit of the units (four) and of the tens, and how many bits tens have; the lowest comes first"""


@dataclass(frozen=True, eq=False)
class Ltc:
    """What the labels on a sound track say of the frames of a video."""

    times_ns: np.ndarray
    """int64 [frames], since midnight"""
    label: str
    """That of the first frame"""
    rate: Fraction
    """Labels a second"""
    jumps: int
    """How often labels do not go on with the sound"""


@dataclass(frozen=True, eq=False)
class _Labels:
    """Labels as they were heard, in order."""

    begins_s: np.ndarray
    """float64 [n], in the container's time"""
    fields: np.ndarray
    """int64 [n, 4]: hours, minutes, seconds, frames"""
    drop: bool


def hear_ltc(path: Path, pts_ns: np.ndarray) -> Ltc | None:
    """Times of the frames of a video by the LTC on one of its sound channels; None where there is none.

    Args:
        pts_ns: int64 [frames], presentation times in the container.
    """
    place = _find(path)
    if place is None:
        return None
    track, channel = place
    heard = [decode_ltc(samples[channel], start) for start, samples in _blocks(path, track, BLOCK_S)]
    labels = _joined([found for found in heard if found])
    rate = _rate(labels) if labels else None
    return _of_frames(labels, rate, pts_ns) if labels and rate else None


def _find(path: Path) -> tuple[int, int] | None:
    """The track and channel that begin with labels."""
    tracks = 0
    with suppress(av.FFmpegError), av.open(str(path)) as container:
        tracks = len(container.streams.audio)
    for track in range(tracks):
        for start, samples in islice(_blocks(path, track, LOOK_S), 1):
            for channel, wave in enumerate(samples):
                if decode_ltc(wave, start):
                    return track, channel
    return None


def _blocks(path: Path, track: int, seconds: float) -> Iterator[tuple[float, np.ndarray]]:
    """Start in seconds and samples, float32 [channels, n] at RATE, of a sound track, as far as it is whole."""
    parts: list[np.ndarray] = []
    begins, count = 0.0, 0
    with suppress(av.FFmpegError), av.open(str(path)) as container:
        stream = container.streams.audio[track]
        resampler = av.AudioResampler("fltp", stream.layout, RATE)
        for frame in container.decode(stream):
            begins = begins if parts or count else float(frame.time or 0.0)
            parts += [piece.to_ndarray() for piece in resampler.resample(frame)]
            if sum(part.shape[1] for part in parts) >= seconds * RATE:
                yield begins + count / RATE, (block := np.concatenate(parts, axis=1))
                parts, count = [], count + block.shape[1]
    if parts:
        yield begins + count / RATE, np.concatenate(parts, axis=1)


def _joined(found: Sequence[_Labels]) -> _Labels | None:
    if not found:
        return None
    begins = np.concatenate([labels.begins_s for labels in found])
    return _Labels(begins, np.concatenate([labels.fields for labels in found]), found[0].drop)


def decode_ltc(samples: np.ndarray, start_s: float = 0.0) -> _Labels | None:
    """Labels in samples, float [n] at RATE; None where there are hardly any."""
    turns = _turns(samples)
    bits, starts = _bits(turns)
    if len(bits) < FEWEST_LABELS * BITS:
        return None
    ends = np.flatnonzero((np.lib.stride_tricks.sliding_window_view(bits, len(SYNC)) == SYNC).all(axis=1)) + len(SYNC)
    ends = ends[ends >= BITS]
    if len(ends) < FEWEST_LABELS:
        return None
    words = bits[ends[:, None] - BITS + np.arange(BITS)]
    fields = np.stack([_field(words, *places) for places in FIELDS.values()], axis=1)
    begins = start_s + starts[ends - BITS] / RATE
    right = (fields < [24, 60, 60, 30]).all(axis=1) & _whole(begins, ends)
    _, minutes, seconds, frames = fields[right].T
    skipped = (minutes % 10 > 0) & (seconds == 0) & (frames < 2)  # by drop-frame counting
    drop = bool(words[right, DROP_FLAG].mean() > 0.5 and not skipped.any())
    return _consistent(_Labels(begins[right], fields[right], drop)) if right.any() else None


def _turns(samples: np.ndarray) -> np.ndarray:
    """Where a wave crosses its middle, float64 [n], in samples; what is far below the usual height does not count."""
    whole = samples[: len(samples) // WHILE * WHILE].astype(np.float64).reshape(-1, WHILE)
    if not len(whole):
        return np.zeros(0)
    low, high = np.percentile(whole, (5, 95), axis=1)
    heights = (high - low) / 2
    wave = (whole - ((low + high) / 2)[:, None]).ravel()
    least = HYSTERESIS * np.where(heights > QUIET * heights.max(), heights, np.inf)
    sure = np.flatnonzero(np.abs(wave) > np.repeat(least, WHILE))
    if len(sure) < 2:
        return np.zeros(0)
    turned = np.flatnonzero(np.diff(np.sign(wave[sure])))
    before, after = sure[turned], sure[turned + 1]
    turns: np.ndarray = before + wave[before] / (wave[before] - wave[after]) * (after - before)
    return turns


def _bits(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits, uint8 [n], and where each begins: a long step is a zero, two short ones are a one. A short step without a
    second is left out; the word that it stood in will not fit."""
    steps = np.diff(turns) / RATE
    if not len(steps):
        return np.zeros(0, np.uint8), np.zeros(0)
    short = steps < LONG_S
    borders = np.flatnonzero(np.diff(short, prepend=~short[:1]))
    within = np.arange(len(steps)) - np.repeat(borders, np.diff(borders, append=len(steps)))
    second = short & (within % 2 == 1)
    last = np.flatnonzero(second | (~short & (steps < LONGEST_S)))
    return second[last].astype(np.uint8), turns[last - second[last]]


def _field(words: np.ndarray, units: int, tens: int, width: int) -> np.ndarray:
    """Two decimal digits, int64 [n], of bits [n, BITS]; 99 where the units are no digit."""
    ones = words[:, units : units + 4].astype(np.int64) @ (1 << np.arange(4))
    more = words[:, tens : tens + width].astype(np.int64) @ (1 << np.arange(width))
    return np.where(ones > 9, 99, ones + 10 * more)


def _whole(begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Whether a word follows or precedes another one by BITS bits and the time of a frame."""
    steps = np.diff(begins)
    near = (np.diff(ends) == BITS) & (steps > 0.9 / float(RATES[-1])) & (steps < 1.1 / float(RATES[0]))
    return _either(near)


def _either(pairs: np.ndarray) -> np.ndarray:
    """bool [n] of those that are in one of [n - 1] pairs of neighbours."""
    either: np.ndarray = np.append(pairs, False) | np.append(False, pairs)
    return either


def _consistent(labels: _Labels) -> _Labels | None:
    """Without those that are not the next one's predecessor, or the last one's successor, by their digits."""
    hours, minutes, seconds, frames = labels.fields.T
    whole = (hours * 60 + minutes) * 60 + seconds
    turns_over = ((whole[1:] - whole[:-1]) % 86400 == 1) & np.isin(frames[1:], (0, 2)) & (frames[:-1] >= LAST_FRAME)
    follows = ((np.diff(whole) == 0) & (np.diff(frames) == 1)) | turns_over
    kept = _either(follows)
    if kept.sum() < FEWEST_LABELS:
        return None
    return _Labels(labels.begins_s[kept], labels.fields[kept], labels.drop)


def _rate(labels: _Labels) -> Fraction | None:
    """At which the labels count: by their time, and by the highest frame number; None where none fits."""
    steps = np.diff(labels.begins_s)
    usual = steps[steps < 1.5 * np.median(steps)]
    measured = 1 / float(usual.mean())
    rates = [rate for rate in RATES if not labels.drop or rate == DROP_RATE]
    best = min(rates, key=lambda rate: abs(float(rate) / measured - 1))
    fits = abs(float(best) / measured - 1) < 0.005 and labels.fields[:, 3].max() < round(best)
    return best if fits else None


def _of_frames(labels: _Labels, rate: Fraction, pts_ns: np.ndarray) -> Ltc:
    """Each frame by the label that was heard last when it was shown, the first ones by the first label."""
    mark = ";" if labels.drop else ":"
    texts = [
        f"{hours:02}:{minutes:02}:{seconds:02}{mark}{frame:02}" for hours, minutes, seconds, frame in labels.fields
    ]
    said, begins = labels_to_ns(texts, rate), np.rint(labels.begins_s * NANOSECONDS).astype(np.int64)
    late = said - begins
    runs = np.cumsum(np.abs(np.diff(late, prepend=late[:1])) > NANOSECONDS / 2 / rate)
    believed = np.bincount(runs)[runs] >= FEWEST_LABELS  # fewer in a row that agree are misread
    late, begins = (late[believed], begins[believed]) if believed.any() else (late, begins)
    times = late[np.maximum(np.searchsorted(begins, pts_ns, side="right") - 1, 0)] + pts_ns
    first = round(Fraction(int(times[0])) * rate / NANOSECONDS)
    jumps = int((np.abs(np.diff(late)) > NANOSECONDS / 2 / rate).sum())
    return Ltc(times, frame_to_label(first, rate, drop_frame=labels.drop), rate, jumps)
