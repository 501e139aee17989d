"""Gains recovered from observations with known ones."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.accept import matches_report
from calibration.colour import BalanceOptions, ColourModel, ColourReport, balance, with_colours
from calibration.features import FeatureOptions
from calibration.held_out import balance_held_out
from calibration.rig import Rig
from calibration.shading import corner_radius, shading_basis, turns_back
from calibration.srgb import LINEAR
from calibration.triangulate import SparsePoints, TriangulateOptions, triangulate
from tests.support.calibration_scene import filmed, ring, srgb

CAMERAS = 8


def observed(
    gains: np.ndarray,
    *,
    shading: np.ndarray | None = None,
    points: int = 400,
    noise: float = 0.02,
    outliers: float = 0.0,
    seed: int = 0,
) -> SparsePoints:
    """Points of random colours, each seen somewhere in the pictures of four neighbouring cameras.

    Their sensors divide light by their gains, their lenses lose some by k1, k2 [C, 2].
    """
    rng = np.random.default_rng(seed)
    point = np.repeat(np.arange(points), 4).astype(np.int32)
    camera = np.sort((rng.integers(0, CAMERAS, (points, 1)) + np.arange(4)) % CAMERAS, axis=1).ravel().astype(np.int32)
    colour = rng.uniform(0.05, 0.5, (points, 3))[point] / gains[camera] * np.exp(rng.normal(0, noise, (4 * points, 3)))
    shiny = rng.uniform(size=4 * points) < outliers
    colour[shiny] *= rng.uniform(1.3, 2.5, (int(shiny.sum()), 1))
    rig = ring(CAMERAS)
    xy = rng.uniform(0, 1, (4 * points, 2)) * (640, 360)
    if shading is not None:
        colour *= np.exp((shading[camera] * basis(rig, xy)).sum(axis=1))[:, None]
    return SparsePoints(
        cameras=rig.names,
        xyz=np.zeros((points, 3)),
        rgb=np.zeros((points, 3), np.uint8),
        views=np.full(points, 4, np.int32),
        error_px=np.zeros(points, np.float32),
        instant=np.zeros(points, np.int32),
        point=point,
        camera=camera,
        xy=xy.astype(np.float32),
        colour=colour.astype(np.float32),
        matches=matches_report(rig, []),
    )


def basis(rig: Rig, xy: np.ndarray) -> np.ndarray:
    """All cameras of the ring have the same intrinsics."""
    camera = rig.cameras[0]
    return shading_basis(camera, (xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy))


def balanced(points: SparsePoints, **options: float) -> ColourReport:
    return balance(ring(CAMERAS), points, options=BalanceOptions(**options))


def random_gains(seed: int = 1, spread: float = 0.2) -> np.ndarray:
    log = np.random.default_rng(seed).normal(0, spread, (CAMERAS, 3))
    return np.exp(log - log.mean(axis=0))


def found(points: SparsePoints, **options: float) -> np.ndarray:
    return np.array(list(balanced(points, **options).gains.values()))


@pytest.mark.parametrize("seed", range(3))
def test_gains_come_back_within_the_noise(seed):
    gains = random_gains(seed)
    # 200 observations a camera with 2 % noise: 0.14 % if the others were known, some more because they are not.
    assert np.abs(found(observed(gains, seed=seed)) / gains - 1).max() < 0.01


def test_highlights_do_not_bend_them():
    gains = random_gains()
    points = observed(gains, outliers=0.1)
    robust = np.abs(found(points) / gains - 1)
    squares = np.abs(found(points, huber=100.0) / gains - 1)
    # A tenth of the observations, half as bright again and more, shifts least squares by about 5 %; all cameras have
    # them alike, so only their unevenness counts.
    assert robust.max() < 0.015
    assert robust.mean() < 0.5 * squares.mean()


def test_their_geometric_mean_is_one():
    assert np.allclose(np.log(found(observed(random_gains()))).mean(axis=0), 0, atol=1e-6)


def test_a_common_factor_of_all_cameras_changes_nothing():
    gains = random_gains()
    assert np.allclose(found(observed(gains)), found(observed(1.25 * gains)), rtol=5e-3)  # dark colours weigh less


def test_balanced_cameras_are_left_alone():
    report = balanced(observed(np.ones((CAMERAS, 3))))
    assert not report.kept
    assert "do not agree better" in report.reason
    assert set(report.gains.values()) == {(1.0, 1.0, 1.0)}


def test_the_report_tells_the_held_out_spread():
    report = balanced(observed(random_gains()))
    assert report.kept
    assert list(report.spreads) == list(ColourModel)
    assert report.spreads[ColourModel.NONE] > 0.05
    # Deviations from the median of four, of 2 % noise: about half of them stay below 1.2 %.
    assert report.spreads[ColourModel.GAINS] == pytest.approx(0.012, abs=0.003)
    assert json.loads(json.dumps(report.to_json()))["points"] == 400


def test_a_camera_that_sees_too_little_keeps_one_and_is_named():
    points = observed(random_gains())
    rows = np.flatnonzero(points.camera == 3)[10:]
    colour = points.colour.copy()
    colour[rows] = np.nan
    report = balanced(replace(points, colour=colour))
    assert report.weak_cameras == ("cam03",)
    assert report.gains["cam03"] == (1.0, 1.0, 1.0)
    assert report.observations["cam03"] == 10
    others = np.array([gain for name, gain in report.gains.items() if name != "cam03"])
    assert np.allclose(np.log(others).mean(axis=0), 0, atol=1e-6)


def test_cameras_that_share_no_points_are_balanced_in_their_groups():
    gains = random_gains()
    points = observed(gains)
    group = points.camera >= 4
    mixed = np.bincount(points.point, group) % 4 != 0  # points that both halves see
    colour = np.where(mixed[points.point][:, None], np.float32(np.nan), points.colour)
    report = balanced(replace(points, colour=colour))
    log = np.log(np.array(list(report.gains.values())))
    expected = np.log(gains)
    for half in (slice(0, 4), slice(4, 8)):
        assert np.allclose(log[half], expected[half] - expected[half].mean(axis=0), atol=0.01)


def test_without_observations_nothing_is_claimed():
    points = observed(random_gains(), points=5)
    report = balanced(points)
    assert not report.kept
    assert report.reason == "only 0 cameras have 30 usable observations or more"
    assert len(report.weak_cameras) == CAMERAS


def test_gains_enter_the_rig():
    report = balanced(observed(random_gains()))
    rig = with_colours(ring(CAMERAS), report)
    assert rig["cam05"].gains == report.gains["cam05"]
    assert rig.names == ring(CAMERAS).names


def test_from_pictures_to_gains():
    rig, gains, pictures = filmed(6)
    options = TriangulateOptions(features=FeatureOptions(max_features=600))
    report = balance(rig, triangulate(rig, [pictures], options=options))
    assert report.kept
    # The strongest features are the worst case: their patches shrink in oblique views and take in darker surroundings.
    # Measured 1.6 % at worst; with seven times as many features 0.3 %.
    assert np.abs(np.array(list(report.gains.values())) / gains - 1).max() < 0.025


SHADING = np.array([(-0.35, 0.05)] * 4 + [(-0.1, 0.05), (0.0, 0.0), (-0.6, 0.1), (-0.3, -0.1)])
RADII = np.linspace(0, 1, 11)


def light_apart(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Greatest difference of the light that two shadings [C, 2] say for a radius, natural logarithm [C]."""
    camera = ring(1).cameras[0]
    between = shading_basis(camera, np.stack([RADII * corner_radius(camera), 0 * RADII], axis=1))
    return np.abs((found - true) @ between.T).max(axis=1)


