"""Linear timecode (LTC) on a sound track: SMPTE ST 12-1, 80 bits a frame, each a wave that turns at its borders, a one
in its middle, too."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from sync.audio import Track, sound_tracks
from sync.timecode import NANOSECONDS, frame_to_label, labels_to_ns
from sync.tree import whole_file

KEPT = 3
"""Version of the files of what was heard"""
RATE = 48_000
"""Samples a second that are read"""
LOOK_S, BLOCK_S = 10.0, 60.0
"""Of a track, in which there must be labels for it to be read to its end; and what is read at once then"""
LOOKS, SILENT = 12, 1e-6
"""Times so long that are looked at while all is silent, which is below the least step of 16 bits"""
FEWEST_LABELS, MOST = 10, 0.5
"""For it to be labels; and the share of them that must go on with the sound, or most are misread"""
LONG_S = 16.5 / RATE
"""Between half a bit at 24 frames a second, 260 us, and a whole one at 30, 417 us"""
LONGEST_S = 2 * LONG_S
"""Longer than any bit: silence, or something else"""
WHILE = RATE // 20
"""Samples in which a wave's middle and height are measured"""
HUM = RATE // 500
"""Samples of four bits and more, over which a mean is taken off"""
APART_S = 1.5
"""Between the labels of two channels, which are compared without their rate, for them to disagree"""
HYSTERESIS, QUIET = 0.1, 0.2
"""Of the wave's height about there, which noise does not cross; and of its greatest height, below which it is silent"""
STEEP = 2
"""Samples within which a wave turns; between others it is silent, and turns where it is heard again"""
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


Heard = tuple[Ltc | None, tuple[str, ...]]
"""What is heard, None where there is nothing, and what of it a person should know"""


def hear_ltc(path: Path, pts_ns: np.ndarray, kept: Path | None = None) -> Heard:
    """Times of the frames of a video by the LTC on one of its sound channels.

    Args:
        pts_ns: int64 [frames], presentation times in the container.
        kept: folder for what was heard, so that no track with LTC is read twice; None keeps nothing.
    """
    place = None if kept is None else kept / f"{_mark(path)}.npz"
    known = None if place is None else _known(place, len(pts_ns))
    if known is not None:
        return known
    heard, notes = _hear(path, pts_ns)
    if place is not None and heard is not None:
        _keep(place, heard, notes)
    return heard, notes


def _mark(path: Path) -> str:
    """Of a file as it is now."""
    seen = path.stat()
    words = (KEPT, path.resolve(), seen.st_size, seen.st_mtime_ns, seen.st_ctime_ns, seen.st_ino)
    return hashlib.sha256("\0".join(map(str, words)).encode()).hexdigest()


def _known(place: Path, frames: int) -> Heard | None:
    damaged = (OSError, EOFError, ValueError, KeyError, BadZipFile)
    with suppress(*damaged), open(place, "rb") as file, np.load(file, allow_pickle=False) as data:
        said, times = json.loads(str(data["said"])), data["times_ns"]
        if times.shape == (frames,) and times.dtype == np.int64:
            return Ltc(times, said["label"], Fraction(said["rate"]), said["jumps"]), tuple(said["notes"])
    return None


def _keep(place: Path, heard: Ltc, notes: Sequence[str]) -> None:
    said = {"label": heard.label, "rate": str(heard.rate), "jumps": heard.jumps, "notes": list(notes)}
    place.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(place) as file:
        np.savez(file, times_ns=heard.times_ns, said=np.array(json.dumps(said)))


def _hear(path: Path, pts_ns: np.ndarray) -> Heard:
    places, unread = _look(path)
    if not places:
        return None, tuple(map(_distorted, unread))
    first, *others = places
    heard = [decode_ltc(samples[first.channel], start) for start, samples in first.track.blocks(BLOCK_S, RATE)]
    labels = _joined([found for found in heard if found])
    if labels is None:
        return None, (_distorted(first),)
    rate = _rate(labels)
    if rate is None:
        per_second = 1 / float(np.median(np.diff(labels.begins_s)))
        odd = f"{first} carries LTC of {per_second:.4g} labels a second, which is no rate of labels"
        return None, (f"{odd}: is the sample rate in the file's header right? it is not used",)
    told = _of_frames(labels, rate, pts_ns)
    if told is None:
        return None, (_distorted(first),)
    return told, tuple(_place_notes(first, others))


def _distorted(place: object) -> str:
    return f"{place} carries LTC, but is too distorted to be read; it is not used"


@dataclass(frozen=True)
class _Place:
    """A channel of a sound track that begins with labels."""

    track: Track
    channel: int
    late_s: float
    """By how much the labels are later than the container's time, nearly"""

    def __str__(self) -> str:
        return f"channel {self.channel + 1} of sound track {self.track.number + 1}"


def _look(path: Path) -> tuple[list[_Place], list[str]]:
    """Channels that begin with labels, and those that begin with what could be labels."""
    places, unread = list[_Place](), list[str]()
    for track in sound_tracks(path):
        for start, samples in _first_sound(track):
            for channel, wave in enumerate(samples):
                if labels := decode_ltc(wave, start):
                    hours, minutes, seconds, frames = labels.fields[0]
                    said = (hours * 60 + minutes) * 60 + seconds + frames / 25
                    places.append(_Place(track, channel, float(said - labels.begins_s[0])))
                elif len(_words(wave)[0]) >= FEWEST_LABELS:
                    unread.append(str(_Place(track, channel, 0.0)))
    return places, unread


