"""What all splat files agree on, and the small encodings that several of them share."""

from __future__ import annotations

import numpy as np


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
