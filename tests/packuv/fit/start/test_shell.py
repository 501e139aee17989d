import numpy as np
import pytest

from packuv.camera import PinholeCamera
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.points import look, softened
from packuv.fit.start.shell import (
    AGREED,
    MOST_PIXELS,
    Shell,
    ShellOptions,
    coarse,
    directions,
    interpolate,
    sweep_shell,
)

RADII = np.array([5.0, 5.6, 4.7])
"""Half axes of the room in these tests: an ellipsoid about the origin"""
BOUNDS = Bounds(np.zeros(3), 4.2, 0.3)
OPTIONS = ShellOptions(columns=256, steps=48, farthest=4.0)


def wall_picture(camera: PinholeCamera, *, contrast: float) -> np.ndarray:
    """What a camera inside the ellipsoid sees: a smooth random pattern painted on the wall, float32 [3, H, W]."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays, origin = local @ camera.camera_from_world[:3, :3], camera.centre
    a, b, c = ((rays / RADII) ** 2).sum(-1), (rays * origin / RADII**2).sum(-1), ((origin / RADII) ** 2).sum() - 1
    wall = origin + rays * ((-b + np.sqrt(b * b - a * c)) / a)[..., None]
    waves = np.random.default_rng(7).normal(size=(40, 3)) * 3
    pattern = np.cos(wall @ waves.T + np.arange(40)).sum(-1) / 40
    grey = 0.5 + contrast * pattern
    return np.stack([grey, 0.8 * grey, 0.5 * grey]).astype(np.float32)


@pytest.fixture(scope="module")
def room(ring):
    cameras = ring(18)
    return cameras, [wall_picture(camera, contrast=0.8) for camera in cameras]


def test_places_that_cameras_agree_on_lie_on_the_wall(room):
    shell = sweep_shell(*room, bounds=BOUNDS, options=OPTIONS)
    assert shell is not None
    off = np.sqrt((shell.xyz[shell.sure] ** 2 / RADII**2).sum(-1)) - 1
    assert shell.sure.mean() > 0.05
    # One step of the sweep is 3.7 % of the distance; agreement between steps is interpolated.
    assert np.median(np.abs(off)) < 0.01
    assert np.quantile(np.abs(off), 0.95) < 0.05


def test_places_lie_on_the_wall_also_where_nobody_agrees(room):
    shell = sweep_shell(*room, bounds=BOUNDS, options=OPTIONS)
    assert shell is not None
    places = shell.places(2000, np.random.default_rng(0))
    assert 0.8 * 2000 < len(places.xyz) <= 2000
    off = np.sqrt((places.xyz**2 / RADII**2).sum(-1)) - 1
    assert np.median(np.abs(off)) < 0.1
    assert places.rgb.min() >= 0
    assert places.rgb.max() <= 1


def test_places_are_denser_where_the_wall_has_detail():
    rays = directions(64)
    striped, seen = rays[:, :, 0] > 0, np.ones(rays.shape[:2], bool)
    grey = np.where(striped & (np.arange(64) % 4 < 2), 0.9, 0.4)
    shell = Shell(rays, np.repeat(grey[:, :, None], 3, axis=2), ~seen, seen, 1.0, np.zeros((*seen.shape, 1), bool))
    xyz = shell.places(800, np.random.default_rng(0)).xyz
    # 55 % are spread evenly, so half of the sphere has 28 % of them by these alone.
    assert 0.25 * 800 < (xyz[:, 0] < 0).sum() < 0.35 * 800


def test_places_stay_away_from_what_stands_before_the_wall(room):
    cameras, pictures = room
    hidden = [picture.copy() for picture in pictures]
    for index, picture in enumerate(hidden):  # before the foot of the wall something that looks different to each
        picture[:, 2 * picture.shape[1] // 3 :] = np.float32([0.1, 0.5, 0.9][index % 3])
    clear = sweep_shell(cameras, pictures, bounds=BOUNDS, options=OPTIONS)
    spoilt = sweep_shell(cameras, hidden, bounds=BOUNDS, options=OPTIONS)
    assert clear is not None
    assert spoilt is not None
    assert clear.explained > 0.8
    assert spoilt.explained < clear.explained - 0.2
    assert spoilt.likely.mean() < clear.likely.mean()
    sight = look(cameras, [softened(picture) for picture in hidden],
                 spoilt.places(1000, np.random.default_rng(0)).xyz, BOUNDS.near)  # fmt: skip
    assert (sight.deviation[sight.views > 1] < AGREED).mean() > 0.85


def test_pictures_finer_than_the_sphere_are_halved_first(room):
    cameras, pictures = room
    assert all(coarse(camera, OPTIONS.columns) == camera for camera in cameras)
    scale = next(2**n for n in range(1, 9) if 2**n * cameras[0].fx * 2 * np.pi / OPTIONS.columns >= MOST_PIXELS)
    fine = [camera.scaled(scale * camera.width, scale * camera.height) for camera in cameras]
    assert [coarse(camera, OPTIONS.columns).width for camera in fine] == [
        camera.width * scale // 2 for camera in cameras
    ]
    large = [picture.repeat(scale, axis=1).repeat(scale, axis=2) for picture in pictures]
    half = [picture.repeat(scale // 2, axis=1).repeat(scale // 2, axis=2) for picture in pictures]
    halved = [camera.scaled(scale * camera.width // 2, scale * camera.height // 2) for camera in cameras]
    first, again = (sweep_shell(*given, bounds=BOUNDS, options=OPTIONS) for given in ((fine, large), (halved, half)))
    assert first is not None
    assert again is not None
    assert np.array_equal(first.sure, again.sure)
    assert np.array_equal(first.xyz, again.xyz)


def test_places_are_drawn_by_the_seed(room):
    shell = sweep_shell(*room, bounds=BOUNDS, options=OPTIONS)
    assert shell is not None
    first, again, other = (shell.places(500, np.random.default_rng(seed)).xyz for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_blank_walls_have_no_shell(room):
    blank = [np.full_like(picture, 0.4) for picture in room[1]]
    assert sweep_shell(room[0], blank, bounds=BOUNDS, options=OPTIONS) is None


def test_a_different_brightness_of_one_camera_changes_nothing_but_colours(room):
    cameras, pictures = room
    shell = sweep_shell(cameras, pictures, bounds=BOUNDS, options=OPTIONS)
    other = sweep_shell(cameras, [0.7 * pictures[0] + 0.1, *pictures[1:]], bounds=BOUNDS, options=OPTIONS)
    assert shell is not None
    assert other is not None
    # Contrast falls by a third, and with it the say of one camera in eighteen.
    assert (shell.sure == other.sure).mean() > 0.97


def test_interpolation_keeps_what_is_known_and_constants():
    rng = np.random.default_rng(0)
    values, known = rng.random((32, 64)), rng.random((32, 64)) < 0.2
    filled = interpolate(values, known.astype(float))
    np.testing.assert_allclose(filled[known], values[known], rtol=1e-12)
    assert filled.min() >= values[known].min() - 1e-12
    assert filled.max() <= values[known].max() + 1e-12
    np.testing.assert_allclose(interpolate(np.full((32, 64), 2.5), known.astype(float)), 2.5, rtol=1e-12)


def test_directions_are_unit_vectors_and_start_at_the_z_axis():
    rays = directions(128)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-12)
    assert rays[0, :, 2].min() > 0.999
    assert rays[-1, :, 2].max() < -0.999


def test_options_refuse_what_cannot_be_swept():
    with pytest.raises(ValueError, match="odd window"):
        ShellOptions(window=6)
    with pytest.raises(ValueError, match="nearest < farthest"):
        ShellOptions(nearest=3.0, farthest=2.0)
