"""Whether a result may be delivered, in one sentence: why, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from tasks.report.facts import ReportInput
from tasks.report.findings import Finding, Severity
from tasks.report.limits import Limits
from tasks.report.summary import summary

WORDS = frozenset({"The", "What", "Renders", "Cure", "Take", "Remove", "Check", "Write", "Allow", "See"})
"""With which findings that block a delivery begin, and their cures; anything else may be a name"""


class Fitness(StrEnum):
    """What is said of a result as a whole."""

    FIT = "fit for delivery"
    UNFIT = "not fit for delivery"
    UNJUDGED = "not judged"


@dataclass(frozen=True)
class Verdict:
    """What is said of a result as a whole, and why."""

    fitness: Fitness
    text: str
    """One sentence for people"""


def verdict(report: ReportInput, limits: Limits, found: Sequence[Finding]) -> Verdict:
    """Unfit where a finding blocks a delivery; not judged where that cannot be known."""
    blocks = [finding for finding in found if finding.severity is Severity.BLOCKS]
    if blocks:
        return Verdict(Fitness.UNFIT, _unfit(blocks))
    if reason := _unknown(report):
        return Verdict(Fitness.UNJUDGED, f"Not judged: {reason}.")
    return Verdict(Fitness.FIT, _fit(report, limits, found))


def _unfit(blocks: Sequence[Finding]) -> str:
    more = len(blocks) - 1
    others = f" ({more} more reason{'s' * (more > 1)} below)" if more else ""
    return f"Not fit for delivery: {_inner(blocks[0].text)}{others}; to do: {_inner(blocks[0].cure)}."


def _inner(sentence: str) -> str:
    """A sentence as part of another one; what may be a name keeps its capital."""
    text = sentence.rstrip(".")
    lower = text.split(" ", 1)[0] in WORDS
    return text[:1].lower() + text[1:] if lower else text


def _unknown(report: ReportInput) -> str:
    if report.scene is None:
        return "the run did not come to a scene file; run it to its end"
    if not report.scores:
        return "no picture was compared with what was filmed; run to the stage evaluate"
    if not report.held_out:
        return "all scored cameras were fitted, which says nothing about other views; run again with --hold-out"
    if report.scene.verified is None:
        return "nobody compared the scene file with the fit; run to the stage verify"
    return ""


def _fit(report: ReportInput, limits: Limits, found: Sequence[Finding]) -> str:
    level = summary(report)["psnr_db"]
    doubts = sum(finding.severity is Severity.DOUBT for finding in found)
    look = f"; {doubts} thing{'s deserve' if doubts > 1 else ' deserves'} a look first" if doubts else ""
    return (
        f"Fit for delivery: cameras that were never fitted see {level:.2f} dB on average, at least {limits.psnr_db:g} "
        f"were asked for, and every frame decodes to what was fitted{look}."
    )
