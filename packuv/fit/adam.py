"""Adam over chosen rows of an array: a row that is not chosen keeps its values and moments bit for bit.

Each row counts its own steps, so its path depends on its own updates alone: a Gaussian born late, or frozen for a
while, moves as if it were optimized by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numba import prange

from packuv.kernels.compile import kernel, prefer_tbb

_CHUNKS = 64
_f32 = np.float32
_FAST = frozenset({"contract", "nsz", "arcp"})


@dataclass(frozen=True)
class AdamOptions:
    beta1: float = 0.9
    """Decay of the first moment"""
    beta2: float = 0.999
    """Decay of the second moment"""
    epsilon: float = 1e-15
    """Added to the root of the second moment. Far below torch's 1e-8, as in 3D Gaussian Splatting: the gradient of a
    mean over many pixels is small."""

    def __post_init__(self) -> None:
        if not (0 <= self.beta1 < 1 and 0 <= self.beta2 < 1 and self.epsilon > 0):
            raise ValueError(
                f"betas must lie in [0, 1) and epsilon be positive, but are {self.beta1}, {self.beta2}, {self.epsilon}"
            )


@dataclass(frozen=True)
class AdamState:
    """Moments and steps of N rows of K values."""

    first: np.ndarray
    """float32 [N, K]: running mean of the gradient"""
    second: np.ndarray
    """float32 [N, K]: running mean of its square"""
    steps: np.ndarray
    """int32 [N]: updates that the row has seen"""

    @classmethod
    def zeros(cls, parameters: np.ndarray) -> AdamState:
        """Fresh state for an array [N, ...]."""
        shape = (len(parameters), math.prod(parameters.shape[1:]))
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(len(parameters), np.int32))

    def __len__(self) -> int:
        return len(self.steps)

    def take(self, rows: np.ndarray) -> AdamState:
        """The state of some rows, by index or mask, in their order."""
        return AdamState(self.first[rows], self.second[rows], self.steps[rows])

    def grown(self, count: int) -> AdamState:
        """The same state with `count` fresh rows after it."""
        return AdamState(*(np.concatenate([a, np.zeros((count, *a.shape[1:]), a.dtype)])
                           for a in (self.first, self.second, self.steps)))  # fmt: skip


def adam_step(
    parameters: np.ndarray,  # float32 [N, ...], changed in place
    gradient: np.ndarray,  # float32 [N, ...]
    state: AdamState,  # changed in place
    *,
    rate: float | np.ndarray,  # or float [K], a rate per column of the flattened row
    rows: np.ndarray | None = None,  # bool [N]
    options: AdamOptions = AdamOptions(),
) -> None:
    """One step of Adam (Kingma and Ba 2015) for the chosen rows, all where `rows` is None.

    Raises ValueError if shapes or types do not fit.
    """
    count = len(parameters)
    columns = math.prod(parameters.shape[1:])
    if gradient.shape != parameters.shape or state.first.shape != (count, columns):
        raise ValueError(f"{parameters.shape=} {gradient.shape=} {state.first.shape=} do not belong together")
    for name, array in (("parameters", parameters), ("gradient", gradient)):
        if array.dtype != np.float32 or not array.flags.c_contiguous:
            raise ValueError(f"{name} must be C-contiguous float32, but is {array.dtype}")
    chosen = np.ones(count, bool) if rows is None else rows
    if chosen.shape != (count,) or chosen.dtype != bool:
        raise ValueError(f"rows must be bool ({count},), but is {chosen.dtype} {chosen.shape}")
    prefer_tbb()
    rates = np.broadcast_to(np.asarray(rate, np.float32), (columns,))
    _step(parameters.reshape(count, columns), gradient.reshape(count, columns), state.first, state.second, state.steps,
          np.ascontiguousarray(rates), np.ascontiguousarray(chosen).view(np.uint8),
          corrections(options.beta1, options.beta2), *factors(options))  # fmt: skip


def factors(options: AdamOptions) -> tuple[np.float32, ...]:
    """What a step keeps of the first moment and takes of the gradient, the same of the second, and epsilon."""
    beta1, beta2 = options.beta1, options.beta2
    return tuple(map(_f32, (beta1, 1 - beta1, beta2, 1 - beta2, options.epsilon)))


@cache
def corrections(beta1: float, beta2: float) -> np.ndarray:
    """What moments that began at zero lack, by step: factors of the first and of the second's root, float32 [S, 2].

    The last row is 1 within rounding, and serves for all later steps.
    """
    slowest = max(beta1, beta2, 0.5)
    steps = np.arange(1, 2 + int(np.log(1e-8) / np.log(slowest)))
    table = [np.ones(len(steps) + 1), np.ones(len(steps) + 1)]
    table[0][1:], table[1][1:] = 1 / (1 - beta1**steps), 1 / np.sqrt(1 - beta2**steps)
    return np.stack(table, axis=1).astype(np.float32)


@kernel(inline=True, fastmath=_FAST)
def step_row(parameters, gradient, first, second, steps, rates, corrections, keep1, add1, keep2, add2, epsilon, i):
    """One step of row i, on the CPU and on a GPU."""
    steps[i] += 1
    step = min(steps[i], corrections.shape[0] - 1)
    for k in range(parameters.shape[1]):
        g = gradient[i, k]
        m = keep1 * first[i, k] + add1 * g
        v = keep2 * second[i, k] + add2 * g * g
        first[i, k], second[i, k] = m, v
        root = math.sqrt(v) * corrections[step, 1] + epsilon
        parameters[i, k] -= rates[k] * corrections[step, 0] * m / root


@kernel(parallel=True, fastmath=_FAST)
def _step(parameters, gradient, first, second, steps, rates, rows, corrections, keep1, add1, keep2, add2, epsilon):
    count = parameters.shape[0]
    for chunk in prange(_CHUNKS):
        for i in range(count * chunk // _CHUNKS, count * (chunk + 1) // _CHUNKS):
            if rows[i] != 0:
                step_row(parameters, gradient, first, second, steps, rates, corrections, keep1, add1, keep2, add2,
                         epsilon, i)  # fmt: skip
