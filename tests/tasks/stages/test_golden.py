"""Versions that cannot lie: a stage that makes something else of the same input has another version.

SolveRig and FindStarts are not watched: they need larger pictures and longer videos than a test can afford; nor is
FindMotionByRaft, whose sums torch orders by machine.
"""

from __future__ import annotations

import inspect
import json

import llvmlite.binding
import pytest

from tasks.artefacts.stage import Stage
from tasks.stages import calibrate, clock, content, encode, evaluate, fitting, light, preview, synchronize, track
from tests.support import golden
from tests.support.needs import needs

MODULES = (clock, synchronize, calibrate, light, track, content, fitting, preview, encode, evaluate)


@pytest.mark.slow
@needs("avx2", llvmlite.binding.get_host_cpu_features().get("avx2"), "the digests are those of AVX2 instructions")
def test_every_stage_makes_what_its_version_stands_for():
    before = json.loads(golden.RECORD.read_text())
    found = golden.problems(before, golden.measure())
    assert not found, (
        f"{'; '.join(f'{stage} {text}' for stage, text in found.items())}. Raise `version` of a stage whose results "
        "change, then run python -m tests.support.golden --write"
    )


def test_every_stage_is_recorded():
    kinds = {
        kind.__name__
        for module in MODULES
        for kind in vars(module).values()
        if inspect.isclass(kind) and issubclass(kind, Stage) and not inspect.isabstract(kind)
    }
    recorded = {name.split(",")[0] for name in json.loads(golden.RECORD.read_text())}
    assert kinds - recorded == {"SolveRig", "FindStarts", "FindMotionByRaft"}


ENTRY = {"version": 3, "inputs": "a", "outputs": "b"}


@pytest.mark.parametrize(
    ("now", "text"),
    [
        (ENTRY, None),
        ({**ENTRY, "outputs": "c"}, "still has version 3"),
        ({**ENTRY, "outputs": "c", "version": 4}, "write the record anew"),
        ({**ENTRY, "outputs": "c", "inputs": "d"}, "write the record anew"),
        (None, "no stage any more"),
    ],
)
def test_a_change_without_a_new_version_is_found(now, text):
    found = golden.problems({"Encode": ENTRY}, {} if now is None else {"Encode": now})
    assert (found == {}) if text is None else text in found["Encode"]


def test_a_record_is_not_written_over_a_lie(monkeypatch, tmp_path):
    record = tmp_path / "golden.json"
    record.write_text(json.dumps({"Encode": ENTRY}))
    monkeypatch.setattr(golden, "RECORD", record)
    monkeypatch.setattr(golden, "measure", lambda: {"Encode": {**ENTRY, "outputs": "c"}})
    with pytest.raises(ValueError, match="raise these versions first: Encode"):
        golden.write()
    assert json.loads(record.read_text()) == {"Encode": ENTRY}
