"""Files that mean harm: valid ones with something changed, and the worst that could be thought of.

`python -m tests.support.hostile 5000` tries so many changes of each kind of file; `--worst` is the part of the test
that reads the worst ones under a limit of memory.
"""

from __future__ import annotations

import argparse
import copy
import gzip
import hashlib
import io
import json
import math
import resource
import struct
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from packuv.bounds import MOST_LIGHT
from packuv.camera import PinholeCamera
from packuv.files import load_json
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.interchange import read_gaussians, write_compressed_ply, write_ply
from packuv.interchange.spz import write_spz_3
from packuv.scene import SceneHeader, Sound, open_scene, verify_scene, write_scene
from packuv.scene.header import CHECKSUM, HEADER
from packuv.scene.lookahead import DamageError
from packuv.scene.matroska import Packet, VideoTrack, write_matroska
from packuv.viewer.source import SceneSource, describe
from tests.support.splats import ksplat_bytes, random_gaussians, splat_bytes

SECONDS, EXTRA_BYTES = 2.0, 300 << 20
"""What reading a hostile file may take, time by all processors, since others work on this machine, too"""
DEEP: list[Any] = []
for _ in range(200):
    DEEP = [DEEP]
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3, 7, 255, 256, 20_000, 65_536, 2**31, 2**63, 2**64, -(2**63), 10**18, 10**400, 0.5,
    1e308, -1e308, 1e-308, 1e9, math.nan, math.inf, -math.inf, "", "a", "1/0", "0/1", "-1/1", "1e999999999", "nan",
    "9" * 5000, "\x00", "\x1b[2J", "\ud800", "x" * 100_000, [], {}, [[]], [None], [0] * 3, [math.nan] * 3, [1e308] * 3,
    [0] * 100_000, {"a": {}}, DEEP,
)  # fmt: skip


# Changes


