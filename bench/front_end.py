"""Run time against error of what comes before a fit, one knob at a time, on simulated captures with exact truth.

    packuv bench front_end --out bench/results/front_end.json
    packuv bench front_end --out bench/results/front_end.json --stages flow masks

Writes, after every point, the JSON file, a table beside it as .md and a plot as .svg. A point that the file has with
the same request is not measured again, and a benchmark that was stopped goes on: the same command again. Knobs are
settings as for `packuv run --set`, and beside them the number of instants and the width of the pictures. The captures
are made in --work, once.
"""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from bench import command
from bench.against_truth import CAPTURES, REPEATS, STAGES, Filmed, Made, measure
from packuv.files import whole_file
from packuv.kernels.simd import cpu_description
from pipelines.batch.plan import program_digest
from pipelines.options import SequenceOptions, compose
from pipelines.request import read_settings
from sync.capture import CaptureSettings
from tasks.artefacts.recipe import plain

BASE, INSTANTS, WIDTH = "base", "instants", "width of the pictures"
SMALL = 160
"""Width of pictures that are only there to compile kernels"""
Row = dict[str, Any]


@dataclass(frozen=True)
class Point:
    """A stage with some settings."""

    stage: str
    knob: str
    value: str
    settings: tuple[str, ...] = ()
    """As for `packuv run --set`"""
    instants: int = 1
    """That a rig is solved from"""
    width: int | None = None
    """Of the pictures, pixels; None: as the capture says"""

    @property
    def options(self) -> SequenceOptions:
        return compose("high", CaptureSettings(), read_settings(None, list(self.settings)))


