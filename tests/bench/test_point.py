"""A measured point, in full on the tiny capture."""

from __future__ import annotations

import pytest

from bench.pareto import _pairs
from bench.point import Base, measure
from tests.support.golden import FOLDER, SETTINGS


@pytest.mark.slow
def test_a_point_says_its_error_and_what_it_cost(tmp_path):
    fit = {name: value for name, value in SETTINGS["fit"].items()}
    base = Base(
        FOLDER / "capture",
        tmp_path,
        hold_out=("cam03",),
        settings=tuple(_pairs({"keyframes": SETTINGS["keyframes"], "fit": fit})),
    )
    row, outcome = measure(base)
    assert outcome.scene is not None
    assert row["scored_cameras"] == ["cam03"]
    assert 0 < row["fit_cpu_seconds"] < row["cpu_seconds"]
    assert set(row["stages"]) >= {"sync", "motion", "backdrop", "key", "segment", "encode", "evaluate"}
    assert measure(base)[0] == row  # nothing is made again, so it costs what it cost
    smaller, _ = measure(base, ("pictures.max_width=48",), ("cam04",))
    assert smaller["scored_cameras"] == ["cam03"]
    assert smaller["frames"] == row["frames"]
