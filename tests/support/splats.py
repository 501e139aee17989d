"""Gaussians to write into files, for the tests of packuv.interchange."""

import numpy as np

from packuv.gaussians.floats import Gaussians

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def random_gaussians(count, degree, seed=0):
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (degree + 1) ** 2, 3)]
    means, scales, quaternions, opacity, sh = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Gaussians(means, scales, quaternions, opacity, sh)


def alpha_of(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def rotation_error(a, b):
    """Distance between unit quaternions, either sign, [n]."""
    sign = np.where((a.quaternions * b.quaternions).sum(axis=1, keepdims=True) < 0, -1, 1)
    return np.linalg.norm(sign * a.quaternions - b.quaternions, axis=1)
