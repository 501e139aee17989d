"""PSNR and SSIM against plain definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from packuv.metrics import LEAST_FRAMES, likenesses, psnr, ssim, trend


def plain_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, window by window."""
    weights = np.exp(-((np.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    window = np.outer(weights, weights) / weights.sum() ** 2
    values = []
    for y in range(a.shape[0] - 10):
        for x in range(a.shape[1] - 10):
            u, v = a[y : y + 11, x : x + 11].astype(np.float64), b[y : y + 11, x : x + 11].astype(np.float64)
            mu, mv = (window * u).sum(), (window * v).sum()
            su, sv = (window * (u - mu) ** 2).sum(), (window * (v - mv) ** 2).sum()
            suv = (window * (u - mu) * (v - mv)).sum()
            values.append((2 * mu * mv + 1e-4) * (2 * suv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (su + sv + 9e-4)))
    return float(np.mean(values))


def pictures(shape: tuple[int, ...], noise: float = 0.1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.random(shape).astype(np.float32)
    return np.clip(truth + noise * rng.normal(size=shape), 0, 1).astype(np.float32), truth


def test_psnr_of_known_errors():
    truth = np.full((3, 8, 9), 0.5, np.float32)
    assert psnr(truth + np.float32(0.1), truth) == pytest.approx(20, abs=1e-5)
    assert psnr(truth + np.float32(0.01), truth) == pytest.approx(40, abs=1e-4)  # 0.51 - 0.5 in float32
    assert psnr(truth, truth) == float("inf")


def test_psnr_clips_as_a_display_does():
    truth = np.ones((3, 4, 4), np.float32)
    assert psnr(np.full_like(truth, 5), truth) == float("inf")


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_ssim_matches_the_definition(noise):
    a, b = pictures((23, 31), noise)
    # 1e-9: variances as differences of means of squares, in float64.
    assert ssim(a, b) == pytest.approx(plain_ssim(a, b), abs=1e-9)


def test_ssim_of_colour_is_the_mean_of_channels():
    a, b = pictures((3, 20, 25))
    assert ssim(a, b) == pytest.approx(np.mean([ssim(x, y) for x, y in zip(a, b, strict=True)]), abs=1e-12)


def test_ssim_laws():
    a, b = pictures((3, 24, 24))
    assert ssim(b, b) == pytest.approx(1, abs=1e-9)
    assert ssim(a, b) == ssim(b, a)
    assert -1 <= ssim(a, b) < 1
    assert ssim(a[:, ::-1], b[:, ::-1]) == pytest.approx(ssim(a, b), abs=1e-12)
    assert ssim(1 - b, b) < 0


def test_several_pictures_are_as_like_as_each_is_alone():
    truth = pictures((3, 24, 30))[1]
    some = [pictures((3, 24, 30), noise)[0] for noise in (0.02, 0.1, 0.5)]
    some.append(2 * some[0] - np.float32(0.5))  # beyond [0, 1]
    assert likenesses(some, truth) == [(psnr(picture, truth), ssim(picture, truth)) for picture in some]
    assert likenesses([], truth) == []


def test_ssim_of_one_window():
    a, b = pictures((11, 11))
    assert ssim(a, b) == pytest.approx(plain_ssim(a, b), abs=1e-9)


def test_wrong_input_is_refused_with_what_came():
    a, b = pictures((3, 20, 20))
    with pytest.raises(ValueError, match=r"one shape, but have \(3, 20, 20\) and \(20, 20\)"):
        psnr(a, b[0])
    with pytest.raises(ValueError, match="at least 11 pixels a side"):
        ssim(a[:, :10], b[:, :10])


# ---- against scikit-image, with the settings of the field


@pytest.mark.parametrize("noise", [0.02, 0.3])
@pytest.mark.parametrize("shape", [(37, 53), (3, 40, 61)])
def test_as_scikit_image_has_it(shape, noise):
    a, b = (plane.astype(np.float64) for plane in pictures(shape, noise))
    channel = 0 if len(shape) == 3 else None
    wanted = structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=channel
    )
    assert ssim(a, b) == pytest.approx(wanted, abs=1e-9)  # sums in another order
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1), abs=1e-9)


# ---- course over time


@given(st.floats(-5, 5), st.floats(10, 40), st.integers(LEAST_FRAMES, 300), st.integers(0, 1000))
def test_the_trend_of_a_line_is_its_slope_whatever_its_level_and_its_start(slope, level, count, start):
    frames = range(start, start + count)
    levels = [level + slope * (frame - start) / 100 for frame in frames]
    # Float64, and levels of tens of dB.
    assert trend(frames, levels) == pytest.approx(slope, abs=1e-9)
    assert trend(frames, levels[::-1]) == pytest.approx(-slope, abs=1e-9)


def test_few_frames_have_no_trend():
    assert trend(range(LEAST_FRAMES - 1), [30.0] * (LEAST_FRAMES - 1)) is None
    assert trend([], []) is None
