"""Size, speed and distortion of the scene file, beside other codecs and the formats of other programs.

    packuv bench codec --scene SCENE.mkv --capture CAPTURE --out bench/results/codec.json --plot rate.svg
    packuv bench codec --frames 30 --keyframes 4 --out runs/codec.json          # a made-up sequence
    packuv bench codec --segments S0.npz S1.npz --quantizer quantizer.json --out runs/codec.json

`compact` rows are scene files, lossless and at each quality, written, verified and read. `plain atlas` codes every byte
plane of the whole 2048 x 1024 atlas in every frame, as the paper does; `codes` rows the bytes of all Gaussians in every
frame, in the order and mosaic of the scene file but without its differences between frames; `pictures` rows the compact
file's own pictures, as a video or, with WebP and JPEG XL, each alone; these must give back every byte. Rows named as a
format are what `packuv export` writes, read again: a file a frame, of which the frames that are drawn are measured, or
all frames in one. Distortion is the PSNR of renders from cameras that were not fitted against renders of the lossless
scene and, with --capture, against what those cameras filmed. Noise of a made-up sequence is known, so its last row says
what no codec is below that keeps the keys as they are. Wall time on a shared machine is noisy: compare rows of one run,
and CPU seconds, which count all threads.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from bench import command
from bench.doors import MEASURED, USUAL, Pictures, measure_doors
from bench.entropy import channel_bits
from bench.front_end import COLOURS
from bench.made_up import CAMERA, NEAR, SequenceOptions, find_gaussians, make_sequence
from packuv.gaussians.codes import OPACITY, Codes, Quantizer
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvmap import Slots, assign_slots, atlas_pixels, atlas_size
from packuv.gaussians.uvsize import UvOptions
from packuv.interchange import SplatFormat
from packuv.scene import TOLERANCES, EncodeOptions, Quality, Scene, SceneHeader, open_scene, write_scene
from packuv.scene.header import DYNAMIC, KEY
from packuv.scene.mosaic import Mosaic
from packuv.scene.stream import channel_names, key_rows
from packuv.threads import ordinary_schedule
from tasks.stages.evaluate import EvaluateOptions, evaluate_scene


@dataclass(frozen=True)
class Codec:
    """A video codec of FFmpeg, set to be lossless."""

    encoder: str
    pixels: str
    """Pixel format; of those with colour only the luma carries data"""
    options: tuple[tuple[str, str], ...] = ()
    by_program: bool = False
    """Whether the `ffmpeg` on PATH codes it, a process a track, for PyAV has no such encoder"""


CODECS = {
    "ffv1": Codec("ffv1", "gray", (("level", "3"), ("coder", "1"), ("slices", "4"), ("slicecrc", "1"), ("g", "1"))),
    "huffyuv": Codec("ffvhuff", "gray"),
    "x264": Codec("libx264", "yuv420p", (("qp", "0"), ("preset", "medium"))),
    "hevc": Codec("libx265", "yuv420p", (("x265-params", "lossless=1:log-level=error"), ("preset", "medium"))),
    "vp9": Codec("libvpx-vp9", "yuv420p", (("lossless", "1"), ("cpu-used", "4"))),
    "av1": Codec("libsvtav1", "yuv420p", (("svtav1-params", "lossless=1"), ("preset", "8"))),
    "webp": Codec("libwebp", "bgra", (("lossless", "1"),)),
    "jxl": Codec("libjxl", "gray", (("distance", "0"), ("effort", "7"), ("modular", "1")), by_program=True),
}
ALONE = ("ffv1", "hevc")
"""Of these, those that also code the codes themselves: one that knows no other frame, and one that finds its own"""
PASSES = 3
"""In which a scene file is read, to take the middle one's time"""


# The scene file


