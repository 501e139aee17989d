"""A data set: which sequences run and why, one that fails harms no other, and again does only what is missing."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from pipelines.batch.plan import _capture_digest
from pipelines.batch.request import BatchRequest
from pipelines.batch.resources import sequences_at_once
from pipelines.batch.table import Result, ResultTable, Status
from pipelines.cli import FAILED, OK, WRONG, main
from pipelines.register import registered
from tests.support.places import ROOT

CAPTURE = ROOT / "tests" / "golden" / "capture"
GB = 10**9


@pytest.fixture
def dataset(tmp_path) -> Path:
    """Three captures, two of one name and one with a video that is cut short."""
    for place in ("day1/dance", "day2/dance", "day2/cut"):
        shutil.copytree(CAPTURE, tmp_path / "shoot" / place)
        settings = tmp_path / "shoot" / place / "capture.toml"
        lines = [line for line in settings.read_text().splitlines() if not line.startswith("name")]
        settings.write_text("\n".join(lines) + "\n")
    broken = tmp_path / "shoot/day2/cut/videos/cam02.mp4"
    broken.write_bytes(broken.read_bytes()[:400])
    return tmp_path / "shoot"


@pytest.fixture
def manifest(dataset, tmp_path, capsys) -> Path:
    path = tmp_path / "shoot.parquet"
    assert main(["manifest", str(dataset), "-o", str(path)]) == OK
    capsys.readouterr()
    return path


def words(manifest: Path, out: Path, *more: str) -> list[str]:
    asked = ["batch", str(manifest), "--out", str(out), "--preset", "draft", "--stop-after", "sync"]
    return [*asked, "--direct", "--at-once", "1", *more]


def plan(manifest: Path, out: Path, capsys, *more: str) -> dict[str, str]:
    """What would run, and why."""
    capsys.readouterr()
    assert main(words(manifest, out, "--dry-run", "--json", *more)) == OK
    return {
        step["sequence"]: step["why"] if step["does"] == "runs" else step["does"]
        for step in json.loads(capsys.readouterr().out)
    }


def rows(manifest: Path) -> dict[str, dict]:
    table = pq.read_table(manifest.with_name("shoot.results.parquet"))
    return {row["sequence"]: row for row in table.to_pylist()}


@pytest.mark.slow
def test_one_that_fails_harms_no_other_and_again_does_only_what_changed(dataset, manifest, tmp_path, capsys):
    out, told = tmp_path / "out", tmp_path / "told"
    assert main(words(manifest, out, "--notify", f'echo "$PACKUV_FAILED" > {told}')) == FAILED
    said = capsys.readouterr().out.splitlines()
    assert said[-1].startswith("cut: bad input: ")
    assert "cam02.mp4" in said[-1]
    assert told.read_text() == "cut\n"
    found = rows(manifest)
    assert {name: row["status"] for name, row in found.items()} == {
        "day1-dance": "finished",
        "day2-dance": "finished",
        "cut": "bad input",
    }
    for name in ("day1-dance", "day2-dance"):
        assert Path(found[name]["report"]) == out / name / "report.html"
        assert json.loads((out / name / "sequence.json").read_text())["capture"].endswith(name.replace("-", "/"))
    page = (out / "index.html").read_text()
    assert page.index("cut") < page.index("day1-dance")
    assert "day1-dance/report.html" in page

    done = {"day1-dance": "there already", "day2-dance": "there already", "cut": "bad input"}
    assert plan(manifest, out, capsys) == done
    stamp = (out / "day1-dance" / "report.json").stat().st_mtime_ns
    assert main(words(manifest, out)) == FAILED
    assert (out / "day1-dance" / "report.json").stat().st_mtime_ns == stamp
    assert rows(manifest)["day1-dance"]["reused"]
    capsys.readouterr()

    os.utime(dataset / "day1/dance/videos/cam01.mp4")
    assert plan(manifest, out, capsys) == {**done, "day1-dance": "the capture changed"}
    (out / "day2-dance" / "report.html").unlink()
    assert plan(manifest, out, capsys)["day2-dance"] == "report.html is gone"
    assert set(plan(manifest, out, capsys, "--seed", "3").values()) == {"other settings than before", "bad input"}

    assert main(words(manifest, out, "--names", "day*")) == OK
    assert plan(manifest, out, capsys, "--names", "day*") == {
        "day1-dance": "there already",
        "day2-dance": "there already",
    }


def test_a_change_of_anything_that_a_run_reads_makes_it_run_again(tmp_path):
    take, first, plate = (tmp_path / name for name in ("take", "first", "empty"))
    for folder in (take, first, plate):
        for camera in ("cam1", "cam2"):
            (folder / "videos").mkdir(parents=True, exist_ok=True)
            (folder / "videos" / f"{camera}.mp4").touch()
    (take / "capture.toml").write_text('rig_from = "first"\nclean_plate = "empty"\n')
    (first / "calibration").mkdir()
    seen = [_capture_digest(take)]
    for name in (
        "take/masks/cam1/000000.png",
        "take/masks/cam1/000001.png",
        "take/timecodes/cam1.csv",
        "take/t_offsets.json",
        "first/calibration/rig.json",
        "empty/videos/cam1.mp4",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
        seen.append(_capture_digest(take))
    shutil.rmtree(take / "masks")
    seen.append(_capture_digest(take))
    assert len(set(seen)) == len(seen)
    assert all(seen)


def test_sequences_are_chosen_by_name_and_tag(manifest, tmp_path, capsys):
    assert set(plan(manifest, tmp_path / "out", capsys)) == {"day1-dance", "day2-dance", "cut"}
    assert set(plan(manifest, tmp_path / "out", capsys, "--names", "day?-*")) == {"day1-dance", "day2-dance"}
    assert main(words(manifest, tmp_path / "out", "--tags", "outdoors", "--dry-run")) == WRONG
    assert "no sequence of" in capsys.readouterr().err


def test_a_folder_serves_as_a_manifest(dataset, tmp_path, capsys):
    assert set(plan(dataset, tmp_path / "out", capsys)) == {"day1-dance", "day2-dance", "cut"}
    assert (tmp_path / "out" / "shoot.parquet").is_file()


def test_what_is_no_manifest_is_refused(tmp_path, capsys):
    (tmp_path / "notes.parquet").write_text("none")
    for name in ("notes.parquet", "missing.parquet"):
        assert main(words(tmp_path / name, tmp_path / "out")) == WRONG
        assert name in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_data_set_is_processed_once_at_a_time(manifest, tmp_path, capsys):
    out = tmp_path / "out"
    with registered(out, sequence="(data set)", capture=str(manifest), preset="draft"):
        assert main(words(manifest, out)) == WRONG
    assert "runs in" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("cores", "memory", "expected"), [(2, 64 * GB, 1), (16, 64 * GB, 4), (16, 7 * GB, 2), (64, 1 * GB, 1)]
)
def test_sequences_at_a_time_are_bounded_by_cores_and_memory(cores, memory, expected):
    assert sequences_at_once(cores, memory) == expected


def test_results_of_other_folders_stay(tmp_path):
    table = ResultTable(tmp_path / "shoot.results.parquet")
    one = Result("dance", "/runs", Status.FINISHED, psnr_db=28.5, unseen=True, frames=30)
    other = replace(one, out="/elsewhere", status=Status.FAILED, reason="it broke")
    table.put([one])
    table.put([other])
    table.put([replace(one, psnr_db=29.0)])
    assert table.read() == {("dance", "/runs"): replace(one, psnr_db=29.0), ("dance", "/elsewhere"): other}


def test_a_request_checks_what_a_sequence_would(tmp_path):
    good = {"manifest": str(tmp_path / "a.parquet"), "out": str(tmp_path)}
    for wrong, message in (
        ({"preset": "best"}, "preset must be"),
        ({"out": "runs"}, "absolute"),
        ({"at_once": 0}, "at_once"),
    ):
        with pytest.raises(ValueError, match=message):
            BatchRequest(**{**good, **wrong})
