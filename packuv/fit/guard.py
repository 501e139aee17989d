"""No Gaussian leaves an iteration with a value that is not finite: it goes back to its last good state instead.

The rasterizer skips a broken Gaussian and the codes of one mean nothing, so without a guard it would stay broken to the
end of the sequence, unseen. What the guard does is logged, one sentence per iteration, and counted.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

import numpy as np
from numba import prange

from packuv.fit.model import Model
from packuv.fit.start.bounds import Bounds
from packuv.fit.start.first import empty_gaussians
from packuv.gaussians.floats import ATTRIBUTES, Gaussians
from packuv.kernels.compile import kernel, prefer_tbb
from packuv.raster.view import MAX_LENGTH, MAX_LOG_SCALE

LIMITS = {"means": MAX_LENGTH, "log_scales": MAX_LOG_SCALE, "quaternions": 1e18, "opacity_logits": 1e18, "sh": 1e4}
"""Largest magnitude of a usable value: beyond, the rasterizer skips a Gaussian, or the loss leaves float32's range"""
GRADIENT_LIMIT = 1e18
"""A larger gradient's square leaves the range of float32, and the optimizer's second moment would stay infinite"""

_CHUNKS = 64
VALUE_LIMITS = np.array([LIMITS[name] for name in ATTRIBUTES], np.float32)
"""In the order of `ATTRIBUTES`"""
_log = logging.getLogger(__name__)


class Guard:
    """Remembers the last good state of every Gaussian of a model, and brings back those that leave it."""

    def __init__(self, model: Model, bounds: Bounds) -> None:
        self.count = 0
        """Times that a Gaussian was brought back or emptied"""
        self._bounds = bounds
        self.renew(model)

    def renew(self, model: Model) -> None:
        """Take the model as it stands for good, after rows have come, gone or changed their meaning.

        A broken row has no good state: it becomes empty, which no renderer draws.
        """
        self._good = Gaussians(*(getattr(model.gaussians, name).copy() for name in ATTRIBUTES))
        faults = self._inspect(model, None, np.ones(len(model), bool))
        rows = np.flatnonzero(faults)
        if len(rows):
            self._report(model, None, faults, "at the start of a fit or of new rows", "is emptied")
            degree = math.isqrt(model.gaussians.sh.shape[1]) - 1
            model.overwrite(rows, empty_gaussians(len(rows), self._bounds, sh_degree=degree))
            for name in ATTRIBUTES:
                getattr(self._good, name)[rows] = getattr(model.gaussians, name)[rows]

    def check(self, model: Model, gradients: Mapping[str, np.ndarray] | None, rows: np.ndarray, when: str) -> None:
        """Look at the rows, bool [N], that just changed by these gradients (None: by something else).

        One that is broken, or whose gradient is, gets its last good values and fresh moments; the others are good from
        now on. `when` ends up in the log. O(rows).
        """
        faults = self._inspect(model, gradients, rows)
        broken = np.flatnonzero(faults)
        if len(broken):
            self._report(model, gradients, faults, when, "goes back to its last good state")
            model.overwrite(broken, Gaussians(*(getattr(self._good, name)[broken] for name in ATTRIBUTES)))

    def _inspect(self, model: Model, gradients: Mapping[str, np.ndarray] | None, rows: np.ndarray) -> np.ndarray:
        """int8 [N]: 0 for a row in order, else 1 + the place of the attribute, plus 5 if its gradient is at fault."""
        count = len(model)
        flat = {name: _flat(getattr(model.gaussians, name)) for name in ATTRIBUTES}
        slopes = flat if gradients is None else {name: _flat(gradients[name]) for name in ATTRIBUTES}
        good = [_flat(getattr(self._good, name)) for name in ATTRIBUTES]
        faults = np.zeros(count, np.int8)
        prefer_tbb()
        _inspect(*flat.values(), *(slopes[name] for name in ATTRIBUTES), *good, gradients is not None,
                 np.ascontiguousarray(rows).view(np.uint8), VALUE_LIMITS, np.float32(GRADIENT_LIMIT),
                 faults)  # fmt: skip
        return faults

    def _report(
        self, model: Model, gradients: Mapping[str, np.ndarray] | None, faults: np.ndarray, when: str, fate: str
    ) -> None:
        """Count, and name the first of the broken rows."""
        rows = np.flatnonzero(faults)
        self.count += len(rows)
        place, by_gradient = (faults[rows[0]] - 1) % len(ATTRIBUTES), faults[rows[0]] > len(ATTRIBUTES)
        name = ATTRIBUTES[place]
        source = gradients[name] if gradients is not None and by_gradient else getattr(model.gaussians, name)
        term = f"the gradient of {name}" if by_gradient else name
        others = f", and so are {len(rows) - 1} more" if len(rows) > 1 else ""
        _log.warning("%s, %s of Gaussian %d is not finite or absurd (%s)%s; it %s and the fit goes on",
                     when, term, rows[0], _worst(source[rows[0]]), others, fate)  # fmt: skip


