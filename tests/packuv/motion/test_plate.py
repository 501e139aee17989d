"""A plate of the empty stage beside what stands still in a take."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.colour import linear_from_srgb, srgb_from_linear
from packuv.motion import BackgroundOptions, Still, compare_plate

HEIGHT, WIDTH = 90, 160
ROUNDING = 2
"""Grey values: a gain takes a value of 8 bits to another one, and back"""
OPTIONS = BackgroundOptions()


def wall(seed: int = 0, shift_px: float = 0.0) -> np.ndarray:
    """Detail at several scales between 40 and 180, uint8 [H, W, 3]."""
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for cells in (6, 20, 60):
        noise = rng.normal(size=(cells, cells, 3)).astype(np.float32)
        total += cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    moved = cv2.warpAffine(
        total, np.array([[1, 0, shift_px], [0, 1, 0]], np.float32), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
    )
    return (40 + 140 / (1 + np.exp(-moved))).astype(np.uint8)


def lit(pixels: np.ndarray, gains: tuple[float, float, float]) -> np.ndarray:
    return np.rint(255 * srgb_from_linear(linear_from_srgb(pixels / 255) * gains)).astype(np.uint8)


def still(pixels: np.ndarray) -> Still:
    return Still(0, pixels, np.ones(pixels.shape[:2], bool))


def with_person(pixels: np.ndarray) -> np.ndarray:
    """Somebody who stands still before a sixth of the picture."""
    shown = pixels.copy()
    shown[20:80, 60:100] = wall(9)[20:80, 60:100]
    return shown


def test_a_plate_of_the_same_light_stays_as_it_is_and_shows_what_a_person_hides():
    plate = compare_plate(still(wall()), still(with_person(wall())), OPTIONS)
    np.testing.assert_array_equal(plate.still.pixels, wall())
    assert plate.gains == (1.0, 1.0, 1.0)
    assert plate.fits
    assert plate.agreement == pytest.approx(1 - 40 * 60 / (HEIGHT * WIDTH), abs=0.05)


@given(gains=st.tuples(*[st.floats(0.75, 1.3)] * 3))
@settings(max_examples=20)
def test_another_light_is_undone(gains: tuple[float, float, float]):
    plate = compare_plate(still(lit(wall(), gains)), still(with_person(wall())), OPTIONS)
    assert plate.fits
    if plate.gains != (1.0, 1.0, 1.0):  # else every place agrees within the tolerance, or as many as with them
        np.testing.assert_allclose(plate.gains, 1 / np.array(gains), rtol=0.03)
        apart = np.abs(plate.still.pixels.astype(int) - wall())
        assert np.percentile(apart, 99) <= ROUNDING
    assert plate.agreement is not None
    assert plate.agreement > 0.8


def test_a_camera_that_was_moved_shows_another_place():
    own = still(with_person(wall()))
    likeness = [compare_plate(still(wall(shift_px=shift)), own, OPTIONS).likeness for shift in (0, 1, 2, 4, 8)]
    assert max(likeness[3:]) < 0.5 < min(likeness[:2]), likeness
    assert not compare_plate(still(wall(shift_px=4)), own, OPTIONS).fits
    assert not compare_plate(still(wall(seed=1)), own, OPTIONS).fits


def test_what_cannot_be_compared_is_believed():
    plain = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    unknown = Still(0, wall(), np.zeros((HEIGHT, WIDTH), bool))
    for own in (None, unknown):
        plate = compare_plate(still(wall()), own, OPTIONS)
        assert (plate.fits, plate.agreement, plate.likeness, plate.gains) == (True, None, None, (1.0, 1.0, 1.0))
    assert compare_plate(still(plain), still(plain), OPTIONS).likeness is None


def test_dark_and_clipped_channels_have_no_gain():
    dark, white = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    assert compare_plate(still(dark), still(white), OPTIONS).gains == (1.0, 1.0, 1.0)
