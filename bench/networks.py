"""Size against distortion of encoder-decoder networks, beside those of learned steps.

    packuv bench networks --scene scene.mkv --out bench/results/networks_NAME.json

Rows of the scene's first segment go through encoder-decoders (`packuv.compress.networks`), and their integer latents
into a scene file of their own, as if they were codes: in the order of rows, with the pictures, exact differences and
tolerance that other codes have. It is read again, latents become codes, and pictures are those of the codes. A size is
that of the file, and of what the decoder needs. "key" is the first frame alone, "all" every frame of the segment.
Distortion is that of pictures of the scene's cameras, the lossless scene being the truth; "unseen" are cameras from
which nothing was learned: those that were not fitted, or where there are none, every sixth.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench import command
from bench.compression import distortion, facts_of
from packuv.compress.judge import Judge
from packuv.compress.networks import Examples, Transform, neighbours, train
from packuv.compress.sensitivity import row_sensitivity
from packuv.compress.steps import MIDDLE, Steps
from packuv.gaussians.codes import DC, OPACITY, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.scene import EncodeOptions, Scene, SceneHeader, Tolerance, open_scene, write_scene
from packuv.scene.mosaic import NEUTRAL
from packuv.threads import one_torch_thread

UNSEEN = 6
"""Of so many cameras one is left out where none is held out"""
SHRUNK = 0.1
"""Share of the kind's mean in the weight of a row, which few pictures tell"""
POSITION = slice(0, 3)
LEARNED = "learned steps"
SINGLE = Steps(np.ones(3), np.ones(1))
"""Those of the lossless scene"""


@dataclass(frozen=True)
class Design:
    """Which columns of rows go through one encoder-decoder, and into how many latents; others in learned steps."""

    name: str
    parts: tuple[tuple[tuple[int, ...], int], ...]
    hidden: int = 48
    low_bytes: bool = False
    """Whether positions go through networks below their high bytes, which are exact"""


def designs(columns: int) -> tuple[Design, ...]:
    """Those that are tried, for rows of so many columns."""
    position, covariance, appearance = (0, 1, 2), tuple(range(3, 9)), tuple(range(9, columns))
    three = ((position, 3), (covariance, 3), (appearance, 3))
    most = min(len(appearance), 30)  # as many as fit into the columns of a scene file
    apart = ((covariance, 6), (appearance, most))
    return (
        Design("3 latents each, linear", three, 0, low_bytes=True),
        Design("3 latents each", three, low_bytes=True),
        Design("position in steps, as many latents, linear", apart, 0),
        Design("position in steps, as many latents", apart),
        Design("position in steps, one network", ((covariance + appearance, 6 + most),)),
    )


class _Bench:
    """One scene, of one segment."""

    def __init__(self, scene: Scene, folder: Path, *, iterations: int, seed: int) -> None:
        self._scene, self._folder, self._judge = scene, folder, Judge(scene).look(scene)
        self._iterations, self._seed = iterations, seed
        self._segment = scene.segment(0)
        self._squares = row_sensitivity(
            scene, self._judge.learned, self._judge.frames, near=self._judge.near, seed=seed
        )
        self._around = neighbours(len(self._segment.key))

    def rows(self, noise: float, named: str) -> Iterator[dict[str, Any]]:
        """Of the table, of designs whose name holds `named`."""
        yield self.steps(noise)
        for design in designs(self._squares.shape[1]):
            if named in design.name:
                yield self.network(design, noise)

    def steps(self, noise: float) -> dict[str, Any]:
        """Learned steps alone."""
        steps = self._learned(noise)
        header = replace(self._scene.header, quantizer=steps.quantizer(self._scene.header.quantizer))
        file = self._write(steps.segment(self._segment), header, steps.tolerance)
        return {"name": LEARNED, "noise": noise, **self._size(file, 0), **distortion(self._judge, file)}

    def network(self, design: Design, noise: float) -> dict[str, Any]:
        """Trained, written, read and drawn."""
        started = time.perf_counter()
        steps = self._learned(noise)
        wide = np.sqrt(12 * noise / self._squares.sum(axis=0))
        transforms = self._train(design, wide)
        trained = time.perf_counter() - started
        stored = latent_segment(self._segment, design, wide, transforms)
        if not design.low_bytes:
            coarse = steps.segment(self._segment)
            stored = replace(stored, key=Codes(coarse.key.xyz, stored.key.attributes), xyz=coarse.xyz)
        header = replace(self._scene.header, quantizer=any_quantizer(stored.key.attributes.shape[1]))
        tolerance = replace(steps.tolerance, position=0) if design.low_bytes else steps.tolerance
        file = self._write(stored, header, tolerance)
        size = self._size(file, sum(transform.bytes for transform in transforms))
        with open_scene(file) as scene:
            found = scene.segment(0)
        started = time.perf_counter()
        segment = restored_segment(found, design, steps.position, wide, transforms)
        seconds = (time.perf_counter() - started) / len(segment)
        shown = distortion(self._judge, self._write(segment, self._scene.header, Tolerance()))
        times = {"train_seconds": trained, "decode_seconds_per_frame": seconds}
        return {"name": design.name, "noise": noise, **size, **shown, **times}

    def _learned(self, noise: float) -> Steps:
        return Steps.of_noise(noise, self._squares.sum(axis=0), self._scene.header.quantizer)

    def _train(self, design: Design, wide: np.ndarray) -> list[Transform]:
        mean = self._squares.mean(axis=0)
        weights = SHRUNK + (1 - SHRUNK) * self._squares / np.maximum(mean, 1e-300)
        segment = self._segment
        key = _scaled(design, wide, segment.key.xyz, segment.key.attributes)
        moving = _scaled(design, wide, segment.xyz, segment.attributes)
        rows = Examples(key, weights.astype(np.float32), self._around, moving)
        with one_torch_thread():
            return [
                train(rows.columns(np.array(columns)), latents, hidden=design.hidden, iterations=self._iterations,
                      seed=self._seed)
                for columns, latents in design.parts
            ]  # fmt: skip

    def _write(self, segment: Segment, header: SceneHeader, tolerance: Tolerance) -> Path:
        segment.save(self._folder / "segment.npz")
        write_scene(self._folder / "row.mkv", [self._folder / "segment.npz"], header, options=EncodeOptions(tolerance))
        return self._folder / "row.mkv"

    def _size(self, file: Path, more: int) -> dict[str, Any]:
        size = file.stat().st_size + more
        codes = len(self._segment) * len(self._segment.key)
        return {"bytes": size, "decoder_bytes": more, "bits_per_gaussian_and_frame": size * 8 / codes}


