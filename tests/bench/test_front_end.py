"""Run time against error of what comes before a fit: its errors, its knobs, and what is not measured again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from bench import front_end
from bench.against_truth import CAPTURES, STAGES, Filmed, lens_errors, light_error, measure, pose_errors
from bench.front_end import (
    BASE,
    INSTANTS,
    KNOBS,
    NOT_VARIED,
    PANELS,
    WIDTH,
    Point,
    plot,
    points,
    read_rows,
    run,
    table,
    write,
)
from calibration.rig import Rig
from pipelines.options import SequenceOptions
from sync.clock import ClockMode
from tasks.artefacts.recipe import plain

TINY = replace(CAPTURES[0], cameras=3, size="96x54", width=96, instants=2, steps=1, minutes=1)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    return Filmed.there(TINY, tmp_path_factory.mktemp("front_end"))


def leaves(tree: Any, path: str) -> list[str]:
    if not isinstance(tree, dict):
        return [path]
    return [leaf for name, inner in tree.items() for leaf in leaves(inner, f"{path}.{name}")]


def test_every_setting_before_the_fit_is_varied_or_it_is_said_why_not():
    options = plain(SequenceOptions())
    stages = ("pictures", "sync", "rig", "light", "points", "motion", "content", "patches", "keyframes")
    settings = {leaf for stage in stages for leaf in leaves(options[stage], stage)}
    varied = {knob for knobs in KNOBS.values() for knob in knobs} - {INSTANTS, WIDTH}
    still = {leaf for leaf in settings if any(f"{leaf}.".startswith(f"{name}.") for name in NOT_VARIED)}
    assert varied | still == settings
    assert not varied & still


def test_every_point_is_another_one_and_its_settings_exist():
    found = list(points(list(STAGES)))
    asked = {(point.stage, point.options, point.instants, point.width) for point in found}
    assert len(asked) == len(found)
    assert {stage for stage, _, _ in PANELS} == set(STAGES)


def test_a_rig_is_as_right_as_its_alignment_and_as_wrong_as_one_camera(filmed):
    truth = filmed.rig()
    turned = np.eye(4)
    turned[:3, :3] = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0]
    moved = []
    for camera in truth.cameras:
        pose = camera.camera_from_world @ turned
        pose[:3, 3] *= 2.5
        moved.append(replace(camera, camera_from_world=pose))
    same = Rig(tuple(moved), "elsewhere, larger")
    assert max(pose_errors(same, truth).values()) < 1e-4
    assert lens_errors(same, truth) == {"focal_percent": 0.0, "rays_px": 0.0}
    wide = Rig((replace(truth.cameras[0], fx=1.1 * truth.cameras[0].fx), *truth.cameras[1:]), "one lens wrong")
    assert lens_errors(wide, truth)["focal_percent"] == pytest.approx(100 * (np.sqrt(1.1) - 1) / np.sqrt(3))
    assert pose_errors(wide, truth)["centre_percent"] < 1e-6


def test_light_that_is_undone_leaves_nothing(filmed):
    gains = {name: tuple(1 / own.gains) for name, own in filmed.truth.items()}
    shading = {name: (own.shading.k1, own.shading.k2) for name, own in filmed.truth.items()}
    assert light_error(filmed, gains, shading) < 1e-6
    none = {name: (1.0, 1.0, 1.0) for name in gains}
    assert light_error(filmed, none, shading) > 1


def test_times_that_a_trigger_makes_are_better_where_it_is_known(filmed):
    trusted = measure("sync", filmed, SequenceOptions())
    options = SequenceOptions()
    triggered = measure("sync", filmed, replace(options, sync=replace(options.sync, clock=ClockMode.TRIGGERED)))
    assert trusted["wrong_percent"] == triggered["wrong_percent"] == 0
    jitter_ms = TINY.clock.jitter_us / 1000 * np.sqrt(2)  # of a camera and of the reference, which no fit can take away
    assert triggered["time_ms"] == pytest.approx(jitter_ms, rel=0.05)
    assert trusted["time_ms"] > 1.2 * jitter_ms


def test_points_are_measured_whole_and_not_again(filmed, tmp_path, monkeypatch):
    file = tmp_path / "front_end.json"
    chosen = [Point("masks", BASE, BASE), Point("masks", "motion.width", "48", ("motion.width=48",))]
    rows = list(run(filmed, chosen, read_rows(file)))
    assert all(0 < row["recall"] <= 1 and 0 < row["precision"] <= 1 for row in rows)
    write(file, rows)

    def again(*arguments: Any) -> Any:
        raise AssertionError("measured again")

    monkeypatch.setattr(front_end, "measure", again)
    assert list(run(filmed, chosen, read_rows(file))) == rows
    with pytest.raises(AssertionError, match="measured again"):
        list(run(filmed, [*chosen, Point("masks", "motion.tau_px", "1", ("motion.tau_px=1",))], read_rows(file)))
    assert "| motion.width | 48 |" in Path(file).with_suffix(".md").read_text()


def test_what_is_refused_is_in_table_and_plot():
    rows = [
        {"capture": "a", "stage": "flow", "knob": BASE, "value": BASE, "cpu_seconds": 1.0, "moving_px": 0.5},
        {"capture": "a", "stage": "flow", "knob": "motion.preset", "value": "fast", "cpu_seconds": 2.0, "moving_px": 9},
        {
            "capture": "a",
            "stage": "flow",
            "knob": "motion.flow_width",
            "value": "16",
            "cpu_seconds": 0.1,
            "refused": "x",
        },
    ]
    assert "| motion.flow_width | 16 | 0.1 | -90% | refused |" in table(rows)
    marks = [part.text for part in ElementTree.fromstring(plot(rows)).iter("{http://www.w3.org/2000/svg}title")]
    assert sorted(marks, key=str) == [
        "default",
        "motion.flow_width 16: refused, 0.1 CPU s",
        "motion.preset fast: 9, 2 CPU s",
    ]


def test_a_file_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "x.json").write_text('{"rows": [{"knob": "iterations"}]}')
    with pytest.raises(ValueError, match="must hold points of packuv bench front_end"):
        read_rows(tmp_path / "x.json")
