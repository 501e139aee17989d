"""What a video holds, from its packets alone: of a file no more than a picture is decoded, for how it is turned.

Headers lie about frame counts and rates (AVI halves, cut MP4 hides frames), and the frame-exact decoder needs files
whose packets carry true presentation times. Whatever is not such a file is refused here with the command that makes
it one (measured: decoders return wrong pictures from MPEG-TS, cut MP4 and AVI with B-frames).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from sync.ltc import Ltc, hear_ltc
from sync.pictures import USUAL_RATE, Pictures, decode_picture, list_pictures
from sync.timecode import NANOSECONDS, Timecodes, day_of, label_to_frame, labels_to_ns, ticks_to_ns
from sync.tmcd import timecode_track_rate

STREAM_FORMATS = frozenset({"mpegts", "mpeg", "h264", "hevc", "vvc", "m4v", "mpegvideo", "mjpeg", "obu", "dv"})
"""Containers without a reliable time per frame: transport and program streams, bare codec streams."""
PICTURE_FORMATS = frozenset({"image2", "tty", "ico"})
LOOKED_AT = 64
"""Packets that are decoded to find a picture"""
CONTAINER_TIMES = "the container's times"
LONGEST_LOSS_S = Fraction(1, 2)
"""A file may end this much before its header says: the last frame's own duration is often wrong."""


MATRICES = {0: "gbr", 1: "bt709", 4: "fcc", 5: "bt470bg", 6: "smpte170m", 7: "smpte240m", 8: "ycgco", 9: "bt2020nc"}
MATRICES |= {10: "bt2020c", 14: "ictcp"}
TRANSFER_CURVES = {1: "bt709", 4: "gamma22", 5: "gamma28", 6: "smpte170m", 7: "smpte240m", 8: "linear", 9: "log100"}
TRANSFER_CURVES |= {11: "iec61966-2-4", 13: "iec61966-2-1", 14: "bt2020-10", 15: "bt2020-12", 16: "smpte2084"}
TRANSFER_CURVES |= {17: "smpte428", 18: "arib-std-b67"}
PRIMARIES = {1: "bt709", 4: "bt470m", 5: "bt470bg", 6: "smpte170m", 7: "smpte240m", 8: "film", 9: "bt2020"}
PRIMARIES |= {10: "smpte428", 11: "smpte431", 12: "smpte432", 22: "ebu3213"}
RANGES = {1: "limited", 2: "full"}
"""FFmpeg's names for the codes of ITU-T H.273; those that say nothing have none"""


@dataclass(frozen=True)
class ColourTags:
    """How a stream says that it codes colour, in FFmpeg's words; None where it does not say."""

    pixel_format: str | None
    bit_depth: int | None
    """Bits per channel"""
    matrix: str | None
    transfer: str | None
    primaries: str | None
    range: str | None
    """limited or full"""

    @classmethod
    def of(cls, coded: av.VideoCodecContext | av.VideoFrame) -> ColourTags:
        """Of a stream, or of a picture, whose depth may be that of floating-point numbers."""
        form = coded.format
        return cls(
            pixel_format=form.name if form else None,
            bit_depth=max(component.bits for component in form.components) if form else None,
            matrix=MATRICES.get(int(coded.colorspace)),
            transfer=TRANSFER_CURVES.get(int(coded.color_trc)),
            primaries=PRIMARIES.get(int(coded.color_primaries)),
            range=RANGES.get(int(coded.color_range)),
        )


@dataclass(frozen=True, eq=False)
class VideoInfo:
    """One video stream, or one folder of pictures."""

    width: int
    """Pixels, as shown: turned as the file says"""
    height: int
    codec: str
    rate: Fraction
    """Nominal frames per second"""
    frame_count: int
    """Frames that decode, counted from packets"""
    pts_ns: np.ndarray
    """int64 [frame_count]: presentation times in the container, strictly increasing"""
    duration_ns: int
    """From the first frame to the end of the last"""
    size_bytes: int
    colour: ColourTags
    start_label: str | None = None
    """SMPTE label of the first frame, where the container or a sound track has one"""
    label_rate: Fraction | None = None
    """At which that label counts: its track's own, or the video's"""
    heard_ns: np.ndarray | None = None
    """int64 [frame_count]: times of day by the labels on a sound track, where the container has none"""
    begun_ns: int | None = None
    """When recording began, since 1970, by the camera's clock: creation_time, to a second in MP4"""
    odd_label: str | None = None
    """A label that does not exist at that rate, and so is not used"""
    rotation_deg: int = 0
    """By which the stored picture is turned to be shown, counter-clockwise, a multiple of 90"""
    numbered: bool = False
    """Times are the numbers of pictures"""
    notes: tuple[str, ...] = ()
    """What a person should know, one sentence each"""

    def __post_init__(self) -> None:
        if self.pts_ns.shape != (self.frame_count,) or self.frame_count < 1:
            raise ValueError(f"{self.frame_count} frames need as many times, but there are {self.pts_ns.shape}")


