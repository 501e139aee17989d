import numpy as np
import pytest

from packuv.camera import PinholeCamera
from packuv.fit.start.bounds import find_bounds
from packuv.fit.start.first import StartOptions, first_gaussians, neighbour_distance, random_ball, round_gaussians
from packuv.fit.start.hull import hull_points
from packuv.fit.start.points import Points, look, pixels_of


def test_the_centre_is_where_the_axes_meet(ring):
    bounds = find_bounds(ring(7, centre=(1.0, -2.0, 0.5)), near_share=0.1)
    # The weak pull towards a point before the cameras costs about a percent of the radius.
    np.testing.assert_allclose(bounds.centre, [1.0, -2.0, 0.5], atol=0.08)
    assert bounds.radius == pytest.approx(4.0 * np.hypot(1, 0.35), rel=0.02)
    assert bounds.near == pytest.approx(0.1 * bounds.radius)


def test_parallel_cameras_have_a_finite_centre_before_them():
    cameras = []
    for x in (-0.5, 0.0, 0.5):
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(PinholeCamera(f"c{x}", 64, 48, 60, 60, 32, 24, pose))
    bounds = find_bounds(cameras, near_share=0.1)
    assert bounds.centre[2] > 0
    assert np.isfinite(bounds.centre).all()


def test_neighbour_distance_equals_brute_force():
    points = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    distance = np.linalg.norm(points[:, None].astype(np.float64) - points[None], axis=2)
    expected = np.sort(distance, axis=1)[:, 1:4].mean(axis=1)
    np.testing.assert_allclose(neighbour_distance(points), expected, rtol=1e-5)  # float32


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_with_fewer_than_three_others_the_distance_is_a_small_one(count):
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    assert neighbour_distance(points).tolist() == [np.float32(1e-3)] * count
    assert neighbour_distance(points).dtype == np.float32


def test_equal_points_have_no_distance():
    cloud = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    assert not neighbour_distance(np.ones((50, 3), np.float32)).any()
    assert not neighbour_distance(np.repeat(cloud, 4, axis=0)).any()
    pairs = np.repeat(cloud, 2, axis=0)
    np.testing.assert_array_equal(neighbour_distance(pairs)[::2], neighbour_distance(pairs)[1::2])
    assert neighbour_distance(pairs).all()


def test_neighbour_distance_does_not_depend_on_the_order_of_points():
    rng = np.random.default_rng(0)
    lattice = np.stack(np.meshgrid(*[0.1 * np.arange(8)] * 3), axis=-1).reshape(-1, 3).astype(np.float32)
    order = rng.permutation(len(lattice))
    np.testing.assert_array_equal(neighbour_distance(lattice[order]), neighbour_distance(lattice)[order])


def test_the_first_gaussians_are_seen_and_take_the_colours_of_the_pictures(ring):
    cameras = ring(6)
    pictures = [np.full((3, c.height, c.width), 0.25, np.float32) for c in cameras]
    bounds = find_bounds(cameras, near_share=0.1)
    known = Points(np.array([[0.1, 0.2, 0.0]]), np.array([[1.0, 0.5, 0.0]]))
    g = first_gaussians(
        cameras, pictures, bounds=bounds, surface=known, options=StartOptions(count=300), sh_degree=1, seed=3
    )
    assert len(g) == 300
    np.testing.assert_allclose(g.means[0], known.xyz[0], rtol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479 * g.sh[1:, 0], 0.25, atol=1e-6)
    assert not g.sh[:, 1:].any()
    views = sum(pixels_of(c, g.means.astype(np.float64), bounds.near)[0].astype(int) for c in cameras)
    assert (views[1:] >= 3).all()


def test_cameras_without_a_common_volume_are_refused(ring):
    away = []
    for camera in ring(4):
        pose = camera.camera_from_world.copy()
        pose[0], pose[2] = -pose[0], -pose[2]  # turned by 180 degrees
        away.append(PinholeCamera(camera.name, 96, 64, 105, 105, 48, 32, pose))
    pictures = [np.zeros((3, 64, 96), np.float32)] * 4
    bounds = find_bounds(ring(4), near_share=0.1)
    with pytest.raises(ValueError, match="do the cameras look at a common volume"):
        first_gaussians(
            away, pictures, bounds=bounds, surface=None, options=StartOptions(count=50), sh_degree=0, seed=0
        )


def test_hull_points_lie_where_the_masks_meet(ring):
    cameras = ring(8)
    bounds = find_bounds(cameras, near_share=0.1)
    centre, radius = np.array([0.6, -0.3, 0.1]), 0.4
    masks = []
    for camera in cameras:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        (u, v), depth = camera.project(centre[None])[0][0], camera.project(centre[None])[1][0]
        masks.append(np.hypot(x - u, y - v) < radius * camera.fx / depth)
    pictures = [np.full((3, c.height, c.width), 0.5, np.float32) for c in cameras]
    found = hull_points(
        cameras, pictures, masks, bounds=bounds, options=StartOptions(), count=400, rng=np.random.default_rng(0)
    )
    assert len(found.xyz) > 20
    # One camera in five may miss: the hull is a little wider than the ball.
    assert np.linalg.norm(found.xyz - centre, axis=1).max() < 1.8 * radius


def test_random_ball_fills_the_ball_evenly():
    inside = (np.linalg.norm(random_ball(np.random.default_rng(0), 20000), axis=1) < 0.5).mean()
    assert inside == pytest.approx(0.125, abs=0.01)  # 4 standard deviations


def test_round_gaussians_render_the_colour_they_are_given():
    g = round_gaussians(np.zeros((1, 3)), np.array([[0.2, 0.4, 0.9]]), np.array([0.1]), opacity=0.7, sh_degree=0)
    np.testing.assert_allclose(0.5 + 0.28209479177 * g.sh[0, 0], [0.2, 0.4, 0.9], atol=1e-6)
    assert 1 / (1 + np.exp(-g.opacity_logits[0])) == pytest.approx(0.7, rel=1e-6)


def test_a_fit_starts_with_no_more_than_its_cap():
    assert StartOptions(count=300).within(200) == StartOptions(count=160)
    assert StartOptions(count=300).within(400) == StartOptions(count=300)


def test_deviation_is_that_between_cameras(ring):
    cameras = ring(4)
    levels = [0.2, 0.2, 0.4, 0.8]
    pictures = [np.full((3, c.height, c.width), level, np.float32) for c, level in zip(cameras, levels, strict=True)]
    bounds = find_bounds(cameras, near_share=0.1)
    xyz = np.vstack([bounds.centre, bounds.centre + 1e6])
    sight = look(cameras, pictures, xyz, bounds.near)
    assert sight.views.tolist() == [4, 0]
    np.testing.assert_allclose(sight.rgb[0], 0.4, atol=1e-6)
    assert sight.deviation[0] == pytest.approx(np.std(levels, ddof=1), rel=1e-6)
    assert sight.deviation[1] == np.inf
