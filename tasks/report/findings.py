"""What a run's figures say about its result: what is good, doubtful or bad, by name."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tasks.report.facts import ReportInput, StageOutcome, by_camera, mean_by_frame, still_trend


@dataclass(frozen=True)
class Limits:
    """When a figure is bad enough to say so."""

    matched_share: float = 0.90
    """A camera with frames at fewer instants than this share leaves holes in the fit"""
    drop_share: float = 0.02
    """Missing frames as a share of a camera's timecodes: a network or disk that does not keep up"""
    residual_share: float = 0.25
    """95th percentile of the residuals, in frame periods: beyond it, moving things sit visibly elsewhere"""
    gain: float = 1.25
    """A colour gain above this, or below its inverse, is exposure that differs or a camera that sees little"""
    corner: tuple[float, float] = (0.5, 1.1)
    """Light in the corner as a share of that in the middle, least and most: beyond it hardly a lens, rather points that
    say too little, or light that the scene itself lacks there"""
    exposure_jump: float = 1.1
    """A camera's exposure that changes by more than this factor, or its inverse, at once: its automatic may be on"""
    camera_drop_db: float = 6.0
    """A camera this far below the median camera is calibrated, synchronized or balanced worse than the others"""
    frame_drop_db: float = 3.0
    """A frame whose mean is this far below the median frame: motion that the fit could not follow"""
    poor_db: float = 20.0
    """A mean held-out ratio below this shows at a glance"""
    still_fall_db: float = 0.3
    """A greater fall of still areas in 100 frames: frames explain light and shadow in ways that other cameras refute"""
    dynamic_share: float = 0.5
    """More dynamic Gaussians than this: noise passes for motion, and every frame pays for it"""

    def odd_corner(self, light: float) -> bool:
        """Whether this share of light in the corner is beyond the limits."""
        return not self.corner[0] <= light <= self.corner[1]


LIMITS = Limits()


@dataclass(frozen=True)
class Finding:
    """Something that a person should look at."""

    section: str
    """Id of the section on the page"""
    text: str


def findings(report: ReportInput, limits: Limits = LIMITS) -> tuple[Finding, ...]:
    """Everything in the report that crosses a limit, in the order of the page."""
    return (
        *_run_findings(report),
        *(Finding("sync", f"{note}.") for note in report.footage),
        *_sync_findings(report, limits),
        *_content_findings(report),
        *_rig_findings(report, limits),
        *_light_findings(report, limits),
        *_motion_findings(report),
        *_score_findings(report, limits),
        *_scene_findings(report, limits),
    )


def _run_findings(report: ReportInput) -> Iterator[Finding]:
    if report.choice:
        yield from (Finding("run", text) for text in (report.choice.missed, report.choice.late) if text)
    for stage in report.stages:
        if stage.outcome is StageOutcome.FAILED:
            yield Finding("stages", f"The stage {stage.label!r} failed: {stage.reason or 'no reason was given'}.")


def _sync_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.sync is None:
        return
    for row in report.sync.cameras:
        if row.matched_share < limits.matched_share:
            yield Finding("sync", f"{row.camera} has a frame at only {row.matched_share:.0%} of the instants.")
        if row.drops > limits.drop_share * max(1, row.lines):
            yield Finding("sync", f"{row.camera} dropped {row.drops} of {row.lines + row.drops} frames.")
        if row.residual_p95_ns > limits.residual_share * report.sync.period_ns > 0:
            late = row.residual_p95_ns / report.sync.period_ns
            yield Finding("sync", f"{row.camera}: one frame in twenty is {late:.2f} frame periods or more off.")
    yield from (Finding("sync", f"{note}.") for note in report.sync.notes)


def _content_findings(report: ReportInput) -> Iterator[Finding]:
    """Cameras whose pictures refute their times, then those that nobody can tell of."""
    content, period = report.content, report.sync.period_ns if report.sync else 0
    if content is None:
        return
    for camera in content.cameras:
        window, offset = content.worst(camera) or (None, None)
        if window and offset and offset.lies:
            move = f"{camera} = {offset.away * period / 1e9:.4f}"
            yield Finding(
                "sync",
                f"The pictures of {camera} lie {offset.away:+.1f} frames (+- {offset.error:.1f}) from those of the "
                f"others at the same times, by what moves in frames {window.first} to {window.last}; if its timecodes "
                f"are wrong, set time_offset_s = {{ {move} }} in capture.toml.",
            )
    if content.undecided:
        names = content.undecided
        whose = "times of any camera" if len(names) == len(content.cameras) else f"times of {', '.join(names)}"
        yield Finding("sync", f"The pictures do not prove the {whose}: too little moves that several cameras see.")


