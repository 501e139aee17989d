"""N Gaussians as float32 arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from packuv.colour import OFFSET, light_factors

ALPHA_MIN = 1 / 255
"""The alpha below which no renderer draws: a Gaussian in a pixel, and so a Gaussian whose opacity is less."""
DRAWN_LOGIT = math.log(ALPHA_MIN / (1 - ALPHA_MIN))
"""Its logit: writers leave out what no renderer draws."""
SH_C0 = 0.5 / math.sqrt(math.pi)
"""SH basis function of band 0."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as float32 arrays, in the conventions of 3D Gaussian Splatting."""

    means: np.ndarray
    """[N, 3], world"""
    log_scales: np.ndarray
    """[N, 3], natural log of the standard deviations, world"""
    quaternions: np.ndarray
    """[N, 4], w x y z; renderers normalise"""
    opacity_logits: np.ndarray
    """[N]"""
    sh: np.ndarray
    """[N, (degree + 1) ** 2, 3]; colour = 0.5 + sum of basis times coefficient"""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return round(math.sqrt(self.sh.shape[1])) - 1


ATTRIBUTES = tuple(field.name for field in fields(Gaussians))


def arrays(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    """In the order of `ATTRIBUTES`; no copies."""
    return tuple(getattr(gaussians, name) for name in ATTRIBUTES)


def opacity(gaussians: Gaussians) -> np.ndarray:
    """[N], in 0..1"""
    return opacities(gaussians.opacity_logits)


def opacities(logits: np.ndarray) -> np.ndarray:
    """float64, in 0..1"""
    return np.asarray(1 / (1 + np.exp(-logits.astype(np.float64))))


def logit(value: np.ndarray) -> np.ndarray:
    clipped = np.clip(value, 1e-6, 1 - 1e-6)
    return np.asarray(np.log(clipped / (1 - clipped)), dtype=np.float32)


def drawn(gaussians: Gaussians) -> Gaussians:
    """Only those that a renderer would draw."""
    rows = gaussians.opacity_logits >= DRAWN_LOGIT
    return Gaussians(*(array[rows] for array in arrays(gaussians)))


def rows_of(gaussians: Gaussians, rows: np.ndarray | slice) -> Gaussians:
    """Some rows, by index or mask, as copies."""
    return Gaussians(*(array[rows].copy() for array in arrays(gaussians)))


def lit_gaussians(gaussians: Gaussians, light: np.ndarray) -> Gaussians:
    """Gaussians of steady light as they are seen in `light`, natural logarithms [3] by channel: other SH coefficients.

    Their pictures are those of `packuv.colour.lit` wherever the Gaussians cover a pixel; what lies between them stays
    black. In steady light the very same Gaussians come back.
    """
    if not np.any(light):
        return gaussians
    factors = light_factors(light)
    sh = gaussians.sh * factors
    sh[:, 0] += (factors - 1) * (0.5 + OFFSET) / SH_C0
    return replace(gaussians, sh=np.ascontiguousarray(sh, np.float32))


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """[N, 4] w x y z, any length, to [N, 3, 3]."""
    w, x, y, z = (quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def with_canonical_axes(gaussians: Gaussians) -> Gaussians:
    """The same ellipsoids with axes sorted by falling size, turned so that w is the quaternion's largest component.

    Of the 24 frames of an ellipsoid this one has w >= 0.5, so that x, y, z alone tell the rotation, and neighbouring
    Gaussians get similar codes (research: 6 % of a key frame's size).
    """
    order = np.argsort(-gaussians.log_scales, axis=1, kind="stable")  # [N, 3]
    axes = np.take_along_axis(rotation_matrices(gaussians.quaternions.astype(np.float64)), order[:, None, :], axis=2)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    flips = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float64)
    trace = np.einsum("nii,fi->nf", axes, flips)
    axes = axes * flips[trace.argmax(axis=1)][:, None, :]
    return replace(
        gaussians,
        log_scales=np.ascontiguousarray(np.take_along_axis(gaussians.log_scales, order, axis=1)),
        quaternions=_quaternions_with_large_w(axes),
    )


def _quaternions_with_large_w(rotations: np.ndarray) -> np.ndarray:
    """float32 [N, 4] from rotations [N, 3, 3] whose trace is not negative."""
    w = 0.5 * np.sqrt(np.maximum(1 + np.trace(rotations, axis1=1, axis2=2), 1e-12))
    r = rotations
    vector = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    return np.concatenate([w[:, None], vector / (4 * w[:, None])], axis=1).astype(np.float32)
