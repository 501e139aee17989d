"""A scene as a folder of static files: the viewer's page with what it fetches, and the same integers as video.

Any web server can hand the folder out, over plain http too. The page plays the deltas, which every browser reads;
the video streams are for programs with WebCodecs, which want https or localhost. docs/viewer.md describes all files.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
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
from packuv.viewer.source import SceneSource, describe, frame_bytes, key_bytes, tables_bytes
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

FORMAT, VERSION, INDEX = "packuv-web", 1, "index.json"
KEY_FILE, DELTA_FILE = "key.ivf", "delta.ivf"


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
        steps = 3 * len(scene)
        bodies = _write_bodies(scene, folder, lambda done: progress(done, steps))
        video, checks = _write_video(scene, folder, options, lambda done: progress(len(scene) + done, steps))
        index = {"format": FORMAT, "version": VERSION, "bodies": bodies, "video": video, "crc32": checks}
        (folder / INDEX).write_text(json.dumps(index, separators=(",", ":")))
        _write_page(folder)
        _verify(folder, checks, lambda done: progress(2 * len(scene) + done, steps))
        sizes = {entry.name: entry.stat().st_size for entry in folder.iterdir()}
    played = {file for file, _, _ in bodies.values()}
    return WebSummary(
        len(checks), sum(sizes.values()), sum(sizes[name] for name in played), sizes[KEY_FILE] + sizes[DELTA_FILE]
    )


def _write_page(folder: Path) -> None:
    """The viewer as it is, but for the worker, which finds its data through the index."""
    viewer = files("packuv.viewer")
    for name in ("viewer.js", "splats.js", "navigation.js"):
        (folder / name).write_text((viewer / name).read_text())
    (folder / "index.html").write_text((viewer / "page.html").read_text())
    (folder / "worker.js").write_text((viewer / "packed.js").read_text() + (viewer / "worker.js").read_text())


# Deltas


def _write_bodies(scene: Scene, folder: Path, progress: Callable[[int], None]) -> dict[str, tuple[str, int, int]]:
    """What the server of `packuv view` answers, deflated, a file for each segment: path -> file, offset, size."""
    source = SceneSource(scene)
    (folder / "scene.json").write_text(json.dumps(describe(source)))
    bodies = _append(folder / "tables.bin", {"tables.bin": tables_bytes(source.quantizer)})
    done = 0
    for number, frames in enumerate(source.segments):
        file = folder / f"segment{number:05d}.bin"
        bodies |= _append(file, {f"segments/{number}.bin": key_bytes(source, number)})
        for frame in frames:
            bodies |= _append(file, {f"frames/{frame}.bin": frame_bytes(source, frame)})
            done += 1
            progress(done)
    return bodies


def _append(file: Path, contents: Mapping[str, bytes]) -> dict[str, tuple[str, int, int]]:
    places = {}
    with file.open("ab") as out:
        for path, content in contents.items():
            packed = zlib.compress(content, 6)
            places[path] = (file.name, out.tell(), len(packed))
            out.write(packed)
    return places


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
    index = read_index(folder)
    video = index["video"]
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
    """Every frame of a folder, as its page rebuilds it."""
    index = read_index(folder)
    for number, segment in enumerate(index["video"]["segments"]):
        count, columns, xyz, attributes, tail = _planes(_body(folder, index, f"segments/{number}.bin"))
        key, dynamic = Codes(xyz, attributes), tail.astype(bool)
        if (count, columns) != (segment["rows"], attributes.shape[1]):
            raise ValueError(f"{folder}: segment {number} does not match its index")
        for frame in range(segment["first"], segment["first"] + segment["frames"]):
            _, _, step, change, _ = _planes(_body(folder, index, f"frames/{frame}.bin"), key=False)
            codes = Codes(key.xyz.copy(), key.attributes.copy())
            codes.xyz[dynamic] += step
            codes.attributes[dynamic] += change
            yield codes


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


def _body(folder: Path, index: Mapping[str, Any], path: str) -> bytes:
    file, offset, size = index["bodies"][path]
    with (folder / file).open("rb") as opened:
        opened.seek(offset)
        try:
            return zlib.decompress(opened.read(size))
        except zlib.error as error:
            raise ValueError(f"{folder / file}: {path} is damaged ({error})") from None


def _planes(body: bytes, *, key: bool = True) -> tuple[int, int, np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns, positions [n, 3], attributes [n, A], and what follows, of a key's body or a frame's."""
    first, second, columns, _ = np.frombuffer(body, "<u4", 4).tolist()
    count = first if key else second
    xyz = np.frombuffer(body, "<u2", 3 * count, 16).reshape(3, count).T.astype(np.uint16)
    attributes = np.frombuffer(body, np.uint8, columns * count, 16 + 6 * count).reshape(columns, count).T
    return count, columns, xyz, attributes.copy(), np.frombuffer(body, np.uint8, -1, 16 + (6 + columns) * count)


def _verify(folder: Path, checks: list[int], progress: Callable[[int], None]) -> None:
    for frame, pair in enumerate(zip(read_video(folder), read_deltas(folder), strict=True)):
        for codes, what in zip(pair, ("video streams", "deltas"), strict=True):
            if checksum(codes) != checks[frame]:
                raise RuntimeError(f"frame {frame} does not read back from the {what} as it was written")
        progress(frame + 1)
