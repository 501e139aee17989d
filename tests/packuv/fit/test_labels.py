"""Labels and tiles against algorithm 4 of the paper's appendix, written out pixel by pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.fit.labels import LabelOptions, active_tiles, count_hits, dynamic_labels, summed_area
from packuv.gaussians.floats import Gaussians

PAPER = LabelOptions(least_share=0)
WIDTH, HEIGHT = 70, 45


def looking_at(name: str, centre: Sequence[float], target: Sequence[float] = (0, 0, 0)) -> PinholeCamera:
    forward = np.asarray(target, float) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return PinholeCamera(name, WIDTH, HEIGHT, 60.0, 62.0, 36.2, 21.7, pose)


def ring(count: int, radius: float = 3.0) -> list[PinholeCamera]:
    angles = 2 * np.pi * np.arange(count) / count
    return [looking_at(f"c{k}", (radius * np.cos(a), radius * np.sin(a), 0.3)) for k, a in enumerate(angles)]


def random_gaussians(rng: np.random.Generator, count: int) -> Gaussians:
    return Gaussians(
        means=rng.normal(scale=1.2, size=(count, 3)).astype(np.float32),
        log_scales=rng.normal(-3, 1, (count, 3)).astype(np.float32),
        quaternions=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(0, 3, count).astype(np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def small_gaussians(means: np.ndarray, sigma: float = 0.02) -> Gaussians:
    count = len(means)
    return Gaussians(
        means.astype(np.float32),
        np.full((count, 3), np.log(sigma), np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full(count, 3, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def rotation(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def ellipse(g: Gaussians, i: int, camera: PinholeCamera) -> tuple[np.ndarray, float, np.ndarray]:
    """Centre [2], depth and covariance [2, 2] in the picture; steps 1 and 2 of the algorithm."""
    pose = camera.camera_from_world
    local = pose[:3, :3] @ g.means[i].astype(float) + pose[:3, 3]
    turn = rotation(g.quaternions[i].astype(float))
    world = turn @ np.diag(np.exp(2 * g.log_scales[i].astype(float))) @ turn.T
    x, y, z = local
    # As the renderer: slopes are limited to 15 % of the picture beyond its edges.
    sx = np.clip(x / z, (-0.15 * WIDTH - camera.cx) / camera.fx, (1.15 * WIDTH - camera.cx) / camera.fx)
    sy = np.clip(y / z, (-0.15 * HEIGHT - camera.cy) / camera.fy, (1.15 * HEIGHT - camera.cy) / camera.fy)
    jacobian = np.array([[camera.fx / z, 0, -camera.fx * sx / z], [0, camera.fy / z, -camera.fy * sy / z]])
    covariance = jacobian @ pose[:3, :3] @ world @ pose[:3, :3].T @ jacobian.T + 0.3 * np.eye(2)
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]), z, covariance


def squared_distance(centre: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Mahalanobis distance squared of every pixel centre, [H, W]."""
    offset = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1) - centre
    return np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariance), offset)


def naive_hits(
    g: Gaussians, cameras: Sequence[PinholeCamera], masks: Sequence[np.ndarray | None], near: float, overlap: float
) -> tuple[np.ndarray, np.ndarray]:
    hits, views = np.zeros(len(g), int), np.zeros(len(g), int)
    for camera, mask in zip(cameras, masks, strict=True):
        for i in range(len(g)):
            centre, z, covariance = ellipse(g, i, camera)
            if mask is None or z < near or g.opacity_logits[i] < np.log(1 / 254) or np.linalg.det(covariance) <= 1e-7:
                continue
            inside = squared_distance(centre, covariance) <= 9
            hit = bool((inside & mask).any() and (inside & mask).sum() >= overlap * inside.sum())
            hits[i] += hit
            views[i] += hit or bool((centre >= 0).all() and (centre < [WIDTH, HEIGHT]).all())
    return hits, views


