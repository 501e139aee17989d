"""Labels on a GPU: a kernel pass over the Gaussians for each view, with the CPU's own function for each pair."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import numba.cuda
import numpy as np
import torch
from torch import Tensor

from packuv.raster.cuda.launch import MEMORY, on_device, run_rows, shared

cuda: Any = numba.cuda


def count_on_gpu(
    opinion: Callable[..., tuple[bool, bool]],
    means: np.ndarray,
    shapes: np.ndarray,
    visible: np.ndarray,
    voters: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]],
    rule: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Hits and views, int32 [N] each, as `labels.count_hits` counts them.

    `opinion` judges one Gaussian in one view; a voter is a view, its mask and depths.
    """
    hits, seen = (torch.zeros(len(means), dtype=torch.int32, device=MEMORY) for _ in range(2))
    gaussians, limits = [on_device(part) for part in (means, shapes, visible)], on_device(rule)
    for view, mask, depth in voters:
        there = on_device(depth if depth.size else np.zeros((1, 1), np.float32)), *depth.shape
        given = *gaussians, on_device(view), _summed_area(mask), *there, limits, hits, seen
        run_rows(_kernel(opinion), len(means), *given)
    return hits.cpu().numpy(), seen.cpu().numpy()


def _summed_area(mask: np.ndarray) -> Tensor:
    """As `labels.summed_area`: a mask travels in a quarter of its sums' bytes."""
    sums = torch.zeros((mask.shape[0] + 1, mask.shape[1] + 1), dtype=torch.int32, device=MEMORY)
    torch.cumsum(on_device(mask).cumsum(0, dtype=torch.int32), 1, dtype=torch.int32, out=sums[1:, 1:])
    return sums


@cache
def _kernel(opinion: Callable[..., tuple[bool, bool]]) -> Any:
    """A thread for each Gaussian."""
    judge = shared(opinion)

    @cuda.jit
    def vote_all(means, shapes, visible, view, table, depths, height, width, rule, hits, seen):
        i = cuda.grid(1)
        if i >= means.shape[0] or not visible[i]:
            return
        saw, hit = judge(means, shapes, view, table, depths[:height, :width], rule, i)
        if saw:
            seen[i] += 1
        if hit:
            hits[i] += 1

    return vote_all
