"""The atlas as an ordinary video: one track a triplet in one Matroska file, by any of the usual codecs.

For comparison, and for programs that want the paper's pictures; a scene file holds the same integers in a tenth of the
space. The attachment `atlas.json` says what the tracks mean; docs/interchange.md describes it. Pictures keep only the
rows and columns of the atlas that are ever used.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from packuv import bounds
from packuv.atlas.picture import (
    POSITION_HI,
    POSITION_LO,
    Seating,
    draw_triplets,
    filled,
    read_triplets,
    seat,
    triplet_names,
)
from packuv.bounds import field as field_of
from packuv.files import parse_json, whole_file
from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.uvsize import UvOptions
from packuv.progress import Progress, no_progress
from packuv.scene import Scene, SceneHeader, open_scene
from packuv.scene.header import codes_digest
from packuv.scene.matroska import open_matroska
from packuv.threads import ordinary_schedule

FORMAT, VERSION, ATTACHMENT = "packuv-atlas", 1, "atlas.json"
EXACT_ALWAYS = (POSITION_HI, POSITION_LO)
"""Lossless at any quality: a step of a position's high byte is 256 of its low byte's, which wraps besides"""
MULTIPLE, LEAST = 8, 64
"""Picture sizes are multiples of this, and at least that: what the encoders ask for"""
TIME_BASE = Fraction(1, 1000)
MOST_AHEAD = 256
"""Pictures of one track that wait for those of the others; the decoders' own delays are far shorter"""


class AtlasCodec(StrEnum):
    """How the pictures are coded."""

    FFV1 = "ffv1"
    X264 = "x264"
    X265 = "x265"
    VP9 = "vp9"
    AV1 = "av1"
    HUFFYUV = "huffyuv"


@dataclass(frozen=True)
class _Coder:
    """How one codec of FFmpeg is told to take RGB as it is."""

    name: str
    pixels: str
    """Pixel format; yuv420p means that the three channels lie below one another in the luma plane"""
    common: Mapping[str, str]
    lossless: Mapping[str, str]
    lossy: Callable[[int], Mapping[str, str]] | None = None
    """Options for a quality; None where the codec is always lossless"""

    @property
    def stacked(self) -> bool:
        return self.pixels == "yuv420p"

    def options(self, crf: int | None) -> dict[str, str]:
        return {**self.common, **(self.lossless if crf is None or self.lossy is None else self.lossy(crf))}


_X265 = "log-level=error:keyint=-1:scenecut=0"
_CODERS = {
    AtlasCodec.FFV1: _Coder(
        "ffv1",
        "bgr0",
        {"level": "3", "coder": "1", "context": "0", "slices": "24", "slicecrc": "1", "g": "1"},
        {},
    ),
    AtlasCodec.HUFFYUV: _Coder("huffyuv", "rgb24", {}, {}),
    AtlasCodec.X264: _Coder(
        "libx264rgb",
        "bgr24",
        {"preset": "medium", "g": "10000", "sc_threshold": "0", "forced-idr": "1"},
        {"qp": "0"},
        lambda crf: {"crf": str(crf)},
    ),
    AtlasCodec.X265: _Coder(
        "libx265",
        "gbrp",
        {"preset": "fast", "forced-idr": "1"},
        {"x265-params": f"{_X265}:lossless=1"},
        lambda crf: {"crf": str(crf), "x265-params": _X265},
    ),
    AtlasCodec.VP9: _Coder(
        "libvpx-vp9",
        "gbrp",
        {"deadline": "good", "cpu-used": "5", "row-mt": "1", "g": "10000"},
        {"lossless": "1"},
        lambda crf: {"crf": str(crf), "b": "0"},
    ),
    AtlasCodec.AV1: _Coder(
        "libsvtav1",
        "yuv420p",
        {"preset": "8", "g": "10000"},
        {"svtav1-params": "lossless=1:lp=2"},
        lambda crf: {"crf": str(crf)},
    ),
}


