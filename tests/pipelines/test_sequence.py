"""Whole runs on a tiny synthetic capture: what they leave, what they do again, and what a kill costs."""

from __future__ import annotations

import hashlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from calibration.rig import Rig
from packuv.scene import open_scene
from pipelines.cli import main
from pipelines.commands.progress import TerminalProgress
from pipelines.commands.scenes import _capture_of, _worst_frame, filmed
from pipelines.events import Journal
from pipelines.process import Engine, Outcome, find_sequence, jobs_of, plan_of, process, process_directly
from pipelines.request import RunRequest
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from tasks.artefacts.store import Store

FRAMES = 6
SETTINGS: dict[str, Any] = {
    "keyframes": {"separation": 2, "max_segment": 3},
    "fit": {
        "iterations": 20,
        "key_iterations": 8,
        "frame_iterations": 4,
        "spare": 40,
        "key_births": 40,
        "start": {"count": 300},
        "density": {"cap": 400},
    },
}
FIRST, LAST = "fit segment 1 (frames 0-2)", "fit segment 2 (frames 3-5)"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "tiny"
    clock = ClockOptions(drop_share=0, max_late_frames=0)
    simulate(
        folder, SimulateOptions(5, FRAMES, "96x64", seed=3, samples=1, clock=clock, truth=TruthKind.LIGHT, name="tiny")
    )
    return folder


def request(capture: Path, out: Path, **changes: Any) -> RunRequest:
    return RunRequest(**{"capture": str(capture), "out": str(out), "preset": "draft", "settings": SETTINGS, **changes})


def run(asked: RunRequest) -> tuple[Outcome, str]:
    stream = io.StringIO()
    return process_directly(asked, Journal(TerminalProgress(stream))), stream.getvalue()


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def first(capture, tmp_path_factory) -> tuple[Outcome, str]:
    """An uninterrupted run."""
    return run(request(capture, tmp_path_factory.mktemp("runs")))


def artefacts(outcome: Outcome) -> dict[str, str]:
    """What each stage of a run made or found."""
    return {event.label: str(event.key) for event in outcome.events if event.key}


def made(outcome: Outcome) -> set[str]:
    """Stages that had to work."""
    return {event.label for event in outcome.events if event.outcome == "made" and event.key}


def test_run_leaves_scene_report_and_record(first, capture):
    outcome, said = first
    with open_scene(outcome.scene) as scene:
        assert len(scene) == FRAMES
        assert [camera.name for camera in scene.header.cameras] == [f"cam{n:02d}" for n in range(1, 6)]
        assert scene.header.held_out == ("cam03",)
    record = json.loads((outcome.folder / "run.json").read_text())
    report = json.loads((outcome.folder / "report.json").read_text())
    assert report["summary"]["scored_cameras"] == ["cam03"]
    assert report["summary"]["fitted_cameras"] == ["cam01", "cam04", "cam05"]
    assert sorted({item["frame"] for item in report["fitted"]}) == list(range(FRAMES))
    versions = {key.split("/")[0] for key in artefacts(outcome).values()}
    assert set(report["run"]["stage_versions"]) >= versions
    assert report["run"]["otherwise"] == {}
    assert report["summary"]["verified"] is True
    assert record["options"]["fit"]["iterations"] == 20
    assert record["cameras"]["held_out"] == ["cam03"]
    why = "calibration/ holds a COLMAP model"
    assert {"what": "COLMAP", "why": why} in record["skipped"]
    assert why in said
    assert why in (outcome.folder / "report.json").read_text()
    assert Store(outcome.folder / "store").verify() == []
    assert not [path for path in (outcome.folder / "store" / ".work").iterdir() if path.is_dir()]
    assert outcome.scene.stat().st_nlink == 2