def random_mask(rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    cx, cy, radius = rng.uniform(0, WIDTH), rng.uniform(0, HEIGHT), rng.uniform(0.5, 12)
    return (x + 0.5 - cx) ** 2 + (y + 0.5 - cy) ** 2 < radius**2


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1, 0.7]))
def test_hits_equal_the_algorithm_pixel_by_pixel(seed: int, overlap: float) -> None:
    rng = np.random.default_rng(seed)
    g, cameras = random_gaussians(rng, 60), ring(4)
    masks = [random_mask(rng), random_mask(rng), None, np.zeros((HEIGHT, WIDTH), bool)]
    options = replace(PAPER, least_overlap=overlap, radius_limit_px=1e6)
    hits, views = count_hits(g, cameras, masks, near=0.4, options=options)
    naive, seen = naive_hits(g, cameras, masks, 0.4, overlap)
    assert np.array_equal(hits, naive)
    assert np.array_equal(views, seen)
    assert np.array_equal(dynamic_labels(g, cameras, masks, near=0.4, options=options), naive > 0)
    both = dynamic_labels(g, cameras, masks, near=0.4, options=replace(options, min_cameras=2, least_share=0.6))
    assert np.array_equal(both, (naive >= 2) & (naive >= 0.6 * seen))


@given(st.integers(0, 2**32 - 1))
def test_summed_area_counts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((9, 13)) < 0.4
    (y0, y1), (x0, x1) = sorted(rng.integers(0, 10, 2)), sorted(rng.integers(0, 14, 2))
    table = summed_area(mask)
    assert table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0] == mask[y0:y1, x0:x1].sum()


def test_threads_do_not_matter() -> None:
    rng = np.random.default_rng(1)
    g, cameras, masks = random_gaussians(rng, 3000), ring(5), [random_mask(rng) for _ in range(5)]
    before, results = numba.get_num_threads(), []
    for threads in {1, before}:
        numba.set_num_threads(threads)
        results.append(count_hits(g, cameras, masks, near=0.1, options=PAPER))
    numba.set_num_threads(before)
    assert all(np.array_equal(a, b) for other in results for a, b in zip(results[0], other, strict=True))