@dataclass(frozen=True)
class AtlasVideoOptions:
    """How a scene becomes an atlas video."""

    codec: AtlasCodec = AtlasCodec.FFV1
    crf: int | None = None
    """Quality of a lossy video on the codec's own scale, smaller is better; None for lossless"""
    uv: UvOptions = field(default_factory=UvOptions)

    def __post_init__(self) -> None:
        if self.crf is not None and _CODERS[self.codec].lossy is None:
            raise ValueError(f"{self.codec} is always lossless; leave the quality out, or choose another codec")
        most = 63 if self.codec in (AtlasCodec.VP9, AtlasCodec.AV1) else 51
        if self.crf is not None and not 0 <= self.crf <= most:
            raise ValueError(f"the quality of {self.codec} is a number from 0 to {most}, but is {self.crf}")


@dataclass(frozen=True)
class AtlasVideoSummary:
    """What `export_atlas` wrote, and how near the decoded pictures come."""

    frames: int
    bytes: int
    """Size of the file"""
    track_bytes: Mapping[str, int]
    """Sum of the packets of each track"""
    width: int
    height: int
    gaussians: int
    """Of the scene, all frames together, absent ones left out"""
    seated: int
    """Of these in the atlas"""
    rms: Mapping[str, float]
    """Root mean square error of each triplet's used texels after decoding, steps of 8 bits; 0 where exact"""

    @property
    def exact(self) -> bool:
        """Whether every frame reads back as the very integers."""
        return not any(self.rms.values())


# Writing


def export_atlas(
    path: Path, out: Path, *, options: AtlasVideoOptions, progress: Progress = no_progress
) -> AtlasVideoSummary:
    """Write a scene file's atlas as a video, read all of it back, and compare.

    Memory holds one segment's seats and the encoders' look-ahead. Raises RuntimeError when a lossless video does not
    decode to what was drawn.
    """
    with open_scene(path) as scene, whole_file(out) as partial:
        steps = 3 * len(scene)
        plan = _plan(scene, options, lambda done: progress(done, steps))
        _encode(scene, plan, partial, options, lambda done: progress(len(scene) + done, steps))
        summary = _compare(scene, plan, partial, options, lambda done: progress(2 * len(scene) + done, steps))
        if options.crf is None and not summary.exact:
            raise RuntimeError(f"the {options.codec} video does not decode to what was drawn: {dict(summary.rms)}")
    return summary


@dataclass(frozen=True)
class _Plan:
    """Seats of all segments, and the part of the atlas that they use."""

    seatings: tuple[Seating, ...]
    crop: _Crop
    digests: tuple[str, ...]
    gaussians: int
    seated: int


