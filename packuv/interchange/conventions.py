"""What all splat files agree on, and the small encodings that several of them share."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from packuv.gaussians.floats import DRAWN_LOGIT, Gaussians, rows_of

OPAQUE_LOGIT = 20.0
"""For an alpha of 1, which has no finite logit: float32 rounds its alpha to 1"""
ABSENT_LOGIT = -20.0
"""For an alpha of 0, of a row that is kept for its number: float32 has 2e-9, 8 bits have 0"""
FLATNESS = np.log(100.0)
"""An axis of no thickness is so much thinner, natural logarithm, than the thinnest of its Gaussian that has some"""
NO_LOG_SCALE = math.log(np.finfo(np.float32).tiny)
"""A log scale below is none: its thickness is 0 as float32, or next to it"""
LEAST_LOG_SCALE = -20.0
"""Of a Gaussian without any size"""


def finite(gaussians: Gaussians) -> Gaussians:
    """Infinite values that mean something, as finite ones: opacity logits of +inf are alpha 1, log scales of -inf flat,
    and those below NO_LOG_SCALE.

    Opacities of -inf and what is not a number stay.
    """
    scales, logits = gaussians.log_scales, gaussians.opacity_logits
    flat, opaque = scales < NO_LOG_SCALE, np.isposinf(logits)
    if flat.any():
        thinnest = np.where(flat, np.inf, scales).min(axis=1)
        thin = np.where(np.isposinf(thinnest), LEAST_LOG_SCALE, thinnest - FLATNESS)
        scales = np.where(flat, thin[:, None], scales).astype(np.float32)
    if opaque.any():
        logits = np.where(opaque, OPAQUE_LOGIT, logits).astype(np.float32)
    return replace(gaussians, log_scales=scales, opacity_logits=logits)


def is_drawn(gaussians: Gaussians) -> np.ndarray:
    """Mask [n] of those that a renderer would draw."""
    drawn: np.ndarray = gaussians.opacity_logits >= DRAWN_LOGIT
    return drawn


def rows_out(gaussians: Gaussians, mask: np.ndarray, *, keep_rows: bool) -> Gaussians:
    """The Gaussians of a mask; or all in their rows, where the others have alpha 0 and lie as far out as those at most.

    So the same row is the same Gaussian in all frames of a segment.
    """
    if not keep_rows:
        return rows_of(gaussians, mask)
    reach = np.abs(gaussians.means[mask]).max(initial=0)
    means = np.where(mask[:, None], gaussians.means, np.clip(gaussians.means, -reach, reach))
    logits = np.where(mask, gaussians.opacity_logits, np.float32(ABSENT_LOGIT))
    return replace(gaussians, means=means, opacity_logits=logits)


_FLIP_POINT = np.array([1, -1, -1], np.float32)
_FLIP_ROTATION = np.array([1, 1, -1, -1], np.float32)  # of w x y z: y and z flipped is a half turn about x
_FLIP_SH = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Sign of each coefficient under y -> -y, z -> -z: -1 for those of odd degree in y z together."""


def half_turn(gaussians: Gaussians) -> Gaussians:
    """The same scene with y up and z back where it had y down and z forward, or the other way round; exactly."""
    return replace(
        gaussians,
        means=gaussians.means * _FLIP_POINT,
        quaternions=gaussians.quaternions * _FLIP_ROTATION,
        sh=gaussians.sh * _FLIP_SH[: gaussians.sh.shape[1], None],
    )


def unit(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions of length 1, float64 [n, 4]; those of no length are the identity, w x y z."""
    q = quaternions.astype(np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(length > 0, q / np.maximum(length, 1e-12), [1.0, 0, 0, 0])


def alpha_codes(logits: np.ndarray) -> np.ndarray:
    """Alpha in 8 bits, uint8 [n]."""
    return np.rint(255 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.uint8)


def logits_of_alpha(codes: np.ndarray) -> np.ndarray:
    """Opacity logits, float32 [n], of alpha in 8 bits; 0 and 255 mean their cell, not infinity."""
    alpha = np.clip(codes / 255, 0.5 / 255, 1 - 0.5 / 255)
    return np.log(alpha / (1 - alpha)).astype(np.float32)


def drop_largest(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the largest component, int64 [n], and the other three, float64 [n, 3], in order and with its sign +.

    Zero quaternions count as the identity of their first component.
    """
    q = quaternions.astype(np.float64)
    q = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    largest = np.abs(q).argmax(axis=1)
    q = np.where(np.take_along_axis(q, largest[:, None], axis=1) < 0, -q, q)
    others = np.arange(3) + (np.arange(3) >= largest[:, None])  # [n, 3]: their columns
    return largest, np.take_along_axis(q, others, axis=1)


def restore_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Inverse of `drop_largest`: unit quaternions float32 [n, 4]; three that are too long are shortened."""
    others = others / np.maximum(1, np.linalg.norm(others, axis=1, keepdims=True))
    missing = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    place = np.arange(4) - (np.arange(4) > largest[:, None])  # [n, 4]: column of `others`
    quaternions = np.take_along_axis(others, np.minimum(place, 2), axis=1)
    np.put_along_axis(quaternions, largest[:, None], missing[:, None], axis=1)
    return quaternions.astype(np.float32)
