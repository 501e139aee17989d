"""Optical flow and motion masks: run time against error on a filmed synthetic clip with exact truth.

    python -m bench.motion [--out motion.json] [--frames 12] [--size 640x360] [--crf 18 23 28]
        [--raft WEIGHTS ...] [--codec CAPTURE] [--lifted SIMULATED]

Two jointed figures and a ball move before a sparsely textured wall and floor. The clip gets sensor noise and goes
through H.264, as a capture would; truth comes from the exact transforms of the parts. Error of flow is the endpoint
error in pixels of the full picture, where things move and where nothing does. Masks are scored against every pixel
that a moving part covers before or after the step: recall, and false share of the wall beyond a margin.

What a forward-backward check would reject is scored on the same clip, and with --lifted on motion that is lifted into
the world from the cameras of a simulated capture. --codec holds the codec's motion vectors of a capture against DIS
(`bench/vectors.py`).
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from bench import command
from bench.consistency import gap_px, lifted_rows
from bench.vectors import vector_rows
from packuv.motion.raft import Raft, steady
from packuv.motion.step import DisPreset, MotionOptions, grown, measure_step, optical_flow

Row = Mapping[str, Any]
"""Of a table, by column"""


@dataclass(frozen=True)
class Part:
    """An ellipse of cloth, skin or rubber that moves rigidly in the picture plane."""

    radii: tuple[float, float]
    """Half axes, pixels at 640 wide"""
    colour: tuple[int, int, int]
    contrast: float
    """Standard deviation of its texture, grey values"""
    pose: Callable[[float], tuple[float, float, float]]
    """Frame -> x, y (pixels at 640 wide) and angle (radians)"""
    seed: int


def figure(x: float, y: float, *, speed: float, swing: float, phase: float, seed: int) -> list[Part]:
    """Legs, torso, arms and head of someone who walks with `speed` pixels a frame."""

    def at(
        dx: float, dy: float, *, reach: float = 0.0, swings: float = 0.0
    ) -> Callable[[float], tuple[float, float, float]]:
        def pose(t: float) -> tuple[float, float, float]:
            angle = swings * swing * np.sin(0.35 * t + phase)
            return x + speed * t + dx - reach * np.sin(angle), y + dy + reach * np.cos(angle), angle

        return pose

    skin, shirt, trousers = (205, 160, 130), (150, 155, 160), (45, 45, 52)
    return [
        Part((8, 42), trousers, 3, at(-6, 42, reach=38, swings=1), seed + 1),
        Part((8, 42), trousers, 3, at(6, 42, reach=38, swings=-1), seed + 2),
        Part((20, 45), shirt, 14, at(0, 10), seed + 3),
        Part((6, 34), skin, 6, at(-20, -20, reach=28, swings=-1.4), seed + 4),
        Part((6, 34), skin, 6, at(20, -20, reach=28, swings=1.4), seed + 5),
        Part((12, 15), skin, 12, at(0, -48), seed + 6),
    ]


def scene() -> list[Part]:
    """All parts, from back to front."""
    ball = Part((13, 13), (190, 60, 40), 25, lambda t: (180 + 11 * t, 120 + 0.6 * (t - 6) ** 2, 0.5 * t), 90)
    left = figure(120, 190, speed=2.0, swing=0.5, phase=0.0, seed=10)
    right = figure(500, 200, speed=-0.7, swing=0.25, phase=1.0, seed=30)
    return [*left, *right, ball]


def texture(seed: int, contrast: float) -> np.ndarray:
    """float32 [256, 256]: grey offsets at several scales."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(size=(n, n)).astype(np.float32), (256, 256), interpolation=cv2.INTER_CUBIC)
        for n in (16, 48, 128)
    ]
    total: np.ndarray = layers[0] + layers[1] + layers[2]
    scaled: np.ndarray = contrast * total / total.std()
    return scaled


def wall(width: int, height: int) -> np.ndarray:
    """float32 [H, W, 3]: pale smooth panels with thin seams and dots above, a grainy floor below."""
    y, x = np.mgrid[0:height, 0:width] / (width / 640)
    grey = 185 + 25 * np.sin(x / 190) * np.cos(y / 140)
    grey -= 45 * (np.abs((x + 0.4 * y) % 120 - 60) > 59.2) + 45 * (np.abs((y - 0.3 * x) % 110 - 55) > 54.2)
    grey -= 90 * (((x + 31) % 73 - 36) ** 2 + ((y + 17) % 67 - 33) ** 2 < 5)
    floor = 110 + cv2.resize(texture(7, 5), (width, height))
    grey = np.where(y > 250 + 10 * np.sin(x / 200), floor, grey)
    return np.repeat(grey[:, :, None], 3, axis=2).astype(np.float32)