def places(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of everything inside a JSON document."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield (*path, key)
        yield from places(value, (*path, key))


def changed(document: Any, rng: np.random.Generator) -> Any:
    """A copy with one or two of its values replaced, removed or repeated; every depth is as likely as another."""
    result = copy.deepcopy(document)
    for _ in range(rng.integers(1, 3)):
        paths = list(places(result))
        if not paths:
            break
        depth = rng.integers(1, 1 + min(4, max(map(len, paths))))
        paths = [path for path in paths if len(path) == depth] or paths
        *way, last = paths[rng.integers(len(paths))]
        node = result
        for key in way:
            node = node[key]
        if isinstance(node, dict) and rng.random() < 0.1:
            del node[last]
        elif isinstance(node, list) and rng.random() < 0.2:
            node.insert(last, node[last])
        else:
            node[last] = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
    return result


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """A few bytes changed, a piece cut out or doubled, or the end lost."""
    result = bytearray(content)
    place, length = int(rng.integers(len(result))), int(rng.integers(1, 40))
    match rng.integers(5):
        case 0:
            del result[place:]
        case 1:
            del result[place : place + length]
        case 2:
            result[place:place] = result[place : place + length]
        case 3:
            result[place : place + length] = rng.choice([0, 255, 127]).astype(np.uint8).tobytes() * length
        case _:
            for at in rng.integers(len(result), size=length):
                result[at] = rng.integers(256)
    return bytes(result)


# Scenes


def make_scene(path: Path) -> None:
    """A valid scene of two segments, the second of which takes rows from the first."""
    rng, columns, parts = np.random.default_rng(0), attribute_count(0), []
    key = Codes(rng.integers(0, 65536, (40, 3), np.uint16), rng.integers(1, 256, (40, columns), np.uint8))
    with tempfile.TemporaryDirectory() as folder:
        for first in (0, 3):
            moving = np.arange(40) < 12
            xyz = key.xyz[moving] + rng.integers(0, 9, (2, 12, 3), np.uint16)
            attributes = np.repeat(key.attributes[None, moving], 2, axis=0)
            parts.append(Path(folder, f"{first}.npz"))
            Segment(first, key, moving, xyz, attributes).save(parts[-1])
        low, high = np.full(columns, -1.5), np.full(columns, 2.0)
        low[OPACITY], high[OPACITY] = OPACITY_RANGE
        quantizer = Quantizer(np.zeros(3), 1.0, np.full(3, 5.0), low, high)
        camera = PinholeCamera("cam0", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
        times = np.arange(6, dtype=np.int64) * 33_333_333 + 1_700_000_000 * 10**9
        light = rng.normal(0, 0.1, (6, 3))
        header = SceneHeader(
            quantizer, times, Fraction(30), (camera,), ("cam0",), {"worst_ms": 1.5}, {"near": 0.1}, light
        )
        heard = Sound.of("cam0", rng.uniform(-1, 1, (2, 9600)).astype(np.float32))
        write_scene(path, parts, header, sound=heard)


class SceneMaker:
    """Writes the scene again with another header, whose checksum fits."""

    def __init__(self, path: Path) -> None:
        with av.open(str(path)) as container:
            streams = container.streams.video
            attached = {stream.name: stream.data for stream in container.streams.attachments}
            self._packets = [
                Packet(streams.index(packet.stream), packet.pts, packet.duration or 0, bytes(packet))
                for packet in container.demux(*streams)
                if packet.size
            ]
        self.document = json.loads(attached[HEADER])
        self._tracks = [VideoTrack(t["name"], t["width"], t["height"], t["slices"]) for t in self.document["tracks"]]

    def write(self, path: Path, document: Any) -> None:
        self.write_text(path, json.dumps(document, sort_keys=True, separators=(",", ":")).encode())

    def write_text(self, path: Path, text: bytes) -> None:
        checksum = f"{hashlib.sha256(text).hexdigest()}  {HEADER}\n".encode()
        attached = {HEADER: ("application/json", text), CHECKSUM: ("text/plain", checksum)}
        write_matroska(path, self._tracks, self._packets, attached, rate=Fraction(30))

    def with_value(self, path: Path, place: tuple[Any, ...], value: Any) -> None:
        document = copy.deepcopy(self.document)
        node = document
        for key in place[:-1]:
            node = node[key]
        node[place[-1]] = value
        self.write(path, document)


def read_scene(path: Path) -> None:
    """All that commands read of a scene."""
    with open_scene(path, threads=1) as scene:
        source = SceneSource(scene)
        json.dumps(describe(source), allow_nan=False)
        assert all(camera.matrix.shape == (3, 3) for camera in scene.header.cameras)
        assert scene.header.near > 0
        assert np.abs(scene.header.light).max() <= MOST_LIGHT
        for frame in range(min(len(scene), 50)):
            scene.gaussians(frame)
        if heard := scene.sound():
            heard.samples(100, 5000)
    verify_scene(path, threads=1)


# Splats


def webp(size: tuple[int, int]) -> bytes:
    return cv2.imencode(".webp", np.full((*size, 4), 255, np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def sog_files() -> dict[str, Any]:
    """A scene of 8 Gaussians, by file; meta.json as a document."""
    names = ["means_l", "means_u", "scales", "quats", "sh0", "shN_labels"]
    files: dict[str, Any] = {f"{name}.webp": webp((2, 4)) for name in names}
    files["shN_labels.webp"] = cv2.imencode(".webp", np.zeros((2, 4, 4), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])[
        1
    ].tobytes()
    files["shN_centroids.webp"] = webp((1, 192))
    book = np.linspace(-4, 4, 256).tolist()
    files["meta.json"] = {
        "version": 2,
        "count": 8,
        "means": {"mins": [-1.0] * 3, "maxs": [1.0] * 3, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": book, "files": ["sh0.webp"]},
        "shN": {"codebook": book, "bands": 1, "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }
    return files


def sog(files: Mapping[str, Any]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content if isinstance(content, (bytes, str)) else json.dumps(content))
    return out.getvalue()


def splat_files(folder: Path) -> dict[str, bytes]:
    """Small valid files of every kind, by suffix."""
    gaussians = random_gaussians(20, 1)
    found = {".sog": sog(sog_files())}
    for suffix, write in ((".ply", write_ply), (".compressed.ply", write_compressed_ply), (".spz", write_spz_3)):
        write(folder / f"valid{suffix}", gaussians)
        found[suffix] = (folder / f"valid{suffix}").read_bytes()
    found[".splat"], (found[".ksplat"], _) = splat_bytes(gaussians), ksplat_bytes(gaussians, 2)
    return found


def read_camera(path: Path) -> None:
    PinholeCamera.from_json(load_json(path))


READERS: dict[str, Callable[[Path], Any]] = {".mkv": read_scene, ".json": read_camera}


def trouble(path: Path, *, refused: bool = False) -> str:
    """What is wrong with how a file is read; empty where it is read, or refused in one sentence in time.

    With `refused` it must not be read.
    """
    started = time.process_time()
    try:
        READERS.get(path.suffix, read_gaussians)(path)
        if refused:
            return "is read"
    except (ValueError, FileNotFoundError) as error:
        text = str(error)
        if not 20 < len(text) < 1000 or type(error) not in (ValueError, FileNotFoundError, DamageError):
            return f"unclear: {type(error).__name__}: {text[:200]}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:300]
    seconds = time.process_time() - started
    return f"took {seconds:.1f} s" if seconds > SECONDS else ""


# Many


class Fuzz:
    """Changed files of every kind, the same for the same seed."""

    def __init__(self, folder: Path, seed: int) -> None:
        make_scene(folder / "valid.mkv")
        self._folder, self._rng = folder, np.random.default_rng(seed)
        self._maker = SceneMaker(folder / "valid.mkv")
        self._scene = (folder / "valid.mkv").read_bytes()
        self._splats = splat_files(folder)
        self._camera = PinholeCamera("cam0", 64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)).to_json()

    def header(self) -> Path:
        path = self._folder / "header.mkv"
        self._maker.write(path, changed(self._maker.document, self._rng))
        return path

    def container(self) -> Path:
        return self._written("container.mkv", damaged(self._scene, self._rng))

    def splats(self) -> Path:
        suffix = list(self._splats)[self._rng.integers(len(self._splats))]
        content = self._splats[suffix]
        if suffix == ".spz" and self._rng.random() < 0.7:
            content = gzip.compress(damaged(gzip.decompress(content), self._rng), 1)
        elif "ply" in suffix and self._rng.random() < 0.5:
            end = content.index(b"end_header")
            content = damaged(content[:end], self._rng) + content[end:]
        else:
            content = damaged(content, self._rng)
        return self._written(f"splats{suffix}", content)

    def meta(self) -> Path:
        files = sog_files()
        return self._written("meta.sog", sog({**files, "meta.json": changed(files["meta.json"], self._rng)}))

    def camera(self) -> Path:
        return self._written("camera.json", json.dumps(changed(self._camera, self._rng)).encode())

    def _written(self, name: str, content: bytes) -> Path:
        (self._folder / name).write_bytes(content)
        return self._folder / name


KINDS = ("header", "container", "splats", "meta", "camera")


def find_trouble(folder: Path, *, seed: int, count: int) -> list[str]:
    """What went wrong with `count` changes of each kind; the file stays behind under its number."""
    fuzz, found = Fuzz(folder, seed), []
    for number in range(count):
        for kind in KINDS:
            path = getattr(fuzz, kind)()
            problem = trouble(path)
            if problem:
                kept = path.rename(folder / f"bad-{kind}-{number}{''.join(path.suffixes)}")
                found.append(f"{kept}: {problem}")
    return found


# The worst


def write_worst(folder: Path) -> None:
    """One file each for what hung, crashed or ate memory, or might."""
    make_scene(folder / "valid.mkv")
    maker = SceneMaker(folder / "valid.mkv")
    (folder / "valid.mkv").unlink()
    nested = b'{"a":' * 100_000 + b"1" + b"}" * 100_000
    huge = {"cameras": [{**maker.document["cameras"][0], "width": 10**5, "height": 10**4}]}
    values = {
        "rate": (("rate",), "1/0"),
        "rate-exponent": (("rate",), "1e999999999"),
        "degree": (("quantizer", "sh_degree"), 20_000),
        "degree-huge": (("quantizer", "sh_degree"), 1e308),
        "degree-digits": (("quantizer", "sh_degree"), 10**4000),
        "centre": (("quantizer", "centre"), [math.nan] * 3),
        "unit": (("quantizer", "unit"), 1e-320),
        "camera": (("cameras",), huge["cameras"]),
        "cameras": (("cameras",), maker.document["cameras"] * 11_000),
        "blocks": (("tracks", 0, "blocks_across"), 2**40),
        "rows": (("segments", 0, "rows"), 2**60),
        "near": (("extra", "near"), 1e400),
        "up": (("extra", "up"), [0.0, 1e30, 0.0]),
        "times": (("times_ns",), [2**63 - 1 - k for k in range(6)]),
        "light": (("light", 1, 3), 10**400),
        "light-frames": (("light",), [[1] * 300_000] * 3),
        "light-nested": (("light", 2), [[0] * 3] * 6),
        "self-reference": (("segments", 1, "reference"), 1),
        "deep-extra": (("extra", "x"), DEEP),
        "terminal": (("cameras", 0, "name"), "\x1b]0;owned\x07"),
    }
    for name, (place, value) in values.items():
        maker.with_value(folder / f"{name}.mkv", place, value)
    maker.write_text(folder / "nested.mkv", nested)
    maker.write_text(folder / "nested-lists.mkv", b"[" * 3_000_000)
    maker.write_text(folder / "many-values.mkv", b"[" + b"{}," * 3_000_000 + b"0]")
    maker.write_text(folder / "large.mkv", b'{"a":"' + b"x" * (25 << 20) + b'"}')
    maker.write_text(folder / "wide-text.mkv", b'{"a":"' + b"x" * (20 << 20) + "\U0001f600".encode() + b'"}')
    chained = copy.deepcopy(maker.document)
    chained["segments"] = [{**chained["segments"][1], "reference": k - 1 if k else None} for k in range(5000)]
    maker.write(folder / "chain.mkv", chained)
    _write_worst_splats(folder)
    (folder / "nested.json").write_bytes(nested)
    (folder / "camera.json").write_text(json.dumps(huge["cameras"][0]))
    (folder / "not-finite.json").write_text(json.dumps({**maker.document["cameras"][0], "fx": math.nan}))


def _write_worst_splats(folder: Path) -> None:
    valid = splat_files(folder)
    for suffix in valid:
        (folder / f"valid{suffix}").unlink(missing_ok=True)
    ply = valid[".ply"]
    (folder / "count.ply").write_bytes(ply.replace(b"element vertex 20", b"element vertex " + b"9" * 18))
    (folder / "digits.ply").write_bytes(ply.replace(b"element vertex 20", b"element vertex " + b"9" * 5000))
    (folder / "no-columns.ply").write_bytes(
        ply.replace(b"element vertex 20", b"element empty 99999999\nelement vertex 20")
    )
    (folder / "endless.ply").write_bytes(b"ply\n" + b"comment " + b"x" * (4 << 20))
    (folder / "columns.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
        + b"".join(b"property float f_rest_%d\n" % k for k in range(60_000))
        + b"end_header\n"
    )
    for name, count in (("bomb", 2_000_000), ("count", 2**32 - 1)):
        header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0)
        (folder / f"{name}.spz").write_bytes(gzip.compress(header + bytes(40 << 20), 1))
    (folder / "version-4.spz").write_bytes(
        struct.pack("<4sIIBBBB", b"NGSP", 4, 2**26, 0, 12, 0, 5) + struct.pack("<I", 32) + bytes(1000)
    )
    files = sog_files()
    meta = files["meta.json"]
    giant = bytearray(webp((2, 4)))
    giant[21:25] = (16382 | 16382 << 14 | 1 << 28).to_bytes(4, "little")
    assert giant[12:16] == b"VP8L"
    for name, change in {
        "meta-bomb": {"meta.json": b" " * (30 << 20)},
        "nested": {"meta.json": b"[" * 1_000_000},
        "count": {"meta.json": {**meta, "count": 10**9}},
        "many": {"meta.json": {**meta, "count": 2**26}},
        "codebook": {"meta.json": {**meta, "scales": {**meta["scales"], "codebook": [[0.0] * 2000] * 256}}},
        "picture": {"sh0.webp": bytes(giant)},
        "picture-bomb": {"sh0.webp": webp((2000, 2000))},
        "nan": {"meta.json": {**meta, "means": {**meta["means"], "mins": [math.nan] * 3}}},
    }.items():
        (folder / f"{name}.sog").write_bytes(sog({**files, **change}))


def read_worst(folder: Path) -> dict[str, Any]:
    """How many are refused, and trouble by name of file, with this process held to EXTRA_BYTES more than it has."""
    pages = Path("/proc/self/statm").read_text().split()[0]
    limit = int(pages) * resource.getpagesize() + EXTRA_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    found = {path.name: trouble(path, refused=True) for path in sorted(folder.iterdir())}
    wrong = {name: problem for name, problem in found.items() if problem}
    return {"refused": len(found) - len(wrong), "trouble": wrong}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int, nargs="?", default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--worst", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("error")
    if arguments.worst:
        print(json.dumps(read_worst(arguments.folder)))
        return
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="hostile"))
    found = find_trouble(folder, seed=arguments.seed, count=arguments.count)
    print("\n".join(found), f"{len(found)} of {len(KINDS) * arguments.count} went wrong", sep="\n")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
