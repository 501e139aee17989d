"""Plots as SVG text, drawn by a few small functions; colours are CSS classes, so that pages can be dark or light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np
from markupsafe import Markup

from calibration.rig import Camera

WIDTH = 960
LEFT, RIGHT, TOP, BOTTOM = 56, 96, 14, 38
"""Margins around a chart's field, px: numbers, names of the series, nothing, the axis"""
MOST_POINTS = 1600
"""Of a line: two for each pixel across, the least and the most that lie there"""
MOST_BARS = 800
MOST_MARKS = 200
"""More vertical lines would be a surface; then there are none"""
LINE_HEIGHT = 14
TICKS = 5


@dataclass(frozen=True)
class Series:
    """A line of a chart; gaps where y is not finite."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    style: str = "s1"
    """CSS class: s1 to s6, strong or muted"""


@dataclass(frozen=True)
class Field:
    """Where data lands in a chart."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    height: int

    def x(self, value: float) -> float:
        return LEFT + (value - self.x_low) / ((self.x_high - self.x_low) or 1) * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        share = (value - self.y_low) / ((self.y_high - self.y_low) or 1)
        return self.height - BOTTOM - share * (self.height - TOP - BOTTOM)


def line_chart(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    marks: Sequence[float] = (),
    from_zero: bool = False,
    height: int = 260,
) -> Markup:
    """Lines over a common axis, named at their ends; `marks` are vertical lines, such as keyframes.

    A long line is drawn by the least and the most of each part of it, which look the same; many marks are left out.
    """
    series = [thinned(item) for item in series]
    field = _field(series, from_zero, height)
    shown = marks if len(marks) <= MOST_MARKS else ()
    parts = [_grid(field, x_label, y_label), *(_mark(field, mark) for mark in shown)]
    parts += [_line(field, item) for item in series]
    parts += _end_labels(field, series)
    return _svg(WIDTH, height, title, parts)


