"""`packuv plan`: before a run all of it is ahead, after it nothing, in between what is left; and nothing is written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipelines import space
from pipelines.ahead import look_ahead
from pipelines.cli import FAILED, OK, WRONG, main
from pipelines.forecast import Guess, Machine, forecast
from pipelines.options import SequenceOptions
from pipelines.probe import PROBE
from pipelines.request import RunRequest
from tests.pipelines.commands.test_run import CAPTURE, _flat
from tests.support.golden import SETTINGS
from tests.support.sounds import write_video

SETS = [part for name, value in _flat(SETTINGS) for part in ("--set", f"{name}={value}")]
HOW = ["--preset", "draft", "--hold-out", "cam03", *SETS]


def planned(out: Path, capsys: pytest.CaptureFixture[str], *more: str, code: int = OK) -> dict[str, Any]:
    """What `packuv plan --json` says of the tiny capture."""
    capsys.readouterr()
    assert main(["plan", str(CAPTURE), "--out", str(out), *HOW, *more, "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def does(found: dict[str, Any]) -> dict[str, str]:
    return {step["stage"]: step["does"] for step in found["stages"]}


def test_what_is_ahead_shrinks_as_a_run_goes_on(tmp_path, capsys):
    before = planned(tmp_path / "new", capsys)
    assert set(does(before).values()) == {"runs"}
    assert before["minutes_left"] == before["minutes_in_all"]
    assert before["minutes_left"][0] < before["minutes_left"][1]
    assert before["cameras"] == {"fitted": 4, "held_out": 1}
    assert not (tmp_path / "new").exists(), "a plan leaves nothing where nothing was"

    run = ["run", str(CAPTURE), "--out", str(tmp_path), "--direct", *HOW]
    assert main([*run, "--stop-after", "flow"]) == OK
    half = planned(tmp_path, capsys)
    assert does(half) == {
        **dict.fromkeys(("sync", "calibrate", "flow"), "there already"),
        **dict.fromkeys(("fit", "encode", "verify", "evaluate"), "runs"),
    }
    assert half["minutes_left"] < before["minutes_left"]
    (folder,) = (path.parent for path in tmp_path.glob(f"*/{PROBE}"))
    assert "LPIPS" in {item["what"] for item in half["spared"]}

    assert main(run) == OK
    whole = planned(tmp_path, capsys)
    assert set(does(whole).values()) == {"there already"}
    assert whole["minutes_left"] == [0, 0]

    # Whoever looked before a run finds the forecast beside the fact, however short the run.
    report = json.loads((folder / "report.json").read_text())
    rows = {row["what"]: row for row in report["run"]["forecast"]}
    total, there = rows["total time, with what was there before"], ("sync", "calibrate", "flow")
    assert total["forecast"] > 0
    before_it = sum(rows[stage]["fact"] for stage in there)
    assert total["fact"] == pytest.approx(report["summary"]["seconds"] / 60 + before_it, rel=1e-3)
    assert rows["scene file"]["fact"] == (folder / "scene.mkv").stat().st_size / 1e6


@pytest.mark.parametrize(("free", "told"), [(9, "are free\n"), (1, "are free; the CPU does what does not fit\n")])
def test_where_a_gpu_fits_its_memory_is_planned_too(tmp_path, capsys, monkeypatch, free, told):
    """Without it nobody asks how much there is."""
    assert planned(tmp_path, capsys)["gpu_memory_bytes"] == 0
    assert "GPU" not in whole_plan(tmp_path, capsys)
    monkeypatch.setattr("pipelines.process.choose_device", lambda asked: "cuda")
    monkeypatch.setattr("packuv.fit.gpu_memory.memory_of_gpu", lambda: (free * 10**9, 10**10))
    needed = planned(tmp_path, capsys)["gpu_memory_bytes"]
    assert 1e9 < needed < 2e9
    text = whole_plan(tmp_path, capsys)
    assert f"GPU        {needed / 1e9:.1f} GB for the largest fit, {free}.0 GB of 10.0 GB {told}" in text


def whole_plan(out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What `packuv plan` says to people."""
    assert main(["plan", str(CAPTURE), "--out", str(out), *HOW]) == OK
    return capsys.readouterr().out