def transform(part: Part, t: float, scale: float) -> np.ndarray:
    """Picture from part, float64 [3, 3]. Everything speeds up and slows down together, from 0.3 to 1.7 of its pace."""
    x, y, angle = part.pose(t + np.sin(0.8 * t) * 0.7 / 0.8)
    c, s = np.cos(angle) * scale, np.sin(angle) * scale
    return np.array([[c, -s, x * scale], [s, c, y * scale], [0, 0, 1]])


def draw(parts: list[Part], t: float, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Picture float32 [H, W, 3] and the number of the front part, int [H, W], -1 for the wall."""
    picture, owner = wall(width, height), np.full((height, width), -1)
    grid = np.stack([*np.mgrid[0:height, 0:width][::-1] + 0.5, np.ones((height, width))], axis=-1)
    for number, part in enumerate(parts):
        local = grid @ np.linalg.inv(transform(part, t, width / 640)).T
        u, v = local[..., 0].astype(np.float32), local[..., 1].astype(np.float32)
        inside = (u / part.radii[0]) ** 2 + (v / part.radii[1]) ** 2 < 1
        grain = cv2.remap(texture(part.seed, part.contrast), 2 * u + 128, 2 * v + 128, cv2.INTER_LINEAR)
        shade = 1 - 0.25 * (u / part.radii[0]) ** 2
        picture[inside] = (np.array(part.colour) * shade[..., None] + grain[..., None])[inside]
        owner[inside] = number
    return picture, owner


def film(
    parts: list[Part], frames: int, width: int, height: int, crf: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Pictures as a decoder gives them, uint8 [H, W, 3], and their owners [H, W]."""
    rng, owners = np.random.default_rng(3), []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": str(crf), "threads": "1", "g": "30"}
            for t in range(frames):
                picture, owner = draw(parts, t, 2 * width, 2 * height)
                picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
                owners.append(owner[::2, ::2])
                pixels = np.clip(picture + rng.normal(scale=1.5, size=picture.shape), 0, 255).astype(np.uint8)
                frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                frame.pts, frame.time_base = t, Fraction(1, 30)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        with av.open(str(path)) as container:
            return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], owners


def true_flow(parts: list[Part], owner: np.ndarray, t: float) -> np.ndarray:
    """Motion of each pixel of frame t - 1 to frame t, float64 [H, W, 2]."""
    height, width = owner.shape
    grid = np.stack([*np.mgrid[0:height, 0:width][::-1] + 0.5, np.ones((height, width))], axis=-1)
    flow = np.zeros((height, width, 2))
    for number, part in enumerate(parts):
        step = transform(part, t, width / 640) @ np.linalg.inv(transform(part, t - 1, width / 640))
        mine = owner == number
        flow[mine] = (grid[mine] @ step.T - grid[mine])[:, :2]
    return flow


