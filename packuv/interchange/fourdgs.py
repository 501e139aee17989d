"""The .4dgs container, by the library `fourdgs` (`packuv[4dgs]`): each Gaussian has a window of time for itself.

What stays the same from frame to frame is one Gaussian with a long window; what moves is another one in each frame, so
that every frame is what the scene shows, and nothing is guessed between frames. The library rounds everything to steps
that it declares; SH above band 0 are bytes over -4..4, and colours are cut to 0..1. Sound goes along as FLAC, from
nowhere in particular.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import whole_file
from packuv.gaussians.floats import SH_C0, Gaussians, arrays, opacity, rows_of
from packuv.interchange.clip import Clip
from packuv.interchange.conventions import half_turn, is_drawn, unit
from packuv.interchange.joined import equal_rows
from packuv.scene.sound import LAYOUT, Sound

SH_REACH = 4.0
"""Of the bytes of SH"""
SAID = {"coordinate_system": "y-up-right-handed", "color_space": "srgb-rec709-display"}


def write_fourdgs(path: Path, clip: Clip) -> int:
    """Write frames at their times and return the number of drawn Gaussians in all of them.

    A Gaussian says as source group and index which segment and row it is of, so that the same row can be followed.
    Raises ValueError where the library is missing, or for frames without any Gaussian.
    """
    library, spans = _library(), _Spans()
    seconds = clip.seconds
    for time, segment, gaussians in zip(seconds, clip.segments, clip, strict=True):
        spans.add(float(time), segment, gaussians)
    end = float(seconds[-1] + 1 / clip.rate)
    if not spans.count:
        raise ValueError("a .4dgs file holds a Gaussian at least, but these frames have none; choose PLY")
    sources = _sources(library, clip.sound())
    options = library.WriteOptions(profile="fine", preserve_source_ids=True, library="packuv", metadata=SAID)
    with whole_file(path) as partial:
        library.write(str(partial), spans.whole(library, end), end, options=options, audio_sources=sources)
    return spans.drawn


def _sources(library: Any, sound: Sound | None) -> list[Any]:
    """What is heard, as the library has it: stereo, the same wherever one looks."""
    if sound is None:
        return []
    entry = sound.entry
    return [
        library.AudioSource(
            source_id=0,
            codec=entry.codec,
            data=sound.flac,
            name=sound.camera,
            channel_layout=LAYOUT,
            duration_sec=entry.seconds,
            spatial=False,
        )
    ]


def _library() -> Any:
    try:
        import fourdgs
    except ImportError:
        raise ValueError(
            ".4dgs is written by the library fourdgs, which is not there; pip install 'packuv[4dgs]'"
        ) from None
    return fourdgs


@dataclass
class _Spans:
    """Gaussians with the windows in which they stay the same."""

    count: int = 0
    drawn: int = 0
    _parts: list[Gaussians] = field(default_factory=list)
    _starts: list[np.ndarray] = field(default_factory=list)
    _ends: list[tuple[np.ndarray, float]] = field(default_factory=list)
    """Numbers of those that ended, and when"""
    _sources: list[np.ndarray] = field(default_factory=list)
    """Segment and row of each, int64 [n, 2]"""
    _open: tuple[np.ndarray, np.ndarray] = (np.zeros(0, "V1"), np.zeros(0, np.int64))
    """Of the last frame's Gaussians: all values as bytes, and their numbers"""

    def add(self, time: float, segment: int, gaussians: Gaussians) -> None:
        """The next frame, all rows of it."""
        rows = np.flatnonzero(is_drawn(gaussians))
        kept = rows_of(gaussians, rows)
        values, (last, numbers) = _as_bytes(kept), self._open
        same = equal_rows(values, last) if len(last) and len(values) else np.full(len(kept), -1)
        born = same < 0
        ended = np.ones(len(numbers), bool)
        ended[same[~born]] = False
        self._ends.append((numbers[ended], time))
        own = np.empty(len(kept), np.int64)
        own[~born] = numbers[same[~born]]
        own[born] = self.count + np.arange(born.sum())
        self._open = values, own
        self._parts.append(rows_of(kept, born))
        self._starts.append(np.full(born.sum(), time))
        self._sources.append(np.column_stack([np.full(born.sum(), segment), rows[born]]))
        self.count += int(born.sum())
        self.drawn += len(kept)

    def whole(self, library: Any, end: float) -> Any:
        """As the library's GaussianSet; what is still there ends at `end`."""
        all_of = half_turn(Gaussians(*map(np.concatenate, zip(*map(arrays, self._parts), strict=True))))
        starts, ends = np.concatenate(self._starts), np.full(self.count, end)
        for numbers, time in self._ends:
            ends[numbers] = time
        sources = np.concatenate(self._sources)
        colours = np.column_stack([np.clip(0.5 + SH_C0 * all_of.sh[:, 0], 0, 1), opacity(all_of)])
        bands = all_of.sh[:, 1:].transpose(0, 2, 1).reshape(self.count, -1)  # channel by channel
        codes = np.clip(np.rint((bands + SH_REACH) / (2 * SH_REACH) * 255), 0, 255).astype(np.uint8)
        return library.GaussianSet(
            positions=all_of.means,
            scales=np.exp(all_of.log_scales),
            rotations=unit(all_of.quaternions)[:, [1, 2, 3, 0]].astype(np.float32),
            colors=colours.astype(np.float32),
            motions=np.zeros((self.count, 3), np.float32),
            mu_t=starts.astype(np.float32),
            sigma_t=np.full(self.count, np.inf, np.float32),
            win_lo=starts,
            win_hi=ends,
            sh=codes if all_of.sh_degree else None,
            sh_degree=all_of.sh_degree,
            source_group=sources[:, 0],
            source_index=sources[:, 1],
        )


def _as_bytes(gaussians: Gaussians) -> np.ndarray:
    """All values of each as one, [n]."""
    flat = (array.reshape(len(array), math.prod(array.shape[1:])) for array in arrays(gaussians))
    rows = np.concatenate(list(flat), axis=1)
    return np.ascontiguousarray(rows).view(f"V{4 * rows.shape[1]}")[:, 0]
