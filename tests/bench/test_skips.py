"""What skips save: their settings exist, scenes move as much as they say, and the table tells all of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import skips
from bench.point import Base
from bench.skips import SCENES, SETTINGS, SKIPS, run, table
from pipelines.options import compose
from pipelines.request import read_settings
from studio.film_set import MOVING, build_set
from sync.capture import CaptureSettings
from tests.support.golden import FOLDER


@pytest.mark.parametrize("name", SKIPS)
def test_a_skip_off_is_other_settings_than_on(name):
    on, off = (
        compose("draft", CaptureSettings(), read_settings(None, [*SETTINGS, *pairs]))
        for pairs in (SKIPS[name].on, SKIPS[name].off)
    )
    assert on != off


def test_only_what_is_named_moves_and_a_crowd_walks():
    def shapes(seconds: float, **options: Any) -> np.ndarray:
        return build_set(7, 0.1, **options).at(seconds).blockers

    assert np.array_equal(shapes(0, moving=()), shapes(2, moving=()))
    all_still, crate = shapes(2, moving=()), shapes(2, moving=("walker",))
    assert (all_still != crate).any()
    before, after = shapes(0, moving=MOVING, crowd=27), shapes(0.5, moving=MOVING, crowd=27)
    assert len(before) == len(shapes(0)) + 4 * 27
    trunks = (after - before)[len(shapes(0)) + 3 :: 4, :2]  # of each person's four balls; a foot may stand
    moved = np.linalg.norm(trunks, axis=1)
    assert (moved > 0.1).all()
    assert list(SCENES) == ["still", "2", "15", "60"]


def test_what_is_saved_and_added_is_told_from_the_same_settings(monkeypatch):
    figures = {(): (100.0, 25.0), ("fit.sh_degree=1",): (110.0, 25.1), SKIPS["SH bands"].off: (140.0, 25.0)}
    ran = []

    def measure(base: Base, settings: tuple[str, ...]) -> tuple[dict[str, Any], None]:
        ran.append(settings)
        cost, level = figures[settings]
        return {"cpu_seconds": cost, "psnr_calibrated_db": level}, None

    monkeypatch.setattr(skips, "measure", measure)
    base = Base(FOLDER / "capture", Path("/work"), hold_out=("cam03",))
    rows = [{"scene": "still", **row} for row in run(base, ["SH bands"], [])]
    assert rows[1]["saved_cpu_seconds"] == 30
    assert rows[1]["added_db"] == pytest.approx(-0.1)
    assert "| still | SH bands | 140 | 30 | 21% | 25.00 | -0.10 |" in table(rows)
    list(run(base, ["SH bands"], rows))
    assert len(ran) == 4  # no row holds the figures of degree 1 with its bands dropped; the store does
