"""A whole run on a simulated capture in which a parcel is put down half way."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from packuv.gaussians.codes import Codes
from packuv.scene import open_scene
from pipelines.events import Journal
from pipelines.process import Outcome, process_directly
from pipelines.request import RunRequest
from studio.capture import SimulateOptions, TruthKind, simulate
from studio.clocks import ClockOptions
from studio.truth import read_truth

FRAMES, DATE = 24, 12
SETTINGS: dict[str, Any] = {
    "keyframes": {"separation": 12, "max_segment": 23, "promotion": 0},
    "patches": {"lasting": 8},
    "fit": {
        "iterations": 20,
        "key_iterations": 8,
        "frame_iterations": 4,
        "spare": 40,
        "key_births": 40,
        "start": {"count": 1000},
        "density": {"cap": 1300},
        "shell": {"columns": 128, "steps": 24},
    },
}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "parcel"
    clock = ClockOptions(drop_share=0, max_late_frames=0)
    simulate(folder, SimulateOptions(6, FRAMES, "192x108", seed=7, samples=1, clock=clock, entrance_share=1.0,
                                     parcel_share=DATE / FRAMES, truth=TruthKind.LIGHT, name="parcel"))  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def outcome(capture, tmp_path_factory) -> Outcome:
    out = tmp_path_factory.mktemp("runs")
    return process_directly(RunRequest(str(capture), str(out), preset="draft", settings=SETTINGS, jobs=1), Journal())


def test_the_date_is_a_keyframe_and_stands_in_the_report(outcome, capture):
    truth = read_truth(capture)
    assert truth.parcel_ns == truth.tick_times_ns[DATE]
    report = json.loads((outcome.folder / "report.json").read_text())
    (change,) = report["motion"]["changes"]
    assert change["frame"] == DATE
    assert 3 <= len(change["cameras"]) <= 5
    assert not set(change["cameras"]) & set(report["summary"]["held_out"])
    assert report["motion"]["keyframes"] == [0, DATE]
    assert report["summary"]["verified"]


def test_each_epoch_has_its_backdrop_and_no_keyframe_goes_on_over_a_date(outcome):
    labels = [event.label for event in outcome.events if event.key]
    fits = [label for label in labels if "backdrop" in label or "keyframe " in label or "background of" in label]
    assert fits == [
        "background of epoch 1",
        "background of epoch 2",
        "fit backdrop",
        "patch backdrop for epoch 2",
        "fit keyframe 0",
        f"fit keyframe {DATE}",
    ]


def test_what_the_patch_does_not_touch_stays_to_the_bit_and_is_stored_once(outcome):
    with open_scene(outcome.scene) as scene:
        first, last = rows(scene.codes(0)), rows(scene.codes(FRAMES - 1))
        assert len(first & last) > 0.7 * len(first)
        assert [entry.reference for entry in scene.index.segments] == [None, 0]


def rows(codes: Codes) -> set[bytes]:
    return {bytes(xyz) + bytes(own) for xyz, own in zip(codes.xyz, codes.attributes, strict=True)}
