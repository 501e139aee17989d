"""What three cameras tell of each other's principal points and places, by points as exact cameras show them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from calibration.accept import PairMatches, matches_report
from calibration.confirm import confirm, witnesses
from calibration.doubt import accused, doubts
from calibration.multiview import Sightings, foreseen, locate
from calibration.repair import POINT
from calibration.rig import Camera, Rig
from calibration.triangulate import TriangulateOptions
from tests.support.calibration_scene import look_at, ring

NOISE_PX = 0.2


def row(count: int, *, apart: float = 0.4) -> Rig:
    """Cameras side by side that look ahead: what is off along the row moves matches along their epipolar lines."""
    spots = apart * (np.arange(count) - (count - 1) / 2)
    cameras = (
        Camera(f"cam{i}", 640, 360, 500, 500, 320, 180, look_at((x, 0, 0), (x, 0, 4))) for i, x in enumerate(spots)
    )
    return Rig(tuple(cameras), "a row")


def shown(rig: Rig, *, points: int = 80, chance: int = 0, least: int = 3, seed: int = 0) -> Sightings:
    """Points before the rig as its cameras show them, and `chance` ones that are nowhere."""
    rng = np.random.default_rng(seed)
    ahead = 4 * ("row" in rig.source)
    xyz = rng.uniform((-1.5, -0.8, ahead - 1), (1.5, 0.8, ahead + 1), (points, 3))
    rows = []
    for number in range(points + chance):
        for index, camera in enumerate(rig.cameras):
            if number < points and camera.sees(xyz[number : number + 1])[0]:
                rows.append((number, index, *(camera.project(xyz[number : number + 1])[0][0])))
            elif number >= points and rng.random() < 0.6:
                rows.append((number, index, *rng.uniform((0, 0), (camera.width, camera.height))))
    point, camera_, x, y = np.array(rows).T
    pixels = np.stack([x, y], axis=1) + rng.normal(0, NOISE_PX, (len(rows), 2))
    found = Sightings(point.astype(np.int32), camera_.astype(np.int32), pixels)
    return found.only(np.bincount(found.point)[found.point] >= least)


def with_one(rig: Rig, name: str, **changes: float) -> Rig:
    return replace(rig, cameras=tuple(replace(c, **changes) if c.name == name else c for c in rig.cameras))


def moved(rig: Rig, name: str, way: np.ndarray) -> Rig:
    """By a way in the world."""
    pose = rig[name].camera_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ way
    return replace(rig, cameras=tuple(replace(c, camera_from_world=pose) if c.name == name else c for c in rig.cameras))


def radius(rig: Rig) -> float:
    return float(np.median(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1)))


def test_a_sighting_is_foreseen_without_itself():
    """Whatever a camera shows does not change what the others expect of it."""
    rig = ring(5)
    sightings = shown(rig)
    pixels = sightings.pixels.copy()
    pixels[sightings.camera == 2] += (30, -20)
    before, after = (
        foreseen(rig, one, max_error_px=100, min_angle_deg=1).of(2)
        for one in (sightings, replace(sightings, pixels=pixels))
    )
    np.testing.assert_allclose(before.plane, after.plane, atol=1e-15)
    np.testing.assert_allclose(after.miss_px - before.miss_px, np.tile((30, -20), (len(after.plane), 1)), atol=1e-9)


def test_foreseen_agrees_with_locating_the_others():
    """A naive twin: each point located without the camera, and shown in it."""
    rig = ring(5)
    sightings = shown(rig, points=20)
    found = foreseen(rig, sightings, max_error_px=100, min_angle_deg=0).of(1)
    _, xyz, _ = locate(rig, sightings.only(sightings.camera != 1), max_error_px=100, min_views=2, min_angle_deg=0)
    pixels, _ = rig.cameras[1].project(xyz)
    rows = np.unique(sightings.only(sightings.camera != 1).point, return_inverse=True)[0]
    mine = np.isin(rows, np.unique(sightings.point[sightings.camera == 1]))
    expected = found.plane * (rig.cameras[1].fx, rig.cameras[1].fy) + (rig.cameras[1].cx, rig.cameras[1].cy)
    np.testing.assert_allclose(expected, pixels[mine], atol=1e-6)


def test_what_is_missed_is_as_likely_as_its_covariance_says():
    """Squares in standard deviations have the mean of two degrees of freedom."""
    found = foreseen(ring(6), shown(ring(6), points=400), max_error_px=5, min_angle_deg=1.5)
    squares = np.einsum("mi,mij,mj->m", found.miss_px, found.weight, found.miss_px) / NOISE_PX**2
    assert squares.mean() == pytest.approx(2, rel=0.06)


@pytest.mark.parametrize("rig", [ring(6), row(6)], ids=["ring", "row"])
@pytest.mark.parametrize("chance", [0, 240])
def test_right_cameras_are_confirmed(rig, chance):
    assert confirm(rig, shown(rig, chance=chance), noise_px=NOISE_PX) == ({}, {})


@pytest.mark.parametrize("name", ["cam0", "cam2", "cam5"])
@pytest.mark.parametrize("chance", [0, 240])
def test_a_principal_point_that_is_off_along_a_row_is_named(name, chance):
    """Its neighbours have points with it, too; only it is off in all."""
    wrong, unsure = confirm(
        with_one(row(6), name, cx=320 + 0.05 * 640), shown(row(6), chance=chance), noise_px=NOISE_PX
    )
    assert set(wrong) == {name}
    assert unsure == {}
    assert "as if its principal point were off by 5.0% of the width" in wrong[name]


@pytest.mark.parametrize("axis", range(3))
def test_a_camera_that_was_moved_is_named(axis):
    rig = ring(6)
    way = 0.03 * radius(rig) * np.eye(3)[axis]
    wrong, unsure = confirm(moved(rig, "cam04", way), shown(rig, chance=120), noise_px=NOISE_PX)
    assert (set(wrong), unsure) == ({"cam04"}, {})


def test_two_wrong_cameras_are_both_named():
    rig = with_one(with_one(row(8), "cam2", cx=320 + 32), "cam5", cx=320 - 32)
    assert set(confirm(rig, shown(row(8)), noise_px=NOISE_PX)[0]) == {"cam2", "cam5"}


def test_nothing_is_silent():
    """Whatever the evidence, a fault that is not named is of a camera that is said not to be confirmed."""
    for seed in range(12):
        points = (0, 2, 4, 6, 9, 14)[seed % 6]
        sightings = shown(row(5), points=points, chance=60, seed=seed)
        wrong, unsure = confirm(with_one(row(5), "cam3", cx=352), sightings, noise_px=NOISE_PX)
        assert "cam3" in {*wrong, *unsure}, points


def test_what_could_be_wrong_unseen_is_what_the_noise_allows():
    """The standard deviation of a principal point that the witness tells is that of its estimates."""
    rig, told = ring(6), []
    for seed in range(30):
        said = witnesses(rig, shown(rig, points=40, seed=seed), noise_px=NOISE_PX)["cam03"]
        told.append((said.clusters[POINT].off, said.clusters[POINT].unseen))
    off, unseen = np.array(told).T
    # The length of a way with two equal deviations is their root mean square times the root of two.
    assert np.sqrt((off**2).mean() / 2) == pytest.approx(unseen.mean() / 4, rel=0.35)


def test_cameras_too_near_to_each_other_leave_a_place_open():
    """Cameras 2 cm apart hardly tell depth, so a camera may stand elsewhere along its axis."""
    rig = row(6, apart=0.02)
    sightings = shown(rig)
    wrong, unsure = confirm(rig, sightings, noise_px=NOISE_PX)
    assert wrong == {}
    assert set(unsure) == set(rig.names)


def test_doubts_say_it_by_name():
    """Pairs of a row explain all matches of a principal point that is off along it; three cameras do not."""
    right, wrong = row(6), with_one(row(6), "cam2", cx=352)
    sightings = shown(right)
    evidence = [matched(sightings, first, second) for first, second in combinations(range(6), 2)]
    report = matches_report(wrong, evidence)
    assert report.explained_share == 1
    said = doubts(wrong, evidence, report, judge=TriangulateOptions())
    assert accused(said) == set(said) == {"cam2"}


def matched(sightings: Sightings, first: int, second: int) -> PairMatches:
    """What both cameras show."""
    both = np.intersect1d(*(sightings.point[sightings.camera == one] for one in (first, second)))
    pixels = (sightings.pixels[(sightings.camera == one) & np.isin(sightings.point, both)] for one in (first, second))
    return PairMatches(f"cam{first}", f"cam{second}", *pixels)