KNOBS: Mapping[str, Mapping[str, Sequence[object]]] = {
    "sync": {
        "sync.clock": ("triggered",),
        "sync.tolerance_ns": (2_000_000, 5_000_000, 33_000_000),
        "sync.mutual": ("false",),
        "sync.reference": ("cam02", "cam05"),
    },
    "solve": {
        INSTANTS: (2, 4),
        WIDTH: (320, 640),
        "rig.solve.features.max_features": (512, 1024),
        "rig.solve.features.contrast": (0.02, 0.04),
        "rig.solve.ratio": (0.7,),
        "rig.solve.min_pair_matches": (15,),
        "rig.solve.min_pair_share": (0.15,),
        "rig.solve.lens": ("PINHOLE", "OPENCV"),
        "rig.solve.shared_lens": ("true",),
        "rig.solve.focal_factor": (0.8,),
    },
    "points": {
        "points.more_instants": ("", "15"),
        WIDTH: (320, 640),
        "points.triangulate.features.max_features": (1024,),
        "points.triangulate.features.contrast": (0.02,),
        "points.triangulate.neighbours": (4,),
        "points.triangulate.ratio": (0.7,),
        "points.triangulate.epipolar_px": (1.0,),
        "points.triangulate.max_error_px": (1.0,),
        "points.triangulate.min_views": (2, 4),
        "points.triangulate.min_angle_deg": (5.0,),
        "points.triangulate.patch_px": (5, 15),
    },
    "colour": {
        "points.balance.huber": (0.02, 0.1, 1.0),
        "points.balance.dark": (0.003, 0.03),
        "points.balance.shading_spread": ("0.1,0.02", "0.3,0.1", "1.0,0.3"),
        "points.balance.common_spread": (0.1,),
        "points.balance.held_out": (2, 10),
        "points.balance.min_improvement": (0.0, 0.1),
        "points.balance.min_observations": (10, 100),
    },
    "flow": {
        "motion.flow_width": (160, 240, 480, 640),
        "motion.preset": ("ultrafast", "fast"),
    },
    "masks": {
        "motion.evidence": ("flow",),
        "motion.width": (320, 480),
        "motion.flow_width": (160, 640),
        "motion.preset": ("ultrafast", "fast"),
        "motion.tau_px": (0.25, 1.0),
        "motion.low_sigmas": (1.5, 3.0),
        "motion.high_sigmas": (4.0, 8.0),
        "motion.noise_floor": (0.35, 1.4),
        "motion.blur_px": (0.7, 1.5),
        "motion.least_area_px": (20, 150),
        "motion.closing_px": (0, 3, 12),
        "motion.hole_share": (0.01, 0.2),
        "motion.dilation_px": (0, 1, 6),
    },
}
"""Values beside the default, by stage and knob"""
PAIRS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "flow": {"fast, 640 wide": ("motion.preset=fast", "motion.flow_width=640")},
    "sync": {"triggered, 5 ms": ("sync.clock=triggered", "sync.tolerance_ns=5000000")},
}
"""Settings that are only of use together, by stage and what they are called"""
NOT_VARIED: Mapping[str, str] = {
    "rig.check": "tells of cameras that look elsewhere; faults are counted in docs/calibration.md",
    "rig.judge": "judges a calibration; misses and false alarms are in docs/calibration.md",
    "rig.trust": "takes a calibration that is refused",
    "rig.repair": "its faults are planted and counted in docs/calibration.md",
    "rig.refine": "off unless lenses are known; what it gains is in docs/calibration.md",
    "rig.refining": "likewise",
    "rig.solve.judge": "accepts a rig or refuses it, and moves nothing",
    "rig.solve.min_registered": "likewise",
    "rig.solve.timeout_seconds": "likewise",
    "rig.solve.seed": "no quality",
    "rig.solve.threads": "of wall clock; CPU seconds stay, and results are no longer repeatable",
    "rig.more_instants": "varied as `instants`: the setting counts only where one instant does not suffice",
    "points.triangulate.judge": "a figure of the report",
    "points.balance.min_correlation": "of cameras held out, whose scores are in docs/scores.md",
    "points.balance.max_angle_deg": "likewise",
    "motion.backend": "the other one needs weights: docs/motion.md",
    "motion.keep_flow": "of what is stored, not of what is measured",
    "pictures": "of the pictures that are fitted: `packuv bench pareto`",
    "light": "its error is in docs/fit.md",
    "content": "`packuv bench content`",
    "patches": "docs/fit.md",
    "keyframes": "no truth says where a segment should begin: `packuv bench ablation`",
}
"""Why, by the start of their names, the other settings of these stages stand still"""
PANELS = (
    ("sync", "wrong_percent", "frames wrong, %"),
    ("sync", "time_ms", "time, ms"),
    ("solve", "centre_percent", "centre, % of radius"),
    ("solve", "rays_px", "lens, px at 640"),
    ("points", "depth_percent", "depth, %"),
    ("points", "light_percent", "light, %"),
    ("colour", "light_percent", "light, %"),
    ("flow", "moving_px", "end point, px"),
    ("masks", "wrong_percent", "1 - F1, %"),
)
"""What the plot shows: a stage, one of its errors, and its name"""


def points(stages: Sequence[str]) -> Iterator[Point]:
    """Of each stage the base, then one knob at a time."""
    for stage in stages:
        yield Point(stage, BASE, BASE)
        for knob, values in KNOBS[stage].items():
            yield from (_point(stage, knob, value) for value in values)
        yield from (Point(stage, name, name, pairs) for name, pairs in PAIRS.get(stage, {}).items())


def _point(stage: str, knob: str, value: Any) -> Point:
    if knob == INSTANTS:
        return Point(stage, knob, str(value), instants=value)
    if knob == WIDTH:
        return Point(stage, knob, str(value), width=value)
    return Point(stage, knob, str(value) or "none", (f"{knob}={value}",))


def request_of(made: Made, point: Point) -> dict[str, Any]:
    """What tells a point from others, whichever folder it is measured in, and the program."""
    asked = {"stage": point.stage, "settings": list(point.settings), "instants": point.instants, "width": point.width}
    return {**asked, "capture": plain(made), "program": program_digest()}


