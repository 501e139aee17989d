"""A camera's response: factors of light as a scene is drawn with them, and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.colour import linear_from_srgb, lit, srgb_from_linear
from packuv.footage.lens import LensCamera
from packuv.footage.response import Response, corner_radius, shading_means

HEIGHT, WIDTH = 30, 50
PINHOLE = PinholeCamera("a", WIDTH, HEIGHT, 40.0, 42.0, 24.0, 16.0, np.eye(4))
PICTURE = np.random.default_rng(3).uniform(0.1, 0.5, (3, HEIGHT, WIDTH)).astype(np.float32)

gain = st.floats(0.7, 1.4)
responses = st.builds(
    lambda gains, k1, k2, light: Response.of(
        LensCamera(PINHOLE, gains=gains, shading=(k1, k2)), PINHOLE, np.array(light)
    ),
    st.tuples(gain, gain, gain),
    st.floats(-0.6, 0.3),
    st.floats(-0.1, 0.1),
    st.tuples(*[st.floats(-0.2, 0.2)] * 3),
)


def falloff(k1: float, k2: float) -> np.ndarray:
    """Shading [H, W] by its definition, in double precision."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    r2 = ((x - PINHOLE.cx) / PINHOLE.fx) ** 2 + ((y - PINHOLE.cy) / PINHOLE.fy) ** 2
    r2 /= corner_radius(PINHOLE) ** 2
    m2, m4 = shading_means(PINHOLE)
    return np.exp(k1 * (r2 - m2) + k2 * (r2**2 - m4))


def test_without_gain_shading_and_light_a_picture_is_filmed_as_it_is():
    response = Response.of(LensCamera(PINHOLE), PINHOLE)
    assert np.allclose(response.shown(PICTURE), PICTURE, atol=1e-7)


@given(st.tuples(*[st.floats(-2, 1)] * 3).map(np.array))
def test_a_plain_camera_films_the_lit_picture(light):
    response = Response.of(LensCamera(PINHOLE), PINHOLE, light)
    assert np.abs(response.shown(PICTURE) - np.clip(lit(PICTURE, light), 0, 1)).max() < 1e-6  # float32


@given(st.tuples(gain, gain, gain), st.floats(-0.6, 0.3), st.floats(-0.1, 0.1))
def test_what_is_filmed_is_linear_light_times_shading_over_gain(gains, k1, k2):
    response = Response.of(LensCamera(PINHOLE, gains=gains, shading=(k1, k2)), PINHOLE)
    light = linear_from_srgb(PICTURE.astype(np.float64)) * falloff(k1, k2) / np.array(gains)[:, None, None]
    # The power of 2.4 is sRGB but for its straight part near black.
    wanted = srgb_from_linear(light)
    bright = wanted > 0.05
    assert np.abs(response.shown(PICTURE) - wanted)[bright].max() < 1e-4


@given(responses)
def test_undone_is_the_inverse_of_shown_where_nothing_is_clipped(response):
    shown = response.shown(PICTURE)
    inside = (shown > 0) & (shown < 1)
    assert np.abs(response.undone(shown) - PICTURE)[inside].max() < 2e-6


@given(responses, st.integers(0, 2**31))
def test_carried_is_the_derivative_of_shown(response, seed):
    direction = np.random.default_rng(seed).normal(0, 1e-2, PICTURE.shape).astype(np.float32)
    weight = np.random.default_rng(seed + 1).normal(0, 1, PICTURE.shape).astype(np.float32)
    ahead, behind = response.shown(PICTURE + direction), response.shown(PICTURE - direction)
    inside = np.where((np.maximum(ahead, behind) < 1) & (np.minimum(ahead, behind) > 0), weight, 0).astype(np.float32)
    slope = ((ahead - behind).astype(np.float64) * inside).sum() / 2
    assert slope == pytest.approx(float((response.carried(inside).astype(np.float64) * direction).sum()), abs=2e-4)


def test_shading_has_mean_one_over_a_centred_picture():
    wide = PinholeCamera("a", 640, 360, 500.0, 500.0, 320.0, 180.0, np.eye(4))
    y, x = np.mgrid[0:360, 0:640] + 0.5
    r2 = ((x - 320) ** 2 + (y - 180) ** 2) / (320**2 + 180**2)
    m2, m4 = shading_means(wide)
    assert r2.mean() == pytest.approx(m2, abs=1e-5)
    assert (r2**2).mean() == pytest.approx(m4, abs=1e-5)


def test_lamps_are_clipped_and_come_back_only_where_the_camera_was_not():
    lamp = np.full((3, 8, 8), 1.4, np.float32)
    camera = PinholeCamera("a", 8, 8, 10.0, 10.0, 4.0, 4.0, np.eye(4))
    response = Response.of(LensCamera(camera, gains=(1.1, 1.1, 1.1)), camera)
    assert (response.shown(lamp) == 1).all()
    assert (response.carried(np.ones_like(lamp)) > 0).all()


@given(responses, st.sampled_from([2, 3, 0.5]))
def test_a_picture_of_another_size_has_the_same_response(response, scale):
    flat = np.full((3, HEIGHT, WIDTH), 0.3, np.float32)
    size = (3, round(HEIGHT * scale), round(WIDTH * scale))
    scaled = response.scaled(scale, scale).shown(np.full(size, 0.3, np.float32))
    # Corners of the picture agree with each other as far as half a pixel moves them.
    assert np.abs(scaled.mean(axis=(1, 2)) - response.shown(flat).mean(axis=(1, 2))).max() < 2e-3