PACKET = np.dtype([("pts", np.int64), ("duration", np.int64), ("corrupt", bool), ("discard", bool)])
"""What is kept of a packet, 18 bytes: its content would be the whole file in memory"""
UNTIMED = np.iinfo(np.int64).min
"""pts of a packet without one"""


def probe_video(
    path: Path,
    *,
    rate: Fraction | None = None,
    origin: int | None = None,
    listen: bool = True,
    kept: Path | None = None,
) -> VideoInfo:
    """Count the frames of a video and read their times. A folder is one of numbered pictures.

    Args:
        rate: of pictures, which hold no times: numbers per second.
        origin: number of the picture at time 0; None is that of the first one.
        listen: for LTC on sound tracks, where the container has no label.
        kept: see `hear_ltc`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a video, cut short, damaged, or in a form from which frames cannot be taken exactly; the
            message says what to do.
    """
    if path.is_dir():
        return _probe_pictures(list_pictures(path), rate or USUAL_RATE, origin)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file; a capture needs one video per camera")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty; copy the recording again")
    try:
        with av.open(str(path)) as container:
            return _probe(path, container, listen=listen, kept=kept)
    except av.error.FFmpegError as error:
        raise ValueError(f"{path} is no video that FFmpeg can read, or its index is lost: {error.strerror}") from None


def container_timecodes(info: VideoInfo) -> Timecodes:
    """Timecodes from the container: presentation times, after the SMPTE start label where there is one.

    Without a label the times begin where the container's do, which is 0 for most: they align cameras only if all
    recordings were started by one trigger or cut from one timeline.
    """
    times, rate = info.pts_ns, info.label_rate or info.rate
    numbers = np.arange(len(times), dtype=np.int64)
    if info.numbered:
        return Timecodes(times, numbers, source=f"the numbers of its pictures, {float(info.rate):g} per second")
    if info.start_label is None:
        odd = f"its container's label {info.odd_label} does not exist at {info.rate} frames per second; it is not used"
        return Timecodes(times, numbers, source=CONTAINER_TIMES, notes=(odd,) if info.odd_label else ())
    if info.heard_ns is not None:
        source = f"the LTC on its sound track, from {info.start_label} at {float(rate):.5g} per second"
        return Timecodes(info.heard_ns, numbers, day_of(info.start_label, rate), source)
    times = labels_to_ns([info.start_label], rate) + (times - times[0])
    other = f"its container's label counts at {rate} per second, its video runs at {info.rate}"
    day, notes = day_of(info.start_label, rate), (other,) if rate != info.rate else ()
    return Timecodes(times, numbers, day, f"the container's label {info.start_label}", notes=notes)


def _probe(path: Path, container: av.container.InputContainer, *, listen: bool, kept: Path | None) -> VideoInfo:
    stream = container.streams.best("video")
    name = container.format.name
    if not isinstance(stream, av.VideoStream) or name in PICTURE_FORMATS or name.endswith("_pipe"):
        raise ValueError(f"{path} holds no video ({name})")
    if name in STREAM_FORMATS:
        raise ValueError(f"{path} is a stream ({name}) in which frames cannot be sought exactly; {_remedy(path, name)}")
    look, colour = _Look(), ColourTags.of(stream.codec_context)
    seen = (
        (UNTIMED if packet.pts is None else packet.pts, packet.duration or 0, packet.is_corrupt, packet.is_discard)
        for packet in look.passing(container.demux(stream))
        if packet.size
    )
    packets = np.fromiter(seen, PACKET)
    _check_whole(path, container, stream, packets)
    pts = np.sort(_presentation_times(path, name, stream, packets))
    assert stream.time_base is not None
    pts_ns = ticks_to_ns(pts, stream.time_base)
    if (np.diff(pts_ns) <= 0).any():
        raise ValueError(f"{path} has frames with one and the same time; {_reencode(path)}")
    rate = _rate(path, stream, pts_ns)
    gap = int(np.median(np.diff(pts_ns))) if len(pts_ns) > 1 else int(NANOSECONDS / rate)
    sides = (stream.width, stream.height)
    width, height = sides[::-1] if look.rotation_deg % 180 else sides
    label, label_rate, odd = _start_label(path, container, stream, rate)
    heard, told = (None, ()) if label or not listen else hear_ltc(path, pts_ns, kept)
    return VideoInfo(
        width=width,
        height=height,
        codec=stream.codec_context.name,
        rate=rate,
        frame_count=len(pts_ns),
        pts_ns=pts_ns,
        duration_ns=int(pts_ns[-1] - pts_ns[0]) + gap,
        size_bytes=path.stat().st_size,
        colour=colour,
        start_label=heard.label if heard else label,
        label_rate=heard.rate if heard else label_rate,
        heard_ns=heard.times_ns if heard else None,
        begun_ns=_begun_ns(container.metadata.get("creation_time")),
        odd_label=odd,
        rotation_deg=look.rotation_deg,
        notes=(
            *_stream_notes(path, container, stream),
            *(f"{path.stem}: {note}" for note in told),
            *_heard_notes(path, heard),
        ),
    )


