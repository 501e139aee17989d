"""Run time against error: one knob at a time from a base, and the points of the ladder, PSNR against CPU seconds.

    packuv bench pareto CAPTURE --out runs/pareto.json --frames 0:30 --hold-out cam05,cam14,cam23
    packuv bench pareto CAPTURE --out runs/pareto.json --frames 0:30 --hold-out cam05,cam14,cam23 --knobs iterations uv

Writes, after every point, the JSON file, a table beside it as .md and a plot as .svg. A point that the file has with
the same request is not run again, and a run that was stopped goes on: the same command again. The file says of which
request each point is; remove it after a change of the program. The first run on a machine compiles kernels for a minute
or two, which is in the costs of its stages: have `packuv run` run once before.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import chain
from pathlib import Path
from typing import Any

from bench import command
from bench.point import Base, add_arguments, base_of, head, measure, request_of
from packuv.files import whole_file
from packuv.scene import TOLERANCES, Quality
from pipelines.ladder import LADDER
from pipelines.process import find_sequence
from pipelines.request import PRESETS

Pairs = tuple[str, ...]
"""Settings, as for `packuv run --set`"""
BASE, LADDER_KNOB = "base", "ladder"


@dataclass(frozen=True)
class Point:
    """One run."""

    knob: str
    value: str
    settings: Pairs = ()
    fitted_share: float = 1.0
    """Of the cameras that may be fitted"""


def _one(option: str, *values: object) -> dict[str, Pairs]:
    """Values of a single setting."""
    return {str(value): (f"{option}={value}",) for value in values}


def _pairs(tree: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """Nested settings as on the command line."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _pairs(value, f"{path}{name}.")
        else:
            yield f"{path}{name}={value}"


def _tolerance(quality: Quality) -> Pairs:
    return tuple(_pairs({"encode": {"tolerance": vars(TOLERANCES[quality])}}))


KNOBS: Mapping[str, Mapping[str, Pairs]] = {
    LADDER_KNOB: {name: tuple(_pairs(LADDER[name])) for name in ("sketch", "draft", "medium", "standard")},
    "iterations": _one("fit.iterations", 450, 1800),
    "frame_iterations": _one("fit.frame_iterations", 48),
    "settle": _one("fit.settle", 0.05, 0.02),
    "key_iterations": _one("fit.key_iterations", 200, 800),
    "gaussians": {f"{cap}": (f"fit.density.cap={cap}", f"fit.start.count={cap * 7 // 10}") for cap in (30_000, 90_000)},
    "size": _one("pictures.max_width", 320),
    "tolerance": {str(quality): _tolerance(quality) for quality in (Quality.HIGH, Quality.LOW)},
    "tiles": _one("fit.labels.least_overlap", 0.2, 0.8),
    "cameras": {"half": (), "three quarters": ()},
    "sh_degree": _one("fit.sh_degree", 1),
    # From here on not by default.
    "uv": {str(side): (f"fit.uv.rows={side}", f"fit.uv.columns={side}") for side in (512, 2048)},
    "layers": _one("fit.uv.layers", 4),
    "background": _one("fit.background.instants", 7, 30),
    "start": {
        "volume": ("fit.start.surface_share=0",),
        "surface": ("fit.start.surface_share=1",),
        "no shell": ("fit.shell.enabled=false",),
    },
    "births": _one("fit.key_births", 2500, 10_000),
    "precision": {"floats": ("fit.low_precision=false",)},
    "fine": {name: tuple(_pairs(LADDER[name])) for name in ("fine", "high")},
}
"""Settings by knob and value; the base is a point of every knob"""
SHARES = {"half": 0.5, "three quarters": 0.75}
"""Of the fitted cameras, by value of the knob `cameras`"""
BY_DEFAULT = tuple(KNOBS)[: tuple(KNOBS).index("uv")]


def points(knobs: Sequence[str]) -> Iterator[Point]:
    """The base, then those of each knob."""
    yield Point(BASE, BASE)
    for knob in knobs:
        for value, settings in KNOBS[knob].items():
            yield Point(knob, value, settings, SHARES.get(value, 1.0) if knob == "cameras" else 1.0)


