"""A time or an error instead of settings: what is forecast, and what is chosen."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.choice import affordable
from pipelines.cli import WRONG, main
from pipelines.forecast import Guess, Machine, Size
from pipelines.ladder import LADDER
from pipelines.options import compose
from pipelines.request import PRESETS, RunRequest
from sync.capture import CaptureSettings
from tasks.report.facts import Choice
from tests.support.golden import FOLDER

POINTS = {name: compose(name, CaptureSettings(), {}) for name in LADDER}

sides = st.tuples(st.integers(32, 2000), st.integers(32, 1200))
sizes = st.builds(
    Size,
    st.integers(1, 5000),
    st.lists(sides, min_size=1, max_size=8).map(tuple),
    st.lists(sides, min_size=1, max_size=3).map(tuple),
)
machines = st.builds(Machine, st.just(Guess()), st.integers(1, 4))


def asked(**changes: object) -> RunRequest:
    return RunRequest(capture="/capture", out="/out", preset="high", **changes)  # type: ignore[arg-type]  # a test's


@given(sizes, machines, st.floats(0.1, 1000), st.sampled_from([None, 30.0]))
def test_what_may_be_chosen_never_takes_more_than_is_allowed(size, machine, most, target):
    try:
        found = affordable(asked(max_minutes=most, target_psnr=target), POINTS, size, machine)
    except ValueError:  # not even the fastest
        return
    spent = 0.0
    for point in found:
        spent += point.pilot_minutes
        assert spent + point.minutes <= most
    # Whichever is taken after all pilots, as where none reaches the error.
    assert all(spent + point.minutes <= most for point in found)
    assert [point.name for point in found] == list(LADDER)[: len(found)]


@given(sizes, machines, st.floats(0.1, 1000), st.floats(0.1, 1000))
def test_more_time_never_chooses_less(size, machine, first, second):
    def finest(most: float) -> int:
        try:
            return len(affordable(asked(max_minutes=most), POINTS, size, machine))
        except ValueError:
            return 0

    less, more = sorted((first, second))
    assert finest(less) <= finest(more)


def test_a_missed_target_and_a_late_run_are_said():
    choice = Choice("draft", 8.0, 10.0, 30.0, {"sketch": 27.0, "draft": 28.5}, minutes=12.0, psnr_db=29.0)
    assert choice.missed == (
        "The target of 30 dB is missed: draft reaches 29.00 dB (first frames, dB: sketch 27.00, draft 28.50)."
    )
    assert choice.late == "The run took 12.0 minutes, but was to take 10 at most; 8.0 were forecast."
    reached = replace(choice, psnr_db=30.0, minutes=10.0)
    assert (reached.missed, reached.late) == ("", "")
    assert replace(choice, psnr_db=None).missed == "The target of 30 dB is missed: no frame has a score."


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--max-minutes", "0.001"], "even the fastest settings (sketch) are forecast to take"),
        (["--max-minutes", "-1"], "max_minutes must be more than 0, but is -1.0"),
        (["--max-minutes", "nan"], "max_minutes must be more than 0, but is nan"),
        (["--target-psnr", "100"], "target_psnr must lie between 0 and 99 dB, but is 100.0"),
        (["--target-psnr", "30", "--stop-after", "fit"], "target_psnr needs the scores, but the run stops after fit"),
        (["--target-psnr", "30", "--hold-out", ""], "needs cameras that are never fitted, but none is held out"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_no_work(words, message, tmp_path, capsys):
    assert main(["run", str(FOLDER / "capture"), "--out", str(tmp_path), "--direct", *words]) == WRONG
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("store"))


def test_without_a_preset_a_time_sets_no_other_bound(monkeypatch, tmp_path):
    from pipelines.commands import run as command

    seen: list[RunRequest] = []

    def note(request: RunRequest, journal: object, *, direct: bool) -> None:
        seen.append(request)
        raise ValueError("enough")

    monkeypatch.setattr(command, "run", note)
    for words in ([], ["--max-minutes", "5"], ["--max-minutes", "5", "--preset", "draft"]):
        main(["run", str(FOLDER / "capture"), "--out", str(tmp_path), *words])
    assert [request.preset for request in seen] == ["standard", "high", "draft"]
    assert set(PRESETS) <= set(LADDER)