@dataclass(frozen=True)
class _Crop:
    """The rows and columns of the atlas that are stored."""

    rows: np.ndarray
    """Their numbers, rising, int64"""
    columns: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the stored picture."""
        height, width = (max(LEAST, -(-len(part) // MULTIPLE) * MULTIPLE) for part in (self.rows, self.columns))
        return height, width

    def cut(self, picture: np.ndarray) -> np.ndarray:
        """The stored picture of a whole one: used rows and columns, then zeros."""
        stored = np.zeros((*self.size, 3), np.uint8)
        stored[: len(self.rows), : len(self.columns)] = picture[np.ix_(self.rows, self.columns)]
        return stored

    def to_json(self) -> dict[str, Any]:
        """Half-open ranges of atlas rows and columns."""
        return {"rows": _ranges(self.rows), "columns": _ranges(self.columns)}


def _ranges(numbers: np.ndarray) -> list[list[int]]:
    breaks = np.flatnonzero(np.diff(numbers) > 1) + 1
    return [[int(part[0]), int(part[-1]) + 1] for part in np.split(numbers, breaks) if len(part)]


def _plan(scene: Scene, options: AtlasVideoOptions, progress: Callable[[int], None]) -> _Plan:
    """First pass: seats, the used part, digests."""
    seatings, digests = [], []
    drawn = seated = 0
    used: tuple[set[int], set[int]] = (set(), set())
    for number in range(len(scene.index.segments)):
        seating = seat(scene, number, options=options.uv)
        seatings.append(seating)
        for axis in (0, 1):
            used[axis].update(np.unique(seating.pixels[seating.seated, axis]).tolist())
        for frame in range(seating.first, seating.first + seating.frames):
            codes = scene.codes(frame)
            rows = seating.visible(codes)
            digests.append(codes_digest(codes[rows]))
            drawn, seated = drawn + int((codes.attributes[:, OPACITY] > 0).sum()), seated + len(rows)
            progress(len(digests))
    crop = _Crop(*(np.array(sorted(numbers), np.int64) for numbers in used))
    return _Plan(tuple(seatings), crop, tuple(digests), drawn, seated)


def _drawings(scene: Scene, plan: _Plan, options: AtlasVideoOptions) -> Iterator[tuple[bool, dict[str, np.ndarray]]]:
    """Of every frame, whether a segment starts there, and its stored pictures."""
    for seating in plan.seatings:
        for frame in range(seating.first, seating.first + seating.frames):
            pictures = draw_triplets(
                scene.codes(frame), seating, sh_degree=scene.header.quantizer.sh_degree, options=options.uv
            )
            yield frame == seating.first, {name: plan.crop.cut(picture) for name, picture in pictures.items()}


def _document(scene: Scene, plan: _Plan, options: AtlasVideoOptions) -> bytes:
    height, width = plan.crop.size
    uv = options.uv
    content = {
        "format": FORMAT,
        "version": VERSION,
        "codec": str(options.codec),
        "crf": options.crf,
        "stacked": _CODERS[options.codec].stacked,
        "triplets": list(triplet_names(scene.header.quantizer.sh_degree)),
        "width": width,
        "height": height,
        "uv": {"rows": uv.rows, "columns": uv.columns, "layers": uv.layers},
        "stored": plan.crop.to_json(),
        "segments": [{"first": s.first, "frames": s.frames} for s in plan.seatings],
        "digests": list(plan.digests),
        **scene.header.to_json(),
    }
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _encode(scene: Scene, plan: _Plan, path: Path, options: AtlasVideoOptions, progress: Callable[[int], None]) -> None:
    """Second pass: all pictures into the file."""
    document = _document(scene, plan, options)
    if options.codec is not AtlasCodec.HUFFYUV:
        return _write_container(path, "matroska", document, scene, plan, options, progress)
    # PyAV refuses HuffYUV in Matroska, which FFmpeg allows: it goes through AVI.
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".atlas.") as folder:
        _write_container(Path(folder, "atlas.avi"), "avi", None, scene, plan, options, progress)
        Path(folder, ATTACHMENT).write_bytes(document)
        _to_matroska(Path(folder), path, triplet_names(scene.header.quantizer.sh_degree))


def _write_container(
    path: Path,
    kind: str,
    document: bytes | None,
    scene: Scene,
    plan: _Plan,
    options: AtlasVideoOptions,
    progress: Callable[[int], None],
) -> None:
    coder, header = _CODERS[options.codec], scene.header
    os.environ.setdefault("SVT_LOG", "1")  # SVT-AV1 prints its settings for every track unless told to report errors
    # AVI counts frames and knows no times.
    times = range(len(scene)) if kind == "avi" else header.times_ms.tolist()
    base = 1 / header.rate if kind == "avi" else TIME_BASE
    with av.open(str(path), "w", format=kind, options={"fflags": "+bitexact"}) as container:
        names = triplet_names(header.quantizer.sh_degree)
        streams = {name: _stream(container, name, coder, plan.crop.size, header.rate, base, options) for name in names}
        if document is not None:
            container.add_attachment(ATTACHMENT, "application/json", document)
        with ordinary_schedule():
            container.start_encoding()
        for number, (starts, pictures) in enumerate(_drawings(scene, plan, options)):
            for name, picture in pictures.items():
                frame = _frame(picture, coder)
                frame.pts, frame.time_base = times[number], base
                if starts:
                    frame.pict_type = av.video.frame.PictureType.I
                container.mux(streams[name].encode(frame))
            progress(number + 1)
        for stream in streams.values():
            container.mux(stream.encode(None))


def _to_matroska(folder: Path, path: Path, names: Sequence[str]) -> None:
    """Copy the tracks of atlas.avi, with the document beside it, into a Matroska file, by FFmpeg's program."""
    titles = [part for k, name in enumerate(names) for part in (f"-metadata:s:v:{k}", f"title={name}")]
    command = ["ffmpeg", "-v", "error", "-y", "-i", "atlas.avi", "-map", "0:v", "-c", "copy", "-fflags", "+bitexact"]
    command += ["-attach", ATTACHMENT, "-metadata:s:t:0", "mimetype=application/json", *titles]
    done = subprocess.run([*command, "-f", "matroska", str(path.resolve())], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"ffmpeg could not copy the HuffYUV tracks into {path}: {done.stderr.strip()}")