def left_out(base: Base, share: float) -> tuple[str, ...]:
    """Cameras not to fit, so that this share of those that may be is; the kept ones are spread over the rig."""
    held = set(base.scored())
    names = [name for name in find_sequence(base.request()).videos if name not in held]
    count = max(2, round(share * len(names)))
    kept = {names[(2 * place + 1) * len(names) // (2 * count)] for place in range(count)}
    return tuple(name for name in names if name not in kept)


def run(base: Base, chosen: Sequence[Point], known: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Every point, as soon as it is there; one with the same request as one of the `known` rows is not run."""
    rows = {json.dumps(row["request"], sort_keys=True): row for row in known}
    for point in chosen:
        unseen = left_out(base, point.fitted_share)
        request = request_of(base, point.settings, unseen)
        name = json.dumps(request, sort_keys=True)
        if name not in rows:
            rows[name] = {**measure(base, point.settings, unseen)[0], "request": request}
        yield {**rows[name], "knob": point.knob, "value": point.value}


def front(costs: Sequence[float], levels: Sequence[float]) -> list[int]:
    """Indices of the points that no other one beats, from cheap to dear: none costs as little and is as good.

    >>> front([3, 1, 2, 4], [30, 28, 27, 30])
    [1, 0]
    """
    best, found = -math.inf, []
    for index in sorted(range(len(costs)), key=lambda index: (costs[index], -levels[index])):
        if levels[index] > best:
            best = levels[index]
            found.append(index)
    return found


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows in Markdown; differences are to the base."""
    lines = [
        "| knob | value | PSNR, dB | | own gain | SSIM | moving | still | fits, s | all, s | | MB per 30 frames | GB |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    best = {id(rows[index]) for index in front(*_axes(rows))}
    for row in rows:
        change = "" if row["knob"] == BASE else f"{row['psnr_calibrated_db'] - rows[0]['psnr_calibrated_db']:+.2f}"
        cost = "" if row["knob"] == BASE else f"{row['cpu_seconds'] / rows[0]['cpu_seconds'] - 1:+.0%}"
        parts = (row["psnr_own_db"], row["ssim"], row["psnr_moving_db"], row["psnr_still_db"])
        own, ssim, moving, still = ("" if part is None else f"{part:.4g}" for part in parts)
        value = f"**{row['value']}**" if id(row) in best else row["value"]
        lines.append(
            f"| {row['knob']} | {value} | {row['psnr_calibrated_db']:.2f} | {change} | {own} | {ssim} | {moving} | "
            f"{still} | {row['fit_cpu_seconds']:.0f} | {row['cpu_seconds']:.0f} | {cost} | "
            f"{row['mb_per_30_frames']:.2f} | {row['peak_memory_bytes'] / 1e9:.2f} |"
        )
    return "\n".join(
        [*lines, "", "CPU seconds are those of all stages but scoring; bold: nothing is as cheap and as good."]
    )


def _axes(rows: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    return [row["cpu_seconds"] for row in rows], [row["psnr_calibrated_db"] for row in rows]


# The plot

WIDTH, HEIGHT = 1060, 560
LEFT, RIGHT, TOP, BOTTOM = 70, 860, 30, 500
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")


@dataclass(frozen=True)
class _Scale:
    """CPU seconds, logarithmic, and decibels to places of the plot."""

    cheap: float
    dear: float
    low: float
    high: float

    @classmethod
    def of(cls, costs: Sequence[float], levels: Sequence[float]) -> _Scale:
        margin = 0.1 * (max(levels) - min(levels)) + 0.05
        return cls(0.9 * min(costs), 1.1 * max(costs), min(levels) - margin, max(levels) + margin)

    def place(self, cost: float, level: float) -> tuple[float, float]:
        across = math.log(cost / self.cheap) / math.log(self.dear / self.cheap)
        up = (level - self.low) / (self.high - self.low)
        return round(LEFT + across * (RIGHT - LEFT), 1), round(BOTTOM - up * (BOTTOM - TOP), 1)


def plot(rows: Sequence[Mapping[str, Any]]) -> str:
    """PSNR against CPU seconds as SVG: a line a knob, presets as squares, the Pareto front as steps."""
    costs, levels = _axes(rows)
    scale = _Scale.of(costs, levels)
    parts = [_grid(scale), _steps(scale, [(costs[index], levels[index]) for index in front(costs, levels)])]
    knobs = [knob for knob in dict.fromkeys(row["knob"] for row in rows) if knob != BASE]
    for number, knob in enumerate(knobs):
        own = [row for row in rows if row["knob"] == knob]
        parts += _knob(scale, knob, own, rows[0], number)
    x, y = scale.place(costs[0], levels[0])
    parts.append(f'<circle cx="{x}" cy="{y}" r="6" fill="none" stroke="black"><title>base</title></circle>')
    look = f'viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12"'
    start = f'<svg xmlns="http://www.w3.org/2000/svg" {look}>'
    return f'{start}<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{"".join(parts)}</svg>\n'


def _knob(
    scale: _Scale, knob: str, own: Sequence[Mapping[str, Any]], base: Mapping[str, Any], number: int
) -> Iterator[str]:
    """Its line, through the base unless its points are whole settings of their own, marks and legend."""
    colour = COLOURS[number % len(COLOURS)]
    line = own if knob in (LADDER_KNOB, "fine") else [*own, base]
    places = [scale.place(cost, level) for cost, level in sorted(zip(*_axes(line), strict=True))]
    path = "L".join(f"{x} {y}" for x, y in places)
    dashes = "" if number < len(COLOURS) else ' stroke-dasharray="5 3"'
    yield f'<path d="M{path}" fill="none" stroke="{colour}"{dashes}/>'
    for row, cost, level in zip(own, *_axes(own), strict=True):
        x, y = scale.place(cost, level)
        title = f"<title>{escape(knob)} {escape(row['value'])}: {level:.2f} dB, {cost:.0f} CPU s</title>"
        if row["value"] in PRESETS and knob in (LADDER_KNOB, "fine"):
            yield f'<rect x="{x - 5}" y="{y - 5}" width="10" height="10" fill="{colour}">{title}</rect>'
        else:
            yield f'<circle cx="{x}" cy="{y}" r="4" fill="{colour}">{title}</circle>'
        yield f'<text x="{x + 6}" y="{y - 5}" fill="{colour}">{escape(row["value"])}</text>'
    y = TOP + 18 * number
    yield f'<path d="M{RIGHT + 40} {y}h24" stroke="{colour}"{dashes}/>'
    yield f'<text x="{RIGHT + 70}" y="{y + 4}" fill="{colour}">{escape(knob)}</text>'


def _steps(scale: _Scale, best: Sequence[tuple[float, float]]) -> str:
    """The front: at every cost the best level that can be had for it."""
    (x, y), *rest = [scale.place(cost, level) for cost, level in best]
    steps = "".join(f"H{x}V{y}" for x, y in rest)
    return f'<path d="M{x} {y}{steps}H{RIGHT}" fill="none" stroke="black" stroke-width="5" stroke-opacity="0.15"/>'


def _grid(scale: _Scale) -> str:
    parts = [f'<path d="M{LEFT} {TOP}V{BOTTOM}H{RIGHT}" fill="none" stroke="black"/>']
    middle = (LEFT + RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 18}" text-anchor="middle">CPU seconds, without scoring</text>')
    turned = f'x="18" y="{(TOP + BOTTOM) / 2}" transform="rotate(-90 18 {(TOP + BOTTOM) / 2})"'
    parts.append(f'<text {turned} text-anchor="middle">PSNR on unseen cameras, calibrated, dB</text>')
    decades = range(math.floor(math.log10(scale.cheap)), math.ceil(math.log10(scale.dear)) + 1)
    for cost in (step * 10**decade for decade in decades for step in (1, 1.5, 2, 3, 5, 7)):
        if scale.cheap <= cost <= scale.dear:
            x, _ = scale.place(cost, scale.low)
            parts.append(f'<path d="M{x} {BOTTOM}v5" stroke="black"/>')
            parts.append(f'<text x="{x}" y="{BOTTOM + 18}" text-anchor="middle">{cost:g}</text>')
    step = next(step for step in (0.1, 0.2, 0.5, 1, 2, 5, 10) if (scale.high - scale.low) / step <= 10 or step == 10)
    for number in range(math.ceil(scale.low / step), math.floor(scale.high / step) + 1):
        _, y = scale.place(scale.cheap, number * step)
        parts.append(f'<path d="M{LEFT} {y}H{RIGHT}" stroke="black" stroke-opacity="0.08"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{number * step:g}</text>')
    return "".join(parts)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("pareto", __doc__)
    add_arguments(parser)
    parser.add_argument(
        "--knobs",
        nargs="+",
        default=list(BY_DEFAULT),
        choices=[*KNOBS, "all"],
        metavar="KNOB",
        help=f"{', '.join(KNOBS)}, or all; by default those up to {BY_DEFAULT[-1]}, in this order",
    )
    given = parser.parse_args(arguments)
    knobs = list(KNOBS) if "all" in given.knobs else given.knobs
    base = base_of(given)
    known = read_rows(given.out)
    rows: list[dict[str, Any]] = []
    for row in run(base, list(points(knobs)), known):
        rows.append(row)
        write(given.out, base, with_earlier(rows, known))
    print(table(with_earlier(rows, known)))


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Of an earlier run; none without the file. Raises ValueError for a file of something else."""
    if not path.exists():
        return []
    found: list[dict[str, Any]] = json.loads(path.read_text()).get("rows", [])
    if any("request" not in row or "knob" not in row for row in found):
        raise ValueError(f"{path} must hold points of packuv bench pareto, but holds something else; name another file")
    return found


def with_earlier(rows: Sequence[dict[str, Any]], known: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What is there now, then what the file had beside it: of other knobs, or not yet found again."""
    named = {(row["knob"], row["value"]) for row in rows}
    base = rows[0]["request"]
    same = ("capture", "frames", "seed", "preset", "scored", "common", "program")
    others = [row for row in known if all(row["request"].get(name) == base[name] for name in same)]
    return list(chain(rows, (row for row in others if (row["knob"], row["value"]) not in named)))


def write(path: Path, base: Base, rows: Sequence[Mapping[str, Any]]) -> None:
    """The file, the table and the plot, each whole or as it was."""
    texts = {
        path: json.dumps({**head(base), "rows": rows}, indent=1) + "\n",
        path.with_suffix(".md"): table(rows) + "\n",
        path.with_suffix(".svg"): plot(rows),
    }
    for target, text in texts.items():
        with whole_file(target) as part:
            part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