def run(filmed: Filmed, chosen: Sequence[Point], known: Sequence[Row]) -> Iterator[Row]:
    """Every point, as soon as it is there; one with the same request as one of the `known` rows is not measured."""
    rows = {json.dumps(row["request"], sort_keys=True): row for row in known}
    warm = set[str]()
    for point in chosen:
        request = request_of(filmed.made, point)
        name = json.dumps(request, sort_keys=True)
        if name not in rows:
            if point.stage not in {*REPEATS, *warm}:  # the first call compiles kernels, or loads them
                measure(point.stage, filmed, Point(point.stage, BASE, BASE).options, SMALL)
                warm.add(point.stage)
            found = measure(point.stage, filmed, point.options, point.width, point.instants)
            rows[name] = {**found, "request": request}
        labels = {"capture": filmed.made.name, "stage": point.stage, "knob": point.knob, "value": point.value}
        yield {**rows[name], **labels}


def of_base(rows: Sequence[Row], row: Row) -> Row:
    """The row of the default settings that one is compared with."""
    return next(
        other
        for other in rows
        if (other["capture"], other["stage"], other["knob"]) == (row["capture"], row["stage"], BASE)
    )


# The table


def table(rows: Sequence[Row]) -> str:
    """In Markdown: one for each stage, with both captures side by side, and what was not varied."""
    parts = [_stage_table(stage, [row for row in rows if row["stage"] == stage]) for stage in STAGES]
    left = [f"| `{name}` | {why} |" for name, why in NOT_VARIED.items()]
    return "\n\n".join([*filter(None, parts), "\n".join(["Not varied:\n", "| settings | why |", "|---|---|", *left])])


