"""Size against distortion of one scene: lossless, by tolerance, by learned steps, these with dead zones, with fewer
Gaussians whose codes are moved to make up for the others, and with one attribute coarse alone.

    packuv bench compression --scene scene.mkv --out bench/results/compression_NAME.json --plot compression_NAME.svg

Dead zones are about where a code was in the frame before, or about 0 in bands of view dependence; a scene without
frames after a key has no rows of the one, one of SH degree 0 none of the other. Distortion is that of pictures of the
scene's cameras, the lossless scene being the truth; SSIM and "unseen" are of cameras that were not fitted, from which
no step was learned; cameras are imagined where nobody filmed the scene. Every row is a scene file that was written,
verified and read again.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench import command
from bench.codec import Point, plot
from packuv.compress import usual_iterations
from packuv.compress.brief import brief
from packuv.compress.judge import Judge
from packuv.compress.rows import Rows
from packuv.compress.sensitivity import sensitivity
from packuv.compress.steps import Steps
from packuv.compress.targets import Targets
from packuv.gaussians.codes import OPACITY, REST, Codes, attribute_count
from packuv.gaussians.segment import Segment
from packuv.metrics import decibels, ssim
from packuv.progress import Ticks, no_progress
from packuv.scene import TOLERANCES, EncodeOptions, Quality, Scene, Tolerance, open_scene, write_scene

KINDS = {"position": slice(0, 3), "scale": slice(3, 6), "rotation": slice(6, 9), "opacity": slice(9, 10)}
"""Of the 3 + A kinds of codes; colours are the rest"""
DEAD = 5 / 6
"""Of a step: as far from where it was a code in a dead zone stays there, which rounding lets go half a step away"""
NOUGHT = 128
"""Code of 0 of bands above 0, in learned steps"""
RAW_BITS = 8
"""Of an attribute's code; a coordinate has twice as many"""


class _Table:
    """Files of one scene, measured one after the other."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        self._scene, self._folder, self._judge = scene, folder, Judge(scene).look(scene)
        self.segments = [scene.segment(number) for number in range(len(scene.index.segments))]
        self.codes = sum(len(part.key) * len(part) for part in self.segments)
        self.sensitivity = sensitivity(scene, self._judge.learned, self._judge.frames, near=self._judge.near)

    def row(
        self,
        name: str,
        tolerance: Tolerance,
        steps: Steps | None = None,
        dead: Callable[[Segment], Segment] | None = None,
    ) -> dict[str, Any]:
        """Size and distortion of the scene so written; with `dead` zones in its steps."""
        paths = [self._folder / f"{number}.npz" for number in range(len(self.segments))]
        for path, segment in zip(paths, self.segments, strict=True):
            coarse = steps.segment(segment) if steps else segment
            (dead(coarse) if dead else coarse).save(path)
        return self._measured(name, paths, tolerance, steps)

    def fewer(self, noise: float, steps: Steps) -> dict[str, Any]:
        """The same of the rows that are worth their bits, moved to make up for the others."""
        started = time.perf_counter()
        judge, ticks = self._judge, Ticks(no_progress, 1)
        targets = Targets(judge.views, near=judge.near)
        rows = Rows(self._scene, targets, self._folder, near=judge.near, seed=0, ticks=ticks)
        paths = rows.coarse(noise, steps, usual_iterations(len(self.segments)))
        facts = {"rows": rows.kept / rows.count, "seconds": round(time.perf_counter() - started, 1)}
        return {**self._measured(f"fewer, noise {noise:g}", paths, steps.tolerance, steps), **facts}

    def _measured(self, name: str, paths: list[Path], tolerance: Tolerance, steps: Steps | None) -> dict[str, Any]:
        header = self._scene.header
        header = brief(replace(header, quantizer=steps.quantizer(header.quantizer))) if steps else header
        file = self._folder / "row.mkv"
        written = write_scene(file, paths, header, options=EncodeOptions(tolerance))
        return {
            "name": name,
            "bytes": written.bytes,
            "track_bytes": dict(written.track_bytes),
            "bits_per_gaussian_and_frame": written.bytes * 8 / self.codes,
            **distortion(self._judge, file),
        }


def held(segment: Segment, tolerance: Tolerance) -> Segment:
    """A segment whose codes stay where they are until they are DEAD steps of the tolerance away from there."""
    zones = [DEAD * step for step in tolerance.steps]
    now = [segment.xyz.copy(), segment.attributes.copy()]
    start = segment.key[segment.dynamic]
    before = [start.xyz, start.attributes]
    for places, attributes in zip(*now, strict=True):
        stays = (attributes[:, OPACITY] > 0) == (before[1][:, OPACITY] > 0)  # nobody comes or goes later
        for codes, last, zone in zip((places, attributes), before, zones, strict=True):
            near = stays[:, None] & (np.abs(codes.astype(np.int64) - last) <= zone)
            codes[near] = last[near]
        before = [places, attributes]
    return replace(segment, xyz=now[0], attributes=now[1])


def quiet(segment: Segment) -> Segment:
    """A segment in learned steps whose coefficients of bands above 0 are 0 up to a step beside it."""
    key, moving = segment.key.attributes.copy(), segment.attributes.copy()
    for codes in (key, moving):
        bands = codes[..., REST:]
        bands[np.abs(bands.astype(int) - NOUGHT) <= 1] = NOUGHT
    return replace(segment, key=Codes(segment.key.xyz, key), attributes=moving)


def distortion(judge: Judge, file: Path) -> dict[str, float | None]:
    """Of a scene file's pictures."""
    errors: dict[bool, list[float]] = {False: [], True: []}
    alike = []
    with open_scene(file) as scene:
        for unseen, picture, truth in judge.pairs(scene):
            errors[unseen].append(float(np.square(picture - truth, dtype=np.float64).mean()))
            if unseen:
                alike.append(ssim(picture, truth))
    known = {"psnr_db": errors[False], "psnr_unseen_db": errors[True]}
    levels = {name: _level(values) for name, values in known.items()}
    return {**levels, "ssim_unseen": float(np.mean(alike)) if alike else None}


