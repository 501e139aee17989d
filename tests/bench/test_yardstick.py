"""What gsplat is asked for, with a dense rasterizer of its signature in its place."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bench import yardstick
from bench.raster import BenchOptions, measure_yardstick, room, room_camera
from packuv import raster
from packuv.camera import PinholeCamera
from packuv.raster import RasterOptions, tile_shape
from tests.support.dense_raster import BACKGROUND, OPTIONS, blend, camera, ellipses, scene, sh_colour, upstream


def dense_rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, far_plane,
                        eps2d, sh_degree, packed, tile_size, render_mode, rasterize_mode):  # fmt: skip
    """What gsplat 1.5 promises for one camera, every Gaussian at every pixel, in float64."""
    assert (packed, rasterize_mode, tile_size) == (False, "classic", 16)
    assert quats.dtype == scales.dtype == viewmats.dtype == Ks.dtype == torch.float32
    pose, lens = viewmats[0].double().numpy(), Ks[0].double().numpy()
    view = PinholeCamera("gsplat", width, height, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2], pose)
    options = RasterOptions(near=near_plane, low_pass_px2=eps2d)
    means = means.double()
    centre, conic, z = ellipses(means, scales.double().log(), quats.double(), view, options)
    means2d = centre.float()[None]
    if sh_degree is not None:
        direction = torch.nn.functional.normalize(means - torch.from_numpy(view.centre), dim=-1)
        colors = sh_colour(sh_degree, colors.double(), direction)
    values = {"RGB": [colors], "RGB+D": [colors, z[:, None]]}[render_mode]
    picture, alpha, _ = blend(
        means2d[0].double(),
        conic,
        z,
        opacities.double(),
        torch.cat([v.double() for v in values], 1),
        view,
        near_plane,
    )
    meta = {"means2d": means2d, "tiles_per_gauss": (z >= near_plane).int()[None]}
    return picture.permute(1, 2, 0).float()[None], alpha.float()[None, ..., None], meta


@pytest.fixture(autouse=True)
def gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=dense_rasterization))


def test_pictures_and_gradients_are_ours_where_tiles_and_rows_are():
    gaussians, view = scene(60), camera()
    rows = np.random.default_rng(0).random(60) < 0.5
    for tiles in (None, np.indices(tile_shape(view)).sum(0) % 2 == 0):
        given = {"options": OPTIONS, "background": BACKGROUND, "tiles": tiles}
        here, there = (renderer.render(gaussians, view, **given) for renderer in (raster, yardstick))
        for name in ("colour", "depth", "alpha"):
            assert np.abs(getattr(there, name) - getattr(here, name)).max() < 1e-4, name
        expected = raster.gradients(here, *upstream(view), rows=rows)
        found = yardstick.gradients(there, *upstream(view), rows=rows)
        for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh", "means2d"):
            truth = getattr(expected, name)
            assert np.linalg.norm(getattr(found, name) - truth) < 1e-4 * np.linalg.norm(truth), name


def test_an_iteration_is_measured():
    options = BenchOptions(count=40, width=64, height=48, repeats=2)
    measured = measure_yardstick(room(options), room_camera(options), options, "cpu")
    assert measured["device"] == "cpu by gsplat"
    assert set(measured["iteration"]) == {"forward", "loss", "backward", "adam"}
    assert min(part["min_ms"] for part in measured["iteration"].values()) > 0
