"""An atlas video back into a scene file: the very integers where it is lossless, and what is left of them where not."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from packuv.atlas.picture import filled, read_triplets
from packuv.atlas.video import AtlasVideo
from packuv.files import check_place
from packuv.gaussians.codes import Codes
from packuv.gaussians.rows import joined_segment
from packuv.gaussians.segment import Segment
from packuv.progress import Progress, no_progress, part_of
from packuv.scene import write_scene
from packuv.scene.header import codes_digest


@dataclass(frozen=True)
class AtlasImportReport:
    """What came over."""

    frames: int
    segments: int
    bytes: int
    """Size of the scene file"""
    gaussians: int
    """Of all frames together"""
    changed: int
    """Frames whose integers are not those that the video was made from"""


def import_atlas(path: Path, out: Path, *, progress: Progress = no_progress) -> AtlasImportReport:
    """Write a scene file of an atlas video, or of one that a lossy or neural codec has been over.

    A texel is one row of its segment. Raises what `AtlasVideo` raises, and ValueError for a frame without Gaussians.
    """
    check_place(out)
    video = AtlasVideo(path)
    steps, tally = 3 * len(video), _Tally()
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}.") as folder:
        parts: list[Path] = []
        for segment in _segments(video, tally, lambda done: progress(done, steps)):
            parts.append(Path(folder, f"{len(parts):05d}.npz"))
            segment.save(parts[-1])
        summary = write_scene(out, parts, video.header, progress=part_of(progress, len(video), steps))
    return AtlasImportReport(len(video), len(parts), summary.bytes, tally.gaussians, tally.changed)


@dataclass
class _Tally:
    frames: int = 0
    gaussians: int = 0
    changed: int = 0

    def add(self, codes: Codes, wanted: str) -> None:
        self.frames += 1
        self.gaussians += len(codes)
        self.changed += codes_digest(codes) != wanted


def _segments(video: AtlasVideo, tally: _Tally, progress: Callable[[int], None]) -> Iterator[Segment]:
    pictures = video.pictures()
    for first, length in video.segments:
        frames, texels = [], []
        for triplets in islice(pictures, length):
            codes = read_triplets(triplets, sh_degree=video.header.quantizer.sh_degree)
            if not len(codes):
                raise ValueError(f"{video.path}: frame {tally.frames} holds no Gaussians")
            tally.add(codes, video.digests[tally.frames])
            frames.append(codes)
            texels.append(np.flatnonzero(filled(triplets)))
            progress(tally.frames)
        used = np.unique(np.concatenate(texels))
        yield joined_segment(first, frames, [np.searchsorted(used, texel) for texel in texels])
