"""When cameras began to record, by what they heard.

The loudness of each recording is compared with that of every other at every shift. Sound needs 29 ms for 10 m, so
cameras that stand apart agree to about a frame, not better.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path

import av
import numpy as np

from sync.audio import Track, sound_tracks
from sync.ltc import label_channels

RATE, HOP = 8000, 8
"""Samples a second that are read, and of one step of loudness: 1 ms"""
STEP_S = HOP / RATE
MOST_SECONDS = 300.0
"""That are read of a recording, from its start"""
BLOCK_S = 20.0
"""Read at once"""
WHILE_S = 0.5
"""Loudness counts beside its mean over this long"""
REACH_S = 60.0
"""Farthest that two recordings may lie apart"""
LEAST_PEAK = 8.0
"""Robust deviations by which the best shift of two recordings must stand out; the best of 100,000 by chance has 4.4"""
LEAST_ERROR_S = 0.005
FIRST_PACKETS = 32
"""Of a video, among which is that of the first frame"""


@dataclass(frozen=True, eq=False)
class Sound:
    """Loudness of a recording."""

    start_s: float
    """When it begins, after the first frame of the video"""
    level: np.ndarray
    """float32 [n], a value each `STEP_S`, beside its mean over a while, of deviation 1; empty for silence"""


def hear(video: Path) -> Sound | None:
    """The first sound track of a video that is not silent, without channels of timecode; None where it has none."""
    tracks = sound_tracks(video)
    if not tracks:
        return None
    with av.open(str(video)) as container:
        if not container.streams.video:
            return None
        picture = container.streams.video[0]
        shown = [packet.pts for packet in islice(container.demux(picture), FIRST_PACKETS) if packet.pts is not None]
        first_s = float(min(shown, default=0) * (picture.time_base or 0))
    heard = None
    for track in tracks:
        begins, samples = _room(track)
        heard = heard or Sound(begins - first_s, np.zeros(0, np.float32))
        if len(level := loudness(samples)):
            return Sound(begins - first_s, level)
    return heard


def listen(video: Path, frame: int, seconds: float, rate: int) -> np.ndarray | None:
    """What a video holds to hear from one of its frames on, float32 [2, n] at `rate`, silent where it has a gap.

    Of the first sound track with anything but timecode on it, the first two channels that are none; one alone is heard
    on both sides. None where there is no such track, or nothing but silence.
    """
    for track in sound_tracks(video):
        labels, heard = label_channels(track), np.zeros((2, round(seconds * rate)), np.float32)
        start = _shown_at(video, frame)
        for begins, samples in track.blocks(BLOCK_S, rate):
            voices = [wave for channel, wave in enumerate(samples) if channel not in labels][:2]
            at = round((begins - start) * rate)
            if at >= heard.shape[1]:
                break
            for side in range(2 if voices else 0):
                part = voices[side % len(voices)][max(0, -at) :][: heard.shape[1] - max(at, 0)]
                heard[side, max(at, 0) : max(at, 0) + len(part)] = part
        if heard.any():
            return heard
    return None


def listen_to_one(
    videos: Mapping[str, Path], frames: Mapping[str, int], seconds: float, rate: int
) -> tuple[str, np.ndarray] | None:
    """The first of these cameras that heard anything from its frame on, and what, see `listen`; None where none did.

    `frames` are in the order in which cameras are asked; one whose frame is -1 is passed over.
    """
    for camera, frame in frames.items():
        if frame >= 0 and (heard := listen(videos[camera], frame, seconds, rate)) is not None:
            return camera, heard
    return None


def _shown_at(video: Path, frame: int) -> float:
    """When a frame of a video is shown, the container's seconds."""
    with av.open(str(video)) as container:
        picture = container.streams.video[0]
        shown = sorted(packet.pts for packet in container.demux(picture) if packet.pts is not None)
        return float(shown[frame] * (picture.time_base or 0))


def _room(track: Track) -> tuple[float, np.ndarray]:
    """When a track begins, seconds, and its sound, float32 [n] at `RATE`; silence where it has a gap."""
    labels = label_channels(track)
    begins, whole = 0.0, np.zeros(round(MOST_SECONDS * RATE), np.float32)
    end = 0
    for start, samples in track.blocks(BLOCK_S, RATE, mono=not labels):
        begins = start if not end else begins
        voices = [wave for channel, wave in enumerate(samples) if channel not in labels]
        first = max(0, round((start - begins) * RATE))
        room = whole[first : first + samples.shape[1]]
        if voices:
            room[:] = np.mean(voices, axis=0)[: len(room)]
        end = max(end, first + len(room))
        if end >= len(whole):
            break
    return begins, whole[:end]


