"""What a stage is told is checked before anything runs: mypy finds a fault between those who declare and who call."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.places import ROOT

CHAIN, FITTING = "pipelines/chain.py", "tasks/stages/fitting.py"
FAULTS = [
    (CHAIN, "FitFirst(take=self.take, instant=", "FitFirst(take=self.take, instnat=", "instnat"),
    (
        FITTING,
        "    def build(self, work: Work) -> Notes:\n        segment, figures",
        "    def biuld(self, work: Work) -> Notes:\n        segment, figures",
        'abstract class "FitSegment"',
    ),
    (
        CHAIN,
        "CutSegment(segment=segment.result(), frames=frame)",
        "CutSegment(frame, segment.result())",
        'Too many positional arguments for "CutSegment"',
    ),
    (
        CHAIN,
        "MeasureSeam(take=self.take, key=key, segment=segment.result(),",
        "MeasureSeam(take=self.take, key=key, segment=segment,",
        'Argument "segment" to "MeasureSeam"',
    ),
    (
        CHAIN,
        "self.options.fit.part(NextOptions)",
        "self.options.fit.part(FrameOptions)",
        'Argument "options" to "FitNext"',
    ),
]
"""File, what it says, what it might say by mistake, and what mypy must answer"""


@pytest.mark.slow
def test_mypy_finds_faults_between_stages(tmp_path: Path) -> None:
    for package in ("pipelines", "tasks", "packuv", "sync", "calibration", "studio"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    for file, right, wrong, _ in FAULTS:
        text = (tmp_path / file).read_text()
        assert text.count(right) == 1, f"{file} says otherwise now: {right}"
        (tmp_path / file).write_text(text.replace(right, wrong))
    command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), "-p", "pipelines"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    for *_, answer in FAULTS:
        assert re.search(rf"error: .*{re.escape(answer)}", done.stdout), f"{answer} is not in:\n{done.stdout}"
