"""Damaged pictures: what is said of them, and a reader that goes on and counts them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import StrEnum
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from packuv.files import whole_file

NEAR = 16
"""Frames before and after a lost one among which another is looked for"""


class Damage(StrEnum):
    """What is wrong with a picture."""

    LOST = "lost"
    """It cannot be decoded"""
    CONCEALED = "concealed"
    """Parts of it are the decoder's guess"""
    FOLLOWS = "follows"
    """It is predicted from a damaged one"""


class DamagedPictureError(ValueError):
    """The file holds the frame, but it cannot be decoded."""


def spans(frames: list[int]) -> list[tuple[int, int]]:
    """Runs of frames, first and last one.

    >>> spans([3, 4, 5, 9])
    [(3, 5), (9, 9)]
    """
    found = list[tuple[int, int]]()
    for frame in sorted(frames):
        if found and found[-1][1] == frame - 1:
            found[-1] = (found[-1][0], frame)
        else:
            found.append((frame, frame))
    return found


class DamageLog:
    """Damage by camera in a file, so that what was found before a kill is known after it."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, Lock()
        self.found: dict[str, dict[int, Damage]] = {}
        if path.exists():
            read: dict[str, dict[str, str]] = json.loads(path.read_text())
            self.found = {name: {int(k): Damage(v) for k, v in own.items()} for name, own in read.items()}

    def note(self, camera: str, damage: Mapping[int, Damage]) -> None:
        """All that is known of a camera by now."""
        with self._lock:
            known = self.found.setdefault(camera, {})
            if all(known.get(frame) == what for frame, what in damage.items()):
                return
            known.update(damage)
            with whole_file(self._path) as partial:
                partial.write_text(json.dumps(self.found))

    def facts(self) -> dict[str, dict[str, Any]]:
        """By damaged camera how many pictures of each kind, and which frames."""
        return {
            name: {
                **{str(kind): sum(what is kind for what in own.values()) for kind in Damage},
                "frames": spans(list(own)),
            }
            for name, own in sorted(self.found.items())
        }


def damage_told(camera: str, facts: Mapping[str, Any], most: int = 5) -> str:
    """What `DamageLog.facts` say of a camera, for people.

    >>> damage_told("cam1", {"lost": 1, "concealed": 1, "follows": 14, "frames": [[74, 89]]})
    'cam1: 16 pictures are damaged (1 lost, 1 concealed, 14 predicted from those), frames 74-89; they count as missing'
    >>> damage_told("cam1", {"lost": 0, "concealed": 1, "follows": 0, "frames": [[75, 75]]})
    'cam1: 1 picture is damaged (1 concealed), frame 75; it counts as missing'
    """
    counts = {"lost": facts["lost"], "concealed": facts["concealed"], "predicted from those": facts["follows"]}
    runs = [f"{first}" if first == last else f"{first}-{last}" for first, last in facts["frames"]]
    more = f" and {len(runs) - most} more runs" if len(runs) > most else ""
    kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    number = sum(counts.values())
    noun, place, those = (
        ("picture is", "frame", "it counts") if number == 1 else ("pictures are", "frames", "they count")
    )
    return f"{camera}: {number} {noun} damaged ({kinds}), {place} {', '.join(runs[:most])}{more}; {those} as missing"


def neighbours(frame: int, count: int) -> list[int]:
    """Frames of 0 .. count - 1 near one, the nearest first.

    >>> neighbours(1, 4)
    [0, 2, 3]
    """
    near = chain.from_iterable((frame - step, frame + step) for step in range(1, NEAR + 1))
    return [other for other in near if 0 <= other < count]


def without(frames: np.ndarray, damaged: Mapping[str, Any]) -> np.ndarray:
    """Frame numbers, int [T], -1 where the picture is damaged as `DamageLog.facts` say of its camera."""
    found = frames.copy()
    for first, last in damaged["frames"]:
        found[(found >= first) & (found <= last)] = -1
    return found