def distance(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Endpoint error, float64 [H, W], of a flow of any size."""
    full = cv2.resize(flow, truth.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    error: np.ndarray = np.linalg.norm(full - truth, axis=2)
    return error


@dataclass(frozen=True)
class Pair:
    """One step of the clip and what is true of it."""

    before: np.ndarray
    """uint8 [H, W], grey"""
    after: np.ndarray
    flow: np.ndarray
    """float64 [H, W, 2]"""
    was: np.ndarray
    """bool [H, W]: covered by a moving part before the step"""
    moved: np.ndarray
    """bool [H, W]: covered before or after"""
    hidden: np.ndarray
    """bool [H, W]: of `was`, where something else covers the place that it moves to, or the picture ends"""
    far: np.ndarray
    """bool [H, W]: more than 8 px (at 640 wide) from anything that moves"""


def pairs(frames: int, width: int, height: int, crf: int) -> list[Pair]:
    parts = scene()
    pictures, owners = film(parts, frames, width, height, crf)
    greys = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    result = []
    for t in range(1, frames):
        was, moved = owners[t - 1] >= 0, (owners[t - 1] >= 0) | (owners[t] >= 0)
        far = ~grown(moved, width, height, 8 * width // 640)
        flow = true_flow(parts, owners[t - 1], t)
        hidden = was & covered(owners[t - 1], owners[t], flow)
        result.append(Pair(greys[t - 1], greys[t], flow, was, moved, hidden, far))
    return result


def covered(owner: np.ndarray, later: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Where another part, or none, is at the place that each pixel moves to, bool [H, W]."""
    height, width = owner.shape
    grid = np.stack([*np.mgrid[0:height, 0:width]], axis=-1)
    place = np.rint(grid + flow[..., ::-1]).astype(int)
    inside = ((place >= 0) & (place < [height, width])).all(axis=2)
    y, x = np.clip(place, 0, [height - 1, width - 1]).transpose(2, 0, 1)
    found: np.ndarray = ~inside | (later[y, x] != owner)
    return found


def timed(clip: list[Pair], measure: Callable[[Pair], object]) -> float:
    """CPU milliseconds a pair, the least of three runs: other work on the machine only adds."""
    times = []
    for _ in range(3):
        start = time.process_time()
        for pair in clip:
            measure(pair)
        times.append(time.process_time() - start)
    return 1e3 * min(times) / len(clip)


def optical_flow_of(pair: Pair, options: MotionOptions) -> np.ndarray:
    return optical_flow(pair.before, pair.after, options)


def flow_rows(clip: list[Pair]) -> Iterator[Row]:
    """Time and endpoint error by flow width and DIS preset."""
    for width in (160, 240, 320, 480, 640):
        for preset in DisPreset:
            options = MotionOptions(width=max(width, 640), flow_width=width, preset=preset)
            flows = [optical_flow_of(pair, options) for pair in clip]
            errors = [distance(flow, pair.flow) for flow, pair in zip(flows, clip, strict=True)]
            truth = [np.linalg.norm(pair.flow, axis=2).mean() for pair in clip]
            magnitude = [measure_step(pair.before, pair.after, options).magnitude for pair in clip]
            yield {
                "flow_width": width,
                "preset": preset.value,
                "ms": timed(clip, partial(optical_flow_of, options=options)),
                "moving_px": float(np.mean([e[p.was].mean() for e, p in zip(errors, clip, strict=True)])),
                "still_px": float(np.mean([e[p.far].mean() for e, p in zip(errors, clip, strict=True)])),
                "magnitude_correlation": float(np.corrcoef(truth, magnitude)[0, 1]),
            }


def raft_rows(clip: list[Pair], weights: Sequence[Path]) -> Iterator[Row]:
    """Time and endpoint error by weights, flow width and updates."""
    for path in weights:
        for width, updates in ((320, 4), (320, 12), (640, 12)):
            raft, options = Raft(path, updates=updates), MotionOptions(flow_width=width)
            flows, times = [], []
            with steady():
                for pair in clip:
                    start = time.process_time()
                    flows.append(optical_flow(pair.before, pair.after, options, raft))
                    times.append(time.process_time() - start)
            errors = [distance(flow, pair.flow) for flow, pair in zip(flows, clip, strict=True)]
            yield {
                "weights": path.name,
                "flow_width": width,
                "updates": updates,
                "ms": 1e3 * min(times),
                "moving_px": float(np.mean([e[p.was].mean() for e, p in zip(errors, clip, strict=True)])),
                "still_px": float(np.mean([e[p.far].mean() for e, p in zip(errors, clip, strict=True)])),
            }


def check_rows(clip: list[Pair]) -> Iterator[Row]:
    """What a forward-backward check keeps and rejects of what moves, by the gap that it tolerates."""
    options = MotionOptions()
    ways = [(optical_flow(p.before, p.after, options), optical_flow(p.after, p.before, options)) for p in clip]
    size = clip[0].before.shape
    gaps = np.stack([gap_px(there, back, size) for there, back in ways])
    errors = np.stack([distance(there, pair.flow) for (there, _), pair in zip(ways, clip, strict=True)])
    was, hidden = (np.stack([getattr(pair, name) for pair in clip]) for name in ("was", "hidden"))
    for tolerance_px in (0.5, 1.0, 2.0):
        kept = gaps <= tolerance_px
        yield {
            "tolerance_px": tolerance_px,
            "rejected": float((~kept)[was].mean()),
            "hidden_rejected": float((~kept)[hidden].mean()),
            "moving_px": float(errors[was].mean()),
            "moving_seen_px": float(errors[was & ~hidden].mean()),
            "moving_hidden_px": float(errors[hidden].mean()),
            "moving_kept_px": float(errors[was & kept].mean()),
        }


def flow_mask(pair: Pair, tau_px: float, options: MotionOptions) -> np.ndarray:
    """The paper's mask before dilation."""
    speed = np.linalg.norm(optical_flow(pair.before, pair.after, options), axis=2)
    fast: np.ndarray = cv2.resize(speed, pair.before.shape[::-1]) > tau_px
    return fast


def both_ways(pair: Pair, tau_px: float, options: MotionOptions) -> np.ndarray:
    """|flow| > tau, forward or backward: where things were and where they are."""
    back = replace(pair, before=pair.after, after=pair.before)
    either: np.ndarray = flow_mask(pair, tau_px, options) | flow_mask(back, tau_px, options)
    return either


def splatted(pair: Pair, tau_px: float, options: MotionOptions) -> np.ndarray:
    """|flow| > tau, and every such pixel carried along its flow."""
    mask = flow_mask(pair, tau_px, options)
    flow = cv2.resize(optical_flow(pair.before, pair.after, options), mask.shape[::-1])
    y, x = np.nonzero(mask)
    target = np.rint(np.stack([y, x]) + flow[y, x].T[::-1]).astype(int)
    target = np.clip(target, 0, np.array(mask.shape)[:, None] - 1)
    mask[target[0], target[1]] = True
    return mask


def flow_near_change(pair: Pair, tau_px: float, options: MotionOptions) -> np.ndarray:
    """|flow| > tau within 6 px of change, and change itself."""
    width, height = pair.before.shape[::-1]
    mask: np.ndarray = grown(measure_step(pair.before, pair.after, options).mask, width, height, 0)
    mask |= flow_mask(pair, tau_px, options) & grown(mask, width, height, 6 * width // 640)
    return mask


def change(pair: Pair, tau_px: float, options: MotionOptions) -> np.ndarray:
    """What `measure_step` gives: change, closed, holes filled where flow says so."""
    mask = measure_step(pair.before, pair.after, replace(options, tau_px=tau_px)).mask
    return grown(mask, pair.before.shape[1], pair.before.shape[0], 0)


def mask_rows(clip: list[Pair]) -> Iterator[Row]:
    """Time, recall and false alarms by kind of mask; all are dilated by 3 px at 640 wide."""
    options, (height, width) = MotionOptions(), clip[0].before.shape
    for method in (flow_mask, both_ways, splatted, flow_near_change, change):
        for tau_px in (0.5, 1.0):
            raw = [method(pair, tau_px, options) for pair in clip]
            masks = [grown(mask, width, height, 3 * width // 640) for mask in raw]
            scored = list(zip(masks, clip, strict=True))
            yield {
                "mask": method.__name__,
                "tau_px": tau_px,
                "ms": timed(clip, partial(method, tau_px=tau_px, options=options)),
                "recall": float(np.mean([mask[pair.moved].mean() for mask, pair in scored])),
                "false_share": float(np.mean([mask[pair.far].mean() for mask, pair in scored])),
                "area_ratio": float(np.mean([mask.sum() / pair.moved.sum() for mask, pair in scored])),
            }


def table(rows: Sequence[Row]) -> str:
    """Rows with equal keys as aligned text."""
    texts = [[f"{v:.3f}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(list(rows[0]), *texts, strict=True)]
    lines = [list(rows[0]), *texts]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("motion", __doc__)
    parser.add_argument("--out", type=Path, help="JSON file; what it holds beside is kept")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--crf", type=int, nargs="*", default=[18, 23, 28], help="none: no clip")
    parser.add_argument("--raft", type=Path, nargs="+", default=[], metavar="WEIGHTS", help="also RAFT with these")
    parser.add_argument("--codec", type=Path, metavar="CAPTURE", help="also motion vectors of this capture's videos")
    parser.add_argument("--lifted", type=Path, metavar="SIMULATED", help="also lifted motion of this simulated capture")
    given = parser.parse_args(arguments)
    width, height = map(int, given.size.split("x"))
    cv2.setNumThreads(1)
    result: dict[str, list[Row]] = json.loads(given.out.read_text()) if given.out and given.out.exists() else {}
    for number, crf in enumerate(given.crf):
        clip = pairs(given.frames, width, height, crf)
        once = {"flow": flow_rows, "forward-backward check": check_rows} if not number else {}
        if given.raft and not number:
            once["raft"] = partial(raft_rows, weights=given.raft)
        for name, rows in {**once, "masks": mask_rows}.items():
            tell(result, f"{name}, {given.size}, crf {crf}", rows(clip))
    if given.codec:
        tell(result, f"codec vectors, {given.codec.name}", vector_rows(given.codec))
    if given.lifted:
        tell(result, f"lifted motion, {given.lifted.name}", lifted_rows(given.lifted))
    if given.out:
        given.out.write_text(json.dumps(result, indent=1) + "\n")


def tell(result: dict[str, list[Row]], name: str, rows: Iterator[Row]) -> None:
    """Keep rows under a name, and print them."""
    result[name] = list(rows)
    print(f"\n{name}\n{table(result[name])}", flush=True)


if __name__ == "__main__":
    main()