def test_what_the_disk_cannot_hold_is_the_last_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(space, "free_bytes", lambda path: 1000)
    assert main(["plan", str(CAPTURE), "--out", str(tmp_path), *HOW]) == FAILED
    told = capsys.readouterr()
    assert "evaluate" in told.out
    assert "are free; free some, or choose another --out" in told.err
    assert not list(tmp_path.iterdir())


def test_a_folder_of_captures_is_planned_as_a_batch_is(tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(CAPTURE, tmp_path / "shoot" / name)
        (tmp_path / "shoot" / name / "capture.toml").write_text(f'name = "{name}"\n')
    out = tmp_path / "out"
    how = ["--preset", "draft", *SETS, "--at-once", "1"]
    assert main(["plan", str(tmp_path / "shoot"), "--out", str(out), *how, "--json"]) == OK
    found = json.loads(capsys.readouterr().out)
    assert [(row["sequence"], row["does"], row["why"]) for row in found["sequences"]] == [
        ("a", "runs", "new"),
        ("b", "runs", "new"),
    ]
    assert found["minutes"] == pytest.approx(
        sum(step["minutes"] for row in found["sequences"] for step in row["plan"]["stages"]), abs=0.02
    )


@pytest.mark.parametrize(
    ("source", "more", "message"),
    [
        ("nowhere", [], "nowhere"),
        (str(CAPTURE), ["--tags", "a"], "this is one capture"),
        (str(CAPTURE), ["--set", "fit.iteration=3"], "iteration"),
    ],
)
def test_what_cannot_be_planned_is_one_sentence(tmp_path, capsys, source, more, message):
    assert main(["plan", source, "--out", str(tmp_path), *more]) == WRONG
    assert message in capsys.readouterr().err


def still(folder: Path) -> Path:
    """A capture in which nothing moves or sounds."""
    (folder / "videos").mkdir(parents=True)
    for name in ("cam1", "cam2", "cam3"):
        write_video(folder / "videos" / f"{name}.mkv", None)
    return folder


def cut_short(folder: Path) -> Path:
    """A capture whose last camera has a time too few."""
    still(folder)
    (folder / "timecodes").mkdir()
    for count, name in ((20, "cam1"), (20, "cam2"), (19, "cam3")):
        lines = [f"frame_{1_700_000_000_000_000 + k * 100_000}_{k:012d}\n" for k in range(count)]
        (folder / "timecodes" / f"{name}.txt").write_text("".join(lines))
    return folder


def with_lenses(folder: Path, *names: str) -> Path:
    """A capture of which lenses are known, and no poses."""
    (still(folder) / "calibration").mkdir()
    lens = "!!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]\n"
    text = "%YAML:1.0\n---\nnames:\n" + "".join(f'  - "{name}"\n' for name in names)
    (folder / "calibration" / "intri.yml").write_text(text + "".join(f"K_{name}: {lens}" for name in names))
    return folder


def one_without_a_lens(folder: Path) -> Path:
    return with_lenses(folder, "cam1", "cam2")


def a_strange_calibration(folder: Path) -> Path:
    (still(folder) / "calibration").mkdir()
    (folder / "calibration" / "transforms.json").write_text('{"frames": []}')
    return folder


def borrowing(lender: Callable[[Path], Path]) -> Callable[[Path], Path]:
    """A capture whose rig is that of another one."""

    def made(folder: Path) -> Path:
        lender(folder.with_name("lender"))
        (still(folder) / "capture.toml").write_text('rig_from = "lender"')
        return folder

    return made


@pytest.mark.parametrize(
    ("capture", "more", "message"),
    [
        (one_without_a_lens, [], "videos without one: cam3"),
        (a_strange_calibration, [], "transforms.json"),
        (still, ["--clock", "content"], "do not tell when cam1, cam2, cam3 began to film"),
        (cut_short, [], "19 timecodes"),
        (borrowing(one_without_a_lens), [], "videos without one: cam3"),
        (borrowing(a_strange_calibration), [], "transforms.json"),
        (borrowing(cut_short), [], "19 timecodes"),
        (still, ["--frames", "50:60"], "the capture has instants 0 to 19"),
    ],
)
def test_a_plan_refuses_what_its_run_refuses(tmp_path, capsys, capture, more, message):
    source = str(capture(tmp_path / "take"))
    told = []
    for command in (["plan"], ["run", "--direct"]):
        assert main([command[0], source, "--out", str(tmp_path / "out"), *command[1:], *more]) == WRONG
        told.append(capsys.readouterr().err.strip().splitlines()[-1])
        if command[0] == "plan":
            assert not (tmp_path / "out").exists(), "a plan leaves nothing where nothing was"
    assert told[0] == told[1]
    assert message in told[0]


def test_a_take_of_another_shape_than_the_one_whose_rig_it_uses_cannot_be_planned(tmp_path, capsys):
    lender, take = shutil.copytree(CAPTURE, tmp_path / "lender"), tmp_path / "take"
    (take / "videos").mkdir(parents=True)
    for video in (lender / "videos").iterdir():
        write_video(take / "videos" / f"{video.stem}.mkv", None)  # square
    (take / "capture.toml").write_text('rig_from = "lender"')
    assert main(["plan", str(take), "--out", str(tmp_path / "out")]) == WRONG
    assert "must film in the shape it was calibrated in" in capsys.readouterr().err


def test_the_rig_of_another_take_is_forecast_until_it_is_there(tmp_path, capsys):
    lender, take, out = (tmp_path / name for name in ("lender", "take", "out"))
    for folder in (lender, take):
        shutil.copytree(CAPTURE, folder)
    text = (take / "capture.toml").read_text()
    (lender / "capture.toml").write_text(text.replace('"tiny"', '"lender"'))
    (take / "capture.toml").write_text(f'{text}\nrig_from = "lender"')
    asked = RunRequest(str(take), str(out), stop_after="calibrate")
    size = look_ahead(asked).size
    assert size.lender is not None
    assert len(size.lender.fitted) == len(size.fitted) + len(size.held_out)
    assert not size.lender.solved
    (with_it, without), options = (size, replace(size, lender=None)), SequenceOptions()
    seconds = [forecast(one, options, Machine(Guess())).seconds["calibrate"] for one in (with_it, without)]
    assert seconds[0] > seconds[1]
    assert main(["run", str(lender), "--out", str(out), "--direct", "--stop-after", "calibrate"]) == OK
    assert look_ahead(asked).size == without


def test_a_rig_that_is_to_be_solved_is_forecast_and_told(tmp_path, capsys):
    def plan(capture: Path) -> tuple[float, list[str]]:
        out = tmp_path / f"of {capture.name}"
        out.mkdir()
        assert main(["plan", str(capture), "--out", str(out), "--stop-after", "calibrate", *SETS, "--json"]) == OK
        found = json.loads(capsys.readouterr().out)
        (minutes,) = (step["minutes"] for step in found["stages"] if step["stage"] == "calibrate")
        return minutes, [*found["not_in_the_forecast"], *(item["what"] for item in found["spared"])]

    given = shutil.copytree(CAPTURE, tmp_path / "given")
    bare = shutil.copytree(CAPTURE, tmp_path / "bare")
    shutil.rmtree(bare / "calibration")
    known = with_lenses(tmp_path / "known", "cam1", "cam2", "cam3")
    (least, told), (more, told_more), (_, told_lenses) = map(plan, (given, bare, known))
    assert least < more
    assert "solving the cameras" in told
    counted = "have to be solved by COLMAP, which is counted as from"
    assert any(f"cameras {counted} one instant " in text for text in told_more)
    assert any(f"of which the lenses alone are known, {counted} 4 instants " in text for text in told_lenses)


def test_a_sequence_that_its_run_would_refuse_does_not_stop_the_plan_of_the_others(tmp_path, capsys):
    shutil.copytree(CAPTURE, tmp_path / "shoot" / "a")
    (tmp_path / "shoot" / "a" / "capture.toml").write_text('name = "a"\n')
    cut_short(tmp_path / "shoot" / "b")
    how = ["--preset", "draft", *SETS, "--at-once", "1"]
    assert main(["plan", str(tmp_path / "shoot"), "--out", str(tmp_path / "out"), *how, "--json"]) == OK
    rows = json.loads(capsys.readouterr().out)["sequences"]
    assert [(row["sequence"], row["does"]) for row in rows] == [("a", "runs"), ("b", "bad input")]
    assert "19 timecodes" in rows[1]["why"]