def emptied(gaussians: Gaussians, bounds: Bounds) -> tuple[Gaussians, int]:
    """A copy in which broken ones are empty, and how many those are."""
    model = Model(gaussians)
    return model.gaussians, Guard(model, bounds).count


def _worst(values: np.ndarray) -> float:
    """The value that is not finite, or the largest."""
    flat = np.atleast_1d(values).ravel()
    broken = flat[~np.isfinite(flat)]
    return float(broken[0] if len(broken) else flat[np.abs(flat).argmax()])


def _flat(values: np.ndarray) -> np.ndarray:
    """[N, ...] as [N, the rest], also for no rows."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


@kernel(inline=True)
def _within(array, i, columns, limit):
    """Whether every value of a row is finite and at most the limit; a comparison with NaN is false."""
    fine = True
    for k in range(columns):
        fine &= abs(array[i, k]) <= limit
    return fine


@kernel(inline=True)
def _copy(source, target, i, columns):
    for k in range(columns):
        target[i, k] = source[i, k]


# Widths are literals, so that the loops unroll: half the time. From the last to the first, so that the first attribute
# at fault is named. The GPU's guard is made of the same functions.


@kernel(inline=True)
def fault_of_values(means, log_scales, quaternions, logits, sh, limits, i):
    """0 for a row in order, else 1 + the place of the attribute."""
    fault = 0
    if not _within(sh, i, sh.shape[1], limits[4]):
        fault = 5
    if not _within(logits, i, 1, limits[3]):
        fault = 4
    if not _within(quaternions, i, 4, limits[2]):
        fault = 3
    if not _within(log_scales, i, 3, limits[1]):
        fault = 2
    if not _within(means, i, 3, limits[0]):
        fault = 1
    return fault


@kernel(inline=True)
def fault_of_gradients(d_means, d_log_scales, d_quaternions, d_logits, d_sh, limit, i):
    """0 for a row in order, else 6 + the place of the attribute."""
    fault = 0
    if not _within(d_sh, i, d_sh.shape[1], limit):
        fault = 10
    if not _within(d_logits, i, 1, limit):
        fault = 9
    if not _within(d_quaternions, i, 4, limit):
        fault = 8
    if not _within(d_log_scales, i, 3, limit):
        fault = 7
    if not _within(d_means, i, 3, limit):
        fault = 6
    return fault


@kernel(inline=True)
def copy_row(means, log_scales, quaternions, logits, sh, to_means, to_log_scales, to_quaternions, to_logits, to_sh, i):
    _copy(means, to_means, i, 3)
    _copy(log_scales, to_log_scales, i, 3)
    _copy(quaternions, to_quaternions, i, 4)
    _copy(logits, to_logits, i, 1)
    _copy(sh, to_sh, i, sh.shape[1])


@kernel(parallel=True)
def _inspect(means, log_scales, quaternions, logits, sh, d_means, d_log_scales, d_quaternions, d_logits, d_sh,
             good_means, good_log_scales, good_quaternions, good_logits, good_sh, with_gradients, rows, limits,
             gradient_limit, faults):  # fmt: skip
    """Write the faults of the chosen rows, and copy those in order to the good ones."""
    count = means.shape[0]
    for chunk in prange(_CHUNKS):
        for i in range(count * chunk // _CHUNKS, count * (chunk + 1) // _CHUNKS):
            if rows[i] == 0:
                continue
            fault = fault_of_values(means, log_scales, quaternions, logits, sh, limits, i)
            if with_gradients:
                by_gradient = fault_of_gradients(d_means, d_log_scales, d_quaternions, d_logits, d_sh, gradient_limit,
                                                 i)  # fmt: skip
                fault = by_gradient if by_gradient != 0 else fault
            faults[i] = fault
            if fault == 0:
                copy_row(means, log_scales, quaternions, logits, sh,
                         good_means, good_log_scales, good_quaternions, good_logits, good_sh, i)  # fmt: skip
