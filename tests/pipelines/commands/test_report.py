"""`packuv report`: two runs side by side, all runs of a folder, and one sentence for what is no run."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.cli import main
from tasks.report.compare import FIGURES, Difference, differences
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


def test_the_page_of_a_comparison_shows_what_differs_and_stands_alone(tmp_path: Path) -> None:
    a, b = write_run(tmp_path / "a", 25.0, command="<b>"), write_run(tmp_path / "<i>b", 18.5, seconds=6.0)
    page = tmp_path / "ab.html"
    assert main(["report", "--compare", str(a), str(b), "--output", str(page)]) == 0
    text = page.read_text()
    assert text.count('class="verdict unjudged"') == text.count('class="verdict unfit"') == 1
    assert "PSNR over time" in text
    assert '<td class="bad">-6.5</td>' in text  # dB, which are lost
    assert '<td class="good">-54</td>' in text  # seconds, which are gained
    assert "iterations" not in text  # the same in both
    assert "<i>b" not in text
    assert not re.search(r"<script|<link|@import|url\(|https?://(?!www.w3.org/2000/svg)", text)
    assert main(["report", "--compare", str(a), str(a), "--output", str(page)]) == 0
    assert "Nothing differs" in page.read_text()
    assert main(["report", str(a), "--output", str(page)]) == 2


@given(st.floats(-50, 50), st.floats(-50, 50), st.sampled_from(sorted(FIGURES)))
def test_what_is_better_there_is_worse_back(a: float, b: float, name: str) -> None:
    there, back = (Difference("figure", FIGURES[name].told, *pair) for pair in ((a, b), (b, a)))
    assert there.better == -back.better
    assert Difference("figure", FIGURES[name].told, a, a).better == 0
    assert Difference("figure", FIGURES[name].told, None, a).better == 0


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


def test_a_report_that_lacks_something_harms_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b, c = (write_run(tmp_path / name, 25.0) for name in "abc")
    told = json.loads((b / "report.json").read_text())
    (b / "report.json").write_text(json.dumps({**told, "findings": None}))
    (c / "report.json").write_text(json.dumps({"run": {}, "summary": {}, "scores": [], "findings": []}))
    assert main(["report", "--compare", str(a), str(b)]) == 2
    assert "must be a report.json as packuv writes it" in capsys.readouterr().err
    assert main(["report", "--compare", str(a), str(c)]) == 0
    capsys.readouterr()
    assert main(["report", "--dataset", str(tmp_path), "--json"]) == 0
    lines = {line["name"]: line for line in json.loads(capsys.readouterr().out)["sequences"]}
    assert [lines[name]["status"] for name in "abc"] == ["finished", "failed", "finished"]
    assert [lines[name]["psnr_db"] for name in "abc"] == [25.0, None, None]
