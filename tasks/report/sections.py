"""What each section of the page shows, as plain values; the template of the section's name lays them out."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

import numpy as np
from markupsafe import Markup

from calibration.rig import Camera
from sync.align import CameraReport, SyncReport
from sync.clock import ClockMode
from tasks.artefacts.recipe import plain
from tasks.report.facts import (
    FOREGROUND,
    LEVELS,
    FrameScore,
    ReportInput,
    StageOutcome,
    StageRecord,
    by_camera,
    mean_by_frame,
    mean_of,
    still_trend,
)
from tasks.report.findings import Finding, corner_light
from tasks.report.limits import Limits
from tasks.report.pictures import DIFFERENCE_GAIN, comparison
from tasks.report.plots import (
    MOST_BARS,
    MOST_MARKS,
    Series,
    Volume,
    bar_chart,
    gain_chart,
    line_chart,
    rig_model,
    rig_views,
    sparkline,
)
from tasks.report.summary import Contrast, contrast, summary

MANY_LINES = 6
"""With more cameras than this, only the worst and the mean are named"""
MANY_STAGES, WORST_STAGES = 24, 6
"""Of more stages that are alike than the first, so many have a row, and one row sums up the rest"""
VIEWER = "http://127.0.0.1:8787"
"""Where `packuv view` shows a scene unless it is told otherwise"""
BAR_PX = 220
"""The longest stage's bar"""

