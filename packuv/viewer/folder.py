"""A scene as a folder of static files: the viewer's page with what it fetches, and the same integers as video.

Any web server can hand the folder out, over plain http too. The page plays the deltas, which every browser reads;
the video streams are for programs with WebCodecs, which want https or localhost. docs/viewer.md describes all files.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from packuv.bounds import field, fields
from packuv.files import load_json, whole_folder
from packuv.gaussians.codes import Codes, attribute_count
from packuv.progress import Progress, no_progress
from packuv.scene import Scene, open_scene
from packuv.viewer.bodies import Bodies, ReadKey, parents_of, read_frame, read_key, reference_of
from packuv.viewer.source import SceneSource, describe
from packuv.viewer.streams import (
    Sheet,
    StreamWriter,
    WebCodec,
    add_planes,
    code_planes,
    codes_of_planes,
    delta_planes,
    read_stream,
)

FORMAT, VERSION, INDEX, VIDEO = "packuv-web", 2, "index.json", "video.json"
KEY_FILE, DELTA_FILE, SOUND_FILE = "key.ivf", "delta.ivf", "sound.flac"


@dataclass(frozen=True)
class WebOptions:
    """What a folder for the web holds."""

    codec: WebCodec = WebCodec.VP9
    """Of the video streams"""


@dataclass(frozen=True)
class WebSummary:
    """What `write_web` wrote."""

    frames: int
    bytes: int
    """Of all files"""
    delta_bytes: int
    """What the page fetches to play everything once"""
    video_bytes: int
    """Both video streams"""


def write_web(path: Path, out: Path, *, options: WebOptions, progress: Progress = no_progress) -> WebSummary:
    """Write a scene file as a new folder, then decode both forms of every frame and compare.

    Raises FileExistsError where `out` is no new or empty folder, RuntimeError when a frame does not read back exactly.
    """
    with open_scene(path) as scene, whole_folder(out) as folder:
        steps = 4 * len(scene)
        segments, wanted = _write_bodies(scene, folder, lambda done: progress(done, steps))
        video, checks = _write_video(scene, folder, options, lambda done: progress(len(scene) + done, steps))
        _write_json(folder / INDEX, {"format": FORMAT, "version": VERSION, "segments": segments})
        _write_json(folder / VIDEO, {**video, "crc32": checks})
        _write_page(folder)
        _verify(folder, wanted, checks, lambda done: progress(2 * len(scene) + done, steps))
        sizes = {entry.name: entry.stat().st_size for entry in folder.iterdir()}
    played = sum(sizes[entry["file"]] for entry in segments)
    return WebSummary(len(checks), sum(sizes.values()), played, sizes[KEY_FILE] + sizes[DELTA_FILE])


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, separators=(",", ":")))


def _write_page(folder: Path) -> None:
    """The viewer as it is, but for the worker, which finds its data through the index."""
    viewer = files("packuv.viewer")
    for name in ("viewer.js", "splats.js", "navigation.js", "film.js"):
        (folder / name).write_text((viewer / name).read_text())
    (folder / "index.html").write_text((viewer / "page.html").read_text())
    (folder / "worker.js").write_text((viewer / "packed.js").read_text() + (viewer / "worker.js").read_text())


# Deltas


def _write_bodies(
    scene: Scene, folder: Path, progress: Callable[[int], None]
) -> tuple[list[dict[str, Any]], list[int]]:
    """What the server of `packuv view` answers, a file for each segment; sizes of the bodies, as the index has them,
    and the checksum of every frame with its rows in the page's order."""
    source = SceneSource(scene)
    bodies, segments, checks = Bodies(source), [], []
    _write_json(folder / "scene.json", describe(source))
    if heard := source.sound():
        (folder / SOUND_FILE).write_bytes(heard)
    for number, frames in enumerate(source.segments):
        entry: dict[str, Any] = {"file": f"segment{number:05d}.bin", "parts": [], "frames": []}
        with (folder / entry["file"]).open("wb") as out:
            for part in range(bodies.parts(number)):
                entry["parts"].append(out.write(bodies.part(number, part)))
            entry["layers"] = out.write(bodies.layers(number))
            for frame in frames:
                if frame != frames.start:
                    entry["frames"].append(out.write(bodies.frame(frame)))
                checks.append(checksum(bodies.codes(frame)))
                progress(len(checks))
        segments.append(entry)
    return segments, checks


# Video


def _write_video(
    scene: Scene, folder: Path, options: WebOptions, progress: Callable[[int], None]
) -> tuple[dict[str, Any], list[int]]:
    """Both streams; what the index says of them, and the checksum of every frame."""
    os.environ.setdefault("SVT_LOG", "1")  # SVT-AV1 prints its settings unless told to report errors only
    entries = scene.index.segments
    planes = 6 + attribute_count(scene.header.quantizer.sh_degree)
    sheets = [Sheet.of(max(getattr(entry, key) for entry in entries), planes) for key in ("rows", "dynamic")]
    checks: list[int] = []
    with (folder / KEY_FILE).open("wb") as key_file, (folder / DELTA_FILE).open("wb") as delta_file:
        keys, deltas = (
            StreamWriter(file, sheet, options.codec, scene.header.rate)
            for file, sheet in zip((key_file, delta_file), sheets, strict=True)
        )
        for entry in entries:
            last = scene.codes(entry.first)
            keys.add(code_planes(last), starts=True)
            checks.append(checksum(last))
            progress(len(checks))
            for frame in range(entry.first + 1, entry.first + entry.frames):
                now = scene.codes(frame)
                rows = slice(0, entry.dynamic)
                deltas.add(delta_planes(now[rows], last[rows]), starts=frame == entry.first + 1)
                checks.append(checksum(now))
                last = now
                progress(len(checks))
        keys.close()
        deltas.close()
    video = {
        "kind": str(options.codec),
        "key": {"file": KEY_FILE, **keys.to_json()},
        "delta": {"file": DELTA_FILE, **deltas.to_json()},
        "segments": [{key: getattr(e, key) for key in ("first", "frames", "rows", "dynamic")} for e in entries],
    }
    return video, checks