def _level(errors: Sequence[float]) -> float | None:
    """PSNR, dB; None without pictures, or where all are equal."""
    mean = float(np.mean(errors)) if errors else 0.0
    return decibels(mean) if mean else None


def measure(scene: Scene, folder: Path, *, noises: Sequence[float], coarse_bits: int) -> Iterator[dict[str, Any]]:
    """Rows of the table."""
    table, quantizer = _Table(scene, folder), scene.header.quantizer
    for quality in Quality:
        yield table.row(str(quality), TOLERANCES[quality])
    for noise in noises:
        steps = Steps.of_noise(noise, table.sensitivity, quantizer)
        found = table.row(f"learned, noise {noise:g}", steps.tolerance, steps)
        yield {**found, "position_steps": steps.position.tolist(), "attribute_steps": steps.attribute.tolist()}
    for noise in noises:
        steps = Steps.of_noise(noise, table.sensitivity, quantizer)
        if any(segment.xyz.size for segment in table.segments):
            zone = partial(held, tolerance=steps.tolerance)
            yield table.row(f"dead zone of changes, noise {noise:g}", steps.tolerance, steps, zone)
        if quantizer.sh_degree:
            yield table.row(f"dead zone of bands, noise {noise:g}", steps.tolerance, steps, quiet)
    for noise in noises:
        yield table.fewer(noise, Steps.of_noise(noise, table.sensitivity, quantizer))
    count = attribute_count(quantizer.sh_degree)
    for name, kinds in {**KINDS, "colour": slice(10, 3 + count)}.items():
        wide = np.ones(3 + count)
        wide[kinds] = 2.0 ** (RAW_BITS - coarse_bits)
        fewer = 2 * coarse_bits if name == "position" else coarse_bits
        wide[:3] **= 2
        yield table.row(f"{name} in {fewer} bits", Tolerance(), Steps(wide[:3], wide[3:]))


def table(rows: Sequence[dict[str, Any]], raw_bits: float) -> str:
    """One line a row, as Markdown."""
    lines = [
        "| | MB | bits | to lossless | to raw | PSNR, dB | unseen | SSIM, unseen |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        bits = row["bits_per_gaussian_and_frame"]
        figures = [f"{row['bytes'] / 1e6:.3f}", f"{bits:.2f}", f"{rows[0]['bytes'] / row['bytes']:.2f}"]
        figures += [f"{raw_bits / bits:.1f}"]
        figures += ["exact" if row[name] is None else f"{row[name]:.2f}" for name in ("psnr_db", "psnr_unseen_db")]
        figures += ["" if row["ssim_unseen"] is None else f"{row['ssim_unseen']:.4f}"]
        lines.append(f"| {' | '.join([row['name'], *figures])} |")
    return "\n".join(lines)


def drawn(rows: Sequence[dict[str, Any]]) -> str:
    """The plot: a line through what differs in its noise alone."""
    alone, lines = list[Point](), dict[str, list[Point]]()
    for row in rows:
        way, by_noise, _ = row["name"].partition(", noise ")
        point = row["bytes"] / 1e6, row["psnr_db"], row["name"]
        (lines.setdefault(way, []) if by_noise else alone).append(point)
    return plot(alone, "MB", lines)


def facts_of(scene: Scene, benchmark: str, words: Sequence[str]) -> dict[str, Any]:
    """What was measured, and by which command."""
    entry, degree = scene.index.segments[0], scene.header.quantizer.sh_degree
    return {
        "source": scene.path.name,
        "command": shlex.join(["packuv", "bench", benchmark, *words]),
        "load": os.getloadavg()[0],
        "frames": len(scene),
        "gaussians": entry.rows,
        "dynamic": entry.dynamic,
        "sh_degree": degree,
        "raw_bits": 48 + RAW_BITS * attribute_count(degree),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("compression", __doc__)
    parser.add_argument("--scene", type=Path, required=True, help="a lossless scene file")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument(
        "--noises", type=float, nargs="+", default=[1e-7, 1e-6, 1e-5, 1e-4, 1e-3], help="of learned steps"
    )
    parser.add_argument("--plot", type=Path, help="size against PSNR, SVG to write")
    parser.add_argument("--coarse-bits", type=int, default=6, help="of an attribute that is coarse alone")
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser.parse_args(words)
    with command.lossless(options.scene) as scene, tempfile.TemporaryDirectory() as folder:
        facts, rows = facts_of(scene, "compression", words), list[dict[str, Any]]()
        for row in measure(scene, Path(folder), noises=options.noises, coarse_bits=options.coarse_bits):
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({**facts, "rows": rows}, indent=1) + "\n")
    if options.plot:
        options.plot.write_text(drawn(rows))
    print(table(rows, facts["raw_bits"]))


if __name__ == "__main__":
    main()
