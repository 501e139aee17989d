"""Chapters of one recording, joined into the one video that a camera of a capture has: nothing is coded anew."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from errno import EXDEV
from fractions import Fraction
from glob import escape
from pathlib import Path
from typing import Any

import av
import numpy as np

from packuv.files import whole_file
from packuv.progress import Progress
from sync.capture import VIDEO_FOLDERS
from sync.chapters import put_away, recordings, unjoined
from sync.probe import VideoInfo, container_timecodes, probe_video
from sync.timecode import NANOSECONDS

MOST = 1 << 62
"""Ticks"""


@dataclass(frozen=True)
class Joined:
    """A video that was made of chapters."""

    video: Path
    chapters: int
    frames: int


def join(capture: Path, progress: Progress) -> list[Joined]:
    """Make a video of each camera's chapters, and put these into `chapters/` of the capture. What is joined already
    is left as it is.

    Raises:
        FileNotFoundError: no such capture.
        ValueError: a chapter is missing, is no whole video, or does not go on where the one before ends.
    """
    inside = next((capture / name for name in VIDEO_FOLDERS if (capture / name).is_dir()), None)
    if inside is None:
        raise FileNotFoundError(f"{capture} is no capture: it must have a folder 'videos' with what each camera filmed")
    found, joined = list(unjoined(inside)), []
    for number, (camera, chapters) in enumerate(found):
        progress(number, len(found), camera)
        joined.append(_join(inside / f"{camera}.mp4", chapters))
    return joined


def _join(video: Path, chapters: dict[int, Path]) -> Joined:
    place = put_away(video.parent, video.stem)
    _check_movable(list(chapters.values()), place)
    paths = _in_order(video, chapters | _away(place, chapters))
    infos = [probe_video(path) for path in paths]
    _check_alike(paths, infos)
    _check_labels(paths, infos)
    if video.exists():  # by a run that was killed before all chapters were put away
        _check_joined(video, paths, infos, _content(paths))
    else:
        _remove_stale(video)
        with whole_file(video) as part:
            _check_joined(part, paths, infos, _remux(part, paths, infos))
    place.mkdir(parents=True, exist_ok=True)
    for path in chapters.values():
        path.rename(place / path.name)
    with suppress(OSError):  # previews may be left in it
        video.with_suffix("").rmdir()
    return Joined(video, len(paths), sum(info.frame_count for info in infos))


def _away(place: Path, chapters: dict[int, Path]) -> dict[int, Path]:
    """Chapters of the same recording that a run put away before it was killed."""
    (recording,) = recordings(chapters.values())
    away = recordings(place.iterdir()).get(recording, {}) if place.is_dir() else {}
    if both := sorted(chapters.keys() & away.keys()):
        raise FileExistsError(
            f"{away[both[0]]} is in the way of {chapters[both[0]]}, which is the same chapter; take one of them out"
        )
    return away


def _check_movable(paths: list[Path], place: Path) -> None:
    """Raises OSError where chapters cannot be put into a place by renaming them."""
    there = next(folder for folder in (place, *place.parents) if folder.exists())
    for path in paths:
        if (place / path.name).exists():
            raise FileExistsError(
                f"{place / path.name} is in the way of the chapter of this name; take it out of the folder"
            )
        if path.lstat().st_dev != there.stat().st_dev:
            raise OSError(
                EXDEV, f"chapters are put into {place}, which must be on the disk of {path.parent}, but is on another"
            )


def _remove_stale(video: Path) -> None:
    """What runs that were killed left of the video."""
    for path in video.parent.glob(f".{escape(video.name)}.*.partial{video.suffix}"):
        path.unlink()


def _in_order(video: Path, chapters: dict[int, Path]) -> list[Path]:
    numbers = sorted(chapters)
    missing = sorted(set(range(min(1, numbers[0]), numbers[-1] + 1)) - set(numbers))
    if missing:
        raise ValueError(
            f"the chapters of {video.stem} must be all there, but {chapters[numbers[-1]].parent} lacks number "
            f"{missing[0]} of {numbers[-1]}; copy it from the camera's card"
        )
    return [chapters[number] for number in numbers]


def _check_alike(paths: list[Path], infos: list[VideoInfo]) -> None:
    """Raises ValueError where a decoder, set up by the first chapter, would fail at another one."""
    first, *others = [_coding(path, info) for path, info in zip(paths, infos, strict=True)]
    for path, own in zip(paths[1:], others, strict=True):
        differ = [name for name in first if own[name] != first[name] and not (name == "sound" and own[name] is None)]
        if differ:
            raise ValueError(
                f"chapters of one recording must be coded alike, but {path.name} differs from {paths[0].name} in "
                f"{', '.join(differ)}"
            )


def _coding(path: Path, info: VideoInfo) -> dict[str, Any]:
    """What chapters must have in common, by what people call it."""
    with av.open(str(path)) as chapter:
        codec = chapter.streams.video[0].codec_context
        sound = next((stream.codec_context for stream in chapter.streams.audio), None)
        return {
            "codec": info.codec,
            "size": (info.width, info.height),
            "colour": info.colour,
            "frame rate": round(float(info.rate), 1),
            "the set-up of its codec": codec.extradata,
            "sound": sound and (sound.name, sound.sample_rate, sound.layout.name, sound.extradata),
        }


def _check_labels(paths: list[Path], infos: list[VideoInfo]) -> None:
    """Raises ValueError where a chapter's label is neither the time at which the one before ends, nor, as some cameras
    write it, that of the first."""
    starts = [int(container_timecodes(info).times_ns[0]) if info.start_label else None for info in infos]
    begins = starts[0]
    for path, info, start in zip(paths, infos, starts, strict=True):
        if start is None or begins is None or starts[0] is None:
            return
        if min(abs(start - begins), abs(start - starts[0])) > NANOSECONDS:
            raise ValueError(
                f"chapters must go on where the one before ends, but {path.name} is labelled {info.start_label}, "
                f"{(start - begins) / NANOSECONDS:+.1f} s from there"
            )
        begins += info.duration_ns


def _remux(target: Path, paths: list[Path], infos: list[VideoInfo]) -> str:
    """Packets one after another; each chapter begins where the frames of the one before end. Digest of the packets of
    the chapters' pictures."""
    digest = hashlib.sha256()
    with av.open(str(target), "w", format="mp4") as out:
        begins, ends = Fraction(0), dict[int, int]()
        for path, info in zip(paths, infos, strict=True):
            with av.open(str(path)) as chapter:
                sources = [chapter.streams.video[0], *chapter.streams.audio[:1]]
                if not out.streams:
                    _open_streams(out, sources, info)
                    if begun := chapter.metadata.get("creation_time"):
                        out.metadata["creation_time"] = begun
                shift = begins - Fraction(int(info.pts_ns[0]), NANOSECONDS)
                for packet in chapter.demux(sources):
                    number = sources.index(packet.stream)
                    if number == 0:
                        digest.update(bytes(packet))
                    dts = _moved(packet, shift)
                    if dts is not None and dts > ends.get(number, -MOST):  # sound outlasts pictures
                        ends[number], packet.stream = dts, out.streams[number]
                        out.mux(packet)
            begins += Fraction(info.duration_ns, NANOSECONDS)
    return digest.hexdigest()


