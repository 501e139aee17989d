"""The page of a data set: a row for each sequence, the worst first. It needs nothing but itself.

templates/dataset.html.j2 lays it out, and escapes all text.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from urllib.request import pathname2url

from tasks.report.page import Card, duration, templates

ORDER = ("failed", "bad input", "killed", "cancelled", "running", "finished", "waiting")
"""From what needs a look to what does not"""
BAD = ORDER[:3]


@dataclass(frozen=True)
class Line:
    """One sequence, as the page shows it; None where a figure is not known."""

    name: str
    status: str
    """One of ORDER"""
    reused: bool = False
    psnr_db: float | None = None
    ssim: float | None = None
    unseen: bool = False
    """Scored on cameras that were never fitted"""
    mb_per_frame: float | None = None
    frames: int | None = None
    hours: float | None = None
    findings: int | None = None
    """What in its report a person should look at"""
    preset: str = ""
    finished: str = ""
    """UTC, ISO 8601"""
    reason: str = ""
    verdict: str = ""
    """Of its report, one sentence"""
    report: str | None = None
    """Path, relative to the page"""
    scene: str | None = None
    """Likewise"""

    @property
    def bad(self) -> bool:
        """Somebody has to do something."""
        return self.status in BAD

    @property
    def rank(self) -> int:
        """Place of its status, the worst first."""
        return ORDER.index(self.status)


def page_text(name: str, lines: Sequence[Line], *, subtitle: str, goes_on: bool) -> str:
    """The whole page as HTML; while the batch `goes_on` it loads itself again from time to time."""
    ordered = sorted(lines, key=lambda line: (line.rank, math.inf if line.psnr_db is None else line.psnr_db, line.name))
    page = templates().get_template("dataset.html.j2")
    return page.render(
        name=name,
        subtitle=subtitle,
        cards=_cards(lines),
        lines=ordered,
        goes_on=goes_on,
        href=lambda path: pathname2url(str(PurePath(path))),
    )


def _cards(lines: Sequence[Line]) -> list[Card]:
    count = {status: sum(line.status == status for line in lines) for status in ORDER}
    bad, levels = sum(count[status] for status in BAD), _known(line.psnr_db for line in lines)
    sizes, hours = _known(line.mb_per_frame for line in lines), _known(line.hours for line in lines)
    unseen = all(line.unseen for line in lines if line.psnr_db is not None)
    under_way = [f"{count[status]} {status}" for status in ("running", "waiting", "cancelled") if count[status]]
    return [
        Card(f"{count['finished']}", ", ".join([f"of {len(lines)} finished", *under_way]), "" if bad else "good"),
        Card(f"{bad}", "failed", "bad" if bad else ""),
        Card(
            f"{_mean(levels):.2f} dB" if levels else "–", f"mean PSNR, {'unseen' if unseen else 'some fitted'} cameras"
        ),
        Card(f"{_mean(sizes):.3f} MB" if sizes else "–", "a frame, mean"),
        Card(f"{sum(line.frames or 0 for line in lines):,}", "frames"),
        Card(_hours(sum(hours)) if hours else "–", "to make what is finished"),
    ]


def _hours(hours: float) -> str:
    return f"{hours:,.0f} h" if hours > 10 else duration(3600 * hours)


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
