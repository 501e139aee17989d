"""What a run's figures say about its result: what is good, doubtful or bad, by name, and what to do about it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from calibration.doubt import UNCONFIRMED
from sync.content import Content
from tasks.report.facts import ReportInput, StageOutcome, by_camera, mean_by_frame, mean_of, still_trend
from tasks.report.limits import LIMITS, Limits
from tasks.report.summary import contrast

MOST_NAMES = 6
"""Cameras that one line names; the rest are counted"""


class Severity(StrEnum):
    """What a finding means for a delivery, from the worst on."""

    BLOCKS = "blocks delivery"
    DOUBT = "look at it"
    NOTE = "good to know"


SEVERITIES = tuple(Severity)


@dataclass(frozen=True)
class Finding:
    """Something that a person should look at."""

    section: str
    """Id of the section on the page"""
    text: str
    severity: Severity = Severity.DOUBT
    cure: str = ""
    """What to do about it, a sentence"""
    evidence: tuple[str, ...] = ()
    """Of a group: what is found of each camera"""
    camera: str = ""
    """That it is about; empty for none, or several"""
    many: str = ""
    """What several cameras with this finding have in common, as "cameras dropped frames"; such ones become one line"""
    figure: str = ""
    """What was measured of the camera, as short as that line needs it"""


def findings(report: ReportInput, limits: Limits = LIMITS) -> tuple[Finding, ...]:
    """Everything in the report that crosses a limit: what is alike in one, the worst first, then in the order of the
    page."""
    found = (
        *_run_findings(report),
        *(Finding("sync", f"{note}.") for note in report.footage),
        *_sync_findings(report, limits),
        *_content_findings(report),
        *_rig_findings(report, limits),
        *_light_findings(report, limits),
        *_motion_findings(report),
        *_mask_findings(report),
        *_score_findings(report, limits),
        *_scene_findings(report, limits),
    )
    return tuple(sorted(_grouped(found), key=lambda finding: SEVERITIES.index(finding.severity)))


def _grouped(found: tuple[Finding, ...]) -> list[Finding]:
    """One finding for all cameras with the same, where the first of them stands."""
    groups: dict[object, list[Finding]] = {}
    for number, finding in enumerate(found):
        key = (finding.section, finding.many) if finding.many else number
        groups.setdefault(key, []).append(finding)
    return [own[0] if len(own) == 1 else _joined(own) for own in groups.values()]


def _joined(own: list[Finding]) -> Finding:
    names = [f"{finding.camera} ({finding.figure})" if finding.figure else finding.camera for finding in own]
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    text = f"{len(own)} {own[0].many}: {', '.join(names[:MOST_NAMES])}{more}."
    return replace(own[0], text=text, evidence=tuple(finding.text for finding in own), camera="")


def _run_findings(report: ReportInput) -> Iterator[Finding]:
    if report.choice:
        if text := report.choice.missed:
            cure = "Allow a finer --preset or more --max-minutes, or settle for a lower --target-psnr."
            yield Finding("run", text, Severity.BLOCKS, cure)
        if text := report.choice.late:
            yield Finding("run", text, Severity.NOTE, "Allow more time; `packuv plan` tells how much.")
    if report.otherwise:
        yield Finding(
            "run",
            "Some of what was there before was made by other software or another processor.",
            Severity.NOTE,
            "Nothing, unless results must be reproduced to the bit: then run into an empty folder.",
            tuple(f"{', '.join(kinds)}: made by {how}." for how, kinds in report.otherwise.items()),
        )
    for stage in report.stages:
        if stage.outcome is StageOutcome.FAILED:
            text = f"The stage {stage.label!r} failed: {stage.reason or 'no reason was given'}."
            yield Finding("stages", text, Severity.BLOCKS, "Remove the cause, and run the same command again.")


def _sync_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    yield from (Finding("sync", f"{note}.") for note in report.unread)
    if report.sync is None:
        return
    for row in report.sync.cameras:
        if row.matched_share < limits.matched_share:
            yield Finding(
                "sync",
                f"{row.camera} has a frame at only {row.matched_share:.0%} of the instants.",
                cure="See whether it started late or its clock is off; --frames can leave the gap out.",
                camera=row.camera,
                many="cameras have frames at too few instants",
                figure=f"{row.matched_share:.0%}",
            )
        if row.drops > limits.drop_share * max(1, row.lines):
            yield Finding(
                "sync",
                f"{row.camera} dropped {row.drops} of {row.lines + row.drops} frames.",
                cure="Look at the recorder's network and disk before the next take; the fit does without these frames.",
                camera=row.camera,
                many="cameras dropped frames",
                figure=f"{row.drops}",
            )
        if row.residual_p95_ns > limits.residual_share * report.sync.period_ns > 0:
            late = row.residual_p95_ns / report.sync.period_ns
            yield Finding(
                "sync",
                f"{row.camera}: one frame in twenty is {late:.2f} frame periods or more off.",
                cure="Synchronize shutters (genlock); with cameras that run freely try --clock triggered or content.",
                camera=row.camera,
                many="cameras film beside the instants of the reference",
                figure=f"{late:.2f} periods",
            )
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
                cure=f"Set time_offset_s = {{ {move} }} in capture.toml, and run again.",
                camera=camera,
            )
    yield from _alike(content)
    if content.undecided:
        names = content.undecided
        whose = "times of any camera" if len(names) == len(content.cameras) else f"times of {', '.join(names)}"
        text = (
            f"The pictures do not prove the {whose}: too little moves that several cameras see, or they lie farther "
            "off than content.reach instants."
        )
        cure = "Try content.reach=60; have somebody clap or walk through the volume in the next take."
        yield Finding("sync", text, Severity.NOTE, cure)


def _alike(content: Content) -> Iterator[Finding]:
    """Cameras that lie equally, and one of two: who is right, pictures cannot tell."""
    told = {name: worst[1] for name in content.cameras if (worst := content.worst(name))}
    frames = {name: round(offset.away) for name, offset in told.items() if offset.lies}
    for number, count in Counter(frames.values()).items():
        names = ", ".join(name for name, own in frames.items() if own == number)
        if count > 1:
            yield Finding(
                "sync",
                f"{names} lie by about the same {number:+d} frames, {count} of {len(content.cameras)} cameras: "
                "pictures tell that two groups differ, and the larger one is taken to be right; if half of the "
                "cameras or more are wrong alike, it is the others that are named.",
                Severity.NOTE,
                "See whether the cameras of either group have something in common, such as a recorder or a label set "
                "by hand, before moving their times.",
            )
        elif len(told) == 2 and len(frames) == 1:
            (other,) = told.keys() - frames.keys()
            yield Finding(
                "sync",
                f"Of {names} and {other} the pictures tell that their times differ by {abs(number)} frames, and not "
                "which of them is wrong.",
                Severity.NOTE,
                "See which of the two was set by hand or started late before moving its times.",
            )


AMISS = (
    "cameras seem to stand amiss",
    "Look at its pictures in the section on truth and render; solve the rig anew, or ignore the camera.",
)
OPEN = (
    "cameras are not confirmed by the pictures",
    "Nothing speaks against it. Compare its pictures in the section on truth and render; texture where it and two "
    "others look, or more instants (rig.more_instants), would tell.",
)
"""What cameras have in common, and what to do about it"""


def _rig_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.check is not None:
        for name, what in report.check.suspicious.items():
            many, cure = OPEN if what.startswith(UNCONFIRMED) else AMISS
            yield Finding("rig", f"{name}: {what}.", cure=cure, camera=name, many=many)
    yield from _colour_findings(report)
    for camera in report.rig.cameras if report.rig else ():
        worst = max(camera.gains, key=lambda gain: abs(math.log(gain)))
        if not 1 / limits.gain <= worst <= limits.gain:
            yield Finding(
                "colour",
                f"{camera.name} needs a colour gain of {worst:.2f}.",
                Severity.NOTE,
                "The renderer allows for it; set exposure and white balance alike before the next take.",
                camera=camera.name,
                many=f"cameras need a colour gain beyond {limits.gain:g} or 1/{limits.gain:g}",
                figure=f"{worst:.2f}",
            )
        light = float(corner_light(np.array(camera.shading)))
        if limits.odd_corner(light):
            yield Finding(
                "colour",
                f"{camera.name} seems to have {light:.0%} of its light in the corner.",
                cure="Compare its corners in truth and render; its points there may say too little.",
                camera=camera.name,
                many="cameras seem to have odd light in the corner",
                figure=f"{light:.0%}",
            )
    for name, why in report.unlike.items():
        text = f"{name} keeps its colours as filmed: {why}."
        yield Finding("colour", text, camera=name, many="cameras keep their colours as filmed")


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
            yield Finding(
                "colour",
                f"The video of {camera} is coded otherwise than most: {said}.",
                cure="Record all cameras alike, or convert the odd ones from their originals.",
                camera=camera,
                many="videos are coded otherwise than most",
            )
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
            yield Finding(
                "light",
                f"{text}; fit and scores allow for it.",
                cure="Turn its automatic exposure off before the next take.",
                camera=camera,
                many="cameras change their exposure at once; fit and scores allow for it",
                figure=f"{factor:.2f}",
            )


def _motion_findings(report: ReportInput) -> Iterator[Finding]:
    for instant in report.motion.cuts if report.motion else ():
        text = f"Most of the pictures change for good at about frame {instant}"
        yield Finding(
            "motion",
            f"{text}; if the scene is cut there, process the parts apart with --frames.",
            cure=f"If it is cut, run with --frames :{instant} and --frames {instant}: instead.",
        )


def _mask_findings(report: ReportInput) -> Iterator[Finding]:
    for name, why in report.masks.items():
        yield Finding(
            "motion",
            f"Masks of {name} are not used: {why}.".replace("?.", "?"),
            cure="Lay a mask over the picture of its number; make the masks anew, or take them out of the capture.",
            camera=name,
            many="cameras have masks that do not fit what moves and are not used",
        )


def _score_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if not report.scores:
        return
    if not report.held_out:
        yield Finding(
            "quality",
            "No camera was held out, so the scores only tell how well the fit repeats what it saw.",
            cure="Run again with --hold-out and one or two cameras amid the others.",
        )
    yield from _fitted_findings(report, limits)
    cameras = {name: float(np.mean([s.level_db for s in own])) for name, own in by_camera(report.scores).items()}
    middle = float(np.median(list(cameras.values())))
    for name, level in cameras.items():
        if level < middle - limits.camera_drop_db:
            yield Finding(
                "quality",
                f"{name} scores {level:.1f} dB, {middle - level:.1f} dB below the median camera.",
                cure="See its rows in synchronization, camera layout and colour balance.",
                camera=name,
                many=f"cameras score {limits.camera_drop_db:g} dB or more below the median camera",
                figure=f"{level:.1f} dB",
            )
    frames = mean_by_frame(report.scores)
    usual = float(np.median(list(frames.values())))
    low = [frame for frame, level in frames.items() if level < usual - limits.frame_drop_db]
    if low:
        worst = min(low, key=lambda frame: frames[frame])
        text = f"{len(low)} of {len(frames)} frames score {limits.frame_drop_db:g} dB or more below the median frame"
        yield Finding(
            "quality",
            f"{text}, the worst being frame {worst} with {frames[worst]:.1f} dB.",
            cure="Look at it in the viewer; a lower keyframes.max_segment or a finer --preset follows fast motion.",
        )
    slope = still_trend(report.scores)
    if slope is not None and slope < -limits.still_fall_db:
        yield Finding(
            "quality",
            f"Still places rot: they lose {-slope:.2f} dB per 100 frames.",
            cure="See whether light or exposure drifts (light over time), and keep light.enabled on.",
        )
    yield from _delivery_findings(report, float(np.mean(list(cameras.values()))), limits)


def _fitted_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    beside = contrast(report)
    if beside and beside.gap_db > limits.fitted_gap_db:
        yield Finding(
            "quality",
            f"Fitted cameras score {beside.fitted.psnr_db:.1f} dB, unseen ones {beside.unseen.psnr_db:.1f} dB at the "
            f"same frames: {beside.gap_db:.1f} dB of what was fitted is not there from elsewhere.",
            cure="Take fewer fit.iterations or a smaller fit.density.cap, and more cameras; see that those held out "
            "stand amid the others.",
        )


def _delivery_findings(report: ReportInput, overall: float, limits: Limits) -> Iterator[Finding]:
    """What the limits of a delivery say about the scores."""
    if overall < limits.psnr_db:
        text = f"The mean of {overall:.1f} dB is below the limit of {limits.psnr_db:g} dB"
        glance = ": the difference shows at a glance" if overall < LIMITS.psnr_db else ""
        cure = "Cure what is listed below; where nothing is, take a finer --preset."
        yield Finding("quality", f"{text}{glance}.", Severity.BLOCKS, cure)
    moving, flicker = (mean_of(report.scores, name) for name in ("moving_db", "flicker"))
    if limits.moving_db is not None and moving is not None and moving < limits.moving_db:
        text = f"What moves has {moving:.1f} dB, below the limit of {limits.moving_db:g} dB."
        yield Finding("quality", text, Severity.BLOCKS, "Take a finer --preset, or more keyframes.")
    if limits.flicker is not None and flicker is not None and flicker > limits.flicker:
        text = f"Renders flicker by {flicker:.4f}, above the limit of {limits.flicker:g}."
        yield Finding("quality", text, Severity.BLOCKS, "See light over time, and the seams of segments.")


def _scene_findings(report: ReportInput, limits: Limits) -> Iterator[Finding]:
    if report.scene is None:
        return
    if report.scene.verified is False:
        text = f"The scene file does not decode to what was fitted: {report.scene.problem or 'unknown'}."
        yield Finding("size", text, Severity.BLOCKS, "Check the disk, and have it written again: remove store/encode.")
    most = limits.mb_per_30_frames
    if most is not None and report.scene.mb_per_30_frames > most:
        text = f"The scene file has {report.scene.mb_per_30_frames:.2f} MB per 30 frames, above the limit of {most:g}."
        yield Finding("size", text, Severity.BLOCKS, "Write it with a lower --quality, or fit fewer Gaussians.")
    share = sum(report.scene.dynamic) / max(1, sum(report.scene.gaussians))
    if share > limits.dynamic_share:
        text = f"{share:.0%} of the Gaussians are dynamic: noise may pass for motion."
        yield Finding("gaussians", text, cure="Where pictures are noisy, raise motion.tau_px.")