def thinned(series: Series) -> Series:
    """The same line by at most about `MOST_POINTS` points: the least and the most of each stretch of it, and its ends.

    A stretch without a single finite value stays a gap.
    """
    count = len(series.y)
    if count <= MOST_POINTS:
        return series
    y = np.asarray(series.y, np.float64)
    kept = [0, count - 1]
    for part in np.array_split(np.arange(count), MOST_POINTS // 2):
        known = part[np.isfinite(y[part])]
        kept += [known[y[known].argmin()], known[y[known].argmax()]] if len(known) else [part[0]]
    places = np.unique(kept).tolist()
    return replace(series, x=[series.x[place] for place in places], y=[series.y[place] for place in places])


def bar_chart(
    values: Sequence[float], *, title: str, x_label: str, y_label: str, strong: Sequence[int] = (), height: int = 220
) -> Markup:
    """One bar per value, from zero; `strong` ones stand out, such as keyframes. Of many values that lie side by side,
    the largest has a bar, the largest strong one behind it."""
    field = Field(-0.5, len(values) - 0.5, 0, _ceiling(max(values, default=0)), height)
    parts = [_grid(field, x_label, y_label)]
    width = -(-len(values) // MOST_BARS) or 1
    gap = 0.15 if len(values) < 200 else 0
    chosen = set(strong)
    for first in range(0, len(values), width):
        stretch = range(first, min(first + width, len(values)))
        kinds = {style: [index for index in stretch if (index in chosen) == (style == "bar strong")]
                 for style in ("bar strong", "bar")}  # fmt: skip
        for style, places in kinds.items():
            if places:
                most = max(places, key=lambda index: values[index])
                x, right = field.x(stretch[0] - 0.5 + gap), field.x(stretch[-1] + 0.5 - gap)
                parts.append(_bar(field, style, x, right, values[most], f"{most}: {values[most]:.3g}"))
    return _svg(WIDTH, height, title, parts)


def _bar(field: Field, style: str, left: float, right: float, value: float, tip: str) -> str:
    return (
        f'<rect class="{style}" x="{left:.2f}" y="{field.y(value):.2f}" width="{right - left:.2f}" '
        f'height="{field.y(0) - field.y(value):.2f}"><title>{tip}</title></rect>'
    )


def sparkline(counts: Sequence[int], *, title: str, width: int = 104, height: int = 22) -> Markup:
    """A histogram the height of a line; the middle bin boundary is marked."""
    if not counts:
        return Markup()
    step, top = width / len(counts), max(max(counts), 1)
    bars = [
        f'<rect class="bar" x="{index * step:.2f}" y="{height - height * count / top:.2f}" '
        f'width="{max(step - 0.6, 0.6):.2f}" height="{height * count / top:.2f}"/>'
        for index, count in enumerate(counts)
    ]
    middle = f'<line class="grid" x1="{width / 2}" x2="{width / 2}" y1="0" y2="{height}"/>'
    return _svg(width, height, title, [middle, *bars], css="spark")


def gain_chart(names: Sequence[str], gains: np.ndarray, *, title: str) -> Markup:
    """Three dots a camera, r g b, on one axis of factors about 1; gains [C, 3]."""
    height = TOP + BOTTOM + 17 * len(names)
    spread = max(0.02, float(np.abs(np.log(gains)).max()) * 1.1)
    field = Field(-spread, spread, 0, len(names), height)
    ticks = [tick for tick in _ticks(math.exp(-spread), math.exp(spread)) if abs(math.log(tick)) <= spread]
    parts = [_x_tick(field, math.log(tick), f"{tick:g}") for tick in ticks]
    parts.append(f'<line class="axis" x1="{field.x(0):.1f}" x2="{field.x(0):.1f}" y1="{TOP}" y2="{height - BOTTOM}"/>')
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, height - 4, "factor in linear light", "middle"))
    for row, name in enumerate(names):
        y = field.y(len(names) - row - 0.5)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(_text(LEFT - 8, y + 4, name, "end"))
        for channel, style in enumerate(("red", "green", "blue")):
            x = field.x(math.log(gains[row, channel]))
            tip = f"<title>{escape(name)} {style} {gains[row, channel]:.3f}</title>"
            parts.append(f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="4.5">{tip}</circle>')
    return _svg(WIDTH, height, title, parts)


# Cameras from above and from the side


@dataclass(frozen=True)
class Volume:
    """A sphere that the cameras see in common, world."""

    centre: tuple[float, float, float]
    radius: float


def rig_views(
    cameras: Sequence[Camera],
    *,
    held_out: Sequence[str],
    volume: Volume | None,
    unit: str,
    up: Sequence[float] | None = None,
) -> tuple[Markup, Markup]:
    """The rig from above and from the side, at one scale. Up is the mean of the cameras' own, unless `up` is given."""
    axes = np.stack(rig_axes(cameras, up))  # [3, 3]: across, away, up
    spots = np.array([camera.centre for camera in cameras]) @ axes.T
    if volume:
        middle = axes @ volume.centre
        spots = np.concatenate([spots, [middle - volume.radius, middle + volume.radius]])
    low, high = spots.min(axis=0), spots.max(axis=0)
    reach = max(float((high - low).max()) / 2, 1e-9)
    views = [
        RigView(title, axes[[0, k]], ((low + high) / 2)[[0, k]], reach)
        for title, k in (("From above", 1), ("From the side", 2))
    ]
    above, side = (_rig_view(view, cameras, held_out, volume, unit) for view in views)
    return above, side


def rig_model(
    cameras: Sequence[Camera],
    *,
    held_out: Sequence[str],
    volume: Volume | None,
    up: Sequence[float] | None = None,
) -> dict[str, Any]:
    """What page.js turns about: points along across, away and up of `rig_axes`, about their middle, in units of their
    reach. Each camera has its tip and the four corners of its picture."""
    axes = np.stack(rig_axes(cameras, up))
    tips = np.array([camera.centre for camera in cameras]) @ axes.T
    middle = axes @ volume.centre if volume else tips.mean(axis=0)
    reach = max(float(np.linalg.norm(tips - middle, axis=1).max()), volume.radius if volume else 0, 1e-9)
    shown = []
    for camera, tip in zip(cameras, tips, strict=True):
        corners = [(x, y) for x, y in ((0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height))]
        rays = np.array([((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0) for x, y in corners])
        ends = tip + 0.16 * reach * rays @ camera.camera_from_world[:3, :3] @ axes.T
        points = (np.concatenate([tip[None], ends]) - middle) / reach
        shown.append({"name": camera.name, "held": camera.name in held_out, "points": points.round(4).tolist()})
    return {"cameras": shown, "volume": round(volume.radius / reach, 4) if volume else 0}


def rig_axes(
    cameras: Sequence[Camera], known_up: Sequence[float] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors, world: the rig's widest horizontal direction, the one to its left, and up; right-handed."""
    up = -np.sum([camera.camera_from_world[1, :3] for camera in cameras], axis=0)
    up = up if known_up is None else np.asarray(known_up, dtype=np.float64)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, 0.0, 1.0])
    centres = np.array([camera.centre for camera in cameras])
    level = centres - centres.mean(axis=0)
    level -= np.outer(level @ up, up)
    across = np.linalg.svd(level, full_matrices=False)[2][0] if len(cameras) > 1 and level.any() else np.zeros(3)
    if np.linalg.norm(across - (across @ up) * up) < 0.5:  # cameras above one another span nothing level
        across = cameras[0].camera_from_world[0, :3]
    across = across - (across @ up) * up
    across /= np.linalg.norm(across)
    return across, np.cross(up, across), up


@dataclass(frozen=True)
class RigView:
    """A parallel projection of the world."""

    title: str
    axes: np.ndarray
    """float [2, 3]: unit vectors that point right and up in the picture, world"""
    middle: np.ndarray
    """float [2]: what lies in the middle of the picture, along the axes"""
    reach: float
    """Half the side of what must fit in, world"""
    size: int = 470
    """Side of the picture, px"""

    @property
    def scale(self) -> float:
        """Pixels per unit; camera names need the margin."""
        return (self.size / 2 - 52) / self.reach

    def place(self, point: np.ndarray) -> tuple[float, float]:
        """Pixel of a world point."""
        x, y = (self.axes @ point - self.middle) * self.scale
        return self.size / 2 + float(x), self.size / 2 - float(y)


def _rig_view(
    view: RigView, cameras: Sequence[Camera], held_out: Sequence[str], volume: Volume | None, unit: str
) -> Markup:
    parts = [_scale_bar(view, unit)]
    if volume:
        x, y = view.place(np.array(volume.centre))
        parts.append(
            f'<circle class="volume" cx="{x:.1f}" cy="{y:.1f}" r="{volume.radius * view.scale:.1f}">'
            f"<title>common volume, radius {volume.radius:.3g} {unit}</title></circle>"
        )
    parts += [_camera_mark(view, camera, camera.name in held_out) for camera in cameras]
    parts += _camera_names(view, cameras, held_out)
    parts.append(_text(10, 18, view.title, "start", "title"))
    return _svg(view.size, view.size, view.title, parts, css="rig")


def _camera_mark(view: RigView, camera: Camera, is_held_out: bool) -> str:
    """The camera as two wedges, as wide and as high as its picture."""
    tip, rotation, length = camera.centre, camera.camera_from_world[:3, :3], 0.14 * view.reach
    edges = [(0.0, camera.height / 2), (float(camera.width), camera.height / 2)]
    edges += [(camera.width / 2, 0.0), (camera.width / 2, float(camera.height))]
    rays = [np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0]) for x, y in edges]
    ends = [view.place(tip + rotation.T @ (ray * length)) for ray in rays]
    x, y = view.place(tip)
    style = "camera held" if is_held_out else "camera"
    wedges = "".join(
        f'<path class="{style}" d="M{x:.1f} {y:.1f}L{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}Z"/>'
        for a, b in (ends[:2], ends[2:])
    )
    note = ", held out" if is_held_out else ""
    title = f"<title>{escape(camera.name)}{note}: {', '.join(f'{value:.3g}' for value in tip)}</title>"
    return f'<g>{title}{wedges}<circle class="{style} dot" cx="{x:.1f}" cy="{y:.1f}" r="3"/></g>'


