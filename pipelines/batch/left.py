"""What a run in another process left in the folder of its sequence, read back."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.process import Outcome
from pipelines.request import BAD_INPUT
from pipelines.results import event_of
from tasks.artefacts.recipe import restore
from tasks.artefacts.retention import RUN
from tasks.report.facts import Choice
from tasks.report.findings import Finding
from tasks.report.verdict import Verdict
from tasks.report.write import JSON_NAME, PAGE_NAME
from tasks.stages.encode import SCENE

RAISED = re.compile(r".*encountered an exception: (?P<kind>\w+): (?P<text>.*)", re.DOTALL)
"""How the workflow engine tells what a flow raised"""


def run_left(folder: Path, flow_run: str) -> dict[str, Any] | None:
    """run.json, if it is of this run; None where there is none (yet)."""
    try:
        run: dict[str, Any] = json.loads((folder / RUN).read_text())
    except (OSError, ValueError):
        return None
    return run if run.get("flow_run") == flow_run else None


def outcome_left(folder: Path, run: Mapping[str, Any]) -> Outcome:
    """Of a run that came to its end; raises OSError without its report."""
    report = json.loads((folder / JSON_NAME).read_text())
    return Outcome(
        folder=folder,
        scene=folder / SCENE if report["scene"] else None,
        report=folder / PAGE_NAME,
        figures=report["summary"],
        events=tuple(event_of(stage) for stage in run["stages"]),
        findings=restore(tuple[Finding, ...], report["findings"]),
        verdict=restore(Verdict | None, report.get("verdict")),
        choice=restore(Choice | None, report["run"]["choice"]),
    )


def error_left(run: Mapping[str, Any] | None, message: str) -> Exception:
    """Of a run that failed, as `pipelines.process.process` would raise it; `message` is what the engine says."""
    raised = RAISED.fullmatch(message)
    reason = (run or {}).get("reason") or (raised["text"] if raised else message) or "it failed without a word"
    bad = raised is not None and raised["kind"] in {kind.__name__ for given in BAD_INPUT for kind in _kinds(given)}
    return ValueError(reason) if bad else RuntimeError(reason)


def _kinds(kind: type[BaseException]) -> set[type[BaseException]]:
    return {kind, *(inner for one in kind.__subclasses__() for inner in _kinds(one))}
