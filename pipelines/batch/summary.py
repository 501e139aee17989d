"""What came out of a batch, in words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pipelines.batch.table import Result, Status
from pipelines.words import duration

MOST_FAILED = 20
"""That the terminal names at the end"""


@dataclass(frozen=True)
class Summary:
    """How a batch ended."""

    manifest: str
    page: Path
    table: Path
    results: tuple[Result, ...]
    """Of every sequence that was asked for"""
    seconds: float

    @property
    def failed(self) -> tuple[Result, ...]:
        """Every sequence that is not finished, whatever kept it from that."""
        return tuple(result for result in self.results if result.status is not Status.FINISHED)

    @property
    def verdict(self) -> str:
        """One sentence."""
        good = len(self.results) - len(self.failed)
        return f"{good} of {len(self.results)} sequences are finished"

    def lines(self) -> Iterator[str]:
        """The last lines of a batch: those that failed, with their reasons, come last."""
        yield f"{self.verdict}, after {duration(self.seconds)}{self._means()}"
        yield f"table      {self.table}"
        yield f"page       {self.page}"
        for result in self.failed[:MOST_FAILED]:
            yield f"{result.sequence}: {of_result(result)}"
        if len(self.failed) > MOST_FAILED:
            yield f"and {len(self.failed) - MOST_FAILED} more, on the page"

    def to_json(self) -> dict[str, Any]:
        """For `packuv batch --json`."""
        return {
            "manifest": self.manifest,
            "page": str(self.page),
            "table": str(self.table),
            "seconds": round(self.seconds, 3),
            "finished": len(self.results) - len(self.failed),
            "failed": [result.sequence for result in self.failed],
            "sequences": [asdict(result) for result in self.results],
        }

    def _means(self) -> str:
        levels = [result.psnr_db for result in self.results if result.psnr_db is not None]
        sizes = [result.mb_per_frame for result in self.results if result.mb_per_frame is not None]
        level = f"; mean {sum(levels) / len(levels):.2f} dB" if levels else ""
        return level + (f", {sum(sizes) / len(sizes):.3f} MB/frame" if sizes else "")


def of_result(result: Result) -> str:
    """One line on a sequence that ended.

    >>> of_result(Result("dance", "/runs", Status.FINISHED, psnr_db=28.714, unseen=True, seconds=724))
    'finished, 28.71 dB, 12 min 04 s'
    """
    if result.status is not Status.FINISHED:
        return f"{result.status}: {result.reason}" if result.reason else str(result.status)
    parts = [
        str(result.status),
        "" if result.psnr_db is None else f"{result.psnr_db:.2f} dB{'' if result.unseen else ' (fitted cameras)'}",
        "" if result.mb_per_frame is None else f"{result.mb_per_frame:.3f} MB/frame",
        "there already" if result.reused else duration(result.seconds),
    ]
    return ", ".join(part for part in parts if part)