def _camera_names(view: RigView, cameras: Sequence[Camera], held_out: Sequence[str]) -> list[str]:
    """Names beside their cameras where there is room, held-out ones first; tooltips name the others."""
    taken: list[tuple[float, float, float]] = []  # left, right, baseline
    labels = []
    for camera in sorted(cameras, key=lambda camera: camera.name not in held_out):
        x, y = view.place(camera.centre)
        width = 6.4 * len(camera.name)
        outward = 1 if x >= view.size / 2 else -1
        for side, drop in ((outward, 4), (outward, -6), (outward, 14), (-outward, 4), (-outward, -6), (-outward, 14)):
            left = x + 6 if side > 0 else x - 6 - width
            if all(left > right or left + width < start or abs(y + drop - base) > 10 for start, right, base in taken):
                taken.append((left, left + width, y + drop))
                style = "name held" if camera.name in held_out else "name"
                labels.append(_text(x + 6 * side, y + drop, camera.name, "start" if side > 0 else "end", style))
                break
    return labels


def _scale_bar(view: RigView, unit: str) -> str:
    length = _ceiling(view.reach / 3)
    x, y = 12, view.size - 14
    text = _text(x, y - 7, f"{length:g} {unit}", "start")
    return f'<path class="axis" d="M{x} {y - 4}v4h{length * view.scale:.1f}v-4"/>{text}'


