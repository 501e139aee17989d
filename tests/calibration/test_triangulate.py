"""Points from exact cameras: the geometry with chosen sightings, and the whole way from pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.accept import Verdict, matches_report
from calibration.features import FeatureOptions
from calibration.judge import Reading, judge
from calibration.multiview import Sightings, locate, medians
from calibration.rig import Rig
from calibration.triangulate import (
    SparsePoints,
    TriangulateOptions,
    choose_pairs,
    on_one_geometry,
    patch_light,
    reprojections_px,
    triangulate,
)
from tests.support.calibration_scene import arc, filmed, off_surface, render, ring

OPTIONS = TriangulateOptions(features=FeatureOptions(max_features=600))
LIMITS = {"max_error_px": 2.0, "min_views": 3, "min_angle_deg": 1.5}


def sightings(rig: Rig, points: np.ndarray, *, noise_px: float = 0.0, seed: int = 0) -> Sightings:
    """Every camera's view of every point."""
    rng, count = np.random.default_rng(seed), len(rig.cameras)
    pixels = np.stack([camera.project(points)[0] for camera in rig.cameras], axis=1).reshape(-1, 2)
    point, camera = np.repeat(np.arange(len(points)), count), np.tile(np.arange(count), len(points))
    return Sightings(point.astype(np.int32), camera.astype(np.int32), pixels + rng.normal(0, noise_px, pixels.shape))


def ball(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.8, 0.8, (count, 3))


@pytest.mark.parametrize("lens", [(), (-0.25, 0.06, 0.001, -0.002)])
def test_exact_sightings_give_exact_points(lens):
    rig = arc(5, lens=lens)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) + np.array([0, 0, 3])
    kept, xyz, errors = locate(rig, sightings(rig, points), **LIMITS)
    assert len(kept.point) == 250
    # Without a lens only rounding is left; its inverse stops at 1e-5 px, which is 1e-7 of the 3 units to the points.
    assert np.abs(xyz - points).max() < (1e-6 if lens else 1e-9)
    assert errors.max() < (1e-4 if lens else 1e-7)


def test_noise_spreads_points_as_much_as_theory_says():
    """s pixels at focal length f and distance d displace a ray by s d / f; six cameras around leave half of that."""
    rig, points = ring(6), ball(300)
    _, xyz, errors = locate(rig, sightings(rig, points, noise_px=0.5), **LIMITS)
    displaced = 0.5 * np.sqrt(10) / 512
    assert np.sqrt(((xyz - points) ** 2).sum(axis=1).mean()) < displaced
    # 12 numbers minus the 3 of a point: the residual keeps 9/12 of the noise's square, two numbers for each error.
    assert np.sqrt((errors**2).mean()) == pytest.approx(0.5 * np.sqrt(2 * 9 / 12), rel=0.05)


def test_a_wrong_sighting_is_dropped_and_the_point_stays():
    rig, points = ring(6), ball(40)
    exact = sightings(rig, points)
    wrong = np.arange(0, len(exact.point), 6) + np.arange(40) % 6  # one of each point's six, by 30 px and more
    pixels = exact.pixels.copy()
    pixels[wrong] += np.random.default_rng(2).choice([-30, 30], (40, 2))
    kept, xyz, _ = locate(rig, replace(exact, pixels=pixels), **LIMITS)
    assert np.array_equal(np.flatnonzero(~np.isin(np.arange(240), wrong)), np.arange(240)[_rows_kept(exact, kept)])
    assert np.abs(xyz - points).max() < 1e-6


def _rows_kept(whole: Sightings, kept: Sightings) -> np.ndarray:
    pairs = set(zip(kept.point.tolist(), kept.camera.tolist(), strict=True))
    return np.array([pair in pairs for pair in zip(whole.point.tolist(), whole.camera.tolist(), strict=True)])


def test_points_without_parallax_support_or_depth_are_refused():
    rig = ring(6)
    near = rig.select(["cam00", "cam01"])
    far = np.array([[0.0, -40, 300.0]])
    assert len(locate(near, sightings(near, far), **{**LIMITS, "min_views": 2, "min_angle_deg": 5})[1]) == 0
    assert len(locate(near, sightings(near, ball(5)), **LIMITS)[1]) == 0  # two views, three asked for
    opposite = rig.select(["cam00", "cam02", "cam04"])
    behind = np.array([[0.0, -1, -30.0]])  # before two cameras, behind cam00
    assert len(locate(opposite, sightings(opposite, behind), **LIMITS)[1]) == 0


def test_nothing_in_nothing_out():
    empty = Sightings(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 2)))
    kept, xyz, errors = locate(ring(3), empty, **LIMITS)
    assert len(kept.point) == len(xyz) == len(errors) == 0


