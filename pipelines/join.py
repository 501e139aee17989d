"""Chapters of one recording, joined into the one video that a camera of a capture has: nothing is coded anew."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from packuv.files import whole_file
from packuv.progress import Progress
from sync.capture import VIDEO_FOLDERS
from sync.chapters import JOINED, unjoined
from sync.probe import VideoInfo, probe_video
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
        joined.append(_join(capture, inside / f"{camera}.mp4", chapters))
    return joined


def _join(capture: Path, video: Path, chapters: dict[int, Path]) -> Joined:
    paths = _in_order(video, chapters)
    infos = [probe_video(path) for path in paths]
    _check_alike(paths, infos)
    if video.exists():  # by a run that was killed before it put the chapters away
        frames = _checked(video, paths, infos)
    else:
        with whole_file(video) as part:
            _remux(part, paths, infos)
            frames = _checked(part, paths, infos)
    place = capture / JOINED / video.stem
    place.mkdir(parents=True, exist_ok=True)
    for path in paths:
        path.rename(place / path.name)
    with suppress(OSError):  # previews may be left in it
        video.with_suffix("").rmdir()
    return Joined(video, len(paths), frames)


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
    first = infos[0]
    for path, info in zip(paths, infos, strict=True):
        if (info.codec, info.width, info.height, info.colour) != (first.codec, first.width, first.height, first.colour):
            raise ValueError(
                f"chapters of one recording must be coded alike, but {path.name} has pictures of {info.width}x"
                f"{info.height} in {info.codec}, {paths[0].name} of {first.width}x{first.height} in {first.codec}"
            )


def _remux(target: Path, paths: list[Path], infos: list[VideoInfo]) -> None:
    """Packets one after another; each chapter begins where the frames of the one before end."""
    with av.open(str(target), "w", format="mp4") as out:
        begins, ends = Fraction(0), dict[int, int]()
        for path, info in zip(paths, infos, strict=True):
            with av.open(str(path)) as chapter:
                sources = [chapter.streams.video[0], *chapter.streams.audio[:1]]
                if not out.streams:
                    _open_streams(out, sources, info)
                shift = begins - Fraction(int(info.pts_ns[0]), NANOSECONDS)
                for packet in chapter.demux(sources):
                    number = sources.index(packet.stream)
                    dts = _moved(packet, shift)
                    if dts is not None and dts > ends.get(number, -MOST):  # sound outlasts pictures
                        ends[number], packet.stream = dts, out.streams[number]
                        out.mux(packet)
            begins += Fraction(info.duration_ns, NANOSECONDS)


def _open_streams(out: av.container.OutputContainer, sources: list[Any], info: VideoInfo) -> None:
    streams = [out.add_stream_from_template(source) for source in sources]
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


def _checked(video: Path, paths: list[Path], infos: list[VideoInfo]) -> int:
    """Frames of the joined video, which has all of them, evenly."""
    whole = probe_video(video)
    steps, usual = np.diff(whole.pts_ns), np.median(np.diff(infos[0].pts_ns)) if infos[0].frame_count > 1 else 0
    seams = np.cumsum([info.frame_count for info in infos])[:-1] - 1
    if whole.frame_count != sum(info.frame_count for info in infos) or (np.abs(steps[seams] - usual) > usual / 2).any():
        raise ValueError(f"{paths[0]} and the chapters after it do not go on from one to the next; join them by hand")
    return whole.frame_count
