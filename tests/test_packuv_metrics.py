import numpy as np
import pytest

from packuv.metrics import psnr, ssim


def plain_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, window by window."""
    x = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    window = np.outer(x, x) / x.sum() ** 2
    values = []
    for row in range(a.shape[0] - 10):
        for column in range(a.shape[1] - 10):
            p, q = a[row : row + 11, column : column + 11], b[row : row + 11, column : column + 11]
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
            pq = (window * (p - mp) * (q - mq)).sum()
            values.append((2 * mp * mq + 1e-4) * (2 * pq + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(values))


def test_psnr_of_a_known_error():
    truth = np.full((3, 20, 20), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert psnr(truth, truth) == float("inf")
    assert psnr(truth + 9, np.ones_like(truth)) == float("inf")  # a display clips


def test_ssim_equals_its_definition():
    rng = np.random.default_rng(0)
    a = rng.random((18, 23))
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)
    assert ssim(a, b) == pytest.approx(plain_ssim(a, b), abs=1e-9)


def test_ssim_is_one_for_equal_pictures_symmetric_and_falls_with_noise():
    rng = np.random.default_rng(1)
    a = rng.random((3, 32, 40))
    noisy = [np.clip(a + s * rng.normal(size=a.shape), 0, 1) for s in (0.05, 0.2, 0.5)]
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, noisy[0]) == pytest.approx(ssim(noisy[0], a))
    assert ssim(a, noisy[0]) > ssim(a, noisy[1]) > ssim(a, noisy[2])


def test_pictures_of_different_or_tiny_shapes_are_refused():
    with pytest.raises(ValueError, match="one shape"):
        psnr(np.zeros((3, 4, 4)), np.zeros((3, 5, 4)))
    with pytest.raises(ValueError, match="at least 11"):
        ssim(np.zeros((3, 8, 30)), np.zeros((3, 8, 30)))