def _begun_ns(text: str | None) -> int | None:
    """Of a creation_time that was set: unset ones are those of 1904 or 1970."""
    try:
        begun = datetime.fromisoformat(text or "")
    except ValueError:
        return None
    begun = begun if begun.tzinfo else begun.replace(tzinfo=UTC)
    return int(begun.timestamp() * NANOSECONDS) if begun.year > 1980 else None


def _heard_notes(path: Path, heard: Ltc | None) -> Iterator[str]:
    if heard and heard.jumps:
        times = "once" if heard.jumps == 1 else f"{heard.jumps} times"
        yield f"{path.stem}: the LTC on its sound track jumps {times}; each frame has the time of the label before it"


class _Look:
    """Looks at the first picture on the way of a stream's packets: containers say how it is turned, PyAV does not."""

    def __init__(self) -> None:
        self.rotation_deg = 0

    def passing(self, packets: Iterator[av.Packet[av.VideoStream]]) -> Iterator[av.Packet[av.VideoStream]]:
        left = LOOKED_AT
        for packet in packets:
            if left:
                left -= 1
                with suppress(av.FFmpegError):  # which reading the pictures will say
                    for frame in packet.decode():
                        assert isinstance(frame, av.VideoFrame)
                        self.rotation_deg, left = round(frame.rotation / 90) % 4 * 90, 0
                        break
            yield packet


def _stream_notes(path: Path, container: av.container.InputContainer, stream: av.VideoStream) -> tuple[str, ...]:
    attached = av.stream.Disposition.attached_pic
    others = [other for other in container.streams.video if other is not stream and not other.disposition & attached]
    if not others:
        return ()
    found = ", ".join(f"#{other.index} of {other.width}x{other.height}" for other in others)
    return (
        f"{path.stem}: of {len(others) + 1} video streams #{stream.index} of {stream.width}x{stream.height} is read, "
        f"as players do; {found} is not",
    )


def _probe_pictures(pictures: Pictures, rate: Fraction, origin: int | None) -> VideoInfo:
    """Raises ValueError where the first and the last picture differ in size, or one of them cannot be decoded."""
    first, last = (decode_picture(pictures.folder / pictures.names[k]) for k in (0, -1))
    width, height = _shown(first)
    if (width, height) != _shown(last):
        raise ValueError(
            f"the pictures of a camera must have one size, but in {pictures.folder} {pictures.names[0]} is "
            f"{width}x{height} and {pictures.names[-1]} {'x'.join(map(str, _shown(last)))}"
        )
    times = pictures.times_ns(rate, int(pictures.numbers[0]) if origin is None else origin)
    suffix = Path(pictures.names[0]).suffix.lower().removeprefix(".")
    return VideoInfo(
        width=width,
        height=height,
        codec="jpeg" if suffix == "jpg" else suffix,
        rate=rate / pictures.step if pictures.counted else rate,
        frame_count=len(pictures),
        pts_ns=times,
        duration_ns=int(times[-1] - times[0]) + int(NANOSECONDS / rate),
        size_bytes=pictures.size_bytes,
        colour=ColourTags.of(first),
        rotation_deg=round(first.rotation / 90) % 4 * 90,
        numbered=True,
        notes=pictures.notes(pictures.folder.name),
    )