def _stage_table(stage: str, rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    captures = list(dict.fromkeys(row["capture"] for row in rows))
    whole = next((row for row in rows if "refused" not in row), {})
    measures = [name for name in whole if name not in _LABELS]
    heads = [f"{capture}: {name}" for capture in captures for name in ("CPU s", "", *measures)]
    lines = [f"| {stage} | value | {' | '.join(heads)} |", "|---|---|" + "---:|" * len(heads)]
    for knob, value in dict.fromkeys((row["knob"], row["value"]) for row in rows):
        cells = []
        for capture in captures:
            own = [row for row in rows if (row["capture"], row["knob"], row["value"]) == (capture, knob, value)]
            cells += _cells(own[0], of_base(rows, own[0]), measures) if own else [""] * (2 + len(measures))
        lines.append(f"| {knob} | {value} | {' | '.join(cells)} |")
    return "\n".join(lines)


_LABELS = ("cpu_seconds", "request", "capture", "stage", "knob", "value")


def _cells(row: Row, base: Row, measures: Sequence[str]) -> list[str]:
    change = "" if row is base else f"{row['cpu_seconds'] / max(base['cpu_seconds'], 1e-9) - 1:+.0%}"
    figures = ["refused"] * len(measures) if "refused" in row else [f"{row[name]:.3g}" for name in measures]
    return [f"{row['cpu_seconds']:.3g}", change, *figures]


# The plot

PANEL_WIDTH, PANEL_HEIGHT, GAP_X, GAP_Y = 430, 200, 80, 62
LEGEND = 290
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")
WORST = 3.0
"""Errors of more than this many times the default's are drawn at the upper border"""


def plot(rows: Sequence[Row]) -> str:
    """Error against CPU seconds as SVG: a row for each error, a column for each capture, a line a knob."""
    captures = list(dict.fromkeys(row["capture"] for row in rows))
    there = {row["stage"] for row in rows}
    panels = [panel for panel in PANELS if panel[0] in there]
    width, height = len(captures) * (PANEL_WIDTH + GAP_X) + LEGEND, len(panels) * (PANEL_HEIGHT + GAP_Y) + 20
    parts = list[str]()
    for down, (stage, measure_, text) in enumerate(panels):
        top = 30 + down * (PANEL_HEIGHT + GAP_Y)
        knobs = [BASE, *KNOBS[stage], *PAIRS.get(stage, {})]
        for across, capture in enumerate(captures):
            own = [row for row in rows if (row["capture"], row["stage"]) == (capture, stage)]
            left = 60 + across * (PANEL_WIDTH + GAP_X)
            parts += _panel(own, measure_, f"{capture}, {stage}: {text}", knobs, left, top) if own else []
        parts += _legend(knobs[1:], len(captures) * (PANEL_WIDTH + GAP_X) + 20, top)
    look = f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="11"'
    start = f'<svg xmlns="http://www.w3.org/2000/svg" {look}>'
    return f'{start}<rect width="{width}" height="{height}" fill="white"/>{"".join(parts)}</svg>\n'


@dataclass(frozen=True)
class _Axes:
    """CPU seconds, logarithmic, and an error from 0 to places of a panel."""

    left: int
    top: int
    cheap: float
    dear: float
    most: float

    @classmethod
    def of(cls, rows: Sequence[Row], name: str, left: int, top: int) -> _Axes:
        costs = [max(row["cpu_seconds"], 1e-4) for row in rows]
        errors = [row[name] for row in rows if name in row]
        limit = WORST * next((row[name] for row in rows if row["knob"] == BASE and name in row), math.inf)
        most = max((error for error in errors if error <= limit or not limit), default=1.0)
        return cls(left, top, 0.85 * min(costs), 1.15 * max(costs), 1.1 * most or 1.0)

    def place(self, cost: float, error: float) -> tuple[float, float]:
        across = math.log(max(cost, 1e-4) / self.cheap) / math.log(self.dear / self.cheap)
        up = min(error / self.most, 1.0)
        return round(self.left + across * PANEL_WIDTH, 1), round(self.top + (1 - up) * PANEL_HEIGHT, 1)


def _panel(rows: Sequence[Row], name: str, title: str, knobs: Sequence[str], left: int, top: int) -> Iterator[str]:
    """Axes, a line for each knob through the default, and marks; a cross at the upper border is what is refused."""
    axes = _Axes.of(rows, name, left, top)
    yield from _frame(axes, title)
    base = next((row for row in rows if row["knob"] == BASE), None)
    for number, knob in enumerate(knobs[1:]):
        own = [row for row in rows if row["knob"] == knob]
        colour, dashes = _style(number)
        line = sorted((row["cpu_seconds"], row[name]) for row in (*own, *([base] if base else [])) if name in row)
        path = "L".join(f"{x} {y}" for x, y in (axes.place(*pair) for pair in line))
        yield f'<path d="M{path}" fill="none" stroke="{colour}"{dashes} stroke-opacity="0.6"/>' if path else ""
        yield from (_mark(axes, row, name, colour) for row in own)
    if base and name in base:
        x, y = axes.place(base["cpu_seconds"], base[name])
        yield f'<circle cx="{x}" cy="{y}" r="6" fill="none" stroke="black"><title>default</title></circle>'


def _mark(axes: _Axes, row: Row, name: str, colour: str) -> str:
    x, y = axes.place(row["cpu_seconds"], row.get(name, math.inf))
    found = f"{row[name]:.3g}" if name in row else "refused"
    title = f"<title>{escape(row['knob'])} {escape(row['value'])}: {found}, {row['cpu_seconds']:.3g} CPU s</title>"
    if name not in row:
        return f'<path d="M{x - 4} {y - 4}l8 8m-8 0l8 -8" stroke="{colour}" stroke-width="2">{title}</path>'
    if row[name] > axes.most:
        mark = f'<path d="M{x - 5} {y + 4}h10l-5 -9z" fill="{colour}">{title}</path>'
    else:
        mark = f'<circle cx="{x}" cy="{y}" r="3.5" fill="{colour}">{title}</circle>'
    return f'{mark}<text x="{x + 5}" y="{y - 4}" fill="{colour}" font-size="9">{escape(row["value"])}</text>'


def _style(number: int) -> tuple[str, str]:
    return COLOURS[number % len(COLOURS)], "" if number < len(COLOURS) else ' stroke-dasharray="5 3"'


def _legend(knobs: Sequence[str], left: int, top: int) -> Iterator[str]:
    for number, knob in enumerate(knobs):
        colour, dashes = _style(number)
        y = top + 15 * number
        yield f'<path d="M{left} {y}h20" stroke="{colour}"{dashes} stroke-width="2"/>'
        yield f'<text x="{left + 26}" y="{y + 4}" fill="{colour}">{escape(knob)}</text>'


def _frame(axes: _Axes, title: str) -> Iterator[str]:
    left, bottom = axes.left, axes.top + PANEL_HEIGHT
    yield f'<path d="M{left} {axes.top}V{bottom}h{PANEL_WIDTH}" fill="none" stroke="black"/>'
    yield f'<text x="{left}" y="{axes.top - 12}" font-weight="bold">{escape(title)}</text>'
    yield f'<text x="{left + PANEL_WIDTH}" y="{bottom + 30}" text-anchor="end">CPU s</text>'
    for decade in range(math.floor(math.log10(axes.cheap)), math.ceil(math.log10(axes.dear)) + 1):
        for cost in (step * 10.0**decade for step in (1, 2, 3, 5, 7)):
            if axes.cheap <= cost <= axes.dear:
                x, _ = axes.place(cost, 0)
                yield f'<path d="M{x} {bottom}v4" stroke="black"/>'
                yield f'<text x="{x}" y="{bottom + 16}" text-anchor="middle">{cost:g}</text>'
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        error = share * axes.most
        _, y = axes.place(axes.cheap, error)
        yield f'<path d="M{left} {y}h{PANEL_WIDTH}" stroke="black" stroke-opacity="0.08"/>'
        yield f'<text x="{left - 6}" y="{y + 4}" text-anchor="end">{error:.3g}</text>'


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("front_end", __doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write; table and plot go beside it")
    parser.add_argument("--work", type=Path, help="folder of the captures (beside --out)")
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=STAGES, help="all, if not given")
    given = parser.parse_args(arguments)
    known = read_rows(given.out)
    rows: list[Row] = []
    for made in CAPTURES:
        filmed = Filmed.there(made, given.work or given.out.with_suffix(""))
        for row in run(filmed, list(points(given.stages)), known):
            rows.append(row)
            write(given.out, with_earlier(rows, known))
            print(f"{made.name} {row['stage']} {row['knob']} {row['value']}: {row['cpu_seconds']} CPU s", flush=True)
    print(table(with_earlier(rows, known)))


def read_rows(path: Path) -> list[Row]:
    """Of an earlier benchmark; none without the file. Raises ValueError for a file of something else."""
    if not path.exists():
        return []
    found: list[Row] = json.loads(path.read_text()).get("rows", [])
    if any("request" not in row or "stage" not in row for row in found):
        raise ValueError(f"{path} must hold points of packuv bench front_end, but holds something else; name another")
    return found


def with_earlier(rows: Sequence[Row], known: Sequence[Row]) -> list[Row]:
    """What is there now, then what the file had beside it: of other stages, or not yet found again; by one program."""
    named = {_place(row) for row in rows}
    others = [row for row in known if row["request"]["program"] == program_digest() and _place(row) not in named]
    return [*rows, *others]


def _place(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in ("capture", "stage", "knob", "value"))


def write(path: Path, rows: Sequence[Row]) -> None:
    """The file, the table and the plot, each whole or as it was."""
    head = {
        "cpus": len(os.sched_getaffinity(0)),
        "machine": platform.machine(),
        "cpu": cpu_description(),
        "load": round(os.getloadavg()[0], 2),
    }
    texts = {
        path: json.dumps({**head, "rows": rows}, indent=1) + "\n",
        path.with_suffix(".md"): table(rows) + "\n",
        path.with_suffix(".svg"): plot(rows),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    for target, text in texts.items():
        with whole_file(target) as part:
            part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
