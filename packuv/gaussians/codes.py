"""Float attributes of Gaussians <-> the integers that a scene file stores.

Every channel decodes through a table, so a decoded value is the same float32 on every machine.
Positions are 16-bit on a symmetric-log scale about the scene's centre, the rest is 8-bit and uniform
(paper, appendix "Low-Precision Training").
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import prange

from packuv.bounds import MOST_NUMBER, MOST_SH_DEGREE, field, fields, numbers, positive, whole
from packuv.gaussians.floats import Gaussians, arrays
from packuv.kernels.compile import kernel

SCALE = slice(0, 3)
"""Columns of `Codes.attributes`: natural log of the three standard deviations."""
ROTATION = slice(3, 6)
"""x, y, z of the unit quaternion whose w >= 0."""
OPACITY = 6
"""Opacity logit. Code 0 decodes below the 1/255 that every renderer skips: an absent Gaussian."""
DC = slice(7, 10)
"""SH band 0, r g b."""
REST = 10
"""First column of the SH bands above 0, coefficient by coefficient, r g b each."""

OPACITY_RANGE = (-5.6, 7.0)
"""Logit of codes 0 and 255; logit(1/255) is -5.537."""


def attribute_count(sh_degree: int) -> int:
    """Number of 8-bit columns at this SH degree."""
    return 7 + 3 * (sh_degree + 1) ** 2


@dataclass(frozen=True)
class Codes:
    """N Gaussians as integers."""

    xyz: np.ndarray
    """uint16 [N, 3]"""
    attributes: np.ndarray
    """uint8 [N, A], columns as named above"""

    def __post_init__(self) -> None:
        if self.xyz.dtype != np.uint16 or self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise ValueError(f"positions must be uint16 [N, 3], but are {self.xyz.dtype} {self.xyz.shape}")
        if self.attributes.dtype != np.uint8 or self.attributes.shape[:-1] != (len(self.xyz),):
            raise ValueError(
                f"attributes must be uint8 [{len(self.xyz)}, A], but are "
                f"{self.attributes.dtype} {self.attributes.shape}"
            )

    def __len__(self) -> int:
        return len(self.xyz)

    def __getitem__(self, rows: np.ndarray | slice) -> Codes:
        return Codes(self.xyz[rows], self.attributes[rows])


@dataclass(frozen=True)
class Quantizer:
    """Ranges of every channel, fixed once per sequence so that segments stay independent."""

    centre: np.ndarray
    """Scene centre, world, float64 [3]; also the centre of the UV sphere"""
    unit: float
    """Length at which the symmetric-log scale turns from linear to logarithmic, world"""
    reach: np.ndarray
    """float64 [3]: positions up to this distance from the centre along each axis have codes"""
    low: np.ndarray
    """float64 [A]: value of code 0"""
    high: np.ndarray
    """float64 [A]: value of code 255"""
    sh_degree: int = 0

    def __post_init__(self) -> None:
        count = attribute_count(whole(self.sh_degree, "a quantizer's sh_degree", most=MOST_SH_DEGREE))
        if self.low.shape != (count,) or self.high.shape != (count,):
            raise ValueError(
                f"SH degree {self.sh_degree} has {count} columns, but the ranges have "
                f"{self.low.shape} and {self.high.shape}"
            )
        for name in ("centre", "unit", "reach", "low", "high"):
            if not (np.abs(getattr(self, name)) <= MOST_NUMBER).all():
                raise ValueError(
                    f"a quantizer's {name} must be finite, up to {MOST_NUMBER:g}, but is {getattr(self, name)}"
                )
        if not (self.high > self.low).all() or not (self.reach > 0).all() or not self.unit > 0:
            raise ValueError("every range of a quantizer must be positive")

    @cached_property
    def xyz_table(self) -> np.ndarray:
        """float32 [3, 65536]: position of each code."""
        t = (np.arange(65536) / 32767.5 - 1.0) * self._edge[:, None]
        return np.asarray(self.centre[:, None] + np.sign(t) * self.unit * np.expm1(np.abs(t)), dtype=np.float32)

    @cached_property
    def attribute_table(self) -> np.ndarray:
        """float32 [A, 256]: value of each code."""
        step = (self.high - self.low) / 255
        return np.asarray(self.low[:, None] + np.arange(256) * step[:, None], dtype=np.float32)

    def encode(self, gaussians: Gaussians) -> Codes:
        """Nearest codes; values outside their range saturate, see `saturation`."""
        count, columns = len(gaussians), len(self.low)
        xyz, attributes = np.empty((count, 3), np.uint16), np.empty((count, columns), np.uint8)
        _encode(*arrays(gaussians)[:4], _flat(gaussians.sh), *self.scale, xyz, attributes)
        return Codes(xyz, attributes)

    def decode(self, codes: Codes, *, into: Gaussians | None = None) -> Gaussians:
        """Exactly the floats that the fit rendered, written to the first rows of `into` if that is given."""
        if codes.attributes.shape[1] != len(self.low):
            raise ValueError(f"codes have {codes.attributes.shape[1]} columns, the quantizer {len(self.low)}")
        count, coefficients = len(codes), (self.sh_degree + 1) ** 2
        if into is None:
            shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, coefficients, 3)]
            into = Gaussians(*(np.empty(shape, np.float32) for shape in shapes))
        tables, flat = (self.xyz_table, self.attribute_table), _flat(into.sh)
        _decode(codes.xyz, codes.attributes, *tables, *arrays(into)[:4], flat)
        return into

    def saturation(self, gaussians: Gaussians) -> int:
        """Number of values that lie more than half a step outside their range."""
        offset = np.abs(gaussians.means - self.centre) > self.reach * (1 + 1e-4)
        values, half = attribute_values(gaussians), (self.high - self.low) / 510
        outside = (values < self.low - half) | (values > self.high + half)
        return int(offset.sum() + outside.sum())

    @property
    def scale(self) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, np.ndarray]:
        """What `encode_row` takes: centre, unit, edge, low, and codes per unit of each column."""
        return self.centre, self.unit, self._edge, self.low, 255 / (self.high - self.low)

    @property
    def _edge(self) -> np.ndarray:
        """float64 [3]: the symmetric logarithm at the end of each axis."""
        return np.log1p(self.reach / self.unit)

    def to_json(self) -> dict[str, Any]:
        return {
            "centre": self.centre.tolist(),
            "unit": self.unit,
            "reach": self.reach.tolist(),
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "sh_degree": self.sh_degree,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Quantizer:
        what = "the quantizer"
        degree = whole(field(fields(data, what), "sh_degree", what), "the quantizer's sh_degree", most=MOST_SH_DEGREE)
        sizes = {"centre": 3, "reach": 3, "low": attribute_count(degree), "high": attribute_count(degree)}
        arrays = {
            key: numbers(field(data, key, what), f"the quantizer's {key}", (size,)) for key, size in sizes.items()
        }
        return cls(unit=positive(field(data, "unit", what), "the quantizer's unit"), sh_degree=degree, **arrays)


def _flat(sh: np.ndarray) -> np.ndarray:
    """[N, K, 3] as [N, 3 K], a view."""
    return sh.reshape(len(sh), 3 * sh.shape[1])


def attribute_values(gaussians: Gaussians) -> np.ndarray:
    """The 8-bit columns as floats, [N, A]; the quaternion is normalised with w >= 0."""
    q = gaussians.quaternions
    q = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    vector = np.where(q[:, :1] < 0, -q[:, 1:], q[:, 1:])
    return np.concatenate(
        [gaussians.log_scales, vector, gaussians.opacity_logits[:, None], _flat(gaussians.sh)],
        axis=1,
    )


# Functions of one row, on the CPU and on a GPU; the latter knows `math` alone.


@kernel(inline=True)
def _step(value, low, per_step):
    return np.uint8(round(min(max((np.float64(value) - low) * per_step, 0.0), 255.0)))


@kernel(inline=True)
def encode_row(means, log_scales, quaternions, opacity_logits, sh, centre, unit, edge, low, per_step, xyz, attributes,
               i):  # fmt: skip
    for axis in range(3):
        offset = (np.float64(means[i, axis]) - centre[axis]) / unit
        t = math.copysign(math.log1p(abs(offset)), offset) / edge[axis]
        xyz[i, axis] = round(min(max((t + 1) * 32767.5, 0.0), 65535.0))
        attributes[i, axis] = _step(log_scales[i, axis], low[axis], per_step[axis])
    w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    length = max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    sign = (-1.0 if w < 0 else 1.0) / length
    attributes[i, 3] = _step(x * sign, low[3], per_step[3])
    attributes[i, 4] = _step(y * sign, low[4], per_step[4])
    attributes[i, 5] = _step(z * sign, low[5], per_step[5])
    attributes[i, 6] = _step(opacity_logits[i], low[6], per_step[6])
    for k in range(sh.shape[1]):
        attributes[i, 7 + k] = _step(sh[i, k], low[7 + k], per_step[7 + k])


@kernel(inline=True)
def decode_row(xyz, attributes, xyz_table, table, means, log_scales, quaternions, opacity_logits, sh, i):
    for axis in range(3):
        means[i, axis] = xyz_table[axis, xyz[i, axis]]
        log_scales[i, axis] = table[axis, attributes[i, axis]]
    x, y, z = table[3, attributes[i, 3]], table[4, attributes[i, 4]], table[5, attributes[i, 5]]
    # In float64, so that no contraction of multiply and add can change the rounded result.
    rest = 1.0 - (np.float64(x) * x + np.float64(y) * y + np.float64(z) * z)
    quaternions[i, 0] = np.float32(math.sqrt(max(rest, 0.0)))
    quaternions[i, 1], quaternions[i, 2], quaternions[i, 3] = x, y, z
    opacity_logits[i] = table[6, attributes[i, 6]]
    for k in range(sh.shape[1]):
        sh[i, k] = table[7 + k, attributes[i, 7 + k]]


@kernel(parallel=True)
def _encode(means, log_scales, quaternions, opacity_logits, sh, centre, unit, edge, low, per_step, xyz, attributes):
    for row in prange(len(means)):
        encode_row(means, log_scales, quaternions, opacity_logits, sh, centre, unit, edge, low, per_step, xyz,
                   attributes, np.int64(row))  # fmt: skip


@kernel(parallel=True)
def _decode(xyz, attributes, xyz_table, table, means, log_scales, quaternions, opacity_logits, sh):
    for row in prange(len(xyz)):
        decode_row(xyz, attributes, xyz_table, table, means, log_scales, quaternions, opacity_logits, sh,
                   np.int64(row))  # fmt: skip
