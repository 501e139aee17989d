"""The fused loss against its definition in torch, value and gradient."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.fit.depth import SparseDepth, depth_loss
from packuv.fit.losses import PhotometricOptions, photometric_loss

VALUE_TOLERANCE = 1e-6
"""Float32 sums over 10^5 pixels of values below 1; measured 1e-8."""
GRADIENT_TOLERANCE = 3e-6
"""Relative to the greatest; float32 variances are differences of nearly equal numbers; measured 6e-7."""


def reference(picture: torch.Tensor, target: torch.Tensor, mask: torch.Tensor, share: float) -> list[torch.Tensor]:
    """Loss, L1 and SSIM, float64; `mask` [H, W] says which pixels count, the others equal the target."""
    window = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    window = window / window.sum()
    kernel = (window[:, None] * window[None])[None, None].expand(len(picture), 1, 11, 11)

    def blur(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(x[None], kernel, padding=5, groups=len(picture))[0]

    a, b = torch.where(mask, picture, target), target
    ma, mb = blur(a), blur(b)
    variances, covariance = blur(a * a) - ma**2 + blur(b * b) - mb**2, blur(a * b) - ma * mb
    ssim = (2 * ma * mb + 1e-4) * (2 * covariance + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (variances + 9e-4))
    count = len(picture) * mask.sum()
    l1, mean = ((a - b).abs() * mask).sum() / count, (ssim * mask).sum() / count
    return [(1 - share) * l1 + share * (1 - mean), l1, mean]


def pictures(height: int, width: int, seed: int = 0, channels: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.random((channels, height, width)).astype(np.float32)
    return (target + 0.2 * rng.normal(size=target.shape)).astype(np.float32), target


def some_tiles(height: int, width: int, share: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((-(-height // 16), -(-width // 16))) < share


def pixel_mask(tiles: np.ndarray, height: int, width: int) -> np.ndarray:
    return np.kron(tiles, np.ones((16, 16), bool))[:height, :width]


def assert_matches(picture, target, options, tiles=None):
    height, width = target.shape[1:]
    mask = np.ones((height, width), bool) if tiles is None else pixel_mask(tiles, height, width)
    variable = torch.from_numpy(picture).double().requires_grad_()
    truth = reference(variable, torch.from_numpy(target).double(), torch.from_numpy(mask), options.ssim_share)
    (gradient,) = torch.autograd.grad(truth[0], variable)
    found = photometric_loss(picture, target, options=options, tiles=tiles)
    values = [value.item() for value in truth]
    assert np.allclose([found.value, found.l1, found.ssim], values, rtol=0, atol=VALUE_TOLERANCE)
    assert np.abs(found.gradient - gradient.numpy()).max() < GRADIENT_TOLERANCE * gradient.abs().max().item()


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (37, 53), (96, 64), (97, 161), (200, 33)])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_matches_the_definition(size, share):
    assert_matches(*pictures(*size), PhotometricOptions(share))


@settings(max_examples=25)
@given(st.integers(1, 130), st.integers(1, 130), st.integers(1, 4), st.floats(0.05, 0.95), st.integers(0, 2**20))
def test_matches_the_definition_on_some_tiles(height, width, channels, share, seed):
    tiles = some_tiles(height, width, share, seed)
    tiles.flat[seed % tiles.size] = True  # at least one
    assert_matches(*pictures(height, width, seed, channels), PhotometricOptions(), tiles)


def test_all_tiles_are_the_whole_picture_bit_for_bit():
    picture, target = pictures(120, 200)
    whole = photometric_loss(picture, target, options=PhotometricOptions())
    tiles = photometric_loss(picture, target, options=PhotometricOptions(), tiles=np.ones((8, 13), bool))
    assert (whole.value, whole.ssim) == (tiles.value, tiles.ssim)
    assert np.array_equal(whole.gradient, tiles.gradient)


def test_nothing_outside_active_tiles_matters():
    picture, target = pictures(120, 200)
    tiles = some_tiles(120, 200, 0.3)
    mask = pixel_mask(tiles, 120, 200)
    found = photometric_loss(picture, target, options=PhotometricOptions(), tiles=tiles)
    other = np.where(mask, picture, np.float32(7))
    again = photometric_loss(other, target, options=PhotometricOptions(), tiles=tiles)
    assert found.value == again.value
    assert np.array_equal(found.gradient, again.gradient)
    assert not found.gradient[:, ~mask].any()


def test_equal_pictures_have_no_loss_and_no_gradient():
    target = pictures(60, 70)[1]
    found = photometric_loss(target.copy(), target, options=PhotometricOptions(0.5))
    assert found.l1 == 0
    assert found.ssim == pytest.approx(1, abs=VALUE_TOLERANCE)
    assert np.abs(found.gradient).max() < 1e-4 / target.size  # rounding of variances, divided by their constant


def test_no_active_tile_is_no_loss():
    found = photometric_loss(*pictures(40, 40), options=PhotometricOptions(), tiles=np.zeros((3, 3), bool))
    assert (found.value, found.l1, found.ssim) == (0, 0, 1)
    assert not found.gradient.any()


@pytest.mark.parametrize("level", [0.0, 1.0, 1e4])
def test_constant_and_overexposed_pictures_stay_finite(level):
    target = np.zeros((3, 40, 50), np.float32)
    found = photometric_loss(np.full_like(target, level), target, options=PhotometricOptions())
    assert np.isfinite(found.gradient).all()
    assert np.isfinite(found.value)


def test_bytes_do_not_depend_on_threads():
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            found = photometric_loss(*pictures(200, 150), options=PhotometricOptions())
            results.append((found.value, found.gradient.tobytes()))
    finally:
        numba.set_num_threads(before)
    assert results[0] == results[1]


def test_the_gradient_can_go_to_a_given_array():
    picture, target = pictures(40, 50)
    out = np.full_like(target, 9)
    found = photometric_loss(picture, target, options=PhotometricOptions(), tiles=some_tiles(40, 50, 0.5), out=out)
    assert found.gradient is out
    assert np.abs(out).max() < 1


def test_wrong_input_is_refused_with_what_came():
    picture, target = pictures(40, 50)
    with pytest.raises(ValueError, match=r"must both be \[C, H, W\]"):
        photometric_loss(picture, target[:, :39], options=PhotometricOptions())
    with pytest.raises(ValueError, match="target must be C-contiguous float32, but is float64"):
        photometric_loss(picture, target.astype(np.float64), options=PhotometricOptions())
    with pytest.raises(ValueError, match=r"tiles must be bool \(3, 4\)"):
        photometric_loss(picture, target, options=PhotometricOptions(), tiles=np.ones((4, 3), bool))
    with pytest.raises(ValueError, match="must lie in"):
        PhotometricOptions(ssim_share=1.5)


def test_depth_gradients_agree_with_differences():
    rng = np.random.default_rng(4)
    alpha = rng.uniform(0.6, 1, (5, 6)).astype(np.float32)
    depth = (alpha * rng.uniform(2, 3, (5, 6))).astype(np.float32)
    known = SparseDepth(np.array([0, 7, 7, 20]), np.array([2.2, 2.9, 1.0, 2.5], np.float32))
    _, d_depth, d_alpha = depth_loss(depth, alpha, known, scale=2.0)
    step = 1e-3
    for place in ((0, 0), (1, 1), (3, 2), (4, 4)):
        for picture, slope in ((depth, d_depth), (alpha, d_alpha)):
            up, down = picture.copy(), picture.copy()
            up[place] += step
            down[place] -= step
            pairs = ((up, alpha), (down, alpha)) if picture is depth else ((depth, up), (depth, down))
            high, low = (depth_loss(*pair, known, scale=2.0)[0] for pair in pairs)
            # float32 losses of about 0.3, differences over 2e-3
            assert slope[place] == pytest.approx((high - low) / (2 * step), abs=2e-3)


def test_depth_counts_only_where_something_is_drawn():
    known = SparseDepth(np.array([1, 2]), np.array([3.0, 3.0], np.float32))
    alpha = np.array([[1.0, 0.2, 0.4]], np.float32)
    value, d_depth, d_alpha = depth_loss(alpha * 5, alpha, known, scale=1.0)
    assert value == 0
    assert not d_depth.any()
    assert not d_alpha.any()
