"""`packuv report`: two runs side by side, all runs of a folder, and one sentence for what is no run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.cli import main
from pipelines.commands.report import differences
from tasks.report.facts import FrameScore, ReportInput
from tasks.report.write import write_report


def write_run(folder: Path, level_db: float, **changes: object) -> Path:
    """What a run leaves of which only the report is read."""
    scores = tuple(FrameScore("cam1", frame, level_db, 0.9) for frame in range(4))
    report = ReportInput(folder.name, options={"fit": {"iterations": 900}}, seconds=60.0, scores=scores)
    write_report(replace(report, held_out=("cam1",), **changes), folder)  # type: ignore[arg-type]  # by name
    ended = {"sequence": folder.name, "outcome": "finished", "reason": "", "finished": "2026-11-29T08:00:00+00:00"}
    (folder / "run.json").write_text(json.dumps(ended))
    return folder


def test_a_run_differs_from_itself_in_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "a", 25.0)
    assert main(["report", "--compare", str(run), str(run / "report.json")]) == 0
    assert "nothing differs" in capsys.readouterr().out


def test_two_runs_differ_in_what_was_set_what_came_and_what_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a = write_run(tmp_path / "a", 25.0)
    b = write_run(
        tmp_path / "b", 18.5, options={"fit": {"iterations": 90}}, seconds=6.0, stage_versions={"background": 9}
    )
    assert main(["report", "--compare", str(a), str(b), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["differences"]
    told = {item["name"]: (item["a"], item["b"]) for item in found}
    assert told["fit.iterations"] == (900, 90)
    assert told["PSNR, dB"] == told["PSNR of cam1, dB"] == (25.0, 18.5)
    assert told["background"] == (None, 9)
    assert told["total time, s"] == (60.0, 6.0)
    assert next(item["b"] for item in found if item["kind"] == "finding").startswith("The mean of 18.5 dB")
    one, two = (json.loads((folder / "report.json").read_text()) for folder in (a, b))
    there, back = list(differences(one, two)), list(differences(two, one))
    assert [(item.name, item.a, item.b) for item in there] == [(item.name, item.b, item.a) for item in back]


def test_a_data_set_lists_every_run_with_its_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path / "good", 25.0)
    write_run(tmp_path / "poor", 15.0)
    failed = {"sequence": "lost", "outcome": "failed", "reason": "the disk is full", "finished": ""}
    (tmp_path / "lost").mkdir()
    (tmp_path / "lost" / "run.json").write_text(json.dumps(failed))
    assert main(["report", "--dataset", str(tmp_path), "--json"]) == 0
    lines = {line["name"]: line for line in json.loads(capsys.readouterr().out)["sequences"]}
    assert {name: line["status"] for name, line in lines.items()} == {
        "good": "finished",
        "poor": "finished",
        "lost": "failed",
    }
    assert lines["poor"]["verdict"].startswith("Not fit for delivery")
    page = (tmp_path / "report.html").read_text()
    assert all(text in page for text in ("the disk is full", lines["poor"]["verdict"], 'href="poor/report.html"'))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["report"], "report needs the folder of a run"),
        (["report", "{}"], "must be the folder of a run that ended, but has no run.json"),
        (["report", "{}", "--set", "fit.iterations=5"], "only report.NAME may be set"),
        (["report", "--compare", "{}", "{}"], "must be the folder of a run or its report.json"),
        (["report", "--dataset", "{}"], "must be the output folder of runs"),
        (["report", "--dataset", "{}/none"], "no folder"),
    ],
)
def test_what_is_no_run_is_said_in_a_sentence(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word.format(tmp_path) for word in words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