# Parts


def _svg(width: float, height: float, title: str, parts: Sequence[str], css: str = "chart") -> Markup:
    """Markup that templates take as it is: every name within was escaped where its text was made."""
    return Markup(
        f'<svg class="{css}" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg>"
    )


def _text(x: float, y: float, text: str, anchor: str, css: str = "") -> str:
    kind = f' class="{css}"' if css else ""
    return f'<text{kind} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _field(series: Sequence[Series], from_zero: bool, height: int) -> Field:
    xs = [x for item in series for x in item.x]
    ys = [y for item in series for y in item.y if math.isfinite(y)] or [0.0]
    low, high = min(ys), max(ys)
    if from_zero:
        low = min(low, 0.0)
    margin = (high - low) * 0.06 or abs(high) * 0.05 or 1.0
    return Field(
        min(xs, default=0), max(xs, default=1), 0.0 if from_zero and low == 0 else low - margin, high + margin, height
    )


def _grid(field: Field, x_label: str, y_label: str) -> str:
    parts = [_y_tick(field, tick) for tick in _ticks(field.y_low, field.y_high)]
    parts += [_x_tick(field, tick, f"{tick:g}") for tick in _ticks(field.x_low, field.x_high) if tick == int(tick)]
    bottom = field.y(field.y_low)
    parts.append(f'<line class="axis" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{bottom:.1f}" y2="{bottom:.1f}"/>')
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, field.height - 4, x_label, "middle"))
    parts.append(
        f'<text x="14" y="{(TOP + bottom) / 2:.1f}" text-anchor="middle" '
        f'transform="rotate(-90 14 {(TOP + bottom) / 2:.1f})">{escape(y_label)}</text>'
    )
    return "".join(parts)


def _x_tick(field: Field, value: float, text: str) -> str:
    x, bottom = field.x(value), field.height - BOTTOM
    line = f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{bottom}" y2="{bottom + 4}"/>'
    return line + _text(x, bottom + 17, text, "middle")


def _y_tick(field: Field, value: float) -> str:
    y = field.y(value)
    line = f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
    return line + _text(LEFT - 8, y + 4, f"{value:g}", "end")


def _mark(field: Field, value: float) -> str:
    x = field.x(value)
    return (
        f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{field.height - BOTTOM}">'
        f"<title>keyframe {value:g}</title></line>"
    )


def _line(field: Field, series: Series) -> str:
    pieces, pen = [], "M"
    for x, y in zip(series.x, series.y, strict=True):
        if not math.isfinite(y):
            pen = "M"
            continue
        pieces.append(f"{pen}{field.x(x):.1f} {field.y(y):.1f}")
        pen = "L"
    if len(pieces) == 1:  # a line of one point would not show
        pieces.append("h3")
    return f'<path class="line {series.style}" d="{"".join(pieces)}"><title>{escape(series.name)}</title></path>'


def _end_labels(field: Field, series: Sequence[Series]) -> list[str]:
    """Names beside the last points, pushed apart where they would overlap."""
    ends = []
    for item in series:
        points = [y for y in item.y if math.isfinite(y)]
        if item.name and points:
            ends.append((field.y(points[-1]) + 4, item))
    labels, lowest = [], -math.inf
    for y, item in sorted(ends, key=lambda end: end[0]):
        lowest = max(y, lowest + LINE_HEIGHT)
        labels.append((lowest, item))
    overflow = max(0.0, lowest - (field.height - BOTTOM + 4)) if labels else 0.0
    return [_text(WIDTH - RIGHT + 8, y - overflow, item.name, "start", f"label {item.style}") for y, item in labels]


def _ticks(low: float, high: float) -> list[float]:
    """About `TICKS` round numbers within the range."""
    step = _ceiling((high - low) / TICKS) if high > low else 1.0
    first = math.ceil(low / step - 1e-9)
    count = math.floor(high / step + 1e-9) - first + 1
    digits = max(0, 1 - math.floor(math.log10(step)))
    return [round((first + index) * step, digits) + 0.0 for index in range(max(0, count))]


def _ceiling(value: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is not below a positive value; 1 for as good as nothing."""
    if value < 1e-300:  # powers of ten end before denormal numbers do
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * (1 - 1e-9)))
