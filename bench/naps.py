"""A stage that takes its time and no computer: what `bench.scaling` spreads over workers."""

from __future__ import annotations

import time
from dataclasses import dataclass

from tasks.artefacts.stage import Notes, Stage, Work

FILE_BYTES = 100_000
"""Of an artefact, less than a segment has: how fast a disk is, is not the question"""


@dataclass(frozen=True, kw_only=True)
class Nap(Stage):
    """Sleep, telling how far it is each second, then write a file."""

    name, version = "nap", 1
    small = True
    number: int
    seconds: float

    @property
    def label(self) -> str:
        return f"nap {self.number}"

    def build(self, work: Work) -> Notes:
        start = time.monotonic()
        while (slept := time.monotonic() - start) < self.seconds:
            work.progress(slept, self.seconds)
            time.sleep(min(1.0, self.seconds - slept))
        (work.out / "nap.bin").write_bytes(bytes(FILE_BYTES))
        return {"slept_seconds": time.monotonic() - start}
