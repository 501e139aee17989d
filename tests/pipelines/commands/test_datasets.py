"""`packuv manifest`: what it prints, and its exit codes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pipelines.cli import INTERRUPTED, OK, WRONG, main
from pipelines.commands import datasets
from pipelines.manifest import read_manifest
from tests.support.places import ROOT

GOLDEN = ROOT / "tests/golden/capture"


@pytest.fixture
def data_set(tmp_path: Path) -> Path:
    """A capture that is well, and one whose settings are not."""
    for place in ("hall", "yard"):
        shutil.copytree(GOLDEN, tmp_path / "set" / place)
    (tmp_path / "set/yard/capture.toml").write_text("colour = 3")
    return tmp_path / "set"


def test_a_table_has_a_line_per_sequence(data_set, tmp_path, capsys):
    file = tmp_path / "set.parquet"
    assert main(["manifest", str(data_set), "-o", str(file)]) == OK
    told = capsys.readouterr()
    hall, yard = (line for line in told.out.splitlines() if line.startswith("│"))
    assert [cell.strip() for cell in hall.strip("│").split("│")] == [
        *("tiny", "5", "6", "96x64", "30", "0.2 s", "calibration", "synthetic, ring", "")
    ]
    assert [cell.strip() for cell in yard.strip("│").split("│")] == ["yard", *[""] * 7, "capture"]
    assert f"yard: {data_set / 'yard/capture.toml'}: unknown key 'colour'" in told.out
    assert told.out.splitlines()[-1].startswith(f"{file}: 2 sequences of 0.2 s, 5 videos, 30 frames, 35.6 kB")
    assert told.err == "packuv: 1 of 2 captures have problems\n"


def test_json_has_the_rows_by_sequence(data_set, tmp_path, capsys):
    file = tmp_path / "set.parquet"
    assert main(["manifest", str(data_set), "-o", str(file), "--json"]) == OK
    facts = json.loads(capsys.readouterr().out)
    assert facts["dataset"] == str(data_set)
    hall, yard = facts["sequences"]
    assert (hall["sequence"], hall["capture"], hall["problem"]) == ("tiny", str(data_set / "hall"), None)
    assert hall["tags"] == ["synthetic", "ring"]
    rows = read_manifest(file).rows
    assert [camera["digest"] for camera in hall["cameras"]] == [row.digest for row in rows[:5]]
    assert yard["cameras"] == []
    assert "unknown key 'colour'" in yard["problem"]


def test_without_a_usable_capture_it_fails_and_leaves_the_file(data_set, tmp_path, capsys):
    shutil.rmtree(data_set / "hall")
    file = tmp_path / "set.parquet"
    assert main(["manifest", str(data_set), "-o", str(file)]) == WRONG
    error = capsys.readouterr().err
    assert error.startswith("packuv: none of 1 captures can be processed; the first: ")
    assert len(error.splitlines()) == 1
    assert len(read_manifest(file).rows) == 1


def test_wrong_places_are_told_before_anything_is_read(data_set, tmp_path, capsys, monkeypatch):
    for words, message in (
        ([str(tmp_path / "nowhere"), "-o", str(tmp_path / "a.parquet")], "no folder"),
        ([str(tmp_path / "set/hall/videos"), "-o", str(tmp_path / "a.parquet")], "must hold capture folders"),
        ([str(data_set), "-o", str(tmp_path / "nowhere/a.parquet")], "make it first"),
        ([str(data_set), "-o", str(data_set)], "is a folder"),
        ([str(data_set)], "the following arguments are required: -o"),
    ):
        assert main(["manifest", *words]) == WRONG
        told = capsys.readouterr()
        assert told.out == ""
        assert message in told.err
    assert not list(tmp_path.glob("*.parquet"))


def test_an_interrupt_has_its_code(data_set, tmp_path, capsys, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(datasets, "update", interrupted)
    assert main(["manifest", str(data_set), "-o", str(tmp_path / "a.parquet")]) == INTERRUPTED


def test_names_cannot_command_the_terminal(data_set, tmp_path, capsys):
    shutil.copytree(data_set / "yard", data_set / "\x1b[2J[red]")
    assert main(["manifest", str(data_set), "-o", str(tmp_path / "a.parquet")]) == OK
    told = capsys.readouterr()
    assert "\x1b" not in told.out + told.err
    assert "[red]" in told.out