def _shown(frame: av.VideoFrame) -> tuple[int, int]:
    """Width and height, turned as the picture says."""
    sides = (frame.width, frame.height)
    return sides[::-1] if round(frame.rotation / 90) % 2 else sides


def _check_whole(
    path: Path, container: av.container.InputContainer, stream: av.VideoStream, packets: np.ndarray
) -> None:
    if not len(packets):
        raise ValueError(f"{path} holds no frames; copy the recording again")
    if packets["corrupt"].any():
        broken = int(packets["corrupt"].argmax())
        raise ValueError(f"{path} is cut short or damaged at frame {broken}; copy the recording again")
    # only MP4 and MOV count samples exactly in their header
    if container.format.name.startswith("mov") and stream.frames > len(packets):
        raise ValueError(f"{path} is cut short: {len(packets)} of {stream.frames} frames; copy the recording again")
    declared, found = _declared_end_s(stream), _found_end_s(stream, packets)
    if declared is not None and declared - found > LONGEST_LOSS_S:
        raise ValueError(
            f"{path} is cut short: {float(found):.2f} of {float(declared):.2f} s; copy the recording again"
        )


def _presentation_times(path: Path, name: str, stream: av.VideoStream, packets: np.ndarray) -> np.ndarray:
    hidden = int(packets["discard"].sum())
    if hidden:
        raise ValueError(
            f"{path} was cut without re-encoding: an edit list hides {hidden} of its {len(packets)} frames, and "
            f"decoders disagree about the others; {_reencode(path)}"
        )
    if name == "avi" and stream.codec_context.has_b_frames:
        raise ValueError(f"{path} is an AVI with B-frames, which has no presentation times; {_reencode(path)}")
    times: np.ndarray = packets["pts"]
    if untimed := int((times == UNTIMED).sum()):
        raise ValueError(f"{path} has {untimed} frames without a time; {_reencode(path)}")
    return times


def _remedy(path: Path, name: str) -> str:
    """How to get a file with a time per frame. Only MPEG-TS survives copying; others lose or hide frames."""
    if name == "mpegts":
        return f"remux it: ffmpeg -i {path.name} -map 0:v:0 -c copy {path.stem}.mp4"
    return _reencode(path) if name == "mpeg" else _reencode(path).replace("-i ", "-framerate 30 -i ", 1)


def _reencode(path: Path) -> str:
    return f"re-encode it: ffmpeg -i {path.name} -map 0:v:0 -c:v libx264 -crf 12 {path.stem}_exact.mp4"


def _declared_end_s(stream: av.VideoStream) -> Fraction | None:
    """End of the stream by Matroska's DURATION tag, which survives when the file is cut short."""
    parts = stream.metadata.get("DURATION", "").split(":")
    if len(parts) != 3:
        return None
    return sum((Fraction(part) * 60**power for power, part in zip((2, 1, 0), parts, strict=True)), Fraction(0))


def _found_end_s(stream: av.VideoStream, packets: np.ndarray) -> Fraction:
    assert stream.time_base is not None
    begins = np.where(packets["pts"] == UNTIMED, 0, packets["pts"])
    return int((begins + packets["duration"]).max()) * stream.time_base


def _rate(path: Path, stream: av.VideoStream, pts_ns: np.ndarray) -> Fraction:
    """Of the container's rates the one that fits the median gap; else the rate measured."""
    named = [Fraction(rate) for rate in (stream.guessed_rate, stream.average_rate) if rate]
    if len(pts_ns) < 2:
        return named[0] if named else Fraction(30)
    measured = Fraction(NANOSECONDS, int(np.median(np.diff(pts_ns))))
    fits = [rate for rate in named if abs(rate / measured - 1) < Fraction(1, 10)]
    return fits[0] if fits else measured.limit_denominator(1001)


def _start_label(
    path: Path, container: av.container.InputContainer, stream: av.VideoStream, rate: Fraction
) -> tuple[str | None, Fraction | None, str | None]:
    """Label of the first frame, the rate it counts at, and one that does not exist at that rate."""
    tracks = [stream.metadata, container.metadata, *(other.metadata for other in container.streams)]
    # Matroska's writers put it in capitals.
    found = (value for data in tracks for name, value in data.items() if name.lower() == "timecode")
    label = next(found, None)
    if label is None:
        return None, None, None
    own = timecode_track_rate(path) if container.format.name.startswith("mov") else None
    for one in (own, rate):
        with suppress(ValueError):  # a wrong time is worse than none
            if one is not None and label_to_frame(label, one) >= 0:
                return label, one, None
    return None, None, label
