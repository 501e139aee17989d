"""Decode a scene file and compare every frame with its digests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from packuv.progress import Progress, no_progress
from packuv.scene.header import TRACK_NAMES, SegmentEntry, codes_digest
from packuv.scene.lookahead import DamageError
from packuv.scene.reader import Scene, open_scene


@dataclass(frozen=True)
class VerifyReport:
    """What `verify_scene` found."""

    frames: int
    bad: tuple[int, ...] = ()
    """Frames that cannot be read back exactly, in order"""
    problem: str = ""
    """The first thing that is wrong, empty if nothing is"""
    track: str = ""
    """Track of the first packet that is damaged, empty if none is"""
    span: tuple[int, int] | None = None
    """Bytes of that packet in the file, half-open, unless it is missing"""
    header: str = ""
    """What is wrong with the header, its second copy, the file's length, its sound or the bytes around its pictures;
    what that costs is in `bad`"""

    @property
    def ok(self) -> bool:
        return not (self.bad or self.header)


def verify_scene(path: Path, *, threads: int = 0, progress: Progress = no_progress) -> VerifyReport:
    """Decode every frame and compare it with its digest in the header, and the sound with its own.

    Damage inside a segment costs the rest of that segment, and those that refer to its key only if that is damaged.
    Raises like `open_scene` when nothing can be read.
    """
    found: list[tuple[int, ValueError]] = []
    with open_scene(path, threads=threads) as scene:
        for segment in scene.index.segments:
            for frame, trouble in _check_frames(scene, segment):
                if trouble:
                    found.append((frame, trouble))
                progress(frame + 1, len(scene))
        count, header = len(scene), scene.damage or _damaged_sound(scene) or scene.damage_around()
    if not found:
        return VerifyReport(count, problem=header, header=header)
    first = found[0][1]
    where = (TRACK_NAMES[first.address.track], first.span) if isinstance(first, DamageError) else ("", None)
    return VerifyReport(count, tuple(frame for frame, _ in found), str(first), *where, header)


def _check_frames(scene: Scene, segment: SegmentEntry) -> Iterator[tuple[int, ValueError | None]]:
    """Every frame of a segment, with what is wrong with it."""
    lost: ValueError | None = None
    for frame in range(segment.first, segment.first + segment.frames):
        if lost:
            yield frame, lost
            continue
        try:
            same = codes_digest(scene._seek(frame)) == scene.index.digests[frame]
        except ValueError as error:
            lost = error
            yield frame, lost
        else:
            trouble = ValueError(f"{scene.path}: the codes of frame {frame} do not match their digest")
            yield frame, None if same else trouble


def _damaged_sound(scene: Scene) -> str:
    try:
        scene.sound()
    except ValueError as error:
        return str(error)
    return ""
