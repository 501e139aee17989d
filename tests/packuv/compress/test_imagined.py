"""Scenes that nobody filmed are compressed by views from rings about them, and the file says so."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from packuv.compress import Goal, compress
from packuv.compress.imagined import CLOSE, RINGS, WHOLE, looked_at
from packuv.compress.judge import Judge
from packuv.compress.views import Views
from packuv.compress.weigh import weigh
from packuv.gaussians.codes import OPACITY, Codes, attribute_count
from packuv.gaussians.floats import drawn
from packuv.gaussians.orbit import middle
from packuv.gaussians.segment import Segment
from packuv.metrics import decibels
from packuv.progress import Ticks, no_progress
from packuv.scene import SceneHeader, open_scene, verify_scene, write_scene
from packuv.scene.header import ADOPTED
from tests.support.small_scene import small_quantizer, small_scene, small_segments

GOAL = Goal(loss_db=1)


def still_scene(path, rows=500, *, degree=0, opacity=None, **told):
    """One frame of the small scene's first rows, seen by no camera; other opacity codes if any are given."""
    quantizer, key = small_quantizer(), small_segments()[0].key
    bands = attribute_count(degree) - attribute_count(0)
    wide = np.append(quantizer.high, np.full(bands, 0.5)), np.append(quantizer.low, np.full(bands, -0.5))
    quantizer = replace(quantizer, high=wide[0], low=wide[1], sh_degree=degree)
    rest = np.random.default_rng(5).integers(64, 192, (rows, bands)).astype(np.uint8)
    attributes = np.concatenate([key.attributes[:rows], rest], axis=1)
    if opacity is not None:
        attributes[:, OPACITY] = opacity
    nobody, count = np.zeros(rows, bool), attributes.shape[1]
    empty = np.zeros((0, 0, 3), np.uint16), np.zeros((0, 0, count), np.uint8)
    Segment(0, Codes(key.xyz[:rows], attributes), nobody, *empty).save(path.with_suffix(".npz"))
    header = SceneHeader(quantizer, np.zeros(1, np.int64), Fraction(25), **told)
    write_scene(path, [path.with_suffix(".npz")], header)
    path.with_suffix(".npz").unlink()
    return path


def test_own_cameras_are_kept(tmp_path):
    with open_scene(small_scene(tmp_path / "scene.mkv")) as scene:
        assert looked_at(scene) is scene.header
        assert Judge(scene).look(scene).imagined is None


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)], ids=str)
def test_imagined_cameras_stand_in_rings_about_what_is_drawn(tmp_path, up):
    with open_scene(still_scene(tmp_path / "scene.mkv", extra={"up": up, "near": 0.25})) as scene:
        header, judge, shown = looked_at(scene), Judge(scene).look(scene), drawn(scene.gaussians(0))
    centre, radius = middle(shown, share=CLOSE.share)
    near_middle = np.linalg.norm(shown.means - centre, axis=1) <= middle(shown, share=WHOLE.share)[1]
    assert near_middle.mean() > 0.9
    assert header.near == 0.25
    assert len(header.cameras) == CLOSE.cameras * (len(RINGS) + 1) == len({c.name for c in header.cameras})
    heights = []
    for camera in header.cameras:
        away = camera.centre - centre
        assert camera.name.startswith("imagined")
        assert camera.camera_from_world[1, :3] @ up < 0  # down in the picture is down
        assert np.allclose(camera.forward, -away / np.linalg.norm(away))
        assert np.linalg.norm(away) > 2 * radius
        pixels, _ = camera.project(shown.means[near_middle])
        if camera.width == camera.height:  # what shows the whole
            assert ((pixels > 0) & (pixels < camera.width)).all()
        heights.append(np.degrees(np.arcsin(away @ up / np.linalg.norm(away))))
    assert np.allclose(np.unique(np.round(heights, 6)), sorted({15.0, *(elevation for elevation, _ in RINGS)}))
    unseen = {camera.name for camera in judge.cameras} - {camera.name for camera in judge.learned}
    assert unseen
    assert unseen < set(header.held_out)
    assert not {camera.name for camera in judge.learned} & set(header.held_out)