def _open_streams(out: av.container.OutputContainer, sources: list[Any], info: VideoInfo) -> None:
    streams = [out.add_stream_from_template(source) for source in sources]
    streams[0].codec_context.codec_tag = sources[0].codec_context.codec_tag  # Apple's players want hvc1
    if info.start_label and info.heard_ns is None:
        streams[0].metadata["timecode"] = info.start_label


def _moved(packet: Any, shift: Fraction) -> int | None:
    """Moves a packet in time; when it is decoded then, None where it has no time, as at the end of a stream."""
    if packet.dts is None:
        return None
    ticks = round(shift / packet.time_base)
    packet.pts = packet.pts if packet.pts is None else packet.pts + ticks
    packet.dts += ticks
    return int(packet.dts)


def _check_joined(video: Path, paths: list[Path], infos: list[VideoInfo], content: str) -> None:
    """Raises ValueError unless the joined video has the packets of all chapters, at even times."""
    whole = probe_video(video)
    steps, usual = np.diff(whole.pts_ns), np.median(np.diff(infos[0].pts_ns)) if infos[0].frame_count > 1 else 0
    seams = np.cumsum([info.frame_count for info in infos])[:-1] - 1
    if whole.frame_count != sum(info.frame_count for info in infos) or (np.abs(steps[seams] - usual) > usual / 2).any():
        raise ValueError(f"{paths[0]} and the chapters after it do not go on from one to the next; join them by hand")
    if _content([video]) != content:
        raise ValueError(f"{video} is not what {paths[0]} and the chapters after it make; take it out of the folder")


def _content(paths: list[Path]) -> str:
    """Digest of the packets of their pictures."""
    digest = hashlib.sha256()
    for path in paths:
        with av.open(str(path)) as video:
            for packet in video.demux(video.streams.video[0]):
                digest.update(bytes(packet))
    return digest.hexdigest()
