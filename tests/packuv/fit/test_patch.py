"""Patches of the backdrop, on a tiny scene made of Gaussians in which a ball is put down, or taken away."""

from __future__ import annotations

import av
import numpy as np
import pytest

from packuv.fit.density import DensityOptions
from packuv.fit.keyframe import KeyState, fit_backdrop
from packuv.fit.options import FitOptions
from packuv.fit.patch import fit_patch, in_one_place, whole_places
from packuv.fit.start.first import StartOptions, round_gaussians
from packuv.footage import LensCamera, Views
from packuv.gaussians.floats import arrays, rows_of
from packuv.metrics import psnr
from packuv.motion import Still, find_background, patched
from packuv.raster import RasterOptions, render

OPTIONS = FitOptions(
    iterations=150, key_iterations=80, key_births=120, near_jitter=0.0, random_background=False,
    start=StartOptions(count=500), density=DensityOptions(cap=900, every=25, least_views=0),
)  # fmt: skip
FRAMES, DATE = 6, 3


def truth(ball: bool):
    """250 still Gaussians, and a bright ball."""
    rng = np.random.default_rng(5)
    xyz, rgb, scale = rng.uniform(-1, 1, (250, 3)) * [1, 1, 0.3], rng.random((250, 3)), rng.uniform(0.05, 0.2, 250)
    if ball:
        xyz, rgb, scale = np.vstack([xyz, [[0.1, 0.0, 0.75]]]), np.vstack([rgb, [[1, 0.1, 0.1]]]), np.append(scale, 0.2)
    return round_gaussians(xyz, rgb, scale, opacity=0.9, sh_degree=0)


def picture(ball: bool, camera) -> np.ndarray:
    return np.clip(render(truth(ball), camera, options=RasterOptions(0.1)).colour, 0, 1)


@pytest.fixture(scope="module")
def views(ring, tmp_path_factory) -> Views:
    """Seven cameras, of which the last is not fitted."""
    folder, cameras = tmp_path_factory.mktemp("videos"), ring(7)
    for camera in cameras:
        with av.open(str(folder / f"{camera.name}.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "bgr0"
            for instant in range(FRAMES):
                pixels = np.rint(picture(instant >= DATE, camera) * 255).astype(np.uint8).transpose(1, 2, 0)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")))
            container.mux(stream.encode())
    videos = {camera.name: folder / f"{camera.name}.mkv" for camera in cameras}
    frames = np.tile(np.arange(FRAMES)[:, None], (1, len(cameras) - 1))
    return Views(videos, frames, [LensCamera(camera) for camera in cameras[:-1]])


@pytest.fixture(scope="module")
def places(views) -> list[np.ndarray]:
    """What changes, by camera, in small pictures."""
    both = [[views.steady(camera, instant) for instant in (0, DATE)] for camera in range(len(views.cameras))]
    return [(np.abs(a.astype(int) - b).max(axis=2) > 24)[::2, ::2] for a, b in both]


@pytest.fixture(scope="module")
def stills(views, places) -> tuple[list[Still], list[Still]]:
    """Before and after."""
    usual, after = (find_background(views, OPTIONS.background, among=among)
                    for among in (range(DATE), range(DATE, FRAMES)))  # fmt: skip
    masks = [whole_places(mask, camera) for mask, camera in zip(places, views.cameras, strict=True)]
    return usual, [patched(*parts) for parts in zip(usual, after, masks, strict=True)]


def seen(state: KeyState, camera, ball: bool) -> tuple[float, float]:
    """PSNR where the ball is, and elsewhere."""
    shown = render(state.quantizer.decode(state.quantizer.encode(state.gaussians)), camera,
                   options=RasterOptions(state.bounds.near)).colour  # fmt: skip
    wanted = picture(ball, camera)
    there = np.abs(picture(True, camera) - picture(False, camera)).max(axis=0) > 0.1
    return psnr(shown[:, there], wanted[:, there]), psnr(shown[:, ~there], wanted[:, ~there])


@pytest.mark.parametrize("comes", [True, False])
def test_a_patch_shows_the_change_and_leaves_all_other_rows_as_they_are(views, stills, ring, comes):
    before, after = stills if comes else stills[::-1]
    whole = fit_backdrop(views, before, points=None, options=OPTIONS)
    state = fit_patch(whole, views, before, after, options=OPTIONS)
    kept = state.figures["kept"]
    assert state.backdrop == len(state.gaussians)
    assert 0.7 * whole.backdrop < kept < whole.backdrop
    assert state.backdrop <= OPTIONS.density.cap
    old = whole.quantizer.encode(whole.gaussians)
    new = state.quantizer.encode(rows_of(state.gaussians, slice(0, kept)))
    rows = {bytes(xyz) + bytes(own) for xyz, own in zip(old.xyz, old.attributes, strict=True)}
    assert all(bytes(xyz) + bytes(own) in rows for xyz, own in zip(new.xyz, new.attributes, strict=True))
    unseen = ring(7)[-1]
    stale, fresh = seen(whole, unseen, comes), seen(state, unseen, comes)
    assert fresh[0] > stale[0] + 3  # dB, where it changes
    assert fresh[1] > stale[1] - 0.5  # and hardly less elsewhere


def test_nothing_that_changes_leaves_the_backdrop_alone(views, stills):
    whole = fit_backdrop(views, stills[0], points=None, options=OPTIONS)
    same = fit_patch(whole, views, stills[0], stills[0], options=OPTIONS)
    assert all(np.array_equal(a, b) for a, b in zip(arrays(whole.gaussians), arrays(same.gaussians), strict=True))


def test_views_of_one_thing_meet_and_those_of_many_do_not(views, places):
    cameras = views.cameras
    assert in_one_place(dict(enumerate(places)), cameras)
    scattered = {}
    for index in range(3):  # a corner of each picture: above, left, right
        scattered[index] = np.zeros_like(places[index])
        scattered[index][(slice(0, 4), slice(0, 4)) if index else (slice(-4, None), slice(-4, None))] = True
    assert not in_one_place(scattered, cameras)