def _stream(
    container: Any,
    name: str,
    coder: _Coder,
    size: tuple[int, int],
    rate: Fraction,
    base: Fraction,
    options: AtlasVideoOptions,
) -> Any:
    crf = None if name in EXACT_ALWAYS else options.crf
    stream = container.add_stream(coder.name, rate=rate, options=coder.options(crf))
    stream.height, stream.width = (3 * size[0], size[1]) if coder.stacked else size
    stream.pix_fmt = coder.pixels
    stream.time_base = stream.codec_context.time_base = base
    stream.metadata["title"] = name
    return stream


def _frame(picture: np.ndarray, coder: _Coder) -> av.VideoFrame:
    if not coder.stacked:
        # Between RGB formats FFmpeg moves bytes and computes nothing.
        return av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=coder.pixels)
    luma = picture.transpose(2, 0, 1).reshape(-1, picture.shape[1])
    chroma = np.full((luma.shape[0] // 2, luma.shape[1]), 128, np.uint8)
    return av.VideoFrame.from_ndarray(np.concatenate([luma, chroma]), format="yuv420p")


# Reading


class AtlasVideo:
    """An atlas video, read from front to back.

    Raises FileNotFoundError for a missing file, ValueError for one that is no atlas video or is cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"no atlas video {path}")
        with self._open() as container:
            documents = [stream.data for stream in container.streams.attachments if stream.name == ATTACHMENT]
            titles = tuple(stream.metadata.get("title", "") for stream in container.streams.video)
        if not documents:
            raise ValueError(f"{path} is no atlas video: it lacks the attachment {ATTACHMENT}")
        try:
            self._read_document(parse_json(documents[0] or b"", "it"))
        except ValueError as error:
            raise ValueError(f"{path}: its {ATTACHMENT} cannot be read: {error}") from None
        if titles != self.triplets:
            raise ValueError(f"{path} must have the video tracks {self.triplets}, but has {titles}")

    def _open(self) -> Any:
        try:
            return open_matroska(self.path)
        except av.FFmpegError as error:
            raise ValueError(f"{self.path} is no Matroska file, or damaged ({error.strerror})") from None

    def _read_document(self, document: object) -> None:
        data = bounds.fields(document, "it")
        kind, version, digests, triplets, segments, stacked, *size = (
            field_of(data, name, "it")
            for name in ("format", "version", "digests", "triplets", "segments", "stacked", "height", "width")
        )
        if (kind, version) != (FORMAT, VERSION):
            said = [bounds.shown(value).strip("'") for value in (kind, version)]
            raise ValueError(f"it is {said[0]} version {said[1]}, not {FORMAT} {VERSION}")
        self.header = SceneHeader.from_json(data)
        most, listed = bounds.MOST_FRAMES, bounds.items(triplets, "triplets", most=100)
        self.digests = tuple(bounds.words(text, "digests") for text in bounds.items(digests, "digests", most=most))
        self.triplets = triplet_names(self.header.quantizer.sh_degree)
        if tuple(listed) != self.triplets:
            raise ValueError(f"it must have the triplets {', '.join(self.triplets)}, but has {bounds.shown(triplets)}")
        parts = [bounds.fields(part, "a segment") for part in bounds.items(segments, "segments", most=most)]
        self.segments = tuple(
            (
                bounds.whole(field_of(part, "first", "a segment"), "a segment: first", most=most),
                bounds.whole(field_of(part, "frames", "a segment"), "a segment: frames", least=1, most=most),
            )
            for part in parts
        )
        """First scene frame and number of frames of each"""
        ends = np.cumsum([0, *(length for _, length in self.segments)]).tolist()
        starts = [first for first, _ in self.segments]
        if starts != ends[:-1] or not ends[-1] == len(self.digests) == len(self.header.times_ns):
            raise ValueError(
                f"its {len(starts)} segments, {len(self.digests)} digests and {len(self.header.times_ns)} times do not "
                "belong together"
            )
        bounds.check_picture(size[1], size[0], "its pictures")
        self._stacked, self._size = bool(stacked), (int(size[0]), int(size[1]))

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.digests)

    def codes(self) -> Iterator[Codes]:
        """The Gaussians of every frame, in raster order."""
        for pictures in self.pictures():
            yield read_triplets(pictures, sh_degree=self.header.quantizer.sh_degree)

    def pictures(self) -> Iterator[dict[str, np.ndarray]]:
        """The stored pictures of every frame, uint8 [height, width, 3] each."""
        waiting: dict[str, deque[np.ndarray]] = {name: deque() for name in self.triplets}
        count = 0
        for name, picture in self._decoded():
            waiting[name].append(picture)
            if len(waiting[name]) > MOST_AHEAD:
                raise ValueError(f"{self.path}: track {name!r} runs ahead of the others; it is damaged")
            while all(waiting.values()):
                yield {name: queue.popleft() for name, queue in waiting.items()}
                count += 1
        if count != len(self):
            raise ValueError(f"{self.path} holds {count} of its {len(self)} frames; it is damaged or cut short")

    def _decoded(self) -> Iterator[tuple[str, np.ndarray]]:
        with self._open() as container:
            streams = container.streams.video
            name_of = {stream.index: name for stream, name in zip(streams, self.triplets, strict=True)}
            try:
                for packet in container.demux(*streams):
                    for frame in packet.decode():
                        yield name_of[packet.stream.index], self._picture(frame)
            except av.FFmpegError as error:
                raise ValueError(f"{self.path} does not decode ({error.strerror}); it is damaged") from None

    def _picture(self, frame: Any) -> np.ndarray:
        height, width = self._size
        picture: np.ndarray
        if (frame.height, frame.width) != (3 * height if self._stacked else height, width):
            raise ValueError(f"{self.path} has pictures of {frame.width} x {frame.height}, but says {width} x {height}")
        if not self._stacked:
            picture = frame.to_ndarray(format="rgb24")
        else:
            plane = frame.planes[0]
            luma = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
            picture = luma.reshape(3, -1, plane.width).transpose(1, 2, 0)
        return picture


def _compare(
    scene: Scene, plan: _Plan, path: Path, options: AtlasVideoOptions, progress: Callable[[int], None]
) -> AtlasVideoSummary:
    """Third pass: decode, and hold every picture and its Gaussians against what was drawn."""
    names = triplet_names(scene.header.quantizer.sh_degree)
    squares, texels = dict.fromkeys(names, 0.0), 0
    drawings = _drawings(scene, plan, options)
    for number, (decoded, (_, drawn)) in enumerate(zip(AtlasVideo(path).pictures(), drawings, strict=True), start=1):
        texels += int(filled(drawn).sum())
        for name in names:
            squares[name] += _squared_error(decoded[name], drawn[name])
        progress(number)
    rms = {name: float(np.sqrt(squares[name] / max(1, 3 * texels))) for name in names}
    height, width = plan.crop.size
    return AtlasVideoSummary(
        len(plan.digests),
        path.stat().st_size,
        _track_bytes(path, names),
        width,
        height,
        plan.gaussians,
        plan.seated,
        rms,
    )


def _squared_error(decoded: np.ndarray, drawn: np.ndarray) -> float:
    """Sum over all texels, so that a lossless video with a stray value in an empty one is not called exact."""
    return float((np.subtract(decoded, drawn, dtype=np.int32) ** 2).sum())


def _track_bytes(path: Path, names: Sequence[str]) -> dict[str, int]:
    sizes = dict.fromkeys(names, 0)
    with av.open(str(path)) as container:
        name_of = {stream.index: name for stream, name in zip(container.streams.video, names, strict=True)}
        for packet in container.demux(*container.streams.video):
            sizes[name_of[packet.stream.index]] += packet.size
    return sizes
