"""report.html: one page that needs nothing but itself. Styles, plots and pictures are inline; no request leaves it.

`sections` prepares what is shown, templates/ lays it out. All text is escaped there; only `plots` makes markup.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from tasks.report.facts import SIZE_FRAMES, ReportInput, StageOutcome
from tasks.report.findings import findings
from tasks.report.limits import LIMITS, Limits
from tasks.report.sections import SECTIONS, sections
from tasks.report.summary import summary
from tasks.report.verdict import verdict

__all__ = ["SECTIONS", "duration", "page_text"]

MOST_FINDINGS = 12
"""More of them are only counted at the top"""


def page_text(report: ReportInput, limits: Limits = LIMITS) -> str:
    """The whole page as HTML."""
    found = findings(report, limits)
    return (
        templates()
        .get_template("page.html.j2")
        .render(
            name=report.name,
            subtitle=_subtitle(report),
            cards=_cards(report),
            verdict=verdict(report, limits, found),
            findings=found,
            most_findings=MOST_FINDINGS,
            measured=any((report.sync, report.rig, report.scores, report.scene)),
            sections=sections(report, found, limits),
        )
    )


@cache
def templates() -> Environment:
    """Of this room's pages."""
    environment = Environment(
        loader=PackageLoader("tasks.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(form=format, duration=duration)
    return environment


def _subtitle(report: ReportInput) -> str:
    parts = [report.finished, report.host, report.scene.name if report.scene else ""]
    return " · ".join(part for part in parts if part) or "PackUV report"


class Card(NamedTuple):
    """One figure at the head of the page."""

    figure: str
    label: str
    style: str = ""
    """good, bad or neither"""


def _cards(report: ReportInput) -> list[Card]:
    figures = summary(report)
    held, total, scene = len(report.held_out), figures["cameras"], report.scene
    scored = f"{'held-out' if held else 'fitted'} cameras, mean"
    verified = {None: ("not checked", ""), True: ("exact", "good"), False: ("DAMAGED", "bad")}[figures["verified"]]
    peak = figures["peak_memory_bytes"]
    reused = sum(stage.outcome is StageOutcome.REUSED for stage in report.stages)
    ran = sum(stage.outcome is not StageOutcome.SKIPPED for stage in report.stages)
    there = f" of the last run, {reused} of {ran} stages were there" if reused else ""
    return [
        Card(_number(figures["psnr_db"], "{:.2f} dB"), f"PSNR, {scored}"),
        Card(_number(figures["ssim"], "{:.3f}"), f"SSIM, {scored}"),
        Card(_number(figures["mb_per_30_frames"], "{:.2f} MB"), f"per {SIZE_FRAMES} frames, whole file"),
        Card(duration(figures["seconds"]), f"total time{there}{f', peak {peak / 1e9:.1f} GB' if peak else ''}"),
        Card(_number(figures["frames"], "{}"), f"frames at {float(scene.rate):g} fps" if scene else "frames"),
        Card(_number(total, "{}"), f"cameras, {held} held out"),
        Card(verified[0], "decoded and compared", verified[1]),
    ]


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