def shading_of(report: ColourReport) -> np.ndarray:
    return np.array(list(report.shading.values()))


def test_shading_of_each_lens_comes_back_with_the_gains():
    gains = random_gains()
    report = balanced(observed(gains, shading=SHADING, points=1600, outliers=0.1))
    assert report.model is ColourModel.OWN
    assert "shading pays" in report.shading_reason
    assert np.abs(np.array(list(report.gains.values())) / gains - 1).max() < 0.015
    # 800 observations of 2 % noise, a tenth of them highlights; k2 is drawn to the rig's. The corner is worst.
    assert light_apart(shading_of(report), SHADING).max() < 0.05


def test_one_shading_for_all_suffices_where_all_lenses_are_alike():
    shading = np.tile((-0.3, 0.05), (CAMERAS, 1))
    report = balanced(observed(random_gains(), shading=shading))
    assert report.model is ColourModel.COMMON
    assert len(set(report.shading.values())) == 1
    assert light_apart(shading_of(report), shading).max() < 0.03


@pytest.mark.parametrize("seed", range(3))
def test_lenses_without_shading_are_left_alone(seed):
    report = balanced(observed(random_gains(seed), seed=seed))
    assert report.model is ColourModel.GAINS
    assert report.shading_reason.startswith("shading does not pay: held-out points deviate by")
    assert set(report.shading.values()) == {(0.0, 0.0)}


def test_shading_alone_is_found_where_exposures_agree():
    report = balanced(observed(np.ones((CAMERAS, 3)), shading=np.tile((-0.5, 0.0), (CAMERAS, 1))))
    assert report.shaded
    assert np.abs(np.log(list(report.gains.values()))).max() < 0.01


