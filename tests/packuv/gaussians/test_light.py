"""Light, given to Gaussians and to pictures of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.colour import OFFSET, light_factors, lit
from packuv.gaussians.floats import lit_gaussians
from packuv.raster import RasterOptions, render
from tests.support.splats import wall

CAMERA = PinholeCamera("a", 96, 64, 70.0, 70.0, 48.0, 32.0, np.eye(4))
light = st.tuples(*[st.floats(-0.6, 0.6)] * 3).map(np.array)


@pytest.mark.parametrize("degree", [0, 1, 3])
@settings(max_examples=10)
@given(light)
def test_lit_gaussians_draw_the_lit_picture(degree, light):
    options, steady = RasterOptions(near=0.1), wall(degree)
    drawn = render(steady, CAMERA, options=options)
    assert (drawn.alpha > 0.999).mean() > 0.9
    seen = render(lit_gaussians(steady, light), CAMERA, options=options).colour
    # float32; what is not covered is black in one, and lit in the other.
    missing = OFFSET * (light_factors(light)[:, None, None] - 1) * (1 - drawn.alpha)
    assert np.abs(seen - (lit(drawn.colour, light) - missing)).max() < 2e-5


@given(light, light)
def test_light_upon_light_is_their_sum(a, b):
    one, two = lit_gaussians(lit_gaussians(wall(1), a), b), lit_gaussians(wall(1), a + b)
    assert np.allclose(one.sh, two.sh, rtol=0, atol=2e-6)


def test_steady_light_changes_nothing():
    gaussians = wall(1)
    assert lit_gaussians(gaussians, np.zeros(3)) is gaussians
    before = gaussians.sh.copy()
    assert lit_gaussians(gaussians, np.array([0.1, 0, 0])).sh.dtype == np.float32
    assert np.array_equal(gaussians.sh, before)
