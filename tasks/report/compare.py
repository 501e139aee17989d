"""Two runs side by side: in what their reports differ, and the page that shows it.

templates/compare.html.j2 lays it out, and escapes all text. A report here is what report.json holds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, NamedTuple

from markupsafe import Markup

from tasks.report.facts import FrameScore, mean_by_frame
from tasks.report.page import templates
from tasks.report.plots import Series, line_chart
from tasks.report.verdict import Fitness

Report = Mapping[str, Any]


class Figure(NamedTuple):
    """One of a summary."""

    told: str
    better: int = 0
    """1: more is better, -1: less is; 0: neither"""


FIGURES = {
    "psnr_db": Figure("PSNR, dB", 1),
    "psnr_moving_db": Figure("PSNR where it moves, dB", 1),
    "psnr_still_db": Figure("PSNR where it is still, dB", 1),
    "foreground_db": Figure("PSNR of the foreground, dB", 1),
    "foreground_ssim": Figure("SSIM of the foreground", 1),
    "foreground_lpips": Figure("LPIPS of the foreground", -1),
    "ssim": Figure("SSIM", 1),
    "fitted_psnr_db": Figure("PSNR of fitted cameras, dB"),
    "fitted_gap_db": Figure("fitted above unseen cameras, dB", -1),
    "tof_px": Figure("tOF, px", -1),
    "flicker": Figure("flicker", -1),
    "lpips": Figure("LPIPS", -1),
    "mb_per_30_frames": Figure("MB per 30 frames", -1),
    "frames": Figure("frames"),
    "seconds": Figure("total time, s", -1),
    "peak_memory_bytes": Figure("peak memory, bytes", -1),
    "scored_cameras": Figure("scored cameras"),
    "held_out": Figure("held-out cameras"),
    "verified": Figure("decodes exactly"),
}
BETTER = {figure.told: figure.better for figure in FIGURES.values()}
KINDS = {
    "figure": "Figures",
    "camera": "Cameras",
    "finding": "Findings of one of the two",
    "setting": "Settings",
    "stage version": "Versions of stages",
    "version": "Versions of software",
}
"""Of differences, and their headings, in the order of the page"""


@dataclass(frozen=True)
class Difference:
    """Something in which two runs differ; None where a run lacks it."""

    kind: str
    """One of KINDS"""
    name: str
    a: Any
    b: Any

    @property
    def change(self) -> float | None:
        """B - A, where both are figures."""
        sides = (self.a, self.b)
        numbers = [value for value in sides if isinstance(value, int | float) and not isinstance(value, bool)]
        return numbers[1] - numbers[0] if len(numbers) == 2 and self.kind in ("figure", "camera") else None

    @property
    def better(self) -> int:
        """1: B is better, -1: worse, 0: nobody can tell."""
        sense, change = 1 if self.kind == "camera" else BETTER.get(self.name, 0), self.change or 0
        return sense * ((change > 0) - (change < 0))


def differences(a: Report, b: Report) -> Iterator[Difference]:
    """What differs between two reports: settings, versions, of stages too, figures, cameras' scores, findings; in this
    order."""
    for kind, name in (("setting", "options"), ("version", "versions")):
        yield from _fields(kind, _flat(a["run"].get(name) or {}), _flat(b["run"].get(name) or {}))
    yield from _fields("stage version", *(report["run"].get("stage_versions", {}) for report in (a, b)))
    yield from _fields("figure", *(_figures(report) for report in (a, b)))
    yield from _fields("camera", _levels(a), _levels(b))
    texts = [[finding["text"] for finding in report["findings"]] for report in (a, b)]
    only = [[text for text in own if text not in other] for own, other in (texts, texts[::-1])]
    yield from (Difference("finding", "", first, second) for first, second in zip_longest(*only))


def _figures(report: Report) -> dict[str, Any]:
    return {figure.told: report["summary"].get(name) for name, figure in FIGURES.items()}


def _fields(kind: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[Difference]:
    for name in dict.fromkeys([*a, *b]):
        if a.get(name) != b.get(name):
            yield Difference(kind, name, a.get(name), b.get(name))


def _flat(tree: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= _flat(value, f"{place}{name}.") if isinstance(value, Mapping) else {f"{place}{name}": value}
    return found


def _levels(report: Report) -> dict[str, float]:
    """Mean PSNR of each scored camera, dB."""
    levels: dict[str, list[float]] = {}
    for score in report["scores"]:
        levels.setdefault(f"PSNR of {score['camera']}, dB", []).append(score["psnr_db"])
    return {name: sum(own) / len(own) for name, own in levels.items()}


def verdict_text(report: Report) -> str:
    """The verdict, one sentence."""
    text: str = (report.get("verdict") or {"text": "Written before there were verdicts."})["text"]
    return text


def _style(report: Report) -> str:
    said = (report.get("verdict") or {}).get("fitness")
    return next((fitness.name.lower() for fitness in Fitness if fitness == said), "unjudged")


def shown(value: Any) -> str:
    """A value of a report for people."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def page_text(a: Report, b: Report, *, names: tuple[str, str]) -> str:
    """The whole page as HTML; `names` are what the runs are called."""
    found = list(differences(a, b))
    groups = {kind: [item for item in found if item.kind == kind] for kind in KINDS}
    return (
        templates()
        .get_template("compare.html.j2")
        .render(
            sides=[
                {
                    "letter": letter,
                    "name": name,
                    "verdict": verdict_text(report),
                    "style": _style(report),
                    "report": report,
                }
                for letter, name, report in zip("AB", names, (a, b), strict=True)
            ],
            groups=[(KINDS[kind], items) for kind, items in groups.items() if items],
            levels=_chart("PSNR over time", "PSNR, dB", [_by_frame(report) for report in (a, b)]),
            sizes=_chart("Size over time", "MB", [_sizes(report) for report in (a, b)]),
            shown=shown,
        )
    )


def _by_frame(report: Report) -> dict[int, float]:
    scores = [FrameScore(item["camera"], item["frame"], item["psnr_db"], item["ssim"]) for item in report["scores"]]
    return mean_by_frame(scores)


def _sizes(report: Report) -> dict[int, float]:
    sizes: Sequence[int] = (report.get("scene") or {}).get("frame_bytes", ())
    return {report["every"] * place: size / 1e6 for place, size in enumerate(sizes)}


def _chart(title: str, unit: str, curves: Sequence[Mapping[int, float]]) -> Markup | None:
    """Of two curves by frame; None where there is none."""
    lines = [
        Series(letter, list(curve), list(curve.values()), style)
        for letter, style, curve in zip("AB", ("s1", "s2"), curves, strict=True)
        if curve
    ]
    return line_chart(lines, title=title, x_label="frame", y_label=unit, height=240) if lines else None