def test_up_is_that_of_splat_files_or_of_the_map_where_nothing_is_said(tmp_path):
    for extra, up in (({ADOPTED: {}}, [0, -1, 0]), ({}, [0, 0, 1])):
        with open_scene(still_scene(tmp_path / "scene.mkv", extra=extra)) as scene:
            header = looked_at(scene)
            assert header.extra["imagined"]["up"] == up
        assert header.near > 0


def circled(imagined):
    """What a header says of imagined cameras, to the digits that one of a compressed scene has."""
    return np.float32([*imagined["up"], *(place for ball, radius in imagined["spheres"] for place in (*ball, radius))])


@pytest.mark.parametrize("degree", [0, 3])
def test_a_still_scene_that_nobody_filmed_is_compressed_and_says_so(tmp_path, degree):
    scene = still_scene(tmp_path / "scene.mkv", degree=degree)
    found = compress(scene, tmp_path / "small.mkv", GOAL, iterations=3)
    assert found.imagined
    assert found.loss_db <= 1
    assert found.bytes < scene.stat().st_size
    assert verify_scene(tmp_path / "small.mkv").ok
    with open_scene(scene) as source, open_scene(tmp_path / "small.mkv") as small:
        said, judge = small.header.extra["compression"], Judge(source).look(source)
        assert small.header.cameras == ()
    assert np.array_equal(*map(circled, (said["imagined"], judge.imagined)))
    assert all(name.startswith("imagined") for name in said["cameras"])
    errors = judge.errors(tmp_path / "small.mkv")
    assert decibels(errors.mean) == pytest.approx(found.psnr_db)
    assert decibels(errors.unseen) == pytest.approx(found.psnr_held_out_db)
    assert found.loss_db == pytest.approx(GOAL.loss(found.psnr_held_out_db))


@pytest.mark.parametrize("rows", [1, 2])
def test_a_scene_of_next_to_nothing_stays_as_it_is(tmp_path, rows):
    scene = still_scene(tmp_path / "scene.mkv", rows)
    for goal in (GOAL, Goal(ratio=1.1)):
        with pytest.raises(ValueError, match="gets no smaller: its header says more then; keep it as it is"):
            compress(scene, tmp_path / "small.mkv", goal, iterations=3)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.mkv"]


@pytest.mark.parametrize("opacity", [0, 1])
def test_a_scene_that_draws_nothing_is_refused(tmp_path, opacity):
    scene = still_scene(tmp_path / "scene.mkv", 5, opacity=opacity)
    with pytest.raises(ValueError, match=r"must show something to be compressed, but has no Gaussian"):
        compress(scene, tmp_path / "small.mkv", GOAL)


def test_a_scene_whose_cameras_see_nothing_is_refused(tmp_path):
    with open_scene(small_scene(tmp_path / "filmed.mkv")) as scene:
        cameras = scene.header.cameras
    scene = still_scene(tmp_path / "scene.mkv", opacity=0, cameras=cameras, extra={"near": 0.1})
    with pytest.raises(ValueError, match="must show something to be compressed, but its cameras see nothing"):
        compress(scene, tmp_path / "small.mkv", GOAL)
    assert not (tmp_path / "small.mkv").exists()


def test_what_lies_beside_all_imagined_pictures_stays(tmp_path):
    with open_scene(still_scene(tmp_path / "scene.mkv", 200)) as scene:
        segment, header, judge = scene.segment(0), scene.header, Judge(scene).look(scene)
    key = Codes(segment.key.xyz.copy(), segment.key.attributes.copy())
    key.xyz[0] = 32768, 32768, 65535  # straight above all cameras, which look down on the others
    means = header.quantizer.decode(key).means[:1]
    rng, told = np.random.default_rng(0), {"near": judge.near, "ticks": Ticks(no_progress, 1)}
    found = [
        weigh(replace(segment, key=key), header.quantizer, views, rng=rng, **told)
        for views in (judge.views, Views(judge.learned))
    ]
    assert all(camera.centre[2] < means[0, 2] for camera in judge.learned)
    assert np.isinf(found[0][0])
    assert found[1][0] == 0
    assert np.isfinite(found[0][1:]).all()