def test_a_camera_that_sees_few_points_is_drawn_to_the_rigs_shading():
    points = observed(random_gains(), shading=SHADING, points=1600)
    rows = np.flatnonzero(points.camera == 5)  # a lens without any
    rows = rows[np.argsort(np.abs(basis(ring(CAMERAS), points.xy[rows])[:, 0]))]
    xy = points.xy.copy()
    xy[rows[:32]] = xy[rows[0]]
    for count in (32, 10):
        colour = points.colour.copy()
        colour[rows[count:]] = np.nan
        report = balanced(replace(points, colour=colour, xy=xy))
        found, common = np.array([report.shading["cam05"]]), np.array([report.common_shading])
        assert light_apart(found, common)[0] < 0.01  # observations at one place say nothing of a falloff
        assert ("cam05" in report.weak_cameras) == (count == 10)
    assert report.shading["cam05"] == report.common_shading


def test_light_does_not_turn_back_on_its_way_to_the_corner():
    assert turns_back(np.array([(-1.0, 1.0), (-0.3, 0.05), (0.8, -0.8), (0.0, 0.0)])).tolist() == [True, False] * 2
    wild = np.tile((-0.3, 0.05), (CAMERAS, 1))
    wild[2] = -1.2, 1.2
    report = balanced(observed(random_gains(), shading=wild, points=1600), shading_spread=(1.0, 1.0))
    assert report.model is ColourModel.OWN
    assert not turns_back(shading_of(report)).any()
    assert report.shading["cam02"][1] == 0


# Cameras that took no part


@pytest.fixture(scope="module")
def room():
    """An arc of cameras, their gains, shading and pictures, and the points of all but one."""
    rig, gains, pictures = filmed(7)
    shading = np.tile((-0.4, 0.05), (7, 1))
    shading[3] = -0.2, 0.0
    shaded = {}
    for camera, (k1, k2) in zip(rig.cameras, shading, strict=True):
        picture = pictures[camera.name]
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        plane = camera.plane_from_pixels(np.stack([column.ravel(), row.ravel()], axis=1))
        falloff = np.exp(shading_basis(camera, plane) @ (k1, k2)).reshape(column.shape)[:, :, None]
        shaded[camera.name] = srgb(LINEAR[picture] * falloff)
    fitted = rig.select(name for name in rig.names if name != "cam3")
    options = TriangulateOptions(features=FeatureOptions(max_features=2000))
    points = triangulate(fitted, [{name: shaded[name] for name in fitted.names}], options=options)
    return rig, gains, shading, shaded, points


def test_a_camera_that_took_no_part_gets_its_gain_and_shading(room):
    rig, gains, shading, pictures, points = room
    fit = balance(rig.select(points.cameras), points)
    report = balance_held_out(rig, points, fit, [pictures], patch_px=9, options=BalanceOptions())
    held = report.held_out["cam3"]
    assert held.kept
    assert held.spread_after < 0.6 * held.spread_before
    others = [index for index in range(7) if index != 3]
    common = np.log(gains[others]).mean(axis=0)  # the fitted cameras' geometric mean is 1
    assert np.abs(np.log(report.gains["cam3"]) - np.log(gains[3]) + common).max() < 0.03
    if report.model is ColourModel.OWN:
        assert light_apart(np.array([report.shading["cam3"]]), shading[3:4])[0] < 0.1


def test_what_is_fitted_does_not_depend_on_pictures_that_are_not(room):
    rig, _, _, pictures, points = room
    fit = balance(rig.select(points.cameras), points)
    for picture in (pictures["cam3"], 255 - pictures["cam3"], np.zeros_like(pictures["cam3"])):
        report = balance_held_out(
            rig, points, fit, [{**pictures, "cam3": picture}], patch_px=9, options=BalanceOptions()
        )
        for name in points.cameras:
            assert (report.gains[name], report.shading[name]) == (fit.gains[name], fit.shading[name])
        assert (report.model, report.spreads) == (fit.model, fit.spreads)


def test_a_camera_that_shows_something_else_keeps_one_and_is_named(room):
    rig, _, _, pictures, points = room
    fit = balance(rig.select(points.cameras), points)
    for instant in ({**pictures, "cam3": 255 - pictures["cam3"]}, {k: v for k, v in pictures.items() if k != "cam3"}):
        report = balance_held_out(rig, points, fit, [instant], patch_px=9, options=BalanceOptions())
        assert report.gains["cam3"] == (1.0, 1.0, 1.0)
        assert "cam3" in report.weak_cameras
        assert report.held_out["cam3"].observations < 30


def test_something_before_a_camera_does_not_bend_its_gain(room):
    rig, _, _, pictures, points = room
    fit = balance(rig.select(points.cameras), points)
    hidden = pictures["cam3"].copy()
    hidden[:, :120] = np.random.default_rng(0).integers(40, 200, (240, 120, 3), dtype=np.uint8)
    clear, half = (
        balance_held_out(rig, points, fit, [{**pictures, "cam3": picture}], patch_px=9, options=BalanceOptions())
        for picture in (pictures["cam3"], hidden)
    )
    assert half.held_out["cam3"].observations < 0.8 * clear.held_out["cam3"].observations
    assert np.abs(np.log(clear.gains["cam3"]) - np.log(half.gains["cam3"])).max() < 0.03
