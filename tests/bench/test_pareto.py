"""The curve of run time against error: its front, its points, and what is not run again."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench import pareto
from bench.pareto import BY_DEFAULT, KNOBS, SHARES, front, left_out, plot, points, read_rows, run, table, write
from bench.point import Base
from pipelines.options import compose
from pipelines.request import read_settings
from sync.capture import CaptureSettings
from tests.support.golden import FOLDER

BASE = Base(FOLDER / "capture", Path("/work"), hold_out=("cam03",))


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1))
def test_nothing_beats_the_front_and_the_front_beats_all_else(pairs):
    costs, levels = [cost for cost, _ in pairs], [level for _, level in pairs]
    found = front(costs, levels)

    def beats(a: int, b: int) -> bool:
        return costs[a] <= costs[b] and levels[a] >= levels[b] and pairs[a] != pairs[b]

    assert not any(beats(other, index) for index in found for other in range(len(pairs)))
    best = {pairs[index] for index in found}
    assert len(best) == len(found)
    for index in range(len(pairs)):
        assert pairs[index] in best or any(beats(other, index) for other in found)
    assert costs[found[0]] == min(costs)
    assert levels[found[-1]] == max(levels)


@pytest.mark.parametrize("knob", KNOBS)
def test_every_value_of_a_knob_is_a_setting_that_exists_and_is_no_other(knob):
    found = [compose("draft", CaptureSettings(), read_settings(None, pairs)) for pairs in KNOBS[knob].values()]
    if knob == "cameras":
        assert set(KNOBS[knob]) == set(SHARES)
    else:
        assert len(set(found)) == len(found)


def test_the_base_comes_first_and_fewer_cameras_are_spread_and_never_those_that_score():
    assert [point.knob for point in points(BY_DEFAULT)][:2] == ["base", "ladder"]
    assert left_out(BASE, 1.0) == ()
    assert left_out(BASE, 0.5) == ("cam01", "cam04")
    with pytest.raises(ValueError, match="need cameras that are never fitted"):
        Base(FOLDER / "capture", Path("/work"), hold_out=()).scored()


def measured(base: Base, settings: tuple[str, ...], unseen: tuple[str, ...]) -> tuple[dict[str, Any], None]:
    """Stands for hours of work; the real one is tried in tests/bench/test_point.py."""
    cost = float(100 + 10 * len("".join(settings)))
    return {
        "psnr_calibrated_db": 25 + cost / 100,
        "psnr_own_db": 26.0,
        "psnr_moving_db": None,
        "psnr_still_db": 25.0,
        "ssim": 0.8,
        "fit_cpu_seconds": cost / 2,
        "cpu_seconds": cost,
        "mb_per_30_frames": 2.0,
        "peak_memory_bytes": 10**9,
    }, None


def test_a_point_that_is_there_is_not_run_again(monkeypatch, tmp_path):
    ran: list[tuple[str, ...]] = []

    def measure(base: Base, settings: tuple[str, ...], unseen: tuple[str, ...]) -> tuple[dict[str, Any], None]:
        ran.append(settings)
        return measured(base, settings, unseen)

    monkeypatch.setattr(pareto, "measure", measure)
    file, chosen = tmp_path / "pareto.json", list(points(["iterations", "settle", "cameras"]))
    some = []
    for row in run(BASE, chosen, read_rows(file)):
        some.append(row)
        write(file, BASE, some)
        if len(some) == 3:
            break  # killed here
    assert len(ran) == 3
    again = list(run(BASE, chosen, read_rows(file)))
    assert len(ran) == len(chosen)
    assert [(row["knob"], row["value"]) for row in again] == [(point.knob, point.value) for point in chosen]
    other = Base(BASE.capture, BASE.work, frames="0:3", hold_out=("cam03",))
    next(run(other, chosen, read_rows(file)))
    assert len(ran) == len(chosen) + 1  # another request


def test_table_and_plot_show_every_point(monkeypatch):
    monkeypatch.setattr(pareto, "measure", measured)
    rows = list(run(BASE, list(points(["ladder", "settle"])), []))
    text, picture = table(rows), plot(rows)
    assert all(row["value"] in text for row in rows)
    marks = [part.text for part in ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}title")]
    assert len(marks) == len(rows)
    assert picture.count('width="10"') == 2  # draft and standard are presets