def measure_scene(
    label: str,
    segments: Sequence[Path],
    header: SceneHeader,
    path: Path,
    options: EncodeOptions,
    *,
    threads: int,
) -> dict[str, Any]:
    """Write, verify and read one scene file."""
    frames, start = len(header.times_ns), (time.perf_counter(), time.process_time())
    encoded: list[float] = []

    def note_half(done: float, total: float, note: str = "") -> None:
        if done == total // 2:
            encoded.extend((time.perf_counter() - start[0], time.process_time() - start[1]))

    summary = write_scene(path, segments, header, options=options, threads=threads, progress=note_half)
    written = time.perf_counter() - start[0]
    with open_scene(path, threads=threads) as scene:
        rows = [segment.rows for segment in scene.index.segments for _ in range(segment.frames)]
        predictions = [p for segment in scene.index.segments for p in segment.predictions]
        _play(scene)  # kernels are loaded by then
        cpu = time.process_time()
        seconds_floats = float(np.median([_seconds(lambda: _play(scene)) for _ in range(PASSES)]))
        cpu = (time.process_time() - cpu) / PASSES
        seconds_codes = _seconds(lambda: [len(scene.codes(frame)) for frame in range(frames)])
        jumps = np.random.default_rng(0).integers(0, frames, 8)
        seconds_random = _seconds(lambda: [scene.codes(int(frame)) for frame in jumps]) / len(jumps)
        own = [segment.own for segment in scene.index.segments]
    return {
        "layout": label,
        "exact": options.tolerance.exact,
        "tolerance": vars(options.tolerance),
        "bytes": summary.bytes,
        "track_bytes": dict(summary.track_bytes),
        "frames": frames,
        "frames_measured": frames,
        "gaussians_per_frame": float(np.mean(rows)),
        "bits_per_gaussian_and_frame": summary.bytes * 8 / sum(rows),
        "key_rows_stored": own,
        "frames_by_prediction": {name: predictions.count(k) for k, name in enumerate(("repeat", "previous", "linear"))},
        "encode_seconds_per_frame": encoded[0] / frames,
        "encode_cpu_seconds_per_frame": encoded[1] / frames,
        "encode_and_verify_seconds_per_frame": written / frames,
        "decode_codes_seconds_per_frame": seconds_codes / frames,
        "decode_seconds_per_frame": seconds_floats / frames,
        "decode_cpu_seconds_per_frame": cpu / frames,
        "random_access_seconds": seconds_random,
    }


def _play(scene: Scene) -> None:
    """Every frame as floats, in one set of arrays, as a player has them."""
    shown = None
    for frame in range(len(scene)):
        shown = scene.gaussians(frame, into=shown)


def _seconds(work: Any) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


# The paper's pictures


def measure_plain_atlas(segments: Sequence[Path], quantizer: Quantizer, *, frames_measured: int) -> dict[str, Any]:
    """FFV1 of every plane of the whole 2048 x 1024 atlas in every frame, absolute values, zero-filled (the paper).

    Frames cost nearly the same, so a few are encoded and the rest is extrapolated.
    """
    pictures: list[np.ndarray] = []
    rows = total = 0
    for path in segments:
        segment = Segment.load(path)
        total += len(segment)
        floats = quantizer.decode(segment.key)
        slots = assign_slots(floats.means, segment.key.attributes[:, OPACITY], quantizer.centre, options=UvOptions())
        for step in range(min(len(segment), frames_measured - len(pictures))):
            pictures.append(_atlas(_bytes(segment.frame(step)), slots))
            rows += int(slots.kept.sum())
    measured = _through("plain atlas, ffv1", CODECS["ffv1"], [pictures], len(pictures), rows)
    size = round(measured["bytes"] / len(pictures) * total)
    return {**measured, "bytes": size, "frames": total, "gaussians_per_frame": rows / len(pictures)}


