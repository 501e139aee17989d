"""Gaussians to write into files, for the tests of packuv.interchange."""

import numpy as np

from packuv.gaussians.floats import SH_C0, Gaussians

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def random_gaussians(count, degree, seed=0):
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (degree + 1) ** 2, 3)]
    means, scales, quaternions, opacity, sh = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Gaussians(means, scales, quaternions, opacity, sh)


def wall(degree):
    """Large opaque Gaussians that cover a picture from the origin along z, of colours far from both limits."""
    rng, count = np.random.default_rng(0), 600
    means = rng.uniform([-4, -3, 3], [4, 3, 5], (count, 3))
    sh = rng.uniform(-0.02, 0.02, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(0.15, 0.65, (count, 3)) - 0.5) / SH_C0
    values = means, np.full((count, 3), np.log(0.4)), rng.normal(size=(count, 4)), np.full(count, 6.0), sh
    return Gaussians(*(value.astype(np.float32) for value in values))


def alpha_of(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def rotation_error(a, b):
    """Distance between unit quaternions, either sign, [n]."""
    sign = np.where((a.quaternions * b.quaternions).sum(axis=1, keepdims=True) < 0, -1, 1)
    return np.linalg.norm(sign * a.quaternions - b.quaternions, axis=1)
