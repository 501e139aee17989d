"""What a run has fitted so far, to look at while it goes on or after it stopped.

Frames are those that are there, one after another: whole segments; of a segment on its way what is done of it; of a
keyframe alone that one frame; and before the first keyframe the backdrop.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from packuv.fit.frames import done_so_far, unfinished_segment
from packuv.fit.keyframe import KeyState
from packuv.gaussians.codes import Codes
from packuv.gaussians.segment import Segment
from packuv.viewer.source import locate
from pipelines.filmed import Filmed
from pipelines.register import KILLED, find_runs
from tasks.artefacts.recipe import restore
from tasks.artefacts.retention import RUN
from tasks.artefacts.stage import Site
from tasks.artefacts.store import SCRATCH, WORK, Key, Store
from tasks.stages.calibrate import read_names
from tasks.stages.encode import scene_header
from tasks.stages.fitting import SEGMENT
from tasks.stages.footage import Footage, Take

KEPT_SEGMENTS = 3
"""That stay in memory: playback crosses from one into the next"""


@dataclass(frozen=True)
class Part:
    """Frames that follow one another, from a keyframe or the backdrop on."""

    first: int
    """Instant"""
    frames: int
    key: Path
    """Folder of the keyframe's artefact, or of the backdrop's"""
    segment: Path | None = None
    """Folder of the segment's artefact, or of what is done of it; None of a keyframe alone"""

    @property
    def under_way(self) -> bool:
        """Whether its segment is being fitted."""
        return self.segment is not None and self.segment.name == SCRATCH

    def load(self) -> Segment:
        """Its frames; raises OSError for what was finished, and moved, meanwhile."""
        if self.segment is None:
            key = KeyState.load(self.key)
            codes = key.quantizer.encode(key.gaussians)
            xyz = np.zeros((0, 0, 3), np.uint16)
            attributes = np.zeros((0, 0, codes.attributes.shape[1]), np.uint8)
            return Segment(self.first, codes, np.zeros(len(codes), bool), xyz, attributes)
        if self.under_way:
            return unfinished_segment(KeyState.load(self.key), self.segment)
        return Segment.load(self.segment / SEGMENT)


def find_parts(folder: Path) -> tuple[Part, ...]:
    """What is fitted of the last run in the folder of a sequence, in the order of time."""
    store = Store(folder / "store")
    made = [(key.stage, store.path(key)) for key in _made(folder) if store.holds(key)]
    keys = {_instant(place): place for stage, place in made if stage == "key"}
    if not keys:
        return tuple(Part(0, 1, place) for stage, place in made if stage == "backdrop")[:1]
    parts = {instant: Part(instant, 1, place) for instant, place in keys.items()}
    fitted = [(*_span(place), place) for stage, place in made if stage == "segment"]
    for instant, frames, place in [*_under_way(store.root), *fitted]:
        if instant in keys and frames > 1:
            parts[instant] = Part(instant, frames, keys[instant], place)
    return tuple(parts[instant] for instant in sorted(parts))


def _made(folder: Path) -> list[Key]:
    """Artefacts that the last run has made so far, in its order."""
    runs, names = find_runs(folder), list[str]()
    if runs:
        names = list(runs[-1].record.fitted)
    else:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            told = json.loads((folder / RUN).read_text())
            names = told.get(KILLED) or [stage["artefact"] for stage in told["stages"] if "artefact" in stage]
    return [_key(name) for name in names]


def _instant(key: Path) -> int:
    instant: int = json.loads((key / "key.json").read_text())["instant"]
    return instant


@cache
def _span(segment: Path) -> tuple[int, int]:
    """First instant and number of frames of a segment's artefact."""
    with np.load(segment / SEGMENT) as data:
        return int(data["first"]), 1 + len(data["xyz"])


def _under_way(store: Path) -> Iterator[tuple[int, int, Path]]:
    """First instant, number of frames and folder of what is done of segments on their way."""
    for place in (store / WORK).glob(f"segment-*/*/{SCRATCH}"):
        if done := done_so_far(place):
            yield *done, place


class Unfinished:
    """Parts of a fit as a `packuv.viewer.source.Source`. Frames count from 0 without the gaps between parts."""

    def __init__(self, folder: Path, capture: Path | None, parts: tuple[Part, ...]) -> None:
        """`folder` is that of the sequence; without its capture nothing lies beside. Raises OSError where what was
        under way ended meanwhile."""
        store = Store(folder / "store")
        take = _take(store.receipt(Key(parts[0].key.parent.name, parts[0].key.name)).recipe)
        assert take.rig is not None, "who fits has a rig"
        everyone = replace(take, cameras=read_names(store.path(take.rig)))
        footage, key = Footage(everyone, Site(store.root, capture or folder, threads=1)), KeyState.load(parts[0].key)
        held_out = tuple(name for name in everyone.cameras if name not in take.cameras)
        header = scene_header(footage, held_out, key, footage.load_light())
        instants = np.concatenate([np.arange(part.first, part.first + part.frames) for part in parts])
        ends = np.cumsum([part.frames for part in parts]).tolist()
        self.name, self.parts = folder.name, parts
        self.quantizer, self.rate, self.near, self.up = key.quantizer, header.rate, key.bounds.near, header.up
        self.cameras, self.held_out = header.cameras, frozenset(held_out)
        self.metric: bool = header.extra["metric"]
        self.heard = ""  # sound goes on where frames have gaps
        self.light = header.light[instants]
        self.times_ns = np.array([int(frame * 10**9 / header.rate) for frame in range(len(instants))], np.int64)
        self.segments = tuple(range(end - part.frames, end) for end, part in zip(ends, parts, strict=True))
        self.truth = Filmed(everyone.cameras, footage.open_views, instants, self.light) if capture else None
        # What is under way will not be read as it is now again.
        self._moving = {number: part.load() for number, part in enumerate(parts) if part.under_way}
        self._finished = lru_cache(maxsize=KEPT_SEGMENTS)(lambda number: parts[number].load())

    @property
    def told(self) -> str:
        """What there is, in words."""
        if len(self.parts) == 1 and self.parts[0].segment is None and self.parts[0].key.parent.name == "backdrop":
            return "the backdrop, before any keyframe"
        whole = sum(part.segment is not None and not part.under_way for part in self.parts)
        return f"{self.segments[-1].stop} frames of {len(self.parts)} segments, {whole} of them whole"

    def sound(self) -> bytes:
        return b""

    def key(self, segment: int) -> Codes:
        return self._part(segment).key

    def dynamic(self, segment: int) -> np.ndarray:
        return self._part(segment).dynamic

    def reference(self, segment: int) -> int | None:
        """None: a part that grows is not worth a look at what it shares."""
        return None

    def moving(self, frame: int) -> Codes:
        number, offset = locate(self.segments, frame)
        part = self._part(number)
        return part.frame(offset)[part.dynamic]

    def _part(self, number: int) -> Segment:
        found: Segment = self._moving[number] if number in self._moving else self._finished(number)
        return found


def _take(recipe: Mapping[str, Any]) -> Take:
    """The pictures that a stage of the fit looked at, by its recipe."""
    told = dict(recipe["inputs"]["take"])
    names = {name: told[name] and _key(told[name]) for name in ("groups", "rig", "light")}
    told.pop("masks", None)
    take: Take = restore(Take, {**told, **names})
    return take


def _key(name: str) -> Key:
    stage, _, digest = name.partition("/")
    return Key(stage, digest)