def _atlas(rows: np.ndarray, slots: Slots) -> np.ndarray:
    """The atlas planes of rows uint8 [n, channels], about square, in one picture."""
    height, width = atlas_size(UvOptions())
    across = int(np.ceil(np.sqrt(rows.shape[1])))
    down = -(-rows.shape[1] // across)
    y, x = atlas_pixels(slots, options=UvOptions())[slots.kept].T
    picture = np.zeros((down, height, across, width), np.uint8)
    for channel, values in enumerate(rows[slots.kept].T):
        picture[channel // across, y, channel % across, x] = values
    return picture.reshape(down * height, across * width)


def _bytes(codes: Codes) -> np.ndarray:
    """Absolute bytes of every channel, uint8 [n, channels]."""
    return np.concatenate([codes.xyz >> 8, codes.xyz & 255, codes.attributes], axis=1).astype(np.uint8)


# Other codecs


def measure_codecs(path: Path, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """The pictures of both tracks of a scene file through other codecs, each track as one video; and its codes."""
    with open_scene(path) as scene:
        tracks = [pictures for number in range(len(scene.index.tracks)) if (pictures := list(_pictures(scene, number)))]
        codes = list(_undifferenced(scene))
        rows = sum(segment.rows * segment.frames for segment in scene.index.segments)
    for name in names:
        yield _through(f"pictures, {name}", CODECS[name], tracks, len(codes), rows)
    for name in names:
        if name in ALONE:
            yield _through(f"codes, {name}", CODECS[name], [codes], len(codes), rows)


def _through(
    label: str, codec: Codec, tracks: Sequence[Sequence[np.ndarray]], frames: int, rows: int
) -> dict[str, Any]:
    """Videos of so many frames, with so many rows in all of them, coded and decoded."""
    start = time.perf_counter()
    try:
        coded = [_code(codec, pictures) for pictures in tracks]
    except (av.FFmpegError, ValueError, OSError, subprocess.CalledProcessError) as error:
        told = error.stderr.decode().strip() if isinstance(error, subprocess.CalledProcessError) else ""
        return {"layout": label, "skipped": told.split("\n")[-1] or str(error)}
    written = time.perf_counter()
    shapes = [pictures[0].shape for pictures in tracks]
    found = [_decoded(codec, *pair) for pair in zip(coded, shapes, strict=True)]
    read = time.perf_counter()
    size = sum(len(packet) for packets, _ in coded for packet in packets)
    return {
        "layout": label,
        "exact": all(map(_same, found, tracks)),
        "bytes": size,
        "track_bytes": [sum(map(len, packets)) for packets, _ in coded],
        "frames": frames,
        "frames_measured": frames,
        "bits_per_gaussian_and_frame": size * 8 / rows,
        "encode_seconds_per_frame": (written - start) / frames,
        "decode_seconds_per_frame": (read - written) / frames,
    }


def _same(found: Sequence[np.ndarray], pictures: Sequence[np.ndarray]) -> bool:
    return len(found) == len(pictures) and all(map(np.array_equal, found, pictures))


def _undifferenced(scene: Scene) -> Iterator[np.ndarray]:
    """A picture of each frame as if it were a key: all its rows, as they are."""
    channels = len(channel_names(scene.header.quantizer.sh_degree))
    most = max(segment.rows for segment in scene.index.segments)
    mosaic = Mosaic.of(most, tuple(range(channels)), channels)
    for frame in range(len(scene)):
        yield mosaic.draw(key_rows(scene.codes(frame)))


def _pictures(scene: Scene, track: int) -> Iterator[np.ndarray]:
    """All pictures of a track, in order."""
    wanted = [address for address in scene._wanted(0, 0, len(scene) - 1) if address.track == track]
    assert track in (KEY, DYNAMIC)
    yield from (scene._pictures.picture(address, []) for address in wanted)


def _code(codec: Codec, pictures: Sequence[np.ndarray]) -> tuple[list[bytes], bytes | None]:
    """Packets in coding order, and the stream's own header."""
    if codec.by_program:
        return _by_program(codec, pictures), None
    context = av.CodecContext.create(codec.encoder, "w")
    assert isinstance(context, av.VideoCodecContext)
    context.height, context.width = pictures[0].shape
    context.pix_fmt, context.time_base = codec.pixels, Fraction(1, 30)
    context.framerate = Fraction(30)
    context.options = dict(codec.options)
    with ordinary_schedule():
        context.open(strict=False)
    packets: list[av.Packet[Any]] = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(_framed(picture, codec.pixels), format=codec.pixels)
        frame.pts, frame.time_base = number, context.time_base
        packets += context.encode(frame)
    packets += context.encode(None)
    return [bytes(packet) for packet in packets], context.extradata


def _framed(picture: np.ndarray, pixels: str) -> np.ndarray:
    """The picture as luma, with chroma of nothing below where the format wants one."""
    if pixels == "gray":
        return picture
    if pixels == "bgra":
        return np.stack([picture] * 3 + [np.full_like(picture, 255)], axis=2)
    return np.concatenate([picture, np.full((picture.shape[0] // 2, picture.shape[1]), 128, np.uint8)])


def _by_program(codec: Codec, pictures: Sequence[np.ndarray]) -> list[bytes]:
    """A file of each picture. Raises OSError without the program, CalledProcessError where that has no such codec."""
    height, width = pictures[0].shape
    options = [word for name, value in codec.options for word in (f"-{name}", value)]
    with tempfile.TemporaryDirectory() as folder:
        source = ["-f", "rawvideo", "-pixel_format", "gray", "-video_size", f"{width}x{height}", "-i", "-"]
        target = ["-c:v", codec.encoder, *options, "-threads", "1", f"{folder}/%06d.jxl"]
        raw = b"".join(picture.tobytes() for picture in pictures)
        _ffmpeg([*source, *target], raw)
        return [path.read_bytes() for path in sorted(Path(folder).iterdir())]


def _from_program(files: Sequence[bytes], shape: tuple[int, ...]) -> list[np.ndarray]:
    """The pictures of such files."""
    with tempfile.TemporaryDirectory() as folder:
        for number, content in enumerate(files, start=1):
            Path(folder, f"{number:06d}.jxl").write_bytes(content)
        source = ["-threads", "1", "-i", f"{folder}/%06d.jxl"]
        raw = _ffmpeg([*source, "-f", "rawvideo", "-pix_fmt", "gray", "-"], b"")
    return list(np.frombuffer(raw, np.uint8).reshape(-1, *shape))


def _ffmpeg(words: Sequence[str], given: bytes) -> bytes:
    command = ["ffmpeg", "-hide_banner", "-loglevel", "error", *words]
    return subprocess.run(command, input=given, capture_output=True, check=True).stdout


def _decoded(codec: Codec, coded: tuple[list[bytes], bytes | None], shape: tuple[int, ...]) -> list[np.ndarray]:
    """The pictures of packets, uint8 [height, width] each."""
    packets, header = coded
    if codec.by_program:
        return _from_program(packets, shape)
    encoder = av.CodecContext.create(codec.encoder, "w").codec
    names = {"libx264": "h264", "libx265": "hevc", "libvpx-vp9": "vp9", "libsvtav1": "libdav1d", "libwebp": "webp"}
    context = av.CodecContext.create(names.get(codec.encoder, encoder.name), "r")
    assert isinstance(context, av.VideoCodecContext)
    context.extradata = header
    context.height, context.width = height, width = shape
    frames = [frame for packet in packets for frame in context.decode(av.Packet(packet))]
    frames += context.decode(None)
    return [_gray(frame)[:height, :width] for frame in frames]


def _gray(frame: av.VideoFrame) -> np.ndarray:
    """Its luma, or one of its colours, which are all alike."""
    found = frame.to_ndarray()
    return found[:, :, 1] if found.ndim == 3 else found


# Command


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("codec", __doc__)
    parser.add_argument("--scene", type=Path, help="a lossless scene file")
    parser.add_argument("--segments", type=Path, nargs="+", help="segment files; without any a sequence is made up")
    parser.add_argument("--quantizer", type=Path, help="JSON of the segments' quantizer")
    parser.add_argument("--capture", type=Path, help="capture folder of the scene, for PSNR against what was filmed")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--plot", type=Path, help="rate-distortion plot to write, SVG; needs --scene")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--plain-frames", type=int, default=2, help="frames of plain atlas FFV1 to measure")
    parser.add_argument("--render-frames", type=int, default=4, help="frames to render for distortion")
    parser.add_argument("--codecs", nargs="*", default=list(CODECS), choices=list(CODECS))
    parser.add_argument(
        "--formats", nargs="*", type=SplatFormat, default=list(USUAL), choices=list(MEASURED), help="of other programs"
    )
    for name, default in asdict(SequenceOptions()).items():
        parser.add_argument(f"--{name}", type=type(default), default=default, help="of the made-up sequence")
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser.parse_args(words)
    if options.segments and not options.quantizer:
        parser.error("--segments needs --quantizer, the JSON that belongs to them")
    if options.plot and not options.scene:
        parser.error("--plot needs --scene, whose cameras render")
    with tempfile.TemporaryDirectory() as folder:
        results = run(options, words, Path(folder))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    if options.plot:
        options.plot.write_text(plot(points(results["rows"]), "MB per 30 frames"))
    print(table(results["rows"]))


def run(options: argparse.Namespace, words: Sequence[str], folder: Path) -> dict[str, Any]:
    """All measurements of one command line."""
    paths, header, source, least_bits = _sequence(options, folder)
    rows = [
        measure_scene(
            f"compact, {quality}",
            paths,
            header,
            folder / f"{quality}.mkv",
            EncodeOptions(TOLERANCES[quality]),
            threads=options.threads,
        )
        for quality in Quality
    ]
    files = [folder / f"{quality}.mkv" for quality in Quality]
    if len(paths) > 1:
        alone, file = EncodeOptions(reach=1), folder / "alone.mkv"
        rows.append(measure_scene("compact, no sharing", paths, header, file, alone, threads=options.threads))
    if options.capture:
        for row, path in zip(rows, files, strict=False):
            row["unseen_cameras"] = _filmed(path, options.capture)
    if options.plain_frames:
        rows.append(measure_plain_atlas(paths, header.quantizer, frames_measured=options.plain_frames))
    rows += measure_codecs(files[0], options.codecs)
    with open_scene(files[0]) as lossless:
        pictures = Pictures(lossless, frames=options.render_frames)
        for row, file in zip(rows[1:], files[1:], strict=False):
            with open_scene(file) as scene:
                row["psnr_to_lossless_db"] = pictures.psnr(scene.gaussians)
        rows += measure_doors(lossless, options.formats, pictures, folder)
        bits = channel_bits(lossless.segment(0))
    if least_bits is not None:
        rows.append(_floor(rows[0], least_bits))
    first = Segment.load(paths[0])
    return {
        "source": source,
        "command": shlex.join(["packuv", "bench", "codec", *words]),
        "load": os.getloadavg()[0],
        "gaussians": len(first.key),
        "dynamic": int(first.dynamic.sum()),
        "rows": rows,
        "channel_bits": bits,
    }


def _floor(lossless: dict[str, Any], least_bits: float) -> dict[str, Any]:
    """The row of a file with the keys of a lossless one and nothing but noise besides."""
    size = lossless["track_bytes"]["key"] + least_bits / 8
    bits = lossless["bits_per_gaussian_and_frame"] * size / lossless["bytes"]
    return {
        "layout": "keys, and noise alone",
        "exact": True,
        "bytes": round(size),
        "frames": lossless["frames"],
        "bits_per_gaussian_and_frame": bits,
    }


def _sequence(options: argparse.Namespace, folder: Path) -> tuple[list[Path], SceneHeader, Any, float | None]:
    """Segment files, what the scene says, where it is from, and the least bits of its frames after keys if known."""
    if options.scene:
        return *_unpacked(options.scene, folder), None
    source: Any
    least_bits = None
    if options.segments:
        paths, source = options.segments, "segment files"
        quantizer = Quantizer.from_json(json.loads(options.quantizer.read_text()))
    else:
        made_up = SequenceOptions(**{name: getattr(options, name) for name in asdict(SequenceOptions())})
        gaussians, origin = find_gaussians(made_up.seed)
        segments, quantizer, least_bits = make_sequence(gaussians, made_up)
        paths, source = _saved(segments, folder), {"made up from": origin, **asdict(made_up)}
    frames = sum(len(Segment.load(path)) for path in paths)
    times = (np.arange(frames) * 10**9 // 30).astype(np.int64)
    if options.segments:
        return paths, SceneHeader(quantizer, times, Fraction(30)), source, least_bits
    return paths, SceneHeader(quantizer, times, Fraction(30), (CAMERA,), extra={"near": NEAR}), source, least_bits


def _unpacked(path: Path, folder: Path) -> tuple[list[Path], SceneHeader, Any]:
    """The segments of a scene file."""
    with command.lossless(path) as scene:
        segments = [scene.segment(number) for number in range(len(scene.index.segments))]
        return _saved(segments, folder), scene.header, f"scene file {path.name}"


def _saved(segments: Sequence[Segment], folder: Path) -> list[Path]:
    paths = [folder / f"segment{number}.npz" for number in range(len(segments))]
    for path, segment in zip(paths, segments, strict=True):
        segment.save(path)
    return paths


def _filmed(path: Path, capture: Path) -> dict[str, float]:
    """PSNR and SSIM against what cameras filmed that were not fitted."""
    facts = evaluate_scene(path, capture, None, EvaluateOptions(), lambda *_: None)
    return {name: facts["mean"][name] for name in ("psnr_db", "ssim")}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line a layout, as Markdown."""
    lines = [
        "| layout | kB a frame | bits per Gaussian and frame | encode, s | decode, s a frame | to lossless, dB |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        if "skipped" in row:
            lines.append(f"| {row['layout']} | not measured: {row['skipped']} | | | | |")
            continue
        figures = [f"{row['bytes'] / row['frames'] / 1e3:.1f}", f"{row['bits_per_gaussian_and_frame']:.2f}"]
        seconds = (row.get(f"{way}_seconds_per_frame") for way in ("encode", "decode"))
        figures += ["" if each is None else f"{each:.3f}" for each in seconds]
        lines.append(f"| {' | '.join([row['layout'], *figures, _loss(row)])} |")
    return "\n".join(lines)


def _loss(row: dict[str, Any]) -> str:
    if row["exact"]:
        return "exact"
    if "psnr_to_lossless_db" not in row:
        return "NOT EXACT"
    decibel = row["psnr_to_lossless_db"]
    return "equal" if decibel is None else f"{decibel:.2f}"


def points(rows: Sequence[dict[str, Any]]) -> list[Point]:
    """For the plot: MB of 30 frames."""
    sized = [row for row in rows if "bytes" in row]
    return [(row["bytes"] * 30 / row["frames"] / 1e6, row.get("psnr_to_lossless_db"), row["layout"]) for row in sized]


Point = tuple[float, float | None, str]
"""Size in MB, PSNR in dB or None where it is lossless, and name"""


def plot(marked: Sequence[Point], what: str, lines: Mapping[str, Sequence[Point]] | None = None) -> str:
    """Rate against distortion as SVG: size on a logarithmic scale, lossless layouts along the top; points with their
    names, and lines of points, whose names stand in the corner."""
    lines = lines or {}
    everything = [*marked, *(point for line in lines.values() for point in line)]
    known = [decibel for _, decibel, _ in everything if decibel]
    low, high = np.log10([min(p[0] for p in everything) * 0.8, max(p[0] for p in everything) * 1.3])
    bottom, top = min(known, default=40) - 2, max(known, default=40) + 6
    marks = [_axes(low, high, bottom, top, what)]

    def place(size: float, decibel: float | None) -> tuple[float, float]:
        y = 40 if decibel is None else 60 + (top - decibel) / (top - bottom) * 380
        return 70 + (np.log10(size) - low) / (high - low) * 820, y

    for number, (name, line) in enumerate(lines.items()):
        colour = COLOURS[number % len(COLOURS)]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in (place(size, decibel) for size, decibel, _ in line))
        marks.append(f'<path d="M{path}" fill="none" stroke="{colour}"/>')
        marks.append(f'<text x="90" y="{64 + 18 * number}" fill="{colour}" font-weight="bold">{name}</text>')
        marks += [_dot(*place(size, decibel), label, colour) for size, decibel, label in line]
    below = 0
    for size, decibel, label in sorted(marked, key=lambda point: (point[1] is None, point[0])):
        x, y = place(size, decibel)
        under = y + 4 if decibel else y + 18 + 16 * (below % 6)
        below += decibel is None
        marks.append(_dot(x, y, label, "black") + f'<text x="{x + 7:.1f}" y="{under:.1f}">{label}</text>')
    body = "".join(marks)
    head = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1060 500" font-family="sans-serif" font-size="12">'
    return f"{head}{body}</svg>\n"


def _dot(x: float, y: float, label: str, colour: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"><title>{label}</title></circle>'


def _axes(low: float, high: float, bottom: float, top: float, what: str) -> str:
    parts = ['<rect width="1060" height="500" fill="white"/><path d="M70 40V450H890" fill="none" stroke="black"/>']
    parts.append(f'<text x="480" y="490" text-anchor="middle">{what}</text><text x="75" y="30">lossless</text>')
    parts.append('<text x="16" y="250" transform="rotate(-90 16 250)" text-anchor="middle">PSNR to lossless, dB</text>')
    for size in (step * 10.0**decade for decade in range(-3, 3) for step in (1, 2, 3, 5)):
        if low <= np.log10(size) <= high:
            x = 70 + (np.log10(size) - low) / (high - low) * 820
            parts.append(
                f'<path d="M{x:.1f} 450v5" stroke="black"/>'
                f'<text x="{x:.1f}" y="468" text-anchor="middle">{size:g}</text>'
            )
    spacing = 2 if top - bottom < 50 else 5
    for decibel in range(spacing * int(np.ceil(bottom / spacing)), int(top) + 1, spacing):
        y = 60 + (top - decibel) / (top - bottom) * 380
        parts.append(f'<text x="62" y="{y + 4:.1f}" text-anchor="end">{decibel}</text>')
    return "".join(parts)


if __name__ == "__main__":
    main()
