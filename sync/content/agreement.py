"""How well two signals over time agree at every offset between them."""

from __future__ import annotations

import numpy as np

BLOCKS = 8
"""Of instants that are left out in turn, which tells how sure an offset is"""
WHILE = 13
"""Instants over which a mean is taken that slow changes of how much moves do not enter"""
LEAST_OVERLAP = 0.5
"""Share of its instants that two signals must have in common at an offset that is tried"""


def agreement(
    first: np.ndarray, second: np.ndarray, there_first: np.ndarray, there_second: np.ndarray, reach: int
) -> np.ndarray:
    """Normalized correlation if the second signal shows so many instants later what the first one shows.

    Args:
        first, second: float [T, n].
        there_first, there_second: bool [T], where they are known.
        reach: largest offset, instants.

    Returns:
        float64 [2 reach + 1, BLOCKS], from -reach on, in parts by instants that add up; 0 without any change.
    """
    a, b = _centred(first, there_first), _centred(second, there_second)
    scale, count = np.sqrt((a * a).sum() * (b * b).sum()), len(a)
    if not scale:
        return np.zeros((2 * reach + 1, BLOCKS))
    padded = np.zeros((count, count + 2 * reach))
    padded[:, reach : reach + count] = a @ b.T
    down, along = padded.strides
    products = np.lib.stride_tricks.as_strided(padded, (count, 2 * reach + 1), (down + along, along))  # by offset
    sums = np.concatenate([np.zeros((1, 2 * reach + 1)), np.cumsum(products, axis=0)])
    edges = -(-np.arange(BLOCKS + 1) * count // BLOCKS)
    overlap = np.correlate(there_second.astype(np.int64), there_first.astype(np.int64), "full")
    overlap = overlap[count - 1 - reach : count + reach, None]
    both = there_first.sum() * there_second.sum() / count
    known = overlap >= max(1.0, LEAST_OVERLAP * both)
    parts: np.ndarray = np.where(known, np.diff(sums[edges], axis=0).T * both / (scale * np.maximum(overlap, 1)), 0.0)
    return parts


def shifted(rows: np.ndarray, by: int) -> np.ndarray:
    """Rows moved down by so many; 0 comes in."""
    moved = np.zeros_like(rows)
    if abs(by) < len(rows):
        moved[max(0, by) : len(rows) + min(0, by)] = rows[max(0, -by) : len(rows) - max(0, by)]
    return moved


def _centred(signal: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Less the mean of each line over a while, 0 at instants without a picture."""
    known = np.where(there[:, None], signal, 0.0).astype(np.float64)
    sums = np.concatenate([np.zeros((1, signal.shape[1] + 1)), np.cumsum(np.column_stack([known, there]), axis=0)])
    middle = np.arange(len(there))
    first, stop = np.maximum(middle - WHILE // 2, 0), np.minimum(middle + WHILE // 2 + 1, len(there))
    around = sums[stop] - sums[first]
    return np.where(there[:, None], known - around[:, :-1] / np.maximum(around[:, -1:], 1), 0.0)