def test_agreement_tells_what_moves_from_the_wall_behind_it() -> None:
    """A ball in the middle of a ring of cameras, masked in all of them, before a wall of Gaussians all around."""
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(400, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    angle = rng.uniform(0, 2 * np.pi, 2000)
    wall = np.stack([2.5 * np.cos(angle), 2.5 * np.sin(angle), rng.uniform(-0.5, 0.5, 2000)], axis=1)
    cameras = ring(8, radius=3.5)
    masks = [squared_distance(*_ball(camera)) < 1 for camera in cameras]
    g = small_gaussians(np.concatenate([0.28 * direction, wall]))
    joined = dynamic_labels(g, cameras, masks, near=0.1, options=PAPER)
    agreed = dynamic_labels(g, cameras, masks, near=0.1, options=LabelOptions())
    assert joined[:400].all()
    assert agreed[:400].all()
    assert joined[400:].mean() > 0.3
    assert not agreed[400:].any()


def _ball(camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Centre and squared radii of a ball of radius 0.3 at the origin, in the picture."""
    pixels, depth = camera.project(np.zeros((1, 3)))
    return pixels[0], np.diag((0.3 * np.array([camera.fx, camera.fy]) / depth[0]) ** 2)


def test_a_hidden_gaussian_gets_no_vote() -> None:
    camera = looking_at("a", (3, 0, 0))
    g = small_gaussians(np.array([[0.5, 0, 0], [-1.0, 0, 0]]))  # 2.5 and 4 from the camera
    mask = np.ones((HEIGHT, WIDTH), bool)
    depth = np.full((HEIGHT, WIDTH), 2.45, np.float32)
    options = replace(PAPER, depth_tolerance=0.05)
    assert dynamic_labels(g, [camera], [mask], near=0.1, options=options, depths=[depth]).tolist() == [True, False]
    assert dynamic_labels(g, [camera], [mask], near=0.1, options=options, depths=[None]).tolist() == [True, True]
    for nothing in (0.0, np.nan):
        empty = np.full((HEIGHT, WIDTH), nothing, np.float32)
        assert dynamic_labels(g, [camera], [mask], near=0.1, options=options, depths=[empty]).all()
    # A camera that cannot see it does not outvote those that can.
    other = looking_at("b", (0, 3, 0))
    both = count_hits(g, [camera, other], [~mask, mask], near=0.1, options=PAPER, depths=[depth, None])
    assert [votes.tolist() for votes in both] == [[1, 1], [2, 1]]


def test_the_fallback_looks_at_the_pixel_under_the_centre() -> None:
    rng = np.random.default_rng(4)
    g, camera, mask = random_gaussians(rng, 500), ring(1)[0], random_mask(rng)
    pixels, depth = camera.project(g.means.astype(float))
    inside = (depth > 0.2) & (pixels >= 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1)
    inside &= g.opacity_logits >= np.log(1 / 254)
    expected = np.zeros(500, bool)
    x, y = np.floor(pixels[inside]).astype(int).T
    expected[inside] = mask[y, x]
    options = replace(PAPER, centres_only=True)
    assert np.array_equal(dynamic_labels(g, [camera], [mask], near=0.2, options=options), expected)


def test_what_is_not_drawn_or_not_a_number_stays_static() -> None:
    g = small_gaussians(np.zeros((5, 3)))
    g.opacity_logits[0] = -5.6  # an absent Gaussian
    g.means[1] = np.nan
    g.means[2] = [2.95, 0, 0]  # before the near plane
    g.means[3] = [9, 0, 0]  # behind the camera
    mask = np.ones((HEIGHT, WIDTH), bool)
    found = dynamic_labels(g, [looking_at("a", (3, 0, 0))], [mask], near=0.1, options=PAPER)
    assert found.tolist() == [False, False, False, False, True]


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1))
def test_active_tiles_hold_every_pixel_that_is_drawn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g, camera, mask = random_gaussians(rng, 6), ring(1)[0], random_mask(rng)
    touched = mask.copy()
    for i in range(len(g)):
        centre, z, covariance = ellipse(g, i, camera)
        if z >= 0.4:
            opacity = 1 / (1 + np.exp(-float(g.opacity_logits[i])))
            touched |= opacity * np.exp(-0.5 * squared_distance(centre, covariance)) >= 1 / 255
    padded = np.zeros((48, 80), bool)
    padded[:HEIGHT, :WIDTH] = touched
    expected = padded.reshape(3, 16, 5, 16).any(axis=(1, 3))
    assert np.array_equal(active_tiles(mask, g, camera, near=0.4), expected)


def test_without_a_mask_every_tile_is_active() -> None:
    camera, nothing = ring(1)[0], small_gaussians(np.zeros((0, 3)))
    assert active_tiles(None, nothing, camera).all()
    assert not active_tiles(np.zeros((HEIGHT, WIDTH), bool), nothing, camera).any()


def test_bad_input_is_refused() -> None:
    g, camera = small_gaussians(np.zeros((1, 3))), ring(1)[0]
    with pytest.raises(ValueError, match=r"camera 'c0': the mask must be \[45, 70\], but is \(45, 71\)"):
        dynamic_labels(g, [camera], [np.zeros((HEIGHT, WIDTH + 1), bool)], near=0.1, options=PAPER)
    with pytest.raises(ValueError, match="1 cameras need a mask each"):
        dynamic_labels(g, [camera], [], near=0.1, options=PAPER)
    with pytest.raises(ValueError, match="are shares from 0 to 1"):
        LabelOptions(least_share=1.5)
    with pytest.raises(ValueError, match="min_cameras >= 1"):
        LabelOptions(min_cameras=0)
