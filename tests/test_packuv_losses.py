import numpy as np
import pytest
import torch

from packuv.losses import PhotometricOptions, photometric_loss


def twin(picture: torch.Tensor, target: torch.Tensor, share: float) -> torch.Tensor:
    """The same loss in plain torch, float64."""
    weights = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    weights = weights / weights.sum()
    kernel = (weights[:, None] * weights[None, :])[None, None]

    def blur(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(x[:, None], kernel, padding=5)[:, 0]

    a, b = blur(picture), blur(target)
    aa, bb = blur(picture * picture) - a * a, blur(target * target) - b * b
    ab = blur(picture * target) - a * b
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * a * b + c1) * (2 * ab + c2) / ((a * a + b * b + c1) * (aa + bb + c2))
    return (1 - share) * (picture - target).abs().mean() + share * (1 - ssim.mean())


@pytest.mark.parametrize("shape", [(3, 40, 56), (3, 33, 17), (3, 16, 16)])
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_value_and_gradient_equal_autograd(shape, share):
    rng = np.random.default_rng(0)
    picture, target = (rng.random(shape).astype(np.float32) for _ in range(2))
    found = photometric_loss(picture, target, options=PhotometricOptions(share))
    variable = torch.from_numpy(picture.astype(np.float64)).requires_grad_(True)
    loss = twin(variable, torch.from_numpy(target.astype(np.float64)), share)
    loss.backward()
    assert found.value == pytest.approx(loss.item(), rel=1e-5)  # float32 sums
    expected = variable.grad.numpy()
    # float32 cancels in variances of windows: two units in the fifth place of the largest gradient.
    assert np.abs(found.gradient - expected).max() < 2e-5 * np.abs(expected).max() + 1e-9


def test_equal_pictures_have_no_loss_and_no_gradient():
    picture = np.random.default_rng(1).random((3, 32, 48)).astype(np.float32)
    found = photometric_loss(picture, picture.copy(), options=PhotometricOptions())
    assert found.value == pytest.approx(0, abs=1e-6)
    assert np.abs(found.gradient).max() < 1e-6


def test_tiles_that_are_not_active_have_no_gradient_and_all_tiles_equal_none():
    rng = np.random.default_rng(2)
    picture, target = (rng.random((3, 48, 64)).astype(np.float32) for _ in range(2))
    options = PhotometricOptions()
    tiles = np.zeros((3, 4), bool)
    tiles[1, 2] = True
    part = photometric_loss(picture, target, options=options, tiles=tiles)
    outside = np.ones((48, 64), bool)
    outside[16:32, 32:48] = False
    assert not part.gradient[:, outside].any()
    assert part.gradient[:, ~outside].any()
    whole = photometric_loss(picture, target, options=options)
    every = photometric_loss(picture, target, options=options, tiles=np.ones((3, 4), bool))
    assert every.value == pytest.approx(whole.value, rel=1e-6)
    np.testing.assert_array_equal(every.gradient, whole.gradient)


def test_two_runs_give_the_same_bytes():
    rng = np.random.default_rng(3)
    picture, target = (rng.random((3, 90, 120)).astype(np.float32) for _ in range(2))
    first, second = (photometric_loss(picture, target, options=PhotometricOptions()) for _ in range(2))
    assert first.value == second.value
    assert first.gradient.tobytes() == second.gradient.tobytes()


def test_shapes_that_do_not_fit_are_refused():
    a = np.zeros((3, 20, 20), np.float32)
    with pytest.raises(ValueError, match="shape"):
        photometric_loss(a, a[:, :10], options=PhotometricOptions())
    with pytest.raises(ValueError, match="tiles must be bool"):
        photometric_loss(a, a, options=PhotometricOptions(), tiles=np.ones((5, 5), bool))
