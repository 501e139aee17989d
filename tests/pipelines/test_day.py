"""A day of takes with one rig: whose rig a take uses, who makes it, and what the empty stage gives."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.rig import Rig
from packuv.motion import load_stills
from pipelines.cli import main
from pipelines.events import Journal
from pipelines.process import Outcome, process_directly
from pipelines.request import RunRequest
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from tasks.artefacts.store import Store

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Path:
    """A tiny take with its calibration."""
    folder = tmp_path_factory.mktemp("filmed") / "take01"
    clock = ClockOptions(drop_share=0, max_late_frames=0)
    simulate(folder, SimulateOptions(5, 4, "96x64", seed=3, samples=1, clock=clock, truth=TruthKind.LIGHT, held_out=0))
    return folder


@pytest.fixture
def day(filmed, tmp_path) -> Path:
    """A folder with take01, and with take02 and take03 that use its rig and have no calibration."""
    for name, keys in (("take01", ""), ("take02", 'rig_from = "take01"'), ("take03", 'rig_from = "take02"')):
        shutil.copytree(filmed, tmp_path / "day" / name)
        (tmp_path / "day" / name / "capture.toml").write_text(f'fps = 30\nclock = "triggered"\n{keys}\n')
        if keys:
            shutil.rmtree(tmp_path / "day" / name / "calibration")
    return tmp_path / "day"


def run(capture: Path, out: Path, **changes: Any) -> Outcome:
    asked = RunRequest(**{"capture": str(capture), "out": str(out), "preset": "draft", "jobs": 1, **changes})
    return process_directly(asked, Journal())


def test_takes_of_a_day_share_the_rig_that_whoever_comes_first_makes(day, tmp_path):
    out = tmp_path / "runs"
    with ThreadPoolExecutor(2) as both:
        takes = list(both.map(lambda name: run(day / name, out, stop_after="calibrate"), ("take02", "take03")))
    for take in takes:
        rigs = list((take.folder / "store" / "rig").glob("*/rig.json"))
        assert len(rigs) == 1, "its own store holds the rig that it uses"
        assert "rig of take01" in Rig.load(rigs[0]).source
        skipped = json.loads((take.folder / "run.json").read_text())["skipped"]
        assert {"what": "COLMAP", "why": "rig of take01"} in skipped
    made = [event.label for take in takes for event in take.events if event.outcome == "made"]
    assert made.count("take01: rig") == made.count("take01: sync") == 1, "one of the two waited for the other"
    assert not (out / "take02" / "store" / "rig").samefile(out / "take03" / "store" / "rig")
    later = run(day / "take01", out, stop_after="calibrate")
    assert {event.label for event in later.events if event.outcome == "reused"} == {"sync", "rig"}
    assert Store(out / "take01" / "store").verify() == []


def test_the_take_that_lends_the_rig_tells_its_scale(day, tmp_path):
    text = (day / "take01" / "capture.toml").read_text()
    (day / "take01" / "capture.toml").write_text(f'{text}distance = {{cameras = ["cam01", "cam02"], metres = 7}}\n')
    take = run(day / "take02", tmp_path / "runs", stop_after="calibrate")
    (path,) = (take.folder / "store" / "rig").glob("*/rig.json")
    rig = Rig.load(path)
    assert rig.metric
    assert np.linalg.norm(rig["cam01"].centre - rig["cam02"].centre) == pytest.approx(7)
    assert "a unit of it is" in rig.source
    assert "take01: scale" in {event.label for event in take.events}


def test_a_take_that_lends_to_itself_or_is_not_there_ends_with_one_sentence(day, tmp_path, capsys):
    (day / "take01" / "capture.toml").write_text('rig_from = "take03"\n')
    assert main(["run", str(day / "take03"), "--out", str(tmp_path / "runs"), "--direct"]) == 2
    assert "goes round: take03 -> take02 -> take01 -> take03" in capsys.readouterr().err
    (day / "take01" / "capture.toml").write_text('rig_from = "take00"\n')
    assert main(["run", str(day / "take03"), "--out", str(tmp_path / "runs"), "--direct"]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_a_clean_plate_gives_the_background_and_other_cameras_keep_theirs(day, tmp_path):
    (day / "empty" / "videos").mkdir(parents=True)
    for name in ("cam01", "cam02", "cam04"):
        shutil.copy(day / "take01" / "videos" / f"{name}.mp4", day / "empty" / "videos" / f"{name}.mp4")
    # What stands in another corner of the room is no plate of this camera.
    shutil.copy(day / "take01" / "videos" / "cam04.mp4", day / "empty" / "videos" / "cam02.mp4")
    (day / "take01" / "capture.toml").write_text('fps = 30\nclock = "triggered"\nclean_plate = "empty"\n')
    tiny = {
        "iterations": 10,
        "key_iterations": 4,
        "frame_iterations": 2,
        "start": {"count": 200},
        "density": {"cap": 300},
    }
    outcome = run(day / "take01", tmp_path / "runs", stop_after="fit", settings={"fit": tiny})
    (made,) = (outcome.folder / "store" / "background").iterdir()
    plates = json.loads((made / "plates.json").read_text())
    assert {name: plate["used"] for name, plate in plates.items()} == {"cam01": True, "cam02": False, "cam04": True}
    assert {still.camera for still in load_stills(made / "stills.npz")} == {0, 1, 2, 3, 4}
    record = json.loads((outcome.folder / "run.json").read_text())
    skipped = {item["what"]: item["why"] for item in record["skipped"]}
    assert "no video of cam03, cam05" in skipped["clean plate"]
    assert "shows another place" in skipped["clean plate of cam02"]
    findings = json.loads((outcome.folder / "report.json").read_text())["findings"]
    assert any("cam02: its clean plate shows another place" in str(finding) for finding in findings)


def test_a_plate_that_is_not_there_is_missed_at_once(day, tmp_path, capsys):
    (day / "take01" / "capture.toml").write_text('clean_plate = "empty"\n')
    assert main(["run", str(day / "take01"), "--out", str(tmp_path / "runs"), "--direct"]) == 2
    assert "clean_plate = 'empty', but there is no folder" in capsys.readouterr().err