def checksum(codes: Codes) -> int:
    """CRC-32 over the bytes of a frame, plane by plane: high bytes of x y z, low bytes, attributes."""
    return zlib.crc32(code_planes(codes).tobytes())


# Reading


def read_video(folder: Path) -> Iterator[Codes]:
    """Every frame of a folder, from its video streams. Raises ValueError for another folder or a damaged stream."""
    read_index(folder)
    video = load_json(folder / VIDEO)
    codec = WebCodec(video["kind"])
    sheets = [
        Sheet(video[name]["planes"], video[name]["tiles_across"], video[name]["tiles_down"])
        for name in ("key", "delta")
    ]
    with (folder / video["key"]["file"]).open("rb") as a, (folder / video["delta"]["file"]).open("rb") as b:
        keys, deltas = read_stream(a, video["key"], codec), read_stream(b, video["delta"], codec)
        for segment in video["segments"]:
            codes = codes_of_planes(sheets[0].read(_next(keys, folder), segment["rows"]))
            yield codes
            count = segment["dynamic"]
            for _ in range(segment["frames"] - 1):
                moved = add_planes(codes[:count], sheets[1].read(_next(deltas, folder), count))
                codes = Codes(codes.xyz.copy(), codes.attributes.copy())
                codes.xyz[:count], codes.attributes[:count] = moved.xyz, moved.attributes
                yield codes


def _next(pictures: Iterator[np.ndarray], folder: Path) -> np.ndarray:
    try:
        return next(pictures)
    except StopIteration:
        raise ValueError(f"{folder}: a video stream ends before its scene does; it is damaged") from None


def read_deltas(folder: Path) -> Iterator[Codes]:
    """Every frame of a folder, as its page rebuilds it: rows in the page's order."""
    keys: dict[int, ReadKey] = {}
    ways: list[list[int]] = []  # of each segment: those whose keys its own is made of, and itself
    for number, entry in enumerate(read_index(folder)["segments"]):
        bodies = _bodies(folder, entry)
        parts = [next(bodies) for _ in entry["parts"]]
        reference = reference_of(parts[0])
        key = read_key(parts, None if reference is None else keys[reference])
        ways.append([*([] if reference is None else ways[reference]), number])
        keys = {part: key if part == number else keys[part] for part in ways[-1]}
        next(bodies)  # the layers of the UV map
        coded, known = list(bodies), {0: key.codes[: key.dynamic]}
        for offset in range(len(coded) + 1):
            codes = Codes(key.codes.xyz.copy(), key.codes.attributes.copy())
            moving = _moving(known, coded, offset)
            codes.xyz[: key.dynamic], codes.attributes[: key.dynamic] = moving.xyz, moving.attributes
            yield codes


def _moving(known: dict[int, Codes], coded: Sequence[bytes], offset: int) -> Codes:
    """The moving rows of a frame of a segment; adds it and its parents to those known."""
    if offset not in known:
        body = coded[offset - 1]
        known[offset] = read_frame(body, [_moving(known, coded, k) for k in parents_of(body, offset, len(coded) + 1)])
    return known[offset]


def read_index(folder: Path) -> dict[str, Any]:
    """index.json of a folder for the web; raises FileNotFoundError, or ValueError for another one."""
    try:
        index = dict(fields(load_json(folder / INDEX), "it"))
        known = (field(index, "format", "it"), field(index, "version", "it")) == (FORMAT, VERSION)
    except ValueError as error:
        raise ValueError(f"{folder / INDEX} is no index of a scene: {error}") from None
    if not known:
        raise ValueError(f"{folder / INDEX} is {index['format']} version {index['version']}, not {FORMAT} {VERSION}")
    return index


def _bodies(folder: Path, entry: Mapping[str, Any]) -> Iterator[bytes]:
    """All bodies of a segment, inflated, in the order of their file: parts, layers, frames."""
    with (folder / entry["file"]).open("rb") as opened:
        for size in (*entry["parts"], entry["layers"], *entry["frames"]):
            at = opened.tell()
            try:
                yield zlib.decompress(opened.read(size))
            except zlib.error as error:
                raise ValueError(f"{folder / entry['file']}: {size} bytes from {at} are damaged ({error})") from None


def _verify(folder: Path, wanted: list[int], checks: list[int], progress: Callable[[int], None]) -> None:
    done = 0
    for what, frames, sums in (("video streams", read_video(folder), checks), ("deltas", read_deltas(folder), wanted)):
        for frame, (codes, check) in enumerate(zip(frames, sums, strict=True)):
            if checksum(codes) != check:
                raise RuntimeError(f"frame {frame} does not read back from the {what} as it was written")
            done += 1
            progress(done)