def test_the_viewer_of_a_run_finds_what_was_filmed_and_the_worst_frame(first, capture):
    outcome, _ = first
    assert _capture_of(outcome.folder) == capture
    assert _capture_of(capture) is None
    report = json.loads((outcome.folder / "report.json").read_text())
    by_frame = {score["frame"]: score["psnr_db"] for score in report["scores"]}  # of one camera
    assert _worst_frame(outcome.folder) == min(by_frame, key=lambda frame: by_frame[frame])
    assert _worst_frame(capture) is None
    with open_scene(outcome.scene) as scene:
        beside = filmed(scene.header, capture)
    index = outcome.folder / "store" / artefacts(outcome)["evaluate"] / "pictures"
    for item in json.loads((index / "index.json").read_text())["pictures"]:
        truth = cv2.imread(str(index / item["truth"]))[..., ::-1].astype(float)
        shown = beside.picture(item["camera"], item["frame"])
        assert shown is not None
        assert np.abs(shown - truth).mean() < 12  # the same but for the camera's gains and exposure
    assert beside.picture("cam01", 0).shape == truth.shape
    with pytest.raises(ValueError, match="must have"):
        filmed(scene.header, capture / "videos").picture("cam01", 0)


def test_info_and_verify_tell_what_the_scene_is(first, capsys, tmp_path):
    scene = first[0].scene
    assert main(["info", str(scene), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["frames"], facts["lossless"], facts["held_out"]) == (FRAMES, True, ["cam03"])
    assert main(["verify", str(scene)]) == 0
    assert "all 6 frames decode to exactly what was written" in capsys.readouterr().out
    damaged = tmp_path / "damaged.mkv"
    data = bytearray(scene.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    assert main(["verify", str(damaged), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["bad"]
    assert found["span"][0] <= len(data) // 2 < found["span"][1]


def test_a_camera_that_is_named_twice_counts_once(first, capture, tmp_path, capsys):
    asked = request(capture, tmp_path, hold_out=("cam03", "cam05", "cam03"))
    assert plan_of(asked, find_sequence(asked)).held_out == ("cam03", "cam05")
    assert main(["eval", str(first[0].scene), str(capture), "--cameras", "cam03,cam03", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cameras"] == ["cam03"]


def test_a_report_written_anew_is_the_same_but_for_its_limits(first):
    folder, keep = first[0].folder, ("report.html", "report.json")
    before = [(folder / name).read_text() for name in keep]
    assert main(["report", str(folder)]) == 0
    assert [(folder / name).read_text() for name in keep] == before
    assert main(["report", str(folder), "--set", "report.psnr_db=98"]) == 0
    assert json.loads((folder / "report.json").read_text())["verdict"]["fitness"] == "not fit for delivery"
    assert main(["report", str(folder)]) == 0
    assert [(folder / name).read_text() for name in keep] == before


def test_same_command_finds_everything_there(first, capture):
    outcome, _ = first
    before = sha256(outcome.scene)
    again, _ = run(request(capture, outcome.folder.parent))
    assert made(again) == set()
    assert artefacts(again) == artefacts(outcome)
    assert sha256(again.scene) == before


def test_a_finished_sequence_needs_no_workflow_engine(first, capture, monkeypatch):
    from pipelines.commands import run as command

    asked = request(capture, first[0].folder.parent)
    run(asked)
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setattr(command, "workflow_server", lambda out: pytest.fail("it starts a server"))
    again = command.run(asked, Journal(), direct=False)
    assert made(again) == set()
    with pytest.raises(pytest.fail.Exception, match="it starts a server"):
        command.run(request(capture, first[0].folder.parent, seed=1), Journal(), direct=False)


def test_a_changed_option_redoes_only_what_depends_on_it(first, capture):
    outcome, _ = first
    out = outcome.folder.parent

    def redone(**settings: Any) -> set[str]:
        merged = {**SETTINGS, **settings}
        return {label.split(" ")[0] for label in made(run(request(capture, out, settings=merged))[0])}

    shorter = {**SETTINGS["fit"], "frame_iterations": 3}
    found = made(run(request(capture, out, settings={**SETTINGS, "fit": shorter}))[0])
    assert {label for label in found if label.startswith("fit")} == {FIRST, "fit keyframe 3 after 2", LAST}
    assert {label for label in found if not label.startswith("fit")} == {"encode", "verify", "evaluate"}
    assert redone(encode={"tolerance": {"position": 10}}) == {"encode", "verify", "evaluate"}
    assert redone(evaluate={"fitted_cameras": 2}) == {"evaluate"}  # which are scored beside the one held out
    assert redone() == set()  # back to what was there at first


def test_without_lasting_change_nothing_depends_on_how_that_was_found(first, capture):
    outcome, said = first
    assert "no lasting change found" in said
    off, said = run(request(capture, outcome.folder.parent, settings={**SETTINGS, "patches": {"enabled": False}}))
    assert "patches.enabled is false" in said
    assert made(off) == set()
    assert artefacts(off).items() == artefacts(outcome).items() - {("patches", artefacts(outcome)["patches"])}


def seam_of(outcome: Outcome) -> float:
    """Flicker at the scene's border over that elsewhere, for the camera that was held out."""
    metrics = outcome.folder / "store" / artefacts(outcome)["evaluate"] / "metrics.json"
    return json.loads(metrics.read_text())["seam"]


def test_side_by_side_keyframes_start_from_the_backdrop(first, capture, tmp_path):
    outcome, _ = first
    shutil.copytree(outcome.folder / "store", tmp_path / "tiny" / "store")
    settings = {**SETTINGS, "keyframes": {**SETTINGS["keyframes"], "seam": 0}}
    apart, _ = run(request(capture, tmp_path, settings=settings, jobs=2))
    fits = {label for label in made(apart) if label.startswith("fit")}
    assert fits == {"fit keyframe 3", LAST}  # what comes first is the same, one at a time or side by side


def test_side_by_side_a_border_that_shows_is_fitted_again_from_the_frame_before_it(capture, tmp_path):
    """Without a backdrop, whose tiny scene has no border that shows."""

    def fitted(limit: float, jobs: int = 2) -> tuple[set[str], Outcome]:
        fit = {**SETTINGS["fit"], "background": {"instants": 0}}
        settings = {**SETTINGS, "fit": fit, "keyframes": {**SETTINGS["keyframes"], "seam": limit}}
        found, _ = run(request(capture, tmp_path, settings=settings, jobs=jobs))
        return {label for label in made(found) if label.startswith("fit")}, found

    _, outcome = fitted(0, jobs=1)
    fits, apart = fitted(0)
    assert fits == {"fit keyframe 3", LAST}  # what comes first is the same, one at a time or side by side
    fits, mended = fitted(1.01)
    assert fits == set()  # what goes on from the frame before is what one at a time makes
    assert artefacts(mended)[LAST] == artefacts(outcome)[LAST] != artefacts(apart)[LAST]
    assert seam_of(mended) < seam_of(apart)


def test_a_full_disk_is_refused_before_the_work(capture, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
        with pytest.raises(
            OSError, match=r"needs about .*B more under .*store, but .*B are free; free some, or choose another --out"
        ):
            run(request(capture, tmp_path))


def test_an_earlier_stop_and_another_seed(first, capture):
    outcome, _ = first
    out = outcome.folder.parent
    stopped, _ = run(request(capture, out, stop_after="flow", seed=1))
    assert made(stopped) == set()  # nothing before the fit reads the seed
    assert stopped.scene is None
    assert set(artefacts(stopped)) == {"sync", "rig", "light", "points", "motion", "content", "patches", "keyframes"}


def test_light_may_be_left_out_and_changes_nothing_where_it_is_steady(first, capture, tmp_path):
    outcome, _ = first
    skipped = {event.label: event.reason for event in outcome.events if event.outcome == "skipped"}
    assert "less than 0.20%" in skipped["light of the instant"]
    without, _ = run(request(capture, tmp_path, settings={**SETTINGS, "light": {"enabled": False}}, stop_after="flow"))
    assert {event.label: event.reason for event in without.events}["light"] == "light.enabled is false"
    assert set(artefacts(without)) == {"sync", "rig", "points", "motion", "content", "patches", "keyframes"}
    keys = artefacts(outcome)
    assert all(keys[stage] == key for stage, key in artefacts(without).items())


def test_a_known_distance_and_up_reach_the_points_and_change_nothing_before(first, capture, tmp_path):
    known = tmp_path / "tiny"
    shutil.copytree(capture, known)
    text = (known / "capture.toml").read_text()
    (known / "capture.toml").write_text(
        f'{text}up = "cameras"\ndistance = {{cameras = ["cam01", "cam02"], metres = 7}}\n'
    )
    outcome, said = run(request(known, first[0].folder.parent, name="known", stop_after="flow"))
    rig = Rig.load(outcome.folder / "store" / artefacts(outcome)["points"] / "rig.json")
    assert np.linalg.norm(rig["cam01"].centre - rig["cam02"].centre) == pytest.approx(7)
    assert rig.metric
    assert rig.up is not None
    assert rig.up[2] > 0.99  # the simulated studio's floor is level
    assert "scale" in said
    assert artefacts(outcome)["rig"] == artefacts(first[0])["rig"], "the rig as it was placed is the same one"
    again, _ = run(request(known, first[0].folder.parent, name="known", stop_after="flow"))
    assert made(again) == set()


def test_flow_shows_what_was_skipped(workflow, first, capture):
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.sorting import TaskRunSort

    from pipelines.link import Link
    from pipelines.sequence import run_flow

    outcome, _ = first
    for part in (outcome.folder / "store" / "evaluate").iterdir():
        for file in part.rglob("*.json"):
            file.unlink()
    again = run_flow(request(capture, outcome.folder.parent), Journal(), Link())
    assert artefacts(again).items() >= artefacts(outcome).items()
    assert made(again) == {"evaluate", "preview of segment 1", "preview of segment 2"}
    with get_client(sync_client=True) as client:
        runs = client.read_task_runs(sort=TaskRunSort.EXPECTED_START_TIME_DESC, limit=len(artefacts(again)))
    states = {item.name: item.state_name for item in runs}
    assert states["evaluate"] == "Completed"
    assert {state for name, state in states.items() if name not in made(again)} == {"Skipped"}
    assert {FIRST, LAST} <= set(states)


def test_bad_input_in_a_stage_is_named_and_not_retried(workflow, capture, tmp_path):
    from pipelines.link import Link
    from pipelines.sequence import run_flow

    broken = tmp_path / "broken"
    (broken / "videos").mkdir(parents=True)
    for path in (capture / "videos").iterdir():
        (broken / "videos" / path.name).write_bytes(path.read_bytes()[: 400 if path.stem == "cam02" else None])
    progress = Journal(TerminalProgress(io.StringIO()))
    with pytest.raises(ValueError, match=r"cam02\.mp4"):
        run_flow(request(broken, tmp_path / "out"), progress, Link())
    assert [(event.label, event.outcome) for event in progress.events] == [("sync", "failed")]
    record = json.loads((tmp_path / "out" / "broken" / "run.json").read_text())
    assert record["stages"][-1]["outcome"] == "failed"
    assert "cam02.mp4" in record["stages"][-1]["reason"]


def test_a_video_that_is_another_one_for_a_while_leaves_nothing_wrong_behind(first, capture, tmp_path):
    outcome, _ = first
    copy = shutil.copytree(capture, tmp_path / "copy")
    video, seen = copy / "videos/cam01.mp4", []
    asked = request(copy, tmp_path)

    def stage_after(stage: str, replace_with: Path):
        """An engine under which the video becomes another one as soon as a stage is made."""

        def engine(make):
            def submit(asked):
                seen.append(type(asked).__name__)
                future = pool.submit(make, asked)
                if seen[-1] == stage:
                    future.result()
                    with Store(tmp_path / "tiny/store").alone() as alone:
                        assert not alone  # nobody cleans up between two stages
                    shutil.copyfile(replace_with, copy / "part")
                    os.replace(copy / "part", video)
                return future

            return submit

        return engine

    with ThreadPoolExecutor(max_workers=1) as pool:
        changed = Engine(stage_after("ChooseKeyframes", capture / "videos/cam02.mp4"))
        with pytest.raises(ValueError, match=r"cam01\.mp4 has another content than when this run began; put back"):
            process(asked, Journal(), changed, jobs_of(asked))
        assert seen[-1] == "FindBackground"
        shutil.copyfile(capture / "videos/cam01.mp4", video)
        whole = process(asked, Journal(), Engine(stage_after("", video)), jobs_of(asked))
    assert made(whole).isdisjoint({"sync", "rig", "light", "points", "motion", "patches", "keyframes"})
    assert sha256(whole.scene) == sha256(outcome.scene)


def test_after_a_clean_the_same_command_makes_what_is_gone_with_the_same_bytes(first, capture, tmp_path, capsys):
    shutil.copytree(first[0].folder, tmp_path / "tiny")
    asked = request(capture, tmp_path, settings={**SETTINGS, "encode": {"tolerance": {"position": 10}}})
    outcome, _ = run(asked)
    main(["clean", str(tmp_path), "--json"])
    (folder,) = json.loads(capsys.readouterr().out)["folders"]
    names = [item["name"].split("/")[0] for item in folder["sequences"][0]["gone"]]
    assert {"encode", "verify", "evaluate"} <= set(names)
    again, _ = run(asked)
    assert made(again) == set()
    main(["clean", str(tmp_path), "--quota", f"{folder['kept_bytes'] - 1}B", "--json"])
    (folder,) = json.loads(capsys.readouterr().out)["folders"]
    assert [(item["name"].split("/")[0], item["why"]) for item in folder["sequences"][0]["gone"]] == [
        ("motion", "over quota")
    ]
    assert main(["verify", "--store", str(tmp_path)]) == 0
    assert "1 artefacts that others were made from are gone" in capsys.readouterr().out
    again, _ = run(asked)
    assert made(again) == {"motion"}  # a run makes all of its stages, whether or not what is left to do reads them
    assert sha256(again.scene) == sha256(outcome.scene)
    assert main(["verify", "--store", str(tmp_path)]) == 0


@pytest.mark.parametrize(("mode", "kills"), [("--direct", 3), ("", 1)], ids=["direct", "prefect"])
def test_killed_runs_end_with_the_same_bytes(first, capture, tmp_path, mode, kills):
    outcome, _ = first
    settings = tmp_path / "settings.json"
    settings.write_text(json.dumps(SETTINGS))
    words = ["run", str(capture), "--out", str(tmp_path / "out"), "--preset", "draft", *_as_words(SETTINGS)]
    command = [sys.executable, "-m", "pipelines.cli", *words, *([mode] if mode else [])]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT")}
    rng = random.Random(7)
    for _ in range(kills):
        with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as killed:
            try:
                killed.wait(timeout=rng.uniform(6, 30))
            except subprocess.TimeoutExpired:
                killed.send_signal(signal.SIGKILL)
    last = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert last.returncode == 0, last.stderr
    assert sha256(tmp_path / "out" / "tiny" / "scene.mkv") == sha256(outcome.scene)
    assert Store(tmp_path / "out" / "tiny" / "store").verify() == []


def _as_words(settings: dict[str, Any], path: str = "") -> list[str]:
    words: list[str] = []
    for name, value in settings.items():
        if isinstance(value, dict):
            words += _as_words(value, f"{path}{name}.")
        else:
            words += ["--set", f"{path}{name}={value}"]
    return words


def test_a_run_that_stops_leaves_the_finished_segments_as_a_scene_that_plays(first, capture, tmp_path):
    outcome, _ = first
    store = tmp_path / "tiny" / "store"
    shutil.copytree(outcome.folder / "store", store)
    for stage in ("segment", "encode", "verify", "evaluate"):
        shutil.rmtree(store / stage)
    asked, partial, started = request(capture, tmp_path), tmp_path / "tiny" / "scene.partial.mkv", []
    with ThreadPoolExecutor(max_workers=2) as pool:

        def stop_at(stage: str, count: int):
            def engine(make):
                def submit(asked):
                    started.append(type(asked).__name__)
                    if started.count(stage) == count:
                        raise KeyboardInterrupt
                    future = pool.submit(make, asked)
                    if stage == "Encode":
                        future.result()
                    return future

                return submit

            return engine

        with pytest.raises(KeyboardInterrupt):
            process(asked, Journal(), Engine(stop_at("FitSegment", 1)), jobs_of(asked))
        assert not partial.exists()
        with pytest.raises(KeyboardInterrupt):
            process(asked, Journal(), Engine(stop_at("Encode", 1)), jobs_of(asked))
    with open_scene(partial) as scene:
        assert len(scene) == FRAMES
    whole, _ = run(asked)
    assert sha256(whole.scene) == sha256(outcome.scene)
    assert not partial.exists()
