"""Rigs: every camera stands in free space, looks at the scene, and shares a volume with the others."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.accept import check_rig
from calibration.rig import Camera, Rig
from studio.film_set import VISITOR_FROM, VISITOR_TO, VISITOR_X, FilmSet, build_set
from studio.rig import FARTHEST_M, NEAREST_M, TARGET, PlacementOptions, RigKind, StudioCamera, place_cameras

KINDS = list(RigKind)


@pytest.fixture(scope="module")
def film_set() -> FilmSet:
    return build_set(7, 0.3)


def rig_of(kind: RigKind, count: int, seed: int, radius_m: float = 3.1) -> tuple[StudioCamera, ...]:
    return place_cameras([f"cam{k}" for k in range(count)], 640, 360, seed, PlacementOptions(kind, radius_m))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("radius_m", [NEAREST_M, 3.1, FARTHEST_M])
def test_cameras_stand_free_and_look_at_the_scene(film_set: FilmSet, kind: RigKind, radius_m: float) -> None:
    for count in (2, 8, 27, 60):
        for seed in range(3):
            for camera in rig_of(kind, count, seed, radius_m):
                rotation = camera.camera_from_world[:3, :3]
                assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
                assert np.isclose(np.linalg.det(rotation), 1)
                # a lens closer than this to furniture sees nothing else
                assert film_set.clear_of(camera.centre) > 0.15
                local = rotation @ (TARGET - camera.centre)
                pixel = camera.fx * local[:2] / local[2]
                assert local[2] > 1.5
                assert np.abs(pixel).max() < 0.2 * camera.width
                # upright: the picture's down is the world's down
                assert rotation[1, 2] < -0.5


@pytest.mark.parametrize("kind", KINDS)
def test_nobody_walks_into_a_camera(kind: RigKind) -> None:
    for camera in rig_of(kind, 60, 0):
        x, y, z = camera.centre
        in_the_way = abs(x - VISITOR_X) < 0.45 and VISITOR_TO - 0.45 < y < VISITOR_FROM
        assert not in_the_way or z > 1.95


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [4, 8, 20])
def test_cameras_share_a_volume(kind: RigKind, count: int) -> None:
    cameras = tuple(
        Camera(c.name, c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.camera_from_world) for c in rig_of(kind, count, 5)
    )
    check_rig(Rig(cameras, "studio", metric=True))


def test_rigs_are_irregular_by_seed_alone() -> None:
    first, again, other = (rig_of(RigKind.RING, 8, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a.camera_from_world, b.camera_from_world) for a, b in zip(first, again, strict=True))
    distances = [np.linalg.norm(a.centre - b.centre) for a, b in zip(first, other, strict=True)]
    assert min(distances) > 0.005
    assert max(distances) < 0.5
    regular = place_cameras(["a", "b"], 640, 360, 1, PlacementOptions(jitter_m=0.0))
    assert np.allclose([np.hypot(*c.centre[:2]) for c in regular], 3.1)
    assert [(c.fx, c.cx, c.cy) for c in regular] == [(480.0, 320.0, 180.0)] * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"radius_m": 5.0}, r"radius must be 2.5 to 3.4 m.*but is 5.0"),
        ({"height_m": 3.5}, r"height must be 0.4 to 2.75 m, but is 3.5"),
        ({"kind": RigKind.DOME, "height_m": 1.0}, "a dome has cameras at all heights"),
        ({"focal": 0.1}, "0.3 to 3 picture widths, but is 0.1"),
        ({"jitter_m": 1.0}, "jitter must be 0 to 0.15 m, but is 1.0"),
    ],
)
def test_bad_options_are_refused(options, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PlacementOptions(**options)
