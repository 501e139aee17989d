"""report.html: one page that needs nothing but itself. Styles, plots and pictures are inline; no request leaves it."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sync.align import CameraReport, SyncReport
from tasks.artefacts.recipe import plain
from tasks.report.facts import SIZE_FRAMES, Comparison, ReportInput, StageOutcome, StageRecord, by_camera, mean_by_frame
from tasks.report.findings import LIMITS, Finding, Limits, findings
from tasks.report.plots import Series, Volume, bar_chart, gain_chart, line_chart, rig_views, sparkline
from tasks.report.record import summary
from tasks.report.style import CSS, SCRIPT

PICTURE_WIDTH = 640
"""Wider pictures are scaled down for the page, px"""
JPEG_QUALITY = 88
DIFFERENCE_GAIN = 4
"""Absolute differences are shown this many times brighter"""
MANY_LINES = 6
"""With more cameras than this, only the worst and the mean are named"""

MOST_FINDINGS = 12
"""More of them are only counted at the top"""

SECTIONS = {
    "sync": "Synchronization",
    "rig": "Camera layout",
    "colour": "Colour balance",
    "motion": "Motion and keyframes",
    "quality": "Quality over time",
    "pictures": "Truth, render, difference",
    "size": "Size over time",
    "gaussians": "Gaussians over time",
    "stages": "Time and memory",
    "skipped": "What was skipped",
    "run": "How this was made",
}
"""Id and heading, in the order of the page"""


def page_text(report: ReportInput, limits: Limits = LIMITS) -> str:
    """The whole page as HTML."""
    found = findings(report, limits)
    bodies = {
        "sync": _sync(report, limits),
        "rig": _rig(report),
        "colour": _colour(report),
        "motion": _motion(report),
        "quality": _quality(report, limits),
        "pictures": _pictures(report),
        "size": _size(report),
        "gaussians": _gaussians(report),
        "stages": _stages(report),
        "skipped": _skipped(report),
        "run": _run(report),
    }
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title in SECTIONS.items())
    sections = "".join(_section(name, bodies[name], found) for name in SECTIONS)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.name)} · PackUV report</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        f'<header><h1>{escape(report.name)}</h1><p class="lead">{_subtitle(report)}</p></header>\n'
        f"{_cards(report)}\n{_findings_list(report, found)}\n<nav>{links}</nav>\n<main>\n{sections}</main>\n"
        f"<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )


# Head


def _subtitle(report: ReportInput) -> str:
    parts = [report.finished, report.host, report.scene.name if report.scene else ""]
    return " · ".join(escape(part) for part in parts if part) or "PackUV report"


def _cards(report: ReportInput) -> str:
    figures = summary(report)
    held, total, scene = len(report.held_out), figures["cameras"], report.scene
    scored = f"{'held-out' if held else 'fitted'} cameras, mean"
    verified = {None: ("not checked", ""), True: ("exact", "good"), False: ("DAMAGED", "bad")}[figures["verified"]]
    peak = figures["peak_memory_bytes"]
    cards = [
        (_number(figures["psnr_db"], "{:.2f} dB"), f"PSNR, {scored}", ""),
        (_number(figures["ssim"], "{:.3f}"), f"SSIM, {scored}", ""),
        (_number(figures["mb_per_30_frames"], "{:.2f} MB"), f"per {SIZE_FRAMES} frames, whole file", ""),
        (duration(figures["seconds"]), f"total time{f', peak {peak / 1e9:.1f} GB' if peak else ''}", ""),
        (_number(figures["frames"], "{}"), f"frames at {float(scene.rate):g} fps" if scene else "frames", ""),
        (_number(total, "{}"), f"cameras, {held} held out", ""),
        (verified[0], "decoded and compared", verified[1]),
    ]
    boxes = "".join(f'<div class="card {css}"><b>{value}</b><span>{label}</span></div>' for value, label, css in cards)
    return f'<section class="cards" id="summary" aria-label="Summary">{boxes}</section>'


def _findings_list(report: ReportInput, found: Sequence[Finding]) -> str:
    if not found:
        measured = report.sync or report.rig or report.scores or report.scene
        return '<p class="fine">No figure crosses its limit.</p>' if measured else _nothing("Nothing was measured yet.")
    items = [f'<li>{escape(item.text)} <a href="#{item.section}">see</a></li>' for item in found[:MOST_FINDINGS]]
    if len(found) > MOST_FINDINGS:
        items.append(f"<li>And {len(found) - MOST_FINDINGS} more, each beside its figure.</li>")
    return f'<h2 id="findings">What needs a look</h2><ul class="findings">{"".join(items)}</ul>'


def _section(name: str, body: str, found: Sequence[Finding]) -> str:
    own = [item for item in found if item.section == name]
    warnings = f'<ul class="findings">{"".join(f"<li>{escape(item.text)}</li>" for item in own)}</ul>' if own else ""
    return f'<section id="{name}"><h2>{SECTIONS[name]}</h2>{warnings}{body}</section>\n'


def _nothing(what: str) -> str:
    return f'<p class="none">{what}</p>'


# Sections


def _sync(report: ReportInput, limits: Limits) -> str:
    sync = report.sync
    if sync is None:
        return _nothing("No synchronization report: the stage did not run.")
    text = (
        f"Each frame of {escape(sync.reference)} is an instant; another camera's frame belongs to it if it is the "
        f"nearest both ways and at most {sync.tolerance_ns / 1e6:.2f} ms away. {sync.complete} of {sync.instants} "
        f"instants have a frame from every camera. Clocks are {escape(str(sync.clock))}; the frame period is "
        f"{sync.period_ns / 1e6:.3f} ms. The histogram shows the residuals from −{sync.tolerance_ns / 1e6:.1f} to "
        f"+{sync.tolerance_ns / 1e6:.1f} ms: it should be one narrow peak in the middle."
    )
    head = (
        "Camera",
        "offset ms",
        "drift ppm",
        "matched",
        "drops",
        "duplicates",
        "reversed",
        "pauses",
        "residual p95 ms",
    )
    rows = [_sync_row(row, sync, limits) for row in sync.cameras]
    return f"<p>{text}</p>" + _table((*head, "residuals"), rows)


def _sync_row(row: CameraReport, sync: SyncReport, limits: Limits) -> str:
    clock = row.clock
    late = row.residual_p95_ns > limits.residual_share * sync.period_ns > 0
    cells = [
        _cell(f"{row.camera}{' (reference)' if row.camera == sync.reference else ''}"),
        _cell(f"{clock.offset_ns / 1e6:+.3f}", tip=f"± {clock.offset_error_ns / 1e6:.3f} ms, {clock.state}"),
        _cell(f"{clock.drift_ppm:+.2f}", tip=f"± {clock.drift_error_ppm:.2f} ppm"),
        _cell(f"{row.matched_share:.1%}", bad=row.matched_share < limits.matched_share, tip=f"{row.matched} instants"),
        _cell(str(row.drops), bad=row.drops > limits.drop_share * max(1, row.lines), tip=f"{row.lines} timecodes"),
        *(_cell(str(count), bad=count > 0) for count in (row.duplicates, row.reversals, row.jumps)),
        _cell(f"{row.residual_p95_ns / 1e6:.2f}", bad=late, tip=f"median {row.residual_median_ns / 1e6:.2f} ms"),
        f"<td>{sparkline(row.histogram, title=f'residuals of {row.camera}')}</td>",
    ]
    return "".join(cells)


def _rig(report: ReportInput) -> str:
    if report.rig is None:
        return _nothing("No calibration: the stage did not run.")
    check, rig = report.check, report.rig
    unit = "m" if rig.metric else "units"
    volume = Volume(check.scene_centre, check.common_radius) if check else None
    above, side = rig_views(rig.cameras, held_out=report.held_out, volume=volume, unit=unit)
    scale = "" if rig.metric else " The scale is arbitrary: the source does not say what a unit is."
    shared = (
        f" The dashed circle is the common volume: {check.common_radius:.3g} {unit} about the point where the axes "
        f"meet, which {check.seen_share:.0%} of the cameras see; they stand {check.rig_radius:.3g} {unit} from it, "
        "by the median."
        if check
        else ""
    )
    text = (
        f"Calibration from {escape(rig.source)}. Wedges are as wide as the pictures; "
        f"orange cameras were held out of the fit.{shared}{scale}"
    )
    return f'<p>{text}</p><div class="pair"><figure>{above}</figure><figure>{side}</figure></div>'


def _colour(report: ReportInput) -> str:
    if report.rig is None:
        return _nothing("No calibration: the stage did not run.")
    gains = np.array([camera.gains for camera in report.rig.cameras])
    if (gains == 1).all():
        return _nothing("All gains are 1: the cameras were not balanced, or did not need it.")
    text = (
        "Factors r g b that bring each camera to the rig's common colour; their geometric mean is 1. They spread from "
        f"{gains.min():.3f} to {gains.max():.3f}. Dots that fall together are exposure, dots apart are white balance."
    )
    chart = gain_chart([camera.name for camera in report.rig.cameras], gains, title="Colour gains")
    return f'<p>{text}</p><div class="wide">{chart}</div>'


def _motion(report: ReportInput) -> str:
    motion = report.motion
    if motion is None:
        return _nothing("No motion was measured: the stage did not run.")
    count = len(motion.magnitude_px)
    lengths = np.diff([*motion.keyframes, count])
    text = (
        "M(t), the smoothed mean optical flow per frame. Dashed lines are keyframes, where a segment starts; "
        f"{len(motion.keyframes)} segments of {lengths.min()} to {lengths.max()} frames."
        if len(lengths)
        else "M(t), the smoothed mean optical flow per frame."
    )
    series = [Series("M(t)", range(count), [float(value) for value in motion.magnitude_px])]
    chart = line_chart(
        series, title="Motion", x_label="frame", y_label="flow, px", marks=motion.keyframes, from_zero=True
    )
    return f'<p>{text}</p><div class="wide">{chart}</div>'


def _quality(report: ReportInput, limits: Limits) -> str:
    if not report.scores:
        return _nothing("No picture was scored: the stage did not run, or the capture has no picture to compare with.")
    cameras = by_camera(report.scores)
    level = {name: float(np.mean([score.level_db for score in own])) for name, own in cameras.items()}
    worst = min(level, key=lambda name: level[name])
    few = len(cameras) <= MANY_LINES
    series = []
    for number, (name, own) in enumerate(cameras.items()):
        style = f"s{number + 1}" if few else "s2" if name == worst else "muted"
        shown = name if few or name == worst else ""
        series.append(Series(shown, [score.frame for score in own], [score.level_db for score in own], style))
    mean = mean_by_frame(report.scores)
    if len(cameras) > 1:
        series.append(Series("mean", list(mean), list(mean.values()), "strong"))
    who = "cameras that the fit never saw" if report.held_out else "fitted cameras, for none was held out"
    text = (
        f"Peak signal-to-noise ratio of renders against pictures of {who}; higher is better, 6 dB is half the error. "
        "A fall after each keyframe is error that accumulates within the segment."
    )
    marks = report.motion.keyframes if report.motion else ()
    chart = line_chart(series, title="PSNR over time", x_label="frame", y_label="PSNR, dB", marks=marks, height=300)
    return f'<p>{text}</p><div class="wide">{chart}</div>' + _score_table(cameras, level, limits)


def _score_table(cameras: Mapping[str, Sequence[Any]], level: Mapping[str, float], limits: Limits) -> str:
    middle = float(np.median(list(level.values())))
    rows = []
    for name, own in cameras.items():
        worst = min(own, key=lambda score: score.level_db)
        cells = [
            _cell(name),
            _cell(f"{level[name]:.2f}", bad=level[name] < middle - limits.camera_drop_db),
            _cell(f"{worst.level_db:.2f}", tip=f"frame {worst.frame}"),
            _cell(str(worst.frame)),
            _cell(f"{np.mean([score.ssim for score in own]):.3f}"),
            _cell(str(len(own))),
        ]
        rows.append("".join(cells))
    return _table(("Camera", "mean PSNR dB", "worst dB", "at frame", "mean SSIM", "pictures"), rows)


def _pictures(report: ReportInput) -> str:
    if not report.pictures:
        return _nothing("No pictures: nothing was rendered for comparison.")
    score = {(item.camera, item.frame): item for item in report.scores}
    text = (
        "What a camera filmed, what the scene shows from there, and their absolute difference, "
        f"{DIFFERENCE_GAIN} times brighter. Point at a render to see the truth in its place: what jumps is wrong."
    )
    return f"<p>{text}</p>" + "".join(_comparison(item, score) for item in report.pictures)


def _comparison(item: Comparison, scores: Mapping[tuple[str, int], Any]) -> str:
    truth, render = _shown(item.truth), _shown(item.render)
    if truth.shape != render.shape:
        raise ValueError(
            f"truth and render of {item.camera}, frame {item.frame}, must have one size, but have "
            f"{truth.shape[1]}x{truth.shape[0]} and {render.shape[1]}x{render.shape[0]}"
        )
    score = scores.get((item.camera, item.frame))
    figures = f", {score.level_db:.2f} dB, SSIM {score.ssim:.3f}" if score else ""
    choice = f" ({escape(item.choice)})" if item.choice else ""
    title = f"{escape(item.camera)}, frame {item.frame}{choice}{figures}"
    difference = np.clip(np.abs(truth.astype(np.int16) - render) * DIFFERENCE_GAIN, 0, 255).astype(np.uint8)
    named = (
        ("truth", truth, ""),
        ("render", render, " data-blink"),
        (f"difference × {DIFFERENCE_GAIN}", difference, ""),
    )
    figures_html = "".join(
        f'<figure><img src="{_data_url(pixels)}" alt="{name}, {escape(item.camera)}, frame {item.frame}" '
        f'width="{pixels.shape[1]}" height="{pixels.shape[0]}"{extra}><figcaption>{name}</figcaption></figure>'
        for name, pixels, extra in named
    )
    return f'<h3>{title}</h3><div class="trio">{figures_html}</div>'


def _shown(picture: Path | np.ndarray) -> np.ndarray:
    """The picture as uint8 [H, W, 3] RGB, no wider than the page needs."""
    pixels = _read(picture) if isinstance(picture, Path) else picture
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"a picture must be uint8 [H, W, 3], but is {pixels.dtype} {pixels.shape}")
    height, width = pixels.shape[:2]
    if width <= PICTURE_WIDTH:
        return pixels
    size = (PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width)))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _read(path: Path) -> np.ndarray:
    if not path.is_file():
        raise FileNotFoundError(f"the report needs the picture {path}, which is not there")
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"{path} cannot be read as a picture")
    return pixels[..., ::-1]


def _data_url(pixels: np.ndarray) -> str:
    good, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not good:
        raise ValueError(f"a picture of {pixels.shape} cannot be written as JPEG")
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def _size(report: ReportInput) -> str:
    scene = report.scene
    if scene is None:
        return _nothing("No scene file: the stage did not run.")
    keyframes = _keyframes(report)
    sizes = np.array(scene.frame_bytes, dtype=np.float64) / 1e6
    is_key = np.isin(np.arange(scene.frames), keyframes)
    parts = [
        f"{kind} {sizes[rows].mean():.3f} MB"
        for kind, rows in (("keyframes", is_key), ("others", ~is_key))
        if rows.any()
    ]
    overhead = scene.bytes / 1e6 - sizes.sum()
    text = (
        f"Megabytes of each frame, keyframes in orange. On average: {', '.join(parts)}. The whole file has "
        f"{scene.bytes / 1e6:.2f} MB, {overhead:.2f} MB of it header and index."
    )
    chart = bar_chart(sizes.tolist(), title="Size over time", x_label="frame", y_label="MB", strong=keyframes)
    return f'<p>{text}</p><div class="wide">{chart}</div>'


def _gaussians(report: ReportInput) -> str:
    scene = report.scene
    if scene is None:
        return _nothing("No scene file: the stage did not run.")
    share = sum(scene.dynamic) / max(1, sum(scene.gaussians))
    text = (
        "All Gaussians, and those that may change within their segment; only these are stored for every frame, the "
        f"others once per segment. {share:.1%} are dynamic."
    )
    frames = range(scene.frames)
    every, dynamic = (np.array(counts) / 1000 for counts in (scene.gaussians, scene.dynamic))
    series = [Series("all", frames, every.tolist(), "s1"), Series("dynamic", frames, dynamic.tolist(), "s2")]
    chart = line_chart(
        series,
        title="Gaussians over time",
        x_label="frame",
        y_label="thousands",
        marks=_keyframes(report),
        from_zero=True,
    )
    return f'<p>{text}</p><div class="wide">{chart}</div>'


def _keyframes(report: ReportInput) -> list[int]:
    """Keyframes by the motion stage; without it, frames whose number of Gaussians changes."""
    if report.motion:
        return list(report.motion.keyframes)
    counts = report.scene.gaussians if report.scene else ()
    return [0, *(np.flatnonzero(np.diff(counts)) + 1).tolist()] if counts else []


def _stages(report: ReportInput) -> str:
    ran = [stage for stage in report.stages if stage.outcome is not StageOutcome.SKIPPED]
    if not ran:
        return _nothing("No stage was recorded.")
    longest = max(stage.seconds for stage in ran) or 1
    total = sum(stage.seconds for stage in ran)
    text = (
        f"Run time of each stage, {duration(total)} together; stages may run side by side. A reused artefact was there "
        "already, from an earlier run with the same inputs and options."
    )
    rows = [_stage_row(stage, longest) for stage in ran]
    return f"<p>{text}</p>" + _table(("Stage", "", "time", "peak memory", "outcome"), rows)


def _stage_row(stage: StageRecord, longest: float) -> str:
    bar = f'<span class="share" style="width:{max(1.0, 220 * stage.seconds / longest):.0f}px"></span>'
    memory = "" if not stage.peak_memory_bytes else f"{stage.peak_memory_bytes / 1e6:,.0f} MB"
    failed = stage.outcome is StageOutcome.FAILED
    cells = (_cell(duration(stage.seconds)), _cell(memory), _cell(stage.outcome, bad=failed, tip=stage.reason))
    return f'{_cell(stage.label)}<td class="text">{bar}</td>{"".join(cells)}'


def _skipped(report: ReportInput) -> str:
    skipped = [stage for stage in report.stages if stage.outcome is StageOutcome.SKIPPED]
    if not skipped:
        return _nothing("Nothing was skipped.")
    rows = [f'{_cell(stage.label)}<td class="text">{escape(stage.reason)}</td>' for stage in skipped]
    return "<p>Stages that this sequence does not need, and why.</p>" + _table(("Stage", "reason"), rows)


def _run(report: ReportInput) -> str:
    parts = [f"<p>The command, exactly:</p><pre>{escape(report.command)}</pre>"] if report.command else []
    if report.versions:
        text = "\n".join(f"{name:<18} {version}" for name, version in report.versions.items())
        parts.append(f"<p>Versions:</p><pre>{escape(text)}</pre>")
    if report.options is not None:
        text = json.dumps(plain(report.options), indent=1)
        parts.append(f"<details><summary>All options of the run</summary><pre>{escape(text)}</pre></details>")
    return "".join(parts) or _nothing("Neither the command nor the options were recorded.")


# Words and cells


def duration(seconds: float | None) -> str:
    """Time for people: 0.42 s, 12.3 s, 4 min 5 s, 2 h 3 min."""
    if seconds is None:
        return "–"
    if seconds < 60:
        return f"{seconds:.2f} s" if seconds < 1 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def _number(value: float | None, form: str) -> str:
    return "–" if value is None or (isinstance(value, float) and not math.isfinite(value)) else form.format(value)


def _cell(text: str, *, bad: bool = False, tip: str = "") -> str:
    css = ' class="bad"' if bad else ""
    title = f' title="{escape(tip)}"' if tip else ""
    return f"<td{css}{title}>{escape(text)}</td>"


def _table(head: Sequence[str], rows: Iterable[str]) -> str:
    cells = "".join(_head_cell(name) for name in head)
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>'


def _head_cell(name: str) -> str:
    css = ' class="text"' if name == "reason" else ""
    return f"<th{css}>{escape(name)}</th>"
