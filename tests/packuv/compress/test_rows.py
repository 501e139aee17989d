"""Fewer rows and moved codes: nearer to the lossless pictures than coarse codes are, and nobody comes or goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from packuv.compress.rows import Rows
from packuv.compress.steps import Steps
from packuv.compress.targets import Targets
from packuv.compress.tune import moved, moved_segment, tune
from packuv.compress.views import LEAST, MOST, Views
from packuv.compress.weigh import pictures_of, weigh, worth
from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.segment import Segment
from packuv.progress import Ticks, no_progress
from packuv.raster import RasterOptions, render
from packuv.scene import open_scene
from tests.support.small_scene import MOVING, ROWS, small_quantizer, small_scene, small_segments

NEAR, COLUMNS = 0.1, 13
COARSE = Steps(np.full(3, 30.0), np.full(COLUMNS - 3, 12.0), multiple=8)


@pytest.fixture(scope="module")
def cameras(tmp_path_factory):
    with open_scene(small_scene(tmp_path_factory.mktemp("rows") / "scene.mkv")) as scene:
        return scene.header.cameras


def ticks() -> Ticks:
    return Ticks(no_progress, 1)


def test_views_are_cameras_of_the_scene_or_stand_between_two(cameras):
    rng, views = np.random.default_rng(0), Views(cameras)
    seen = [views.draw(rng) for _ in range(100)]
    own = {id(camera) for camera in cameras}
    assert own < {id(camera) for camera in seen}
    rights = np.array([camera.centre[0] for camera in seen])
    assert rights.min() >= 2 * LEAST * 0.5 - 1e-9
    assert rights.max() <= 1 + 0.5 * 2 * MOST
    for camera in seen:
        turn = camera.camera_from_world[:3, :3]
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) > 0


def test_a_camera_alone_is_the_only_view(cameras):
    assert Views(cameras[:1]).draw(np.random.default_rng(1)) is cameras[0]


def test_weights_are_those_of_pictures(cameras):
    segment = small_segments()[0]
    key = Codes(segment.key.xyz.copy(), segment.key.attributes.copy())
    key.xyz[ROWS - 1] = key.xyz[ROWS - 2]
    key.attributes[ROWS - 2] = key.attributes[ROWS - 1]
    key.attributes[ROWS - 1, OPACITY] = 0  # never there
    key.attributes[ROWS - 2, :3] = 0  # a speck
    segment = replace(segment, key=key)
    found = weigh(segment, small_quantizer(), Views(cameras), near=NEAR, rng=np.random.default_rng(2), ticks=ticks())
    assert np.isinf(found[ROWS - 1])
    assert found[ROWS - 2] < np.median(found)
    assert (found[:-1] >= 0).all()
    assert found[:-1].max() <= 1


@pytest.mark.parametrize(("frames", "cameras", "pictures"), [(1, 3, 8), (3, 3, 24), (30, 27, 64), (30, 90, 96)])
def test_each_camera_is_looked_from(frames, cameras, pictures):
    assert pictures_of(frames, cameras) == pictures


def test_a_sweep_begins_at_each_camera_as_often(cameras):
    rng, views = np.random.default_rng(7), Views(cameras)
    names = [camera.name for camera in views.sweep(7, rng)]
    assert sorted(names[:3]) == sorted(names[3:6]) == [camera.name for camera in cameras]


def test_more_noise_leaves_fewer_and_never_none():
    weights = np.random.default_rng(3).random(50).astype(np.float32) / 1000
    kept = [worth(weights, noise) for noise in (0.0, 5e-10, 1e-9, 2e-9, 1.0)]
    counts = [int(rows.sum()) for rows in kept]
    assert counts[0] == len(weights)
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 1
    assert kept[-1][np.argmax(weights)]


def test_moved_rows_stay_equal_and_present():
    segment = COARSE.segment(small_segments()[0])
    offsets = np.random.default_rng(4).normal(0, 3, (ROWS, COLUMNS))
    found = moved_segment(segment, offsets, COARSE)
    for index in range(len(segment)):
        before, after = segment.frame(index), found.frame(index)
        assert np.array_equal(before.attributes[:, OPACITY] > 0, after.attributes[:, OPACITY] > 0)
        assert after.attributes.max() <= 255 / 12
        same = (before.xyz == segment.key.xyz).all(axis=1)
        assert np.array_equal(after.xyz[same], found.key.xyz[same])
    assert np.array_equal(moved(segment.key, np.zeros((ROWS, COLUMNS)), COARSE).xyz, segment.key.xyz)


def error(segment: Segment, cameras) -> float:
    """Mean squared error of the frames' pictures, in coarse steps, to those of the lossless ones."""
    lossless, options = small_segments()[0], RasterOptions(near=NEAR)
    quantizer, wide, errors = small_quantizer(), COARSE.quantizer(small_quantizer()), []
    for index in range(len(segment)):
        for camera in cameras:
            pictures = [
                np.clip(render(own.decode(codes), camera, options=options).colour, 0, 1)
                for own, codes in ((quantizer, lossless.frame(index)), (wide, segment.frame(index)))
            ]
            errors.append(np.square(pictures[0] - pictures[1], dtype=np.float64).mean())
    return float(np.mean(errors))


def test_tuning_makes_up_for_who_is_left_out_and_leaves_others_alone(cameras):
    lossless, quantizer = small_segments()[0], small_quantizer()
    kept = np.random.default_rng(1).random(ROWS) < 0.8
    coarse = COARSE.segment(lossless.only(kept))
    free = np.arange(len(coarse.key)) != 7
    offsets = tune(
        coarse,
        COARSE,
        COARSE.quantizer(quantizer),
        lambda frame: quantizer.decode(lossless.frame(frame)),
        Targets(Views(cameras), near=NEAR),
        np.zeros((len(free), COLUMNS)),
        free=free,
        iterations=40,
        near=NEAR,
        rng=np.random.default_rng(5),
        ticks=ticks(),
    )
    assert not offsets[7].any()
    # Measured: a tenth.
    assert error(moved_segment(coarse, offsets, COARSE), cameras) < 0.25 * error(coarse, cameras)


def test_keys_of_equal_rows_stay_equal_when_they_are_tuned(cameras, tmp_path):
    with open_scene(small_scene(tmp_path / "scene.mkv")) as scene:
        targets = Targets(Views(cameras), near=NEAR)
        rows = Rows(scene, targets, tmp_path, near=NEAR, seed=0, ticks=ticks())
        first, second = (Segment.load(path) for path in rows.coarse(1e-7, COARSE, 10))
    assert 0 < rows.kept < rows.count == 2 * ROWS
    where = {row.tobytes() for row in np.hstack([first.key.xyz, first.key.attributes.astype(np.uint16)])}
    others = [row.tobytes() for row in np.hstack([second.key.xyz, second.key.attributes.astype(np.uint16)])]
    assert sum(row in where for row in others) > 0.9 * len(others)
    assert second.dynamic.sum() <= MOVING
