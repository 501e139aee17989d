"""Scores: what a gain may explain, what tables keep, which cameras stand for the rest."""

from __future__ import annotations

import doctest
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from packuv.colour import linear_from_srgb, srgb_from_linear
from packuv.each import spread
from packuv.metrics import psnr
from packuv.score import Score, read_table, summary, with_own_gain, write_table
from sync.align import FrameGroups
from tasks.artefacts.stage import Files
from tasks.artefacts.store import Key
from tasks.report.facts import still_trend
from tasks.stages import evaluate
from tasks.stages.evaluate import SAME_NS, Evaluate, _rows, frame_scores
from tasks.stages.footage import Take

RNG = np.random.default_rng(5)
SCENE = RNG.uniform(0.05, 0.7, (3, 24, 32)).astype(np.float32)


def test_examples_in_docstrings():
    assert doctest.testmod(evaluate).failed == 0


@given(st.tuples(*[st.floats(0.8, 1.25)] * 3))
def test_own_gain_undoes_any_exposure_and_white_balance(gains):
    light = linear_from_srgb(SCENE.astype(np.float64)) * np.array(gains)[:, None, None]
    filmed = srgb_from_linear(light).astype(np.float32)
    # Exact but for the straight part of sRGB near black, which the factor on sRGB + 0.055 leaves out.
    assert psnr(with_own_gain(SCENE, filmed), filmed) > 60
    assert psnr(with_own_gain(filmed, filmed), filmed) > 90


def test_own_gain_does_not_explain_structure():
    noisy = np.clip(SCENE + RNG.normal(0, 0.1, SCENE.shape), 0, 1).astype(np.float32)
    # A single factor fitted to independent noise gains next to nothing.
    assert psnr(with_own_gain(noisy, SCENE), SCENE) == pytest.approx(psnr(noisy, SCENE), abs=0.5)


TIMES = np.array([0, 33_366_666, 66_733_333, 100_100_000])
"""Nanoseconds"""


def rows_at(times: np.ndarray) -> list[int]:
    nobody = np.zeros((len(TIMES), 1), np.int64)
    return list(_rows(FrameGroups(("a",), "a", TIMES, nobody.astype(np.int32), nobody), times))


@given(st.lists(st.integers(-SAME_NS, SAME_NS), min_size=3, max_size=3))
def test_instants_are_found_by_their_times_however_they_were_heard(shifts):
    assert rows_at(TIMES[[0, 1, 3]] + shifts) == [0, 1, 3]


@pytest.mark.parametrize(
    "times", [TIMES + SAME_NS + 1, TIMES - SAME_NS - 1, TIMES[:1] + 133_000_000, TIMES[[1, 1]] + [0, 1]]
)
def test_instants_that_were_not_filmed_are_refused(times):
    with pytest.raises(ValueError, match="did not film the scene's instants"):
        rows_at(times)


FLICKER = (None, 0.01, 0.03)


def scores(frames: int = 3) -> list[Score]:
    return [
        Score(
            frame,
            frame * 33_000_000,
            camera,
            True,
            20.0 + frame,
            0.5,
            level,
            0.6,
            22.0,
            0.7,
            FLICKER[frame % 3],
            psnr_moving_db=19.0,
            psnr_still_db=30.0 - 0.01 * frame,
            moving_share=0.25,
            tof_px=0.5,
            lpips=None,
        )
        for frame in range(frames)
        for camera, level in (("cam05", 24.0), ("cam14", None))
    ]


def test_table_gives_scores_back(tmp_path):
    write_table(tmp_path / "metrics.arrow", scores())
    assert list(read_table(tmp_path / "metrics.arrow")) == scores()


def test_exact_pictures_count_as_infinite_in_the_report_and_not_at_all_in_means():
    assert [item.psnr_db for item in frame_scores(scores())][:2] == [24.0, float("inf")]
    facts = summary(scores(), frames=3, size_bytes=3000, borders=[2])
    assert facts["by_camera"]["cam05"]["psnr_calibrated_db"] == 24.0
    assert facts["by_camera"]["cam14"]["psnr_calibrated_db"] is None
    assert facts["mean"]["psnr_db"] == 21.0
    assert facts["held_out"]
    assert facts["bytes_per_frame"] == 1000
    assert facts["seam"] == pytest.approx(3.0)
    assert summary(scores(), frames=3, size_bytes=3000, borders=[])["seam"] is None


def test_trends_are_told_by_camera_and_over_all_where_there_are_frames_enough():
    facts = summary(scores(60), frames=60, size_bytes=1, borders=[])
    for means in (facts["mean"], facts["by_camera"]["cam05"], facts["by_camera"]["cam14"]):
        assert means["still_trend_db"] == pytest.approx(-1.0)
        assert means["never_moving_trend_db"] is None
    assert summary(scores(), frames=3, size_bytes=1, borders=[])["mean"]["still_trend_db"] is None
    assert still_trend(frame_scores(scores(60))) == pytest.approx(-1.0)


def test_the_content_of_the_weights_decides_what_is_scored_anew_not_their_place():
    take = Take(groups=Key("sync", "0" * 64), cameras=("cam05",))

    def recipe(**lpips: Any) -> Any:
        stage = Evaluate(take=take, scene=Key("encode", "0" * 64), **lpips)
        return stage.sources, stage.settings

    here = recipe(backbone=Files({"backbone": "1" * 64}), weights="/here/alexnet.pth")
    assert here == recipe(backbone=Files({"backbone": "1" * 64}), weights="/there/alexnet.pth")
    assert here != recipe(backbone=Files({"backbone": "2" * 64}), weights="/here/alexnet.pth")
    assert here != recipe(no_lpips="no file")
    assert recipe(no_lpips="no file") == recipe(no_lpips="no package")


def test_who_draws_takes_a_gpu_but_does_not_decide():
    take = Take(groups=Key("sync", "0" * 64), cameras=("cam05",))
    cpu, cuda = (Evaluate(take=take, scene=Key("encode", "0" * 64), device=device) for device in ("cpu", "cuda"))
    assert (cpu.sources, cpu.settings) == (cuda.sources, cuda.settings)
    assert (cpu.on_gpu, cuda.on_gpu) == (False, True)


@given(st.lists(st.text(min_size=1, max_size=3), unique=True, max_size=40), st.integers(1, 8))
def test_spread_takes_distinct_names_in_order(names, count):
    chosen = spread(names, count)
    assert len(chosen) == min(count, len(names))
    assert list(chosen) == [name for name in names if name in chosen]
