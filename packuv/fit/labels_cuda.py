"""Labels on a GPU: one kernel pass over Gaussians times views, with the CPU's own functions for each pair."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numba.cuda
import numpy as np

from packuv.raster.cuda.launch import on_device, run_rows, shared

cuda: Any = numba.cuda


def count_on_gpu(
    opinion: Callable[..., tuple[bool, bool]],
    means: np.ndarray,
    shapes: np.ndarray,
    visible: np.ndarray,
    voters: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    rule: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Hits and views, int32 [N] each, as `labels.count_hits` counts them.

    `opinion` judges one Gaussian in one view; a voter is a view, its table and depths.
    """
    hits, seen = (on_device(np.zeros(len(means), np.int32)) for _ in range(2))
    if voters:
        views, tables, depths = (list(part) for part in zip(*voters, strict=True))
        pictures = _stacked(tables), _sizes(tables), _stacked(depths), _sizes(depths)
        given = map(on_device, (means, shapes, visible, np.stack(views), *pictures, rule))
        run_rows(_kernel(opinion), len(means) * len(voters), *given, hits, seen)
    return hits.cpu().numpy(), seen.cpu().numpy()


def _stacked(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of different sizes in one array, each in its upper left corner."""
    height, width = _sizes(pictures).max(axis=0)
    whole = np.zeros((len(pictures), max(1, height), max(1, width)), pictures[0].dtype)
    for place, picture in zip(whole, pictures, strict=True):
        place[: picture.shape[0], : picture.shape[1]] = picture
    return whole


def _sizes(pictures: Sequence[np.ndarray]) -> np.ndarray:
    return np.array([picture.shape for picture in pictures])


@cache
def _kernel(opinion: Callable[..., tuple[bool, bool]]) -> Any:
    """A thread for each Gaussian and view."""
    judge = shared(opinion)

    @cuda.jit
    def vote_all(means, shapes, visible, views, tables, table_sizes, depths, depth_sizes, rule, hits, seen):
        i, c = cuda.grid(1) % means.shape[0], cuda.grid(1) // means.shape[0]
        if c >= views.shape[0] or not visible[i]:
            return
        table = tables[c, : table_sizes[c, 0], : table_sizes[c, 1]]
        depth = depths[c, : depth_sizes[c, 0], : depth_sizes[c, 1]]
        saw, hit = judge(means, shapes, views[c], table, depth, rule, i)
        if saw:
            cuda.atomic.add(seen, i, 1)
        if hit:
            cuda.atomic.add(hits, i, 1)

    return vote_all