SECTIONS = {
    "sync": "Synchronization",
    "rig": "Camera layout",
    "colour": "Colour balance",
    "light": "Light over time",
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

View = dict[str, Any]
Body = View | str
"""What a section shows, or why there is nothing to show"""


@dataclass(frozen=True)
class Section:
    """One section of the page."""

    name: str
    title: str
    findings: tuple[Finding, ...]
    view: View = field(default_factory=dict)
    missing: str = ""
    """Why there is nothing to show"""


def sections(report: ReportInput, found: Sequence[Finding], limits: Limits) -> list[Section]:
    """All of them, in the order of the page."""
    bodies: dict[str, Body] = {
        "sync": _sync(report, limits),
        "rig": _rig(report),
        "colour": _colour(report, limits),
        "light": _light(report),
        "motion": _motion(report),
        "quality": _quality(report, limits),
        "pictures": _pictures(report),
        "size": _size(report),
        "gaussians": _gaussians(report),
        "stages": _stages(report),
        "skipped": _skipped(report),
        "run": _run(report),
    }
    return [_section(name, bodies[name], found) for name in SECTIONS]


def _section(name: str, body: Body, found: Sequence[Finding]) -> Section:
    own = tuple(item for item in found if item.section == name)
    if isinstance(body, str):
        return Section(name, SECTIONS[name], own, missing=body)
    return Section(name, SECTIONS[name], own, body)


CLOCKS = {
    ClockMode.TRUSTED: "Clocks are trusted.",
    ClockMode.TRIGGERED: "One trigger fired all cameras; offset and drift of their clocks were fitted.",
    ClockMode.CONTENT: "When each camera began was found from what its pictures show.",
}
"""What is known of the times"""


def _sync(report: ReportInput, limits: Limits) -> Body:
    sync = report.sync
    if sync is None:
        return "No synchronization report: the stage did not run."
    return {
        "reference": sync.reference,
        "tolerance_ms": sync.tolerance_ns / 1e6,
        "period_ms": sync.period_ns / 1e6,
        "clock": CLOCKS[sync.clock],
        "complete": sync.complete,
        "instants": sync.instants,
        "cameras": [{**_sync_row(row, sync, limits), "content": _content(row.camera, report)} for row in sync.cameras],
    }


def _content(camera: str, report: ReportInput) -> View | None:
    """By how many frames a camera's pictures refute its times; None where they do not tell."""
    told = report.content.worst(camera) if report.content else None
    return told and {"frames": told[1].away, "error": told[1].error, "lies": told[1].lies}


def _sync_row(row: CameraReport, sync: SyncReport, limits: Limits) -> View:
    clock = row.clock
    return {
        "camera": row.camera,
        "source": row.source,
        "offset_ms": clock.offset_ns / 1e6,
        "offset_error_ms": clock.offset_error_ns / 1e6,
        "drift_ppm": clock.drift_ppm,
        "drift_error_ppm": clock.drift_error_ppm,
        "state": str(clock.state),
        "matched": row.matched,
        "matched_share": row.matched_share,
        "few_matched": row.matched_share < limits.matched_share,
        "lines": row.lines,
        "drops": row.drops,
        "many_drops": row.drops > limits.drop_share * max(1, row.lines),
        "duplicates": row.duplicates,
        "reversals": row.reversals,
        "jumps": row.jumps,
        "residual_p95_ms": row.residual_p95_ns / 1e6,
        "residual_median_ms": row.residual_median_ns / 1e6,
        "late": row.residual_p95_ns > limits.residual_share * sync.period_ns > 0,
        "residuals": sparkline(row.histogram, title=f"residuals of {row.camera}"),
    }


def _rig(report: ReportInput) -> Body:
    if report.rig is None:
        return "No calibration: the stage did not run."
    check, rig = report.check, report.rig
    unit = "m" if rig.metric else "units"
    volume = Volume(check.scene_centre, check.common_radius) if check else None
    above, side = rig_views(rig.cameras, held_out=report.held_out, volume=volume, unit=unit, up=rig.up)
    return {
        "source": rig.source,
        "unit": unit,
        "metric": rig.metric,
        "volume": check,
        "above": above,
        "model": rig_model(rig.cameras, held_out=report.held_out, volume=volume, up=rig.up),
        "evidence": list(report.evidence.items()),
        "side": side,
    }


def _colour(report: ReportInput, limits: Limits) -> Body:
    if report.rig is None:
        return "No calibration: the stage did not run."
    cameras = report.rig.cameras
    gains, shading = (np.array([getattr(camera, of) for camera in cameras]) for of in ("gains", "shading"))
    if (gains == 1).all() and not shading.any():
        return "All gains are 1: the cameras were not balanced, or did not need it."
    corners = corner_light(shading)
    return {
        "least": gains.min(),
        "most": gains.max(),
        "gains": gain_chart([camera.name for camera in cameras], gains, title="Colour gains"),
        "shaded": bool(shading.any()),
        "darkest": corners.min(),
        "brightest": corners.max(),
        "corners": [
            _corner_row(camera, light, limits) for camera, light in zip(cameras, corners.tolist(), strict=True)
        ],
    }


def _corner_row(camera: Camera, light: float, limits: Limits) -> View:
    k1, k2 = camera.shading
    return {"camera": camera.name, "light": light, "k1": k1, "k2": k2, "odd": limits.odd_corner(light)}


def _light(report: ReportInput) -> Body:
    curve = report.light
    if curve is None:
        return "No light was measured: the stage did not run, or light.enabled is false."
    if not curve.light.any() and not curve.exposures:
        return f"Light and exposures are steady: {curve.reason}."
    frames = range(len(curve.light))
    lines = [
        Series(name, frames, (100 * np.expm1(curve.light[:, channel])).tolist(), name)
        for channel, name in enumerate(("red", "green", "blue"))
    ]
    own = [
        Series(name, frames, (100 * np.expm1(values.mean(axis=1))).tolist(), f"s{number % 6 + 1}")
        for number, (name, values) in enumerate(curve.exposures.items())
    ]
    return {
        "reason": curve.reason,
        "light": None if curve.reason else _change_chart(lines, "Light over time"),
        "exposures": _change_chart(own, "Exposures over time") if own else None,
    }


def _change_chart(lines: Sequence[Series], title: str) -> Markup:
    return line_chart(lines, title=title, x_label="frame", y_label="change, %")


def _motion(report: ReportInput) -> Body:
    motion = report.motion
    if motion is None:
        return "No motion was measured: the stage did not run."
    count = len(motion.magnitude_px)
    lengths = np.diff([*motion.keyframes, count]).tolist()
    series = [Series("M(t)", range(count), [float(value) for value in motion.magnitude_px])]
    return {
        "segments": len(motion.keyframes),
        "marked": len(motion.keyframes) <= MOST_MARKS,
        "shortest": min(lengths, default=0),
        "longest": max(lengths, default=0),
        "changes": [{"frame": change.frame, "cameras": change.cameras} for change in motion.changes],
        "curve": line_chart(
            series, title="Motion", x_label="frame", y_label="optical flow, px", marks=motion.keyframes, from_zero=True
        ),
    }


def _quality(report: ReportInput, limits: Limits) -> Body:
    if not report.scores:
        return "No picture was scored: the stage did not run, or the capture has no picture to compare with."
    cameras = by_camera(report.scores)
    level = {name: float(np.mean([score.level_db for score in own])) for name, own in cameras.items()}
    low = float(np.median(list(level.values()))) - limits.camera_drop_db
    return {
        "held_out": bool(report.held_out),
        "worst": _worst(report),
        "flicker": _flicker(report),
        "beside": _beside(contrast(report), report, limits),
        "levels": line_chart(
            _level_lines(report, cameras, level),
            title="PSNR over time",
            x_label="frame",
            y_label="PSNR, dB",
            marks=report.motion.keyframes if report.motion else (),
            height=300,
        ),
        "cameras": [_score_row(name, own, level[name], low, limits) for name, own in cameras.items()],
        "kinds": list(LEVELS.values()),
        "areas": _areas(report),
        "foreground": any(score.foreground_db is not None for score in report.scores),
        "trend_db": still_trend(report.scores),
    }


def _beside(both: Contrast | None, report: ReportInput, limits: Limits) -> View | None:
    """Fitted cameras beside unseen ones, at the frames of the former."""
    if both is None:
        return None
    frames = both.fitted.frames
    fitted, unseen = (mean_by_frame(scores) for scores in (report.fitted, report.scores))
    lines = [
        Series("fitted", frames, [fitted[frame] for frame in frames], "s1"),
        Series("unseen", frames, [unseen.get(frame, math.nan) for frame in frames], "s2"),
    ]
    return {
        "levels": [("fitted", both.fitted), ("unseen", both.unseen)],
        "gap_db": both.gap_db,
        "far": both.gap_db > limits.fitted_gap_db,
        "frames": frames,
        "curve": line_chart(lines, title="Fitted and unseen cameras", x_label="frame", y_label="PSNR, dB", height=200),
    }


def _worst(report: ReportInput) -> View:
    """The frame with the lowest mean, where in it, and where the viewer shows it."""
    means = mean_by_frame(report.scores)
    frame = min(means, key=lambda item: means[item])
    own = [score for score in report.scores if score.frame == frame]
    camera = min(own, key=lambda score: score.level_db).camera
    place = urlencode({"frame": frame, "camera": camera, "play": 0})
    scene = report.scene.name if report.scene else ""
    return {"frame": frame, "camera": camera, "mean_db": means[frame], "url": f"{VIEWER}/#{place}", "scene": scene}


def _flicker(report: ReportInput) -> Markup | None:
    """What blinks in renders alone, over time, mean over the cameras."""
    means = mean_by_frame(report.scores, "flicker")
    if not means:
        return None
    line = Series("flicker", list(means), list(means.values()), "s4")
    marks = report.motion.keyframes if report.motion else ()
    return line_chart(
        [line], title="Flicker", x_label="frame", y_label="flicker", marks=marks, from_zero=True, height=180
    )


def _areas(report: ReportInput) -> Markup | None:
    """Moving and still areas over time, means over the cameras."""
    named = {name: LEVELS[name] for name in ("moving_db", "still_db", "never_moving_db")}
    lines = []
    for number, (name, text) in enumerate(named.items(), start=1):
        means = mean_by_frame(report.scores, name)
        if means:
            lines.append(Series(text, list(means), list(means.values()), f"s{number}"))
    if not lines:
        return None
    return line_chart(lines, title="Moving and still areas", x_label="frame", y_label="PSNR, dB", height=260)


def _level_lines(
    report: ReportInput, cameras: Mapping[str, Sequence[FrameScore]], level: Mapping[str, float]
) -> list[Series]:
    """One line a camera, and their mean where there are several."""
    worst = min(level, key=lambda name: level[name])
    few = len(cameras) <= MANY_LINES
    lines = []
    for number, (name, own) in enumerate(cameras.items()):
        style = f"s{number + 1}" if few else "s2" if name == worst else "muted"
        shown = name if few or name == worst else ""
        lines.append(Series(shown, [score.frame for score in own], [score.level_db for score in own], style))
    if len(cameras) > 1:
        mean = mean_by_frame(report.scores)
        lines.append(Series("mean", list(mean), list(mean.values()), "strong"))
    return lines


def _score_row(camera: str, own: Sequence[FrameScore], mean_db: float, low: float, limits: Limits) -> View:
    slope = still_trend(own)
    worst = min(own, key=lambda score: score.level_db)
    return {
        "camera": camera,
        "mean_db": mean_db,
        "low": mean_db < low,
        "worst_db": worst.level_db,
        "worst_frame": worst.frame,
        "ssim": float(np.mean([score.ssim for score in own])),
        "levels": [mean_of(own, name) for name in LEVELS],
        "trend_db": slope,
        "falls": slope is not None and slope < -limits.still_fall_db,
        **{name: mean_of(own, name) for name in ("tof_px", "flicker", "lpips", *FOREGROUND)},
        "pictures": len(own),
    }


def _pictures(report: ReportInput) -> Body:
    if not report.pictures:
        return "No pictures: nothing was rendered for comparison."
    scores = {(item.camera, item.frame): item for item in report.scores}
    return {"gain": DIFFERENCE_GAIN, "shots": [comparison(item, scores) for item in report.pictures]}


def _size(report: ReportInput) -> Body:
    scene = report.scene
    if scene is None:
        return "No scene file: the stage did not run."
    keyframes = _keyframes(report)
    sizes = np.array(scene.frame_bytes, dtype=np.float64) / 1e6
    is_key = np.isin(np.arange(scene.frames), keyframes)
    kinds = (("keyframes", is_key), ("others", ~is_key))
    return {
        "means": [(kind, sizes[rows].mean()) for kind, rows in kinds if rows.any()],
        "whole_mb": scene.bytes / 1e6,
        "overhead_mb": scene.bytes / 1e6 - sizes.sum(),
        "sound": scene.sound,
        "each": scene.frames <= MOST_BARS,
        "frames": bar_chart(sizes.tolist(), title="Size over time", x_label="frame", y_label="MB", strong=keyframes),
    }


def _gaussians(report: ReportInput) -> Body:
    scene = report.scene
    if scene is None:
        return "No scene file: the stage did not run."
    frames = range(scene.frames)
    every, dynamic = (np.array(counts) / 1000 for counts in (scene.gaussians, scene.dynamic))
    chart = line_chart(
        [Series("all", frames, every.tolist(), "s1"), Series("dynamic", frames, dynamic.tolist(), "s2")],
        title="Gaussians over time",
        x_label="frame",
        y_label="thousands",
        marks=_keyframes(report),
        from_zero=True,
    )
    return {"dynamic_share": sum(scene.dynamic) / max(1, sum(scene.gaussians)), "counts": chart}


def _keyframes(report: ReportInput) -> list[int]:
    """Keyframes by the motion stage; without it, frames whose number of Gaussians changes."""
    if report.motion:
        return list(report.motion.keyframes)
    counts = report.scene.gaussians if report.scene else ()
    return [0, *(np.flatnonzero(np.diff(counts)) + 1).tolist()] if counts else []


def _stages(report: ReportInput) -> Body:
    ran = [stage for stage in report.stages if stage.outcome is not StageOutcome.SKIPPED]
    if not ran:
        return "No stage was recorded."
    longest = max(stage.seconds for stage in ran) or 1
    shown, rest = told_apart(ran, lambda stage: (stage.outcome is StageOutcome.FAILED, stage.seconds))
    return {
        "total": summary(report)["seconds"],
        "stages": [_stage_row(stage, longest) for stage in shown],
        "rest": [_rest_row(kind, stages) for kind, stages in rest.items()],
        "forecast": report.forecast,
    }


def told_apart(
    stages: Sequence[StageRecord], worth: Callable[[StageRecord], Any]
) -> tuple[list[StageRecord], dict[str, list[StageRecord]]]:
    """Stages that a table shows, in order, and the rest by kind: of a kind with many stages it shows those that are
    worth most, of equals the first. Stages are of one kind where their labels differ in numbers alone."""
    kinds: dict[str, list[StageRecord]] = {}
    for stage in stages:
        kinds.setdefault(re.sub(r"[\d,-]+", "N", stage.label), []).append(stage)
    rest: dict[str, list[StageRecord]] = {}
    hidden: set[int] = set()
    for own in kinds.values():
        if len(own) > MANY_STAGES:
            rest[_kind(own[0])] = others = sorted(own, key=worth, reverse=True)[WORST_STAGES:]
            hidden.update(map(id, others))
    return [stage for stage in stages if id(stage) not in hidden], rest


def _kind(stage: StageRecord) -> str:
    """What stages that are alike are called: the words before the first number."""
    return re.split(r"\s*[\d(]", stage.label)[0] or stage.label


def _rest_row(kind: str, stages: Sequence[StageRecord]) -> View:
    outcomes = Counter(str(stage.outcome) for stage in stages)
    memory = max((stage.peak_memory_bytes or 0 for stage in stages), default=0)
    return {
        "label": f"{len(stages):,} more: {kind}",
        "seconds": sum(stage.seconds for stage in stages),
        "memory_mb": memory / 1e6 if memory else None,
        "outcome": ", ".join(f"{count:,} {outcome}" for outcome, count in outcomes.items()),
    }


def _stage_row(stage: StageRecord, longest: float) -> View:
    return {
        "label": stage.label,
        "seconds": stage.seconds,
        "bar_px": max(1.0, BAR_PX * stage.seconds / longest),
        "memory_mb": stage.peak_memory_bytes / 1e6 if stage.peak_memory_bytes else None,
        "outcome": str(stage.outcome),
        "failed": stage.outcome is StageOutcome.FAILED,
        "reason": stage.reason,
    }


def _skipped(report: ReportInput) -> Body:
    skipped = [stage for stage in report.stages if stage.outcome is StageOutcome.SKIPPED]
    if not skipped:
        return "Nothing was skipped."
    shown, rest = told_apart(skipped, lambda stage: 0)
    rows = [{"label": stage.label, "reason": stage.reason} for stage in shown]
    more = [{"label": f"{len(own):,} more: {kind}", "reason": "for the like reason"} for kind, own in rest.items()]
    return {"stages": rows + more}


def _listed(versions: Mapping[str, Any]) -> str:
    width = max((len(name) for name in versions), default=0)
    return "\n".join(f"{name:<{width}}  {version}" for name, version in versions.items())


def _run(report: ReportInput) -> Body:
    if not report.command and not report.versions and report.options is None:
        return "Neither the command nor the options were recorded."
    return {
        "command": report.command,
        "choice": report.choice,
        "versions": _listed(report.versions),
        "stage_versions": _listed(report.stage_versions),
        "options": "" if report.options is None else json.dumps(plain(report.options), indent=1),
    }