def latent_segment(segment: Segment, design: Design, wide: np.ndarray, transforms: Sequence[Transform]) -> Segment:
    """Latents in the place of attributes, high bytes of positions; who is there keeps its own column."""
    places, columns = _places(sum(latents for _, latents in design.parts))

    def latent(xyz: np.ndarray, attributes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = _scaled(design, wide, xyz, attributes)
        parts = zip(design.parts, transforms, strict=True)
        found = [transform.latents(values[..., list(part)]) for (part, _), transform in parts]
        stored = np.full((*xyz.shape[:-1], columns), NEUTRAL, np.uint8)
        stored[..., places] = np.concatenate(found, axis=-1) + NEUTRAL
        stored[..., OPACITY] = attributes[..., OPACITY] > 0
        return xyz & 0xFF00, stored

    return _mapped(segment, latent)


def restored_segment(
    stored: Segment, design: Design, position: np.ndarray, wide: np.ndarray, transforms: Sequence[Transform]
) -> Segment:
    """Codes of latents, and of positions in these steps unless they go through a network."""
    places, _ = _places(sum(latents for _, latents in design.parts))

    def codes(xyz: np.ndarray, attributes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = np.empty((*xyz.shape[:-1], len(wide)), np.float32)
        values[..., POSITION] = (xyz - MIDDLE) * position + MIDDLE
        first = 0
        for (part, latents), transform in zip(design.parts, transforms, strict=True):
            here = attributes[..., places[first : first + latents]].astype(np.int64) - NEUTRAL
            values[..., list(part)] = transform.values(here) * wide[list(part)]
            first += latents
        if design.low_bytes:
            values[..., POSITION] += xyz
        return _codes(values, attributes)

    return _mapped(stored, codes)


def _mapped(segment: Segment, change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Segment:
    """The segment whose positions [..., 3] and attributes [..., A] are changed."""
    xyz, attributes = change(segment.xyz, segment.attributes)
    return replace(segment, key=Codes(*change(segment.key.xyz, segment.key.attributes)), xyz=xyz, attributes=attributes)


def _codes(values: np.ndarray, attributes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and attributes of values [..., 3 + A]; who is there in `attributes` stays there."""
    rounded = np.rint(values)
    found = SINGLE.limited(rounded[..., POSITION.stop :], attributes[..., OPACITY] > 0)
    return np.clip(rounded[..., POSITION], 0, 65535).astype(np.uint16), found


def _scaled(design: Design, wide: np.ndarray, xyz: np.ndarray, attributes: np.ndarray) -> np.ndarray:
    """Columns float32 [..., 3 + A] in steps so wide."""
    place = xyz & 0xFF if design.low_bytes else xyz
    return np.asarray(np.concatenate([place, attributes], axis=-1) / wide, np.float32)


def _places(count: int) -> tuple[np.ndarray, int]:
    """Columns of attributes for so many latents, and how many columns there are.

    Where the others' differences to green would be stored, green stays constant.
    """
    for degree in range(4):
        columns = np.arange(attribute_count(degree))
        green = (columns >= DC.start) & ((columns - DC.start) % 3 == 1)
        free = columns[(columns != OPACITY) & ~green]
        if len(free) >= count:
            return free[:count], len(columns)
    raise ValueError(f"{count} latents do not fit into a scene file")


def any_quantizer(columns: int) -> Quantizer:
    """Of so many columns of attributes; what it says means nothing."""
    degree = next(degree for degree in range(4) if attribute_count(degree) == columns)
    return Quantizer(np.zeros(3), 1.0, np.ones(3), np.zeros(columns), np.full(columns, 255.0), degree)


def prepared(scene: Scene, folder: Path) -> dict[str, Path]:
    """Scene files of the first frame, and of the first segment."""
    segment, header = scene.segment(0), scene.header
    if not header.held_out:
        header = replace(header, held_out=tuple(camera.name for camera in header.cameras[UNSEEN // 2 :: UNSEEN]))
    still = np.zeros(len(segment.key), bool)
    key = replace(segment, dynamic=still, xyz=segment.xyz[:0, :0], attributes=segment.attributes[:0, :0])
    paths = {"key": folder / "key.mkv"} | ({"all": folder / "all.mkv"} if len(segment) > 1 else {})
    for (_, path), part in zip(paths.items(), (key, segment), strict=False):
        part.save(folder / "prepared.npz")
        write_scene(path, [folder / "prepared.npz"], header.first(len(part)))
    return paths


def smaller(row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> float | None:
    """Share that a row saves of what steps take for the same PSNR of unseen cameras.

    Between and beyond two neighbours of theirs the logarithm of size is taken as linear in dB.
    """
    points = sorted(
        (other["psnr_unseen_db"], np.log(other["bytes"]))
        for other in rows
        if other["name"] == LEARNED and other["frames"] == row["frames"]
    )
    if len(points) < 2 or row["name"] == LEARNED:
        return None
    level = row["psnr_unseen_db"]
    first = min(max(sum(point[0] < level for point in points) - 1, 0), len(points) - 2)
    (low, low_size), (high, high_size) = points[first : first + 2]
    size = float(np.exp(low_size + (level - low) / (high - low) * (high_size - low_size)))
    return 1 - float(row["bytes"]) / size


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line a row, as Markdown."""
    lines = [
        "| frames | noise | | kB | PSNR, dB | unseen | SSIM, unseen | smaller than steps | trained, s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        share = smaller(row, rows)
        figures = [row["frames"], f"{row['noise']:g}", row["name"], f"{row['bytes'] / 1e3:.1f}"]
        figures += [f"{row['psnr_db']:.2f}", f"{row['psnr_unseen_db']:.2f}", f"{row['ssim_unseen']:.4f}"]
        figures += ["" if share is None else f"{share:.1%}"]
        figures += [f"{row['train_seconds']:.0f}" if "train_seconds" in row else ""]
        lines.append(f"| {' | '.join(figures)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("networks", __doc__)
    parser.add_argument("--scene", type=Path, required=True, help="a lossless scene file")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--noises", type=float, nargs="+", default=[1e-6, 3e-6, 1e-5, 1e-4, 1e-3], help="one a rate")
    parser.add_argument("--frames", nargs="+", choices=("key", "all"), default=["key", "all"])
    parser.add_argument("--named", default="", help="only designs whose name holds this")
    parser.add_argument("--iterations", type=int, default=150, help="of each training")
    parser.add_argument("--seed", type=int, default=0)
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser.parse_args(words)
    with command.lossless(options.scene) as scene, tempfile.TemporaryDirectory() as name:
        facts: dict[str, Any] = {**facts_of(scene, "networks", words), "rows": []}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        for row in _rows(prepared(scene, Path(name)), options):
            facts["rows"].append(row)
            options.out.write_text(json.dumps(facts, indent=1) + "\n")
            print(row, file=sys.stderr, flush=True)
    print(table(facts["rows"]))


def _rows(paths: Mapping[str, Path], options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for frames in options.frames:
        if frames in paths:
            with open_scene(paths[frames]) as scene:
                bench = _Bench(scene, paths[frames].parent, iterations=options.iterations, seed=options.seed)
                for noise in options.noises:
                    yield from ({"frames": frames, **row} for row in bench.rows(noise, options.named))


if __name__ == "__main__":
    main()
