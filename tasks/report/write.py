"""The report of a run: report.json for programs, report.html for people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from packuv.files import whole_file
from tasks.artefacts.recipe import naming, write_json
from tasks.report.facts import (
    Comparison,
    FrameScore,
    LightCurve,
    MotionCurve,
    ReportInput,
    SceneFigures,
    StageOutcome,
    StageRecord,
    frames_to_picture,
    scene_figures,
)
from tasks.report.findings import Finding, findings
from tasks.report.limits import LIMITS, Limits
from tasks.report.page import page_text
from tasks.report.record import report_json

__all__ = [
    "Comparison",
    "Finding",
    "FrameScore",
    "LightCurve",
    "Limits",
    "MotionCurve",
    "ReportFiles",
    "ReportInput",
    "SceneFigures",
    "StageOutcome",
    "StageRecord",
    "findings",
    "frames_to_picture",
    "scene_figures",
    "write_report",
]

JSON_NAME = "report.json"
PAGE_NAME = "report.html"


@dataclass(frozen=True)
class ReportFiles:
    """What `write_report` wrote."""

    json: Path
    page: Path


def write_report(report: ReportInput, folder: Path, *, limits: Limits = LIMITS) -> ReportFiles:
    """Write report.json and report.html into `folder`, which is made where it is missing.

    Each file is replaced in one step. Raises FileNotFoundError for a picture that is not there, ValueError for one
    that cannot be read or does not match its counterpart.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = ReportFiles(folder / JSON_NAME, folder / PAGE_NAME)
    text = page_text(report, limits)
    write_json(files.json, report_json(report, limits))
    with whole_file(files.page) as partial, naming(files.page):
        partial.write_text(text, encoding="utf-8")
    return files
