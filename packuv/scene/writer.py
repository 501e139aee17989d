"""Write a scene file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from packuv.gaussians.segment import Segment
from packuv.partial import partial_path
from packuv.progress import Progress, no_progress, part_of
from packuv.scene.copy import append_copy
from packuv.scene.encoder import EncodeOptions, SceneEncoder, survey
from packuv.scene.header import HEADER, SceneHeader
from packuv.scene.matroska import Spool, write_matroska
from packuv.scene.sound import SOUND, Sound
from packuv.scene.verify import verify_scene


@dataclass(frozen=True)
class SceneSummary:
    """What `write_scene` wrote."""

    frames: int
    bytes: int
    """Size of the file"""
    track_bytes: Mapping[str, int]
    """Sum of the packets of each track"""
    digests: tuple[str, ...]


def write_scene(
    path: Path,
    segments: Sequence[Path],
    header: SceneHeader,
    *,
    sound: Sound | None = None,
    options: EncodeOptions | None = None,
    threads: int = 0,
    progress: Progress = no_progress,
) -> SceneSummary:
    """Encode segment files, in order, into one scene file, and read all of it back before it gets its name.

    `sound` goes along unless the options leave it out. Segments that are not fitted yet may be left off at the end,
    with `header.first(frames)`: the file then ends early.
    One segment at a time is in memory. Raises ValueError when the segments do not follow one another or do not match
    the header, RuntimeError when the file does not decode to what was written.
    """
    path, options = Path(path), options or EncodeOptions()
    sound = sound if options.sound else None
    found = survey(segments, header, options)
    partial = partial_path(path)
    steps = 2 * len(header.times_ns)
    try:
        with tempfile.TemporaryFile(dir=path.parent) as file:
            spool = Spool(file)
            with SceneEncoder(header, found, spool, options.tolerance, threads=threads) as encoder:
                for segment in segments:
                    encoder.add(Segment.load(segment), lambda done: progress(done, steps))
                index = replace(encoder.finish(), sound=sound.entry if sound else None)
            videos = [entry.video(number) for number, entry in enumerate(index.tracks)]
            attachments = index.encode()
            flac = sound.flac if sound else b""
            write_matroska(partial, videos, spool, attachments, rate=header.rate, flac=flac)
            append_copy(partial, attachments[HEADER][1])
        check = verify_scene(partial, threads=threads, progress=part_of(progress, steps // 2, steps))
        if not check.ok:
            raise RuntimeError(f"the scene was written but does not read back: {check.problem}")
        _publish(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    track_bytes = {video.name: sum(entry.sizes) for video, entry in zip(videos, index.tracks, strict=True)}
    if sound:
        track_bytes[SOUND] = len(sound.flac)
    return SceneSummary(len(index.digests), path.stat().st_size, track_bytes, index.digests)


def _publish(partial: Path, path: Path) -> None:
    """Give the file its name in one step, after its bytes are on the disk."""
    for target in (partial, None, path.parent):
        if target is None:
            os.replace(partial, path)
            continue
        descriptor = os.open(target, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
