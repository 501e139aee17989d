"""Size and speed of the scene file, beside plain FFV1 of the whole atlas.

    python -m bench.codec --out runs/codec.json                      # a made-up sequence
    python -m bench.codec --segments S0.npz S1.npz --quantizer quantizer.json --out runs/codec.json

The made-up sequence puts a moving, turning, bending actor among static surroundings. Its Gaussians are those of a
trained scenes (`splats/*.compressed.ply` under PACKUV_DATA) or, without them, drawn on made-up surfaces; the noise that
a fit leaves in moving Gaussians is imitated by an AR(1) process. Wall time on a shared machine is noisy: compare
rows of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from packuv.interchange import read_ply
from packuv.matroska import Encoder, Track
from packuv.quantize import OPACITY, OPACITY_RANGE, ROTATION, Codes, Gaussians, Quantizer, attribute_values
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.segment import Segment
from packuv.stream import channel_names, key_rows
from packuv.uvmap import UvOptions, assign_slots, atlas_pixels, atlas_size

DATA = Path(os.environ.get("PACKUV_DATA", Path(__file__).parents[1] / "../shared/data"))


@dataclass(frozen=True)
class SequenceOptions:
    """A made-up sequence."""

    frames: int = 30
    """Frames of one segment, its keyframe included"""
    keyframes: int = 1
    """Segments, each of `frames` frames"""
    still: int = 260_000
    """Gaussians of the surroundings before the UV map prunes"""
    restless: int = 23_000
    """Of these, how many do not move but are labelled dynamic, and so get noise"""
    actor: int = 60_000
    """Gaussians of the actor"""
    noise: float = 1.0
    """Strength of the fit's noise; 1: 0.03 in log scale, 0.01 in rotation, 0.1 in logit, 0.02 in colour, 5 % of the
    own size in position, correlated 0.9 from frame to frame"""
    seed: int = 1


# Sources of Gaussians


def trained_gaussians(folder: Path) -> Gaussians:
    """All trained scenes of a folder (compressed PLY, y down), as one cloud with z up."""
    scenes = [read_ply(path) for path in sorted(folder.glob("*.compressed.ply"))]
    up = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0])
    return _turned(_join([_placed(scene, 2.0, np.zeros(3)) for scene in scenes]), up)


def made_up_gaussians(n: int, rng: np.random.Generator) -> Gaussians:
    """Flat Gaussians on a bumpy ball about 2 across, with a texture."""
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bumps = 0.1 * np.sin(7 * direction[:, 0] + 3 * direction[:, 1]) + 0.05 * np.sin(19 * direction[:, 2])
    means = direction * (1 + bumps)[:, None]
    scales = np.log([0.02, 0.015, 0.003]) + rng.normal(0, 0.4, (n, 3))
    quaternions = np.concatenate([np.ones((n, 1)), direction + rng.normal(0, 0.1, (n, 3))], axis=1)
    texture = np.sin(means @ rng.normal(0, 12, (3, 3))) + rng.normal(0, 0.1, (n, 3))
    return Gaussians(means, scales, _unit(quaternions), rng.normal(1.5, 2, n), texture[:, None])


def _unit(quaternions: np.ndarray) -> np.ndarray:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


# The sequence


def _pick(g: Gaussians, rows: np.ndarray) -> Gaussians:
    return Gaussians(g.means[rows], g.log_scales[rows], g.quaternions[rows], g.opacity_logits[rows], g.sh[rows])


def _join(parts: Sequence[Gaussians]) -> Gaussians:
    names = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
    return Gaussians(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _placed(g: Gaussians, height: float, offset: np.ndarray) -> Gaussians:
    """Scaled to a height in metres, its middle put at `offset`."""
    low, high = np.percentile(g.means, [1, 99], axis=0)
    factor = height / (high - low).max()
    return replace(g, means=(g.means - (low + high) / 2) * factor + offset, log_scales=g.log_scales + np.log(factor))


def _turned(g: Gaussians, rotation: np.ndarray) -> Gaussians:
    """Turned about the origin by unit quaternions [4] or [n, 4], w x y z."""
    rotation = np.broadcast_to(rotation, (len(g), 4))
    w, u, v = rotation[:, :1], rotation[:, 1:], g.quaternions[:, 1:]
    across = 2 * np.cross(u, g.means)
    scalar = w * g.quaternions[:, :1] - (u * v).sum(axis=1, keepdims=True)
    vector = w * v + g.quaternions[:, :1] * u + np.cross(u, v)
    means = g.means + w * across + np.cross(u, across)
    return replace(g, means=means, quaternions=np.concatenate([scalar, vector], axis=1))


def _about_z(angle: np.ndarray | float) -> np.ndarray:
    half = np.asarray(angle) / 2
    return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)


def _surroundings(source: Gaussians, count: int, rng: np.random.Generator) -> Gaussians:
    """Twelve different, larger samples of the source, which stand all around at 4 to 7 m."""
    parts = []
    for k in range(12):
        part = _pick(source, rng.permutation(len(source))[: count // 12])
        radius, azimuth = 4 + k % 4, k * np.pi / 6
        place = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), 0])
        parts.append(_placed(_turned(part, _about_z(1.1 * k)), 1.6 * radius, place))
    return _join(parts)


def _posed(actor: Gaussians, seconds: float) -> Gaussians:
    """The actor at a time: it turns, bends with height and wanders, about 25 mm a frame."""
    bend = 0.25 * np.sin(2 * np.pi * seconds * 0.8) * actor.means[:, 2] / 0.9
    turned = _turned(actor, _about_z(0.6 * np.sin(np.pi * seconds) + bend))
    way = [0.5 * np.sin(0.8 * np.pi * seconds), 0.6 * np.sin(seconds), 0.05 * np.sin(4 * np.pi * seconds)]
    return replace(turned, means=turned.means + way)


class _FitNoise:
    """AR(1) noise on every attribute of the dynamic Gaussians."""

    def __init__(self, g: Gaussians, strength: float, rng: np.random.Generator) -> None:
        self._rng, size = rng, np.exp(g.log_scales.mean(axis=1, keepdims=True))
        self._sigma = [strength * s for s in (0.05 * size, 0.03, 0.01, 0.10, 0.02)]
        self._state = [np.zeros_like(a) for a in _arrays(g)]

    def step(self) -> None:
        draws = (sigma * self._rng.standard_normal(s.shape) for s, sigma in zip(self._state, self._sigma, strict=True))
        self._state = [0.9 * s + draw for s, draw in zip(self._state, draws, strict=True)]

    def on(self, g: Gaussians) -> Gaussians:
        noisy = Gaussians(*(a + s for a, s in zip(_arrays(g), self._state, strict=True)))
        return replace(noisy, quaternions=_unit(noisy.quaternions))


def _arrays(g: Gaussians) -> tuple[np.ndarray, ...]:
    return g.means, g.log_scales, g.quaternions, g.opacity_logits, g.sh


def make_sequence(source: Gaussians, options: SequenceOptions) -> tuple[list[Segment], Quantizer]:
    """Segments of one made-up sequence, pruned by the UV map at each key, and their quantizer."""
    rng = np.random.default_rng(options.seed)
    around = _surroundings(source, options.still, rng)
    near = np.argsort(np.abs(np.arctan2(around.means[:, 1], around.means[:, 0]) - 0.5))[: options.restless]
    is_still = np.ones(len(around), bool)
    is_still[near] = False
    actor = _placed(_pick(source, rng.permutation(len(source))[: options.actor]), 1.8, np.zeros(3))
    still, restless = _pick(around, np.flatnonzero(is_still)), _pick(around, near)
    quantizer = _quantizer(_join([still, restless, _posed(actor, 0)]))
    segments = []
    for number in range(options.keyframes):
        first = number * options.frames
        segments.append(_segment(first, still, restless, actor, quantizer, options, rng))
    return segments, quantizer


def _segment(
    first: int,
    still: Gaussians,
    restless: Gaussians,
    actor: Gaussians,
    quantizer: Quantizer,
    options: SequenceOptions,
    rng: np.random.Generator,
) -> Segment:
    key = _join([still, restless, _posed(actor, first / 30)])
    kept = assign_slots(key.means, key.opacity_logits, quantizer.centre, options=UvOptions()).kept
    dynamic = np.arange(len(key)) >= len(still)
    noise = _FitNoise(_pick(key, dynamic), options.noise, rng)
    frames = []
    for frame in range(first + 1, first + options.frames):
        noise.step()
        frames.append(quantizer.encode(noise.on(_join([restless, _posed(actor, frame / 30)])))[kept[dynamic]])
    count = int((dynamic & kept).sum())
    xyz = np.array([f.xyz for f in frames], np.uint16).reshape(-1, count, 3)
    attributes = np.array([f.attributes for f in frames], np.uint8).reshape(len(frames), count, -1)
    return Segment(first, quantizer.encode(key)[kept], dynamic[kept], xyz, attributes)


def _quantizer(key: Gaussians) -> Quantizer:
    """Ranges with margin from the first frame, centre in the actor."""
    values = attribute_values(key)
    low, high = np.percentile(values, [0.02, 99.98], axis=0)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    low[ROTATION], high[ROTATION] = -1, 1
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    return Quantizer(np.zeros(3), 1.0, np.abs(key.means).max(axis=0) * 1.2, low, high, key.sh_degree)


# Measurements


def measure_scene(segments: Sequence[Path], header: SceneHeader, folder: Path, *, threads: int) -> dict[str, Any]:
    """Write, verify and read one scene file."""
    path, frames, clock = folder / "scene.mkv", len(header.times_ns), [time.perf_counter()]
    encoded: list[float] = []

    def note(done: int, total: int) -> None:
        if done == total // 2:
            encoded.append(time.perf_counter())

    summary = write_scene(path, segments, header, threads=threads, progress=note)
    clock.append(time.perf_counter())
    with open_scene(path, threads=threads) as scene:
        rows = [segment.rows for segment in scene.index.segments for _ in range(segment.frames)]
        predictions = [p for segment in scene.index.segments for p in segment.predictions]
        seconds_codes = _seconds(lambda: [scene.codes(frame) for frame in range(frames)])
        seconds_floats = _seconds(lambda: [scene.gaussians(frame) for frame in range(frames)])
        jumps = np.random.default_rng(0).integers(0, frames, 8)
        seconds_random = _seconds(lambda: [scene.codes(int(frame)) for frame in jumps]) / len(jumps)
    return {
        "layout": "compact",
        "bytes": summary.bytes,
        "track_bytes": dict(summary.track_bytes),
        "frames": frames,
        "frames_measured": frames,
        "gaussians_per_frame": float(np.mean(rows)),
        "bits_per_gaussian_and_frame": summary.bytes * 8 / sum(rows),
        "frames_by_prediction": {name: predictions.count(k) for k, name in enumerate(("repeat", "previous", "linear"))},
        "encode_frames_per_second": frames / (encoded[0] - clock[0]),
        "encode_and_verify_frames_per_second": frames / (clock[1] - clock[0]),
        "decode_codes_frames_per_second": frames / seconds_codes,
        "decode_floats_frames_per_second": frames / seconds_floats,
        "random_access_seconds": seconds_random,
    }


def _seconds(work: Any) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def measure_plain_atlas(
    segments: Sequence[Path], quantizer: Quantizer, *, threads: int, frames_measured: int
) -> dict[str, Any]:
    """FFV1 of every plane of the whole 2048 x 1024 atlas in every frame, absolute values, zero-filled (the paper).

    Frames cost nearly the same, so a few are encoded and the rest is extrapolated.
    """
    options = UvOptions()
    height, width = atlas_size(options)
    channels = len(channel_names(quantizer.sh_degree))
    across = int(np.ceil(np.sqrt(channels)))
    down = -(-channels // across)
    encoder = Encoder(Track("atlas", width * across, height * down, across * down), threads=threads)
    total, seconds = 0, 0.0
    sizes: list[int] = []
    rows: list[int] = []
    for path in segments:
        segment = Segment.load(path)
        total += len(segment)
        floats = quantizer.decode(segment.key)
        slots = assign_slots(floats.means, segment.key.attributes[:, OPACITY], quantizer.centre, options=options)
        y, x = atlas_pixels(slots, options=options)[slots.kept].T
        for step in range(min(len(segment), max(0, frames_measured - len(sizes)))):
            picture = np.zeros((down, height, across, width), np.uint8)
            rows_of_frame = _bytes(segment.frame(step))[slots.kept]
            for channel in range(channels):
                picture[channel // across, y, channel % across, x] = rows_of_frame[:, channel]
            start = time.perf_counter()
            sizes.append(len(encoder.encode(picture.reshape(down * height, across * width))))
            seconds += time.perf_counter() - start
            rows.append(int(slots.kept.sum()))
    return {
        "layout": "plain atlas",
        "bytes": round(np.mean(sizes) * total),
        "frames": total,
        "frames_measured": len(sizes),
        "gaussians_per_frame": float(np.mean(rows)),
        "bits_per_gaussian_and_frame": sum(sizes) * 8 / sum(rows),
        "encode_frames_per_second": len(sizes) / seconds,
    }


def _bytes(codes: Codes) -> np.ndarray:
    """Absolute bytes of every channel, uint8 [n, channels]."""
    return np.concatenate([codes.xyz >> 8, codes.xyz & 255, codes.attributes], axis=1).astype(np.uint8)


def key_entropy(segment: Segment) -> dict[str, float]:
    """Order-0 entropy of each channel of the key, bits: what a codec without context would pay."""
    rows, bits = key_rows(segment.key), {}
    for channel, name in enumerate(channel_names(round(((rows.shape[1] - 13) / 3) ** 0.5) - 1)):
        share = np.bincount(rows[:, channel], minlength=256) / len(rows)
        bits[name] = float(-(share[share > 0] * np.log2(share[share > 0])).sum())
    return bits


# Command


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.codec", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--segments", type=Path, nargs="+", help="segment files; without them a sequence is made up")
    parser.add_argument("--quantizer", type=Path, help="JSON of the segments' quantizer")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--plain-frames", type=int, default=2, help="frames of plain atlas FFV1 to measure")
    for name, default in asdict(SequenceOptions()).items():
        parser.add_argument(f"--{name}", type=type(default), default=default, help="of the made-up sequence")
    options = parser.parse_args(arguments)
    if options.segments and not options.quantizer:
        parser.error("--segments needs --quantizer, the JSON that belongs to them")
    with tempfile.TemporaryDirectory() as folder:
        results = run(options, Path(folder))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n")
    print(table(results["rows"]))


def run(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """All measurements of one command line."""
    made_up = SequenceOptions(**{name: getattr(options, name) for name in asdict(SequenceOptions())})
    if options.segments:
        paths, source = options.segments, "segment files"
        quantizer = Quantizer.from_json(json.loads(options.quantizer.read_text()))
    else:
        paths, quantizer, source = _write_made_up(made_up, folder)
    frames = sum(len(Segment.load(path)) for path in paths)
    times = (np.arange(frames) * 10**9 // 30).astype(np.int64)
    header = SceneHeader(quantizer, times, Fraction(30))
    rows = [measure_scene(paths, header, folder, threads=options.threads)]
    if options.plain_frames:
        rows.append(
            measure_plain_atlas(paths, quantizer, threads=options.threads, frames_measured=options.plain_frames)
        )
    first = Segment.load(paths[0])
    return {
        "source": source,
        "sequence": None if options.segments else asdict(made_up),
        "gaussians": len(first.key),
        "dynamic": int(first.dynamic.sum()),
        "rows": rows,
        "key_entropy_bits": key_entropy(first),
    }


def _write_made_up(options: SequenceOptions, folder: Path) -> tuple[list[Path], Quantizer, str]:
    trained = any((DATA / "splats").glob("*.compressed.ply"))
    rng = np.random.default_rng(options.seed)
    source = trained_gaussians(DATA / "splats") if trained else made_up_gaussians(250_000, rng)
    segments, quantizer = make_sequence(source, options)
    paths = [folder / f"segment{number}.npz" for number in range(len(segments))]
    for path, segment in zip(paths, segments, strict=True):
        segment.save(path)
    return paths, quantizer, "trained scenes" if trained else "made-up surfaces"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line a layout."""
    lines = [f"{'layout':12} {'MB/30 frames':>13} {'bits/G/frame':>13} {'encode f/s':>11} {'decode f/s':>11}"]
    for row in rows:
        size = row["bytes"] * 30 / row["frames"] / 1e6
        decode = row.get("decode_floats_frames_per_second", float("nan"))
        lines.append(
            f"{row['layout']:12} {size:13.2f} {row['bits_per_gaussian_and_frame']:13.2f} "
            f"{row['encode_frames_per_second']:11.2f} {decode:11.2f}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