def _rig_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.check is not None:
        yield from (Finding("rig", f"{camera}: {what}.") for camera, what in report.check.suspicious.items())
    yield from _colour_findings(report)
    for camera in report.rig.cameras if report.rig else ():
        worst = max(camera.gains, key=lambda gain: abs(math.log(gain)))
        if not 1 / limits.gain <= worst <= limits.gain:
            yield Finding("colour", f"{camera.name} needs a colour gain of {worst:.2f}.")
        light = float(corner_light(np.array(camera.shading)))
        if limits.odd_corner(light):
            yield Finding("colour", f"{camera.name} seems to have {light:.0%} of its light in the corner.")
    yield from (Finding("colour", f"{name} keeps its colours as filmed: {why}.") for name, why in report.unlike.items())


def corner_light(shading: np.ndarray) -> np.ndarray:
    """Light in a picture's corner as a share of that in its middle, [...] of k1, k2 [..., 2]."""
    light: np.ndarray = np.exp(shading.sum(axis=-1))
    return light


def _colour_findings(report: ReportInput) -> Iterator[Finding]:
    """Cameras whose videos code colour otherwise than most do, or look like log footage that nobody called so."""
    codings = {camera: tuple(tags.items()) for camera, tags in report.colours.items()}
    usual = dict(Counter(codings.values()).most_common(1)[0][0]) if codings else {}
    for camera, tags in report.colours.items():
        differing = [
            f"{name.replace('_', ' ')} {tags[name]}, not {usual[name]}" for name in usual if tags[name] != usual[name]
        ]
        if differing:
            said = "; ".join(differing).replace("None", "untold")
            yield Finding("colour", f"The video of {camera} is coded otherwise than most: {said}.")
    if report.log_like:
        names, verb = ", ".join(report.log_like), "looks" if len(report.log_like) == 1 else "look"
        yield Finding(
            "colour", f'{names} {verb} like log footage; say which in capture.toml, such as transfer = "slog3".'
        )


def _light_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    for camera in report.light.exposures if report.light else ():
        factor, instant = report.light.jump(camera) if report.light else (1.0, 0)
        if not 1 / limits.exposure_jump <= factor <= limits.exposure_jump:
            text = f"The exposure of {camera} jumps by a factor of {factor:.2f} at frame {instant}"
            yield Finding("light", f"{text}; fit and scores allow for it.")


def _motion_findings(report: ReportInput) -> Iterator[Finding]:
    for instant in report.motion.cuts if report.motion else ():
        text = f"Most of the pictures change for good at about frame {instant}"
        yield Finding("motion", f"{text}; if the scene is cut there, process the parts apart with --frames.")


def _score_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if not report.scores:
        return
    if not report.held_out:
        yield Finding(
            "quality", "No camera was held out, so the scores only tell how well the fit repeats what it saw."
        )
    cameras = {name: float(np.mean([s.level_db for s in own])) for name, own in by_camera(report.scores).items()}
    middle = float(np.median(list(cameras.values())))
    for name, level in cameras.items():
        if level < middle - limits.camera_drop_db:
            yield Finding("quality", f"{name} scores {level:.1f} dB, {middle - level:.1f} dB below the median camera.")
    frames = mean_by_frame(report.scores)
    usual = float(np.median(list(frames.values())))
    low = [frame for frame, level in frames.items() if level < usual - limits.frame_drop_db]
    if low:
        worst = min(low, key=lambda frame: frames[frame])
        text = f"{len(low)} of {len(frames)} frames score {limits.frame_drop_db:g} dB or more below the median frame"
        yield Finding("quality", f"{text}, the worst being frame {worst} with {frames[worst]:.1f} dB.")
    slope = still_trend(report.scores)
    if slope is not None and slope < -limits.still_fall_db:
        yield Finding("quality", f"Still places rot: they lose {-slope:.2f} dB per 100 frames.")
    overall = float(np.mean(list(cameras.values())))
    if overall < limits.poor_db:
        yield Finding("quality", f"The mean of {overall:.1f} dB is poor: the difference shows at a glance.")


def _scene_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.scene is None:
        return
    if report.scene.verified is False:
        yield Finding(
            "size", f"The scene file does not decode to what was fitted: {report.scene.problem or 'unknown'}."
        )
    share = sum(report.scene.dynamic) / max(1, sum(report.scene.gaussians))
    if share > limits.dynamic_share:
        yield Finding("gaussians", f"{share:.0%} of the Gaussians are dynamic: noise may pass for motion.")