def loudness(samples: np.ndarray) -> np.ndarray:
    """Of mono samples, float [n], at `RATE`: see `Sound.level`."""
    edges = np.diff(samples.astype(np.float64), prepend=0.0)  # rumble carries far, and says little of when
    whole = edges[: len(edges) // HOP * HOP].reshape(-1, HOP)
    if len(whole) < 2 * WHILE_S / STEP_S:
        return np.zeros(0, np.float32)
    power = (whole**2).mean(axis=1)
    level = np.log(power + 1e-3 * power.mean() + 1e-12)
    width = round(WHILE_S / STEP_S)
    sums = np.cumsum(np.concatenate([np.zeros(1), level]))
    middle = np.arange(len(level))
    first, stop = np.maximum(middle - width // 2, 0), np.minimum(middle + width // 2 + 1, len(level))
    level = level - (sums[stop] - sums[first]) / (stop - first)
    spread = level.std()
    return (level / spread).astype(np.float32) if spread > 1e-6 else np.zeros(0, np.float32)


def starts_by_sound(heard: Mapping[str, Sound]) -> dict[str, tuple[float, float]]:
    """When the first frame of each camera was filmed, and the error of that, in seconds; the first camera's is 0.

    Cameras whose sound is not that of the others are missing.
    """
    pairs = {(a, b): shift for a, b, shift in _shifts(heard)}
    names = [name for name in heard if any(name in pair for pair in pairs)]
    if not names:
        return {}
    rows = [
        (names.index(a), names.index(b), shift - heard[b].start_s + heard[a].start_s) for (a, b), shift in pairs.items()
    ]
    group = _largest_group(len(names), rows)
    chosen = [row for row in rows if row[0] in group]
    starts = _solve(len(names), chosen)
    origin = starts[min(group)]
    return {
        names[number]: (float(starts[number] - origin), max(LEAST_ERROR_S, _left(number, starts, chosen)))
        for number in sorted(group)
    }


def _left(camera: int, starts: np.ndarray, rows: list[tuple[int, int, float]]) -> float:
    """Median of what the pairs of a camera contradict its start by."""
    return float(np.median([abs(starts[b] - starts[a] - shift) for a, b, shift in rows if camera in (a, b)]))


def _shifts(heard: Mapping[str, Sound]) -> Iterator[tuple[str, str, float]]:
    """Pairs of which one shift stands out: what the first hears, the second hears so many seconds earlier in its own
    recording."""
    audible = {name: sound.level for name, sound in heard.items() if len(sound.level)}
    if len(audible) < 2:
        return
    size = 1 << int(np.ceil(np.log2(2 * max(len(level) for level in audible.values()))))
    spectra = {name: np.fft.rfft(level, size) for name, level in audible.items()}
    for a, b in combinations(audible, 2):
        reach = min(round(REACH_S / STEP_S), (min(len(audible[a]), len(audible[b])) * 3) // 4)
        levels = np.fft.irfft(spectra[a] * np.conj(spectra[b]), size)
        levels = np.concatenate([levels[-reach:], levels[: reach + 1]])  # from -reach on
        top = int(levels.argmax())
        usual = np.median(levels)
        scatter = 1.4826 * float(np.median(np.abs(levels - usual)))
        if scatter and levels[top] - usual > LEAST_PEAK * scatter:
            yield a, b, (top - reach) * STEP_S


def _largest_group(count: int, rows: list[tuple[int, int, float]]) -> set[int]:
    """Cameras that pairs connect."""
    group = list(range(count))
    for a, b, _ in rows:
        group = [group[a] if own == group[b] else own for own in group]
    usual = max(group, key=lambda own: (group.count(own), -own))
    return {number for number, own in enumerate(group) if own == usual}


def _solve(count: int, rows: list[tuple[int, int, float]]) -> np.ndarray:
    """Starts [count] whose differences are the shifts, in the least absolute sense: wrong pairs lose their say."""
    first, second = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    shifts, weights = np.array([row[2] for row in rows]), np.ones(len(rows))
    matrix = np.zeros((len(rows), count))
    matrix[np.arange(len(rows)), first], matrix[np.arange(len(rows)), second] = -1, 1
    starts: np.ndarray = np.zeros(count)
    for _ in range(50):
        starts = np.linalg.lstsq(matrix * weights[:, None], shifts * weights, rcond=None)[0]
        weights = 1 / np.sqrt(np.maximum(np.abs(matrix @ starts - shifts), 1e-4))
    return starts