def test_medians_are_numpy_s():
    rng = np.random.default_rng(0)
    point = np.repeat(np.arange(30), rng.integers(1, 9, 30))
    values = rng.normal(size=(len(point), 3))
    expected = np.stack([np.median(values[point == p], axis=0) for p in range(30)])
    assert np.array_equal(medians(values, point), expected)


def test_matches_without_a_geometry_are_none_and_no_error():
    for seed in range(200):  # four to a place, nearly: OpenCV fails an assertion in a tenth of these
        rng = np.random.default_rng(seed)
        places = np.repeat(rng.random((2 + seed % 5, 2)) * [160, 90], 4, axis=0)
        kept = on_one_geometry(places, places + rng.normal(0, 0.5, places.shape))
        assert kept is None or kept.shape == (len(places),)
    twice = np.repeat(rng.random((7, 2)) * [160, 90], 2, axis=0)
    assert on_one_geometry(twice, twice + 1) is None
    assert on_one_geometry(np.empty((0, 2)), np.empty((0, 2))) is None


def test_matches_on_one_geometry_are_kept_and_strangers_are_not():
    cameras, rng = ring(2).cameras, np.random.default_rng(0)
    points = ball(60)
    first, second = (camera.project(points)[0] for camera in cameras)
    second[:20] = rng.random((20, 2)) * [cameras[1].width, cameras[1].height]
    kept = on_one_geometry(first, second)
    assert kept is not None
    assert kept[20:].all()
    assert kept[:20].mean() < 0.3


def test_pairs_are_neighbours():
    pairs = choose_pairs(ring(12), neighbours=2)
    beside = {tuple(sorted((f"cam{i:02d}", f"cam{(i + 1) % 12:02d}"))) for i in range(12)}
    assert set(pairs) == beside


def test_patch_light_is_the_mean_of_linear_light_and_knows_clipping():
    picture = np.full((20, 30, 3), 128, np.uint8)
    picture[10:, :, :] = 255
    light, clean = patch_light(picture, np.array([[5.5, 5.5], [5.5, 8.5]]), side_px=5)
    assert np.allclose(light[0], ((128 / 255 + 0.055) / 1.055) ** 2.4, atol=1e-6)
    assert clean.tolist() == [True, False]


# From pictures


@pytest.fixture(scope="module")
def room() -> SparsePoints:
    rig, _, pictures = filmed(6)
    return triangulate(rig, [pictures], options=OPTIONS)


def test_points_lie_on_the_walls(room):
    distance = off_surface(room.xyz)
    assert len(room.xyz) > 200
    # A tenth of a pixel of SIFT at 3.5 units and focal length 304 is 1 mm across; parallax of 20 to 50 degrees
    # makes up to three times of that in depth. Features at the board's edges belong to no plane.
    assert np.median(distance) < 0.005
    assert np.quantile(distance, 0.95) < 0.03
    assert room.matches.verdict is Verdict.ACCEPTED
    assert room.matches.reprojection_px < 0.2


def test_observations_agree_with_points(room):
    rig = filmed(6)[0]
    assert np.array_equal(np.bincount(room.point), room.views)
    assert room.views.min() >= 3
    keys = room.point.astype(np.int64) * 100 + room.camera
    assert np.all(np.diff(keys) > 0)  # sorted, and no camera twice
    for index, camera in enumerate(rig.cameras):  # no lens in this rig: undistorted pixels are pixels
        mine = room.camera == index
        error = np.linalg.norm(camera.project(room.xyz[room.point[mine]])[0] - room.xy[mine], axis=1)
        assert error.max() <= 2.0 + 1e-3  # float32 pixels


def test_a_lens_is_taken_into_account():
    rig = arc(4, span_deg=35, lens=(-0.2, 0.04, 0.001, -0.001))
    points = triangulate(rig, [{camera.name: render(camera) for camera in rig.cameras}], options=OPTIONS)
    assert np.median(off_surface(points.xyz)) < 0.005
    flat = Rig(tuple(replace(camera, distortion=()) for camera in rig.cameras), "")
    for index, camera in enumerate(flat.cameras):
        mine = points.camera == index
        error = np.linalg.norm(camera.project(points.xyz[points.point[mine]])[0] - points.xy[mine], axis=1)
        assert np.median(error) < 0.3


def test_same_pictures_same_bytes_and_files_round_trip(room, tmp_path):
    rig, _, pictures = filmed(6)
    triangulate(rig, [{name: picture.copy() for name, picture in pictures.items()}], options=OPTIONS).save(
        tmp_path / "a.npz"
    )
    room.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    loaded = SparsePoints.load(tmp_path / "a.npz")
    assert loaded.cameras == room.cameras
    assert loaded.matches == room.matches
    assert np.array_equal(loaded.xyz, room.xyz)
    assert np.array_equal(loaded.colour, room.colour, equal_nan=True)


