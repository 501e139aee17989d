"""What was filmed sets the targets where it is known, and tells what is lost."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from packuv.compress import Goal, compress
from packuv.compress.judge import Judge
from packuv.compress.targets import Target, Targets
from packuv.compress.views import Views
from packuv.footage import LensCamera, Response
from packuv.footage import Views as Footage
from packuv.footage.response import PLAIN
from packuv.gaussians.codes import Codes
from packuv.raster import RasterOptions, render
from packuv.scene import open_scene
from tests.support.small_scene import FRAMES, small_scene, small_segments

NEAR = 0.1
GAINS = (0.9, 1.0, 1.2)
"""Of cameras that film the scene"""


@pytest.fixture(scope="module")
def lossless(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("lossless") / "scene.mkv")


@pytest.fixture(scope="module")
def footage(lossless, tmp_path_factory):
    """Of the small scene by its own cameras with gains; the second one lacks the third frame."""
    folder = tmp_path_factory.mktemp("footage")
    with open_scene(lossless) as scene:
        lenses = [LensCamera(camera, gains=GAINS) for camera in scene.header.cameras]
        for lens in lenses:
            place = folder / lens.pinhole.name
            place.mkdir()
            for frame in range(FRAMES):
                drawn = render(scene.gaussians(frame), lens.pinhole, options=RasterOptions(near=NEAR)).colour
                shown = Response.of(lens, lens.pinhole).shown(drawn)
                picture = np.rint(255 * shown.transpose(1, 2, 0)[..., ::-1]).astype(np.uint8)
                cv2.imwrite(str(place / f"{frame:06d}.png"), picture)
    frames = np.repeat(np.arange(FRAMES)[:, None], len(lenses), axis=1)
    frames[2, 1] = -1
    return Footage({lens.pinhole.name: folder / lens.pinhole.name for lens in lenses}, frames, lenses)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    """The small scene as a fit may leave it: each Gaussian a little beside where it was filmed."""
    rng = np.random.default_rng(8)
    segments = []
    for segment in small_segments():
        key = segment.key.xyz + rng.integers(-150, 151, segment.key.xyz.shape)
        segments.append(replace(segment, key=Codes(key.astype(np.uint16), segment.key.attributes)))
    return small_scene(tmp_path_factory.mktemp("wrong") / "scene.mkv", segments)


def test_targets_are_filmed_pictures_of_fitted_cameras_and_lossless_ones(lossless, footage):
    rng = np.random.default_rng(0)
    with open_scene(lossless) as scene:
        targets = Targets(Views(footage.cameras[:2]), Judge(scene).look(scene, footage).filmed, near=NEAR)
        found = [targets.draw(2, lambda: scene.gaussians(2), rng) for _ in range(60)]
    filmed = [target for target in found if target.response is not PLAIN]
    assert {target.camera.name for target in filmed} == {"cam0"}  # of the second there is no such frame
    assert 0.2 < len(filmed) / len(found) < 0.5
    assert all(np.array_equal(target.picture, footage.filmed(0, 2)) for target in filmed)


def test_where_nothing_was_filmed_all_targets_are_lossless(lossless, footage):
    with open_scene(lossless) as scene:
        targets = Targets(Views(footage.cameras), near=NEAR)
        assert targets.draw(0, lambda: scene.gaussians(0), np.random.default_rng(1)).response is PLAIN


def test_a_pull_is_the_derivative_of_half_the_squared_error(footage):
    rng = np.random.default_rng(2)
    picture = footage.filmed(0, 0)
    target = Target(footage.cameras[0], picture, footage.response(0, 0))
    colour = rng.uniform(0.2, 0.8, picture.shape).astype(np.float32)

    def half(values):
        return 0.5 * np.square(target.response.shown(values) - picture, dtype=np.float64).sum()

    along = rng.normal(size=colour.shape).astype(np.float32)
    step = np.float32(1e-3)
    slope = (half(colour + step * along) - half(colour - step * along)) / (2 * float(step))
    assert np.vdot(target.pull(colour), along) == pytest.approx(slope, rel=1e-2)


def test_footage_makes_better_pictures_than_the_scene_it_was_fitted_to(wrong, footage, tmp_path):
    goal = Goal(ratio=1.8)
    blind = compress(wrong, tmp_path / "blind.mkv", goal, iterations=60)
    told = list[float]()
    seeing = compress(
        wrong, tmp_path / "seeing.mkv", goal, footage=footage, iterations=60,
        progress=lambda done, total, note="": told.append(done / total),
    )  # fmt: skip
    assert told == sorted(told)
    assert 0.5 < told[-1] <= 1
    with open_scene(wrong) as scene:
        judge = Judge(scene).look(scene, footage)
    lost = {name: judge.errors(tmp_path / f"{name}.mkv").lost_db for name in ("blind", "seeing")}
    assert seeing.ratio >= 1.8 <= blind.ratio
    assert lost["seeing"] == pytest.approx(seeing.loss_db, abs=1e-9)
    assert lost["seeing"] < lost["blind"] - 0.3
    assert seeing.moved
    assert not seeing.unfollowed
    for name in ("blind", "seeing"):
        with open_scene(tmp_path / f"{name}.mkv") as scene:
            assert scene.header.extra["compression"]["filmed"] == (name == "seeing")


def test_footage_without_a_picture_to_judge_by_is_refused(lossless, footage, tmp_path):
    told = list[tuple[float, float]]()

    def progress(done: float, total: float, note: str = "") -> None:
        told.append((done, total))

    blank = Footage(footage._videos, np.where(np.arange(3) == 2, -1, footage.frames), footage.lenses)
    with pytest.raises(ValueError, match="compared with what cam2 filmed, but the capture has no picture"):
        compress(lossless, tmp_path / "small.mkv", Goal(ratio=1.8), footage=blank, progress=progress)
    assert not list(tmp_path.iterdir())
    assert [done for done, _ in told] == [*range(1, 9 + 2 + 6 + 1)]  # drawn, then filmed: first ones, and all


def test_a_camera_that_films_something_else_is_not_followed(lossless, footage):
    others = dict(footage._videos)
    others["cam0"] = others["cam2"]
    with open_scene(lossless) as scene:
        found = Judge(scene).look(scene, Footage(others, footage.frames, footage.lenses)).filmed
        assert found.followed == ("cam1",)
        assert [*found.unfollowed] == ["cam0"]
        assert "dB to the scene, others" in found.unfollowed["cam0"]
        assert not Judge(scene).look(scene, footage).filmed.unfollowed
        without = Footage(others, np.where(np.arange(3) == 1, -1, footage.frames), footage.lenses)
        assert Judge(scene).look(scene, without).filmed.unfollowed == {"cam1": "no picture at frames 1, 3, 5"}
        assert Judge(scene).look(scene).filmed is None


def test_the_larger_loss_of_held_out_and_of_fitted_cameras_counts(lossless, wrong, footage):
    with open_scene(lossless) as scene, open_scene(wrong) as other:
        filmed = Judge(scene).look(scene, footage).filmed
        right, moved = filmed._levels(scene), filmed._levels(other)
        lost = [right[group] - moved[group] for group in (True, False)]
        assert filmed.lost_db(other) == max(lost)
    assert min(lost) > 1
