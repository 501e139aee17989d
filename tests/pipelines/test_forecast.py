"""What a run is forecast to take: laws of the model, and runs that it was measured on."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.forecast import forecast_of
from packuv.fit.pace import FitSize
from pipelines.forecast import (
    STAGE_OF,
    TIME_WITHIN,
    Guess,
    Machine,
    Size,
    again_seconds,
    fit_size,
    forecast,
    machine_of,
    pilot_minutes,
    question_of,
    work_of,
)
from pipelines.ladder import LADDER, up_to
from pipelines.options import compose
from pipelines.probe import PROBE, REFERENCE, Probe, remember, remembered
from pipelines.process import find_sequence, plan_of
from pipelines.request import STAGES, RunRequest
from sync.capture import CaptureSettings
from tasks.artefacts.jobs import CancelledError, Jobs
from tests.pipelines.test_choice import POINTS, machines, sizes
from tests.support.golden import FOLDER
from tests.support.places import ROOT

BASKETBALL = Size(150, ((640, 360),) * 24, ((640, 360),) * 3)
FACTS = json.loads((ROOT / "bench/results/forecast.json").read_text())


@given(sizes, machines, st.sampled_from(list(LADDER)))
def test_more_frames_cameras_or_pixels_never_take_less(size, machine, name):
    now = forecast(size, POINTS[name], machine)
    larger = tuple((2 * width, 2 * height) for width, height in size.fitted)
    more = [
        replace(size, frames=size.frames + 1),
        replace(size, frames=size.frames * 3),
        replace(size, fitted=(*size.fitted, max(size.fitted, key=lambda side: side[0] * side[1]))),
        replace(size, held_out=(*size.held_out, (640, 360))),
        replace(size, fitted=larger),
        replace(size, solved=True),
        replace(size, solved=True, lenses=True),
    ]
    for other in more:
        found = forecast(other, POINTS[name], machine)
        assert found.minutes >= now.minutes * (1 - 1e-12)
        assert found.memory_bytes >= now.memory_bytes
        assert found.gpu_bytes >= now.gpu_bytes > 10**9
        assert found.disk_bytes >= 0.98 * now.disk_bytes  # heights of flow are rounded
        assert found.scene_bytes >= now.scene_bytes
    assert pilot_minutes(size, POINTS[name], machine, 6) > 0


@given(sizes, machines)
def test_both_attempts_of_a_solve_take_as_long_whichever_comes_first(size, machine):
    unknown, known = (replace(size, solved=True, lenses=lenses) for lenses in (False, True))
    once = [forecast(one, POINTS["draft"], machine).seconds["calibrate"] for one in (unknown, known)]
    again = [again_seconds(one, POINTS["draft"], machine) for one in (unknown, known)]
    assert once[0] <= once[1] * (1 + 1e-12)  # known lenses are solved from several instants first
    assert once[0] + again[0] == pytest.approx(once[1] + again[1])


@given(sizes, machines)
def test_the_ladder_goes_up_for_every_capture(size, machine):
    minutes = [forecast(size, options, machine).minutes for options in POINTS.values()]
    assert minutes == sorted(minutes)
    assert up_to("high") == tuple(LADDER)


@given(sizes, st.floats(0.2, 5.0), st.floats(0.0, 0.9))
def test_time_is_in_proportion_to_the_pace_and_grows_with_what_moves(size, pace, moving):
    options = POINTS["draft"]

    def minutes(factor: float, share: float) -> float:
        steps = {str(one): factor * Guess().step(one) for one in (REFERENCE, fit_size(size, options))}
        return forecast(size, options, Machine(Probe(steps, share, None))).minutes

    assert minutes(pace, moving) == pytest.approx(pace * minutes(1.0, moving))
    assert minutes(1.0, moving) <= minutes(1.0, moving + 0.1)


def test_every_kind_of_work_belongs_to_a_stage_and_stopping_earlier_takes_less():
    assert set(work_of(BASKETBALL, POINTS["draft"], Guess())) == set(STAGE_OF)
    minutes = [forecast(BASKETBALL, POINTS["draft"], Machine(Guess()), stage).minutes for stage in STAGES]
    assert minutes == sorted(minutes)


@pytest.mark.parametrize("run", FACTS, ids=[run["run"] for run in FACTS])
def test_the_forecast_is_near_the_runs_that_it_was_measured_on(run):
    found = forecast_of(run, compose(run["preset"], CaptureSettings(), run["settings"]))
    for name in ("minutes", "memory_bytes", "disk_bytes", "scene_bytes"):
        assert getattr(found, name) == pytest.approx(run[name], rel=TIME_WITHIN - 1), name


def test_a_look_is_remembered_for_the_same_question_on_the_same_machine_alone(tmp_path):
    request = RunRequest(capture=str(FOLDER / "capture"), out=str(tmp_path))
    capture = find_sequence(request)
    size = Size(8, ((96, 64),) * 3)
    options = compose("draft", CaptureSettings(), {"fit": {"density": {"cap": 1000}, "start": {"count": 500}}})
    question, jobs = question_of(plan_of(request, capture), size, (options,)), Jobs(threads=1)
    found = Probe({str(fit_size(size, options)): 0.01, str(REFERENCE): 0.03}, 0.2, 0.05)
    assert remembered(tmp_path, question, jobs) is None
    remember(tmp_path, question, jobs, found)
    assert remembered(tmp_path, question, jobs) == found
    assert remembered(tmp_path, question, Jobs(threads=2)) is None
    assert remembered(tmp_path, replace(question, sizes=(FitSize(64, 64, 9),)), jobs) is None
    assert remembered(tmp_path, replace(question, frames=(3,)), jobs) is None
    (tmp_path / PROBE).write_text('{"asked": ')
    jobs.cancel("only looking")
    with pytest.raises(CancelledError):
        machine_of(tmp_path, question, jobs, 1)