def test_instants_accumulate_and_may_lack_cameras(room):
    rig, _, pictures = filmed(6)
    fewer = {name: picture for name, picture in pictures.items() if name != "cam5"}
    both = triangulate(rig, [pictures, fewer], options=OPTIONS)
    first = both.instant == 0
    assert np.array_equal(both.xyz[first], room.xyz)
    assert first.sum() < len(both.xyz) < 2 * first.sum()
    assert 5 not in both.camera[both.instant[both.point] == 1]


def test_pictures_must_fit_the_rig():
    rig, _, pictures = filmed(6)
    with pytest.raises(
        ValueError, match=r"camera 'cam1' needs uint8 pictures \(240, 320, 3\), but got uint8 \(120, 320, 3\)"
    ):
        triangulate(rig, [{**pictures, "cam1": pictures["cam1"][::2]}])
    with pytest.raises(ValueError, match=r"there are also \['door'\]"):
        triangulate(rig, [{**pictures, "door": pictures["cam1"]}])
    grey = {name: np.full_like(picture, 90) for name, picture in pictures.items()}
    with pytest.raises(ValueError, match="none was found in 1 instants"):
        triangulate(rig, [grey])
    two = rig.names[:2]
    with pytest.raises(ValueError, match=r"seen by 3 cameras \(min_views\), but there are 2"):
        triangulate(rig.select(two), [{name: pictures[name] for name in two}], options=OPTIONS)
    with pytest.raises(ValueError, match="at least two views"):
        TriangulateOptions(min_views=1)


# Judgement


def test_a_right_calibration_is_taken_as_given():
    rig, _, pictures = filmed(6)
    judgement = judge(rig, pictures, options=OPTIONS)
    assert (judgement.reading, judgement.matches.verdict) == (Reading.AS_GIVEN, Verdict.ACCEPTED)
    assert judgement.rig is rig


def transposed(pose: np.ndarray) -> np.ndarray:
    return np.block([[pose[:3, :3].T, pose[:3, 3:]], [pose[3:]]])


FLIP = np.diag([1.0, -1, -1, 1])
WRITTEN = {
    Reading.TRANSPOSED: transposed,
    Reading.INVERTED: np.linalg.inv,
    Reading.OPENGL: lambda pose: FLIP @ pose,
    Reading.INVERTED_OPENGL: lambda pose: np.linalg.inv(pose) @ FLIP,
}
"""What a file holds for a pose, by the convention it was written in"""


@pytest.mark.parametrize("reading", WRITTEN)
def test_a_mistaken_convention_is_found_and_mended(reading):
    rig, _, pictures = filmed(6)
    write = WRITTEN[reading]
    wrong = Rig(tuple(replace(c, camera_from_world=write(c.camera_from_world)) for c in rig.cameras), "a file")
    judgement = judge(wrong, pictures, options=OPTIONS)
    assert (judgement.reading, judgement.matches.verdict) == (reading, Verdict.ACCEPTED)
    assert judgement.rig.source == f"a file, read with {reading.value}"
    for mended, right in zip(judgement.rig.cameras, rig.cameras, strict=True):
        assert np.allclose(mended.camera_from_world, right.camera_from_world, atol=1e-9)


def test_poses_of_other_cameras_are_rejected():
    rig, _, pictures = filmed(6)
    poses = [rig.cameras[i].camera_from_world for i in (3, 5, 0, 4, 2, 1)]
    shuffled = Rig(tuple(replace(c, camera_from_world=p) for c, p in zip(rig.cameras, poses, strict=True)), "shuffled")
    judgement = judge(shuffled, pictures, options=OPTIONS)
    assert judgement.matches.verdict is Verdict.REJECTED
    assert judgement.rig is shuffled


def test_an_observation_is_as_far_off_as_it_was_moved() -> None:
    rig, xyz = ring(4), ball(50)
    seen = sightings(rig, xyz)
    xy = seen.pixels + np.where(seen.camera[:, None] == 1, (3.0, 4.0), 0.0)
    points = SparsePoints(
        cameras=rig.names,
        xyz=xyz,
        rgb=np.zeros((50, 3), np.uint8),
        views=np.full(50, 4, np.int32),
        error_px=np.zeros(50, np.float32),
        instant=np.zeros(50, np.int32),
        point=seen.point,
        camera=seen.camera,
        xy=xy.astype(np.float32),
        colour=np.zeros((200, 3), np.float32),
        matches=matches_report(rig, []),
    )
    # positions are float32, 3e-5 of a pixel
    assert np.allclose(reprojections_px(rig, points), np.where(seen.camera == 1, 5.0, 0.0), atol=1e-3)
