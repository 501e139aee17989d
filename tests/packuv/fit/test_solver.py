"""When a frame has had enough iterations, and which Gaussians make room."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from packuv.fit.density import DensityOptions
from packuv.fit.losses import PhotometricOptions, photometric_loss
from packuv.fit.model import Model
from packuv.fit.options import FitOptions
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.first import round_gaussians
from packuv.gaussians.floats import opacity
from packuv.raster import render
from tests.support.dense_raster import OPTIONS, camera, scene

VIEWS = [camera(), camera(64, 48), camera(80, 60)]
LIMIT = 480


def shots(shift: float) -> list[Shot]:
    """What three cameras see of the scene when it has moved."""
    truth = scene(60, degree=0)
    truth.means[:, 0] += shift
    return [Shot(view, render(truth, view, options=OPTIONS).colour.clip(0, 1)) for view in VIEWS]


def settled(shots: list[Shot], limit: int, usual: float = np.inf, **changes: Any) -> tuple[Solver, float | None, int]:
    """A solver that has settled on the shots, its loss, and the iterations that it took."""
    options = FitOptions(random_background=False, frame_iterations=limit, frame_rate_scale=4.0, **changes)
    tried = solver(**changes)
    losses, count = tried.settle(shots, options, usual=usual)
    return tried, None if losses is None else sum(losses.values()), count


def solver(**changes: Any) -> Solver:
    options = FitOptions(random_background=False, **changes)
    return Solver(Model(scene(60, degree=0)), Bounds(np.zeros(3), 2.0, OPTIONS.near), options, np.random.default_rng(0))


def test_what_no_picture_holds_stays_and_what_hardly_shows_goes():
    tried = solver(density=DensityOptions(cap=60, least_views=2))
    (axis,) = {tuple(view.camera_from_world[2, :3]) for view in VIEWS}
    tried.model.gaussians.means[:5] -= 50 * np.float32(axis)  # behind all cameras
    tried.model.gaussians.opacity_logits[6:10] = -4.5  # a picture holds some of their pixels, faintly
    supported = tried.supported(shots(0.0))
    assert supported[:5].all()
    assert not supported[6:10].any()
    assert supported[10:].mean() > 0.5


def test_a_frame_that_is_right_stops_soon():
    _, loss, count = settled(shots(0.0), LIMIT, near_jitter=0.0)
    assert count <= 72
    assert loss < 1e-3


@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_a_frame_goes_on_while_it_gains_whatever_the_near_plane_hides(jitter):
    """Without a camera nearer than 2.7, a near plane of up to 3.2 hides what others see: the loss swings."""
    tried, loss, count = settled(shots(0.15), LIMIT, near_jitter=jitter, near_reach=1.6)
    assert 72 <= count < LIMIT, count
    assert loss < 0.5 * settled(shots(0.15), 3, near_jitter=0.0)[1]
    found = [render(tried.model.gaussians, shot.camera, options=OPTIONS).colour for shot in shots(0.15)]
    whole = [photometric_loss(picture, shot.target, options=PhotometricOptions()).value
             for picture, shot in zip(found, shots(0.15), strict=True)]  # fmt: skip
    assert loss == pytest.approx(np.mean(whole), rel=0.25)


def test_slower_gains_are_waited_for_if_asked():
    short = settled(shots(0.15), LIMIT, near_jitter=0.0, settle=0.2)[2]
    long = settled(shots(0.15), LIMIT, near_jitter=0.0, settle=0.005)[2]
    assert short < long


def test_a_frame_far_from_its_keyframes_loss_goes_on_although_it_gains_little():
    early = settled(shots(0.15), LIMIT, near_jitter=0.0, settle=0.2)
    _, loss, count = settled(shots(0.15), LIMIT, early[1] / 2 / 1.3, near_jitter=0.0, settle=0.2, near_key=1.3)
    assert early[2] < count < LIMIT
    assert loss <= early[1] / 2
    assert settled(shots(0.15), LIMIT, 1e-9, near_jitter=0.0, settle=0.2)[2] == LIMIT


def test_the_limit_holds_and_no_loss_is_made_up():
    assert settled(shots(0.15), 30, near_jitter=0.0)[2] == 30
    assert settled(shots(0.15), 30, near_jitter=1.0, near_reach=1.6)[1:] == (None, 30)


def test_what_shows_least_makes_room_and_what_is_frozen_stays():
    tried = solver(density=DensityOptions(cap=50))
    rows = np.arange(60) % 3 != 0
    tried.free(rows)
    pictures = [render(tried.model.gaussians, view, options=OPTIONS, weights=True) for view in VIEWS]
    shown = sum(picture.weights for picture in pictures)
    before = tried.model.gaussians.means.copy()
    tried.make_room(shots(0.0))
    stays = ~rows | (shown > np.sort(shown[rows])[9])
    assert np.array_equal(tried.model.gaussians.means, before[stays])
    assert len(tried.rows) == len(tried.model) == 50
    tried.make_room(shots(0.0))
    assert len(tried.model) == 50


@pytest.mark.parametrize(("black_share", "stays"), [(0.1, True), (0.6, False)], ids=["a room", "a bare stage"])
def test_black_is_a_surface_in_a_room_and_nothing_on_a_bare_stage(black_share, stays):
    """One black Gaussian before black: nobody can tell, so how much of the pictures is black decides."""
    black = round_gaussians(np.zeros((1, 3)), np.zeros((1, 3)), np.array([0.08]), opacity=0.8, sh_degree=0)
    targets = []
    for view in VIEWS:
        picture = np.full((3, view.height, view.width), 0.5, np.float32)
        side = np.sqrt(black_share) / 2
        rows, columns = (slice(round((0.5 - side) * n), round((0.5 + side) * n)) for n in (view.height, view.width))
        picture[:, rows, columns] = 0
        targets.append(Shot(view, picture))
    options = FitOptions(near_jitter=0.0)
    tried = Solver(Model(black), Bounds(np.zeros(3), 2.0, OPTIONS.near), options, np.random.default_rng(0))
    tried.run(targets, 60, of=60)
    assert bool(opacity(tried.model.gaussians)[0] > 0.5) is stays