def _first_sound(track: Track) -> Iterator[tuple[float, np.ndarray]]:
    """The first block of a track that is not silent: a timecode box may be switched on after the camera."""
    for start, samples in islice(track.blocks(LOOK_S, RATE), LOOKS):
        if np.ptp(samples, axis=1).max(initial=0.0) > SILENT:
            yield start, samples
            return


def label_channels(track: Track) -> set[int]:
    """Channels of a track that begin with labels, or with what could be labels."""
    for _, samples in _first_sound(track):
        return {channel for channel, wave in enumerate(samples) if len(_words(wave)[0]) >= FEWEST_LABELS}
    return set()


def _place_notes(first: _Place, others: Sequence[_Place]) -> Iterator[str]:
    if first.track.damaged:
        packets = "packet" if first.track.damaged == 1 else "packets"
        yield f"{first.track.damaged} {packets} of the sound track with LTC are damaged: its labels go on over them"
    for other in others:
        if abs(other.late_s - first.late_s) > APART_S:
            yield (
                f"{other} carries LTC, too, which is {other.late_s - first.late_s:+.1f} s from that of {first}; the "
                "latter is used"
            )


def _joined(found: Sequence[_Labels]) -> _Labels | None:
    if not found:
        return None
    begins = np.concatenate([labels.begins_s for labels in found])
    return _Labels(begins, np.concatenate([labels.fields for labels in found]), found[0].drop)


def decode_ltc(samples: np.ndarray, start_s: float = 0.0) -> _Labels | None:
    """Labels in samples, float [n] at RATE; None where there are hardly any."""
    words, begins, ends = _words(samples)
    if len(words) < FEWEST_LABELS:
        return None
    begins = start_s + begins
    fields = np.stack([_field(words, *places) for places in FIELDS.values()], axis=1)
    right = (fields < [24, 60, 60, 30]).all(axis=1) & _whole(begins, ends)
    if not right.any():
        return None
    _, minutes, seconds, frames = fields[right].T
    skipped = (minutes % 10 > 0) & (seconds == 0) & (frames < 2)  # by drop-frame counting
    drop = bool(words[right, DROP_FLAG].mean() > 0.5 and not skipped.any())
    return _consistent(_Labels(begins[right], fields[right], drop))


def _words(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What ends with a sync word: uint8 [n, BITS], when it begins, float64 [n], seconds, and at which bit it ends.

    It begins where a line through its bits does: where each begins is off by a part of a sample, by more where the wave
    is dull or noisy, and the first one after silence by more still.
    """
    bits, starts = _bits(_turns(samples))
    if len(bits) < BITS:
        return np.zeros((0, BITS), np.uint8), np.zeros(0), np.zeros(0, np.int64)
    ends = np.flatnonzero((np.lib.stride_tricks.sliding_window_view(bits, len(SYNC)) == SYNC).all(axis=1)) + len(SYNC)
    ends = ends[ends >= BITS]
    places = ends[:, None] - BITS + np.arange(BITS)
    return bits[places], np.polyfit(np.arange(BITS), starts[places].T, 1)[1] / RATE, ends


def _turns(samples: np.ndarray) -> np.ndarray:
    """Where a wave crosses its middle, float64 [n], in samples; what is far below the usual height does not count."""
    whole = _without_hum(samples[: len(samples) // WHILE * WHILE]).reshape(-1, WHILE)
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
    between = before + wave[before] / (wave[before] - wave[after]) * (after - before)
    return np.where(after - before > STEEP, after - 0.5, between)


def _without_hum(samples: np.ndarray) -> np.ndarray:
    """Less the mean of some bits around, float64 [n]: what is slower than labels, as the hum of mains."""
    sums = np.concatenate([np.zeros(1), np.cumsum(samples, dtype=np.float64)])
    middle = np.arange(len(samples))
    first, stop = np.maximum(middle - HUM // 2, 0), np.minimum(middle + HUM // 2 + 1, len(samples))
    left: np.ndarray = samples - (sums[stop] - sums[first]) / (stop - first)
    return left


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


def _of_frames(labels: _Labels, rate: Fraction, pts_ns: np.ndarray) -> Ltc | None:
    """Each frame by the label that was heard last when it was shown, the first ones by the first label; None where
    most labels are misread."""
    mark = ";" if labels.drop else ":"
    texts = [
        f"{hours:02}:{minutes:02}:{seconds:02}{mark}{frame:02}" for hours, minutes, seconds, frame in labels.fields
    ]
    said, begins = labels_to_ns(texts, rate), np.rint(labels.begins_s * NANOSECONDS).astype(np.int64)
    late = said - begins
    runs = np.cumsum(np.abs(np.diff(late, prepend=late[:1])) > NANOSECONDS / 2 / rate)
    believed = np.bincount(runs)[runs] >= FEWEST_LABELS  # fewer in a row that agree are misread
    if believed.mean() < MOST:
        return None
    late, begins = late[believed], begins[believed]
    times = late[np.maximum(np.searchsorted(begins, pts_ns, side="right") - 1, 0)] + pts_ns
    first = round(Fraction(int(times[0])) * rate / NANOSECONDS)
    jumps = int((np.abs(np.diff(late)) > NANOSECONDS / 2 / rate).sum())
    return Ltc(times, frame_to_label(first, rate, drop_frame=labels.drop), rate, jumps)
