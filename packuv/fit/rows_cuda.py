"""Rows of a model on a GPU: masters, moments, last good values, codes and what is drawn, and a step of all of them.

A thread for each row calls the CPU's own functions for Adam, guard and quantizer. A row that is not chosen is not
written, so it keeps values, moments and codes to the bit.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import numba.cuda
import numpy as np
import torch
from torch import Tensor

from packuv.fit.adam import AdamOptions, AdamState, corrections, factors, moved
from packuv.fit.guard import GRADIENT_LIMIT, VALUE_LIMITS, copy_row, emptied, fault_of_gradients, fault_of_values
from packuv.fit.model import Model, Rates
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.codes import Codes, Quantizer, decode_row, encode_row
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, arrays
from packuv.raster.cuda.launch import MEMORY, on_device, run_rows, shared

cuda: Any = numba.cuda
_NEVER = np.iinfo(np.int64).max
_f32 = np.float32
_log = logging.getLogger(__name__)


class RowsOnGpu:
    """N Gaussians under optimisation, on the GPU until `bring_home`.

    A `Population`: what changes other than by a step is drawn, and guarded, from `renew` on.
    """

    def __init__(self, model: Model, rows: np.ndarray, bounds: Bounds, quantizer: Quantizer | None) -> None:
        """Take a model that is in order, and the rows that may change, bool [N]; draw what its codes decode to, or the
        masters without a quantizer."""
        self.masters = tuple(map(on_device, arrays(model.gaussians)))
        """float32, as the arrays of `Gaussians`"""
        self.rows = on_device(np.ascontiguousarray(rows).view(np.uint8))
        """uint8 [N], 1 for those that may change"""
        self._bounds, self._quantizer = bounds, quantizer
        self._good = tuple(values.clone() for values in self.masters)
        states = list(model.moments.values())
        self._first, self._second = (
            on_device(np.concatenate([getattr(state, name) for state in states], axis=1))
            for name in ("first", "second")
        )
        self._steps = on_device(np.stack([state.steps for state in states], axis=1))
        self._adam = AdamOptions()
        self._corrections = on_device(corrections(self._adam.beta1, self._adam.beta2))
        self._limits = on_device(VALUE_LIMITS)
        self._told = torch.tensor([0, _NEVER], dtype=torch.int64, device=MEMORY)
        self._emptied = 0
        self._fresh = torch.zeros_like(self.rows)
        """uint8 [N], 1 for those that something else than a step has changed since `renew`"""
        self.drawn = self.masters
        """What the renderer draws"""
        if quantizer is not None:
            self._draw_codes(quantizer, quantizer.encode(model.gaussians))
        else:
            self._lay_out()

    def __len__(self) -> int:
        return len(self.rows)

    def _draw_codes(self, quantizer: Quantizer, codes: Codes) -> None:
        self._xyz, self._attributes = on_device(codes.xyz.astype(np.int32)), on_device(codes.attributes)
        self.drawn = tuple(map(on_device, arrays(quantizer.decode(codes))))
        centre, unit, *ranges = quantizer.scale
        tables = quantizer.xyz_table, quantizer.attribute_table
        self._scale = on_device(centre), float(unit), *map(on_device, ranges), *map(on_device, tables)
        self._lay_out()

    def _lay_out(self) -> None:
        """Keep what kernels get each time as [N, columns]: masters, good ones, and what is drawn."""
        self._lines = tuple(_flat(part) for part in (self.masters, self._good, self.drawn))

    def step(self, gradients: Sequence[Tensor], rates: Tensor, moving: Tensor, number: int) -> None:
        """One step of Adam for the `moving` rows, uint8 [N]; those that break go back to their last good state, the
        others are encoded and decoded again. `rates` as `rates_of`; `number` tells the iteration."""
        slopes, (values, good, _) = _flat(gradients), self._lines
        memory = self._first, self._second, self._steps
        given = rates, moving, self._corrections, *factors(self._adam)
        run_rows(_advance, len(self), *values, *slopes, *memory, *given)
        limits = self._limits, _f32(GRADIENT_LIMIT)
        run_rows(_guard, len(self), *values, *slopes, *good, *memory, moving, *limits, number, self._told)
        self._draw_again(moving)

    def _draw_again(self, rows: Tensor) -> None:
        """Encode these rows, uint8 [N], and draw what the codes decode to; with no quantizer masters are drawn."""
        if self._quantizer is None:
            return
        masters, drawn = ([*lines[:3], own[3], lines[4]] for lines, own in
                          ((self._lines[0], self.masters), (self._lines[2], self.drawn)))  # fmt: skip
        run_rows(_code, len(self), *masters, rows, *self._scale, self._xyz, self._attributes, *drawn)

    def column(self, name: str) -> np.ndarray:
        return _array(self._master(name))

    def some(self, rows: np.ndarray) -> Gaussians:
        index = on_device(rows)
        return Gaussians(*(_array(values[index]) for values in self.masters))

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        index = on_device(rows)
        self._master(name)[index] = on_device(values)
        self._fresh[index] = 1

    def keep(self, rows: np.ndarray) -> None:
        index = on_device(np.flatnonzero(rows) if rows.dtype == bool else rows)
        self._change_each(lambda values: values[index])

    def append(self, born: Gaussians) -> None:
        """They may change; broken ones are emptied."""
        before, count = len(self), len(born)
        self._change_each(lambda values: torch.cat([values, values.new_zeros((count, *values.shape[1:]))]))
        self.rows[before:] = 1
        self.overwrite(np.arange(before, before + count), born)

    def overwrite(self, rows: np.ndarray, values: Gaussians) -> None:
        """Broken ones are emptied."""
        values, broken = emptied(values, self._bounds)
        self._emptied += broken
        for name in ATTRIBUTES:
            self.put(name, rows, getattr(values, name))
        for moment in (self._first, self._second, self._steps):
            moment[on_device(rows)] = 0

    def renew(self) -> None:
        """Take the rows as they stand for good, and draw what the changed ones' codes decode to."""
        self._good = tuple(values.clone() for values in self.masters)
        self._lay_out()
        self._draw_again(self._fresh)
        self._fresh.zero_()

    def _master(self, name: str) -> Tensor:
        return self.masters[ATTRIBUTES.index(name)]

    def _change_each(self, change: Callable[[Tensor], Tensor]) -> None:
        """Replace what there is of each row."""
        self.masters = tuple(map(change, self.masters))
        self.rows, self._fresh, self._first, self._second, self._steps = map(
            change, (self.rows, self._fresh, self._first, self._second, self._steps)
        )
        if self._quantizer is None:
            self.drawn = self.masters
        else:
            self._xyz, self._attributes, *drawn = map(change, (self._xyz, self._attributes, *self.drawn))
            self.drawn = tuple(drawn)

    def bring_home(self, model: Model) -> int:
        """Give the model its masters and moments; returns how many times a row went back to its last good state.

        What is stored is encoded from the masters on the CPU, and must be what was rendered. Raises RuntimeError where
        the codes that were drawn decode to something else there. Masters beside a border between two codes, which CPU
        and GPU round differently, are given the value that was drawn.
        """
        gaussians = Gaussians(*(_array(values) for values in self.masters))
        if self._quantizer is not None:
            _agree(gaussians, self.codes, Gaussians(*map(_array, self.drawn)), self._quantizer)
        model.gaussians = gaussians
        widths = np.cumsum([math.prod(values.shape[1:]) for values in arrays(gaussians)])[:-1]
        moments = (np.split(_array(moment), widths, axis=1) for moment in (self._first, self._second))
        steps = _array(self._steps).T
        for name, first, second, count in zip(ATTRIBUTES, *moments, steps, strict=True):
            model.moments[name] = AdamState(*map(np.ascontiguousarray, (first, second, count)))
        return self._report()

    @property
    def codes(self) -> Codes:
        """Those that are drawn; there must be a quantizer."""
        return Codes(_array(self._xyz).astype(np.uint16), _array(self._attributes))

    def _report(self) -> int:
        count, first = (int(value) for value in self._told.tolist())
        if count:
            number, row, fault = first >> 36, first >> 4 & 0xFFFFFFFF, first & 15
            name = ATTRIBUTES[(fault - 1) % len(ATTRIBUTES)]
            term = f"the gradient of {name}" if fault > len(ATTRIBUTES) else name
            others = f", the first of {count} times" if count > 1 else ""
            _log.warning("iteration %d, %s of Gaussian %d is not finite or absurd%s; it goes back to its last good "
                         "state and the fit goes on", number, term, row, others)  # fmt: skip
        return count + self._emptied


def rates_of(rates: Rates, gaussians: Gaussians, *, radius: float, progress: float) -> Tensor:
    """Rates of all columns of all attributes, float32 [columns], as `Rates.columns`."""
    widths = {name: math.prod(getattr(gaussians, name).shape[1:]) for name in ATTRIBUTES}
    parts = [rates.columns(name, width, radius=radius, progress=progress) for name, width in widths.items()]
    return on_device(np.concatenate(parts).astype(np.float32))


def _agree(masters: Gaussians, codes: Codes, drawn: Gaussians, quantizer: Quantizer) -> None:
    """See `bring_home`; changes masters in place."""
    mine = quantizer.decode(codes)
    for name in ATTRIBUTES:
        unlike = getattr(mine, name) != getattr(drawn, name)
        if differing := int(unlike.any(axis=tuple(range(1, unlike.ndim))).sum()):
            raise RuntimeError(
                f"{name} of {differing} of {len(codes)} Gaussians were drawn otherwise than their codes decode on the "
                "CPU: the file would not hold what was fitted; fit on the CPU (--device cpu)"
            )
    stored = quantizer.encode(masters)
    off = np.maximum(
        np.abs(stored.xyz.astype(np.int32) - codes.xyz).max(axis=1, initial=0),
        np.abs(stored.attributes.astype(np.int32) - codes.attributes).max(axis=1, initial=0),
    )
    if (off > 1).any():
        raise RuntimeError(
            f"the GPU's codes of {int((off > 1).sum())} of {len(codes)} Gaussians are more than one step from those of "
            "the CPU; fit on the CPU (--device cpu)"
        )
    for name in ATTRIBUTES:
        getattr(masters, name)[off > 0] = getattr(mine, name)[off > 0]


def _flat(fields: Sequence[Tensor]) -> list[Tensor]:
    """[N, ...] as [N, the rest], also for no rows."""
    return [values.reshape(len(values), math.prod(values.shape[1:])) for values in fields]


def _array(tensor: Tensor) -> np.ndarray:
    """A copy on the host."""
    return np.array(tensor.cpu().numpy())


_moved, _fault_of_values, _fault_of_gradients = map(shared, (moved, fault_of_values, fault_of_gradients))
_copy_row, _encode_row, _decode_row = map(shared, (copy_row, encode_row, decode_row))


@cuda.jit(device=True)
def _step_row(parameters, gradient, first, second, steps, rates, corrections, keep1, add1, keep2, add2, epsilon, i):
    steps[i] += 1
    step = min(steps[i], corrections.shape[0] - 1)
    for k in range(parameters.shape[1]):
        m, v, fall = _moved(gradient[i, k], first[i, k], second[i, k], rates[k], corrections[step, 0],
                            corrections[step, 1], keep1, add1, keep2, add2, epsilon)  # fmt: skip
        first[i, k], second[i, k] = m, v
        parameters[i, k] -= fall


@cuda.jit
def _advance(means, log_scales, quaternions, logits, sh, d_means, d_log_scales, d_quaternions, d_logits, d_sh,
             first, second, steps, rates, rows, corrections, keep1, add1, keep2, add2, epsilon):  # fmt: skip
    """Adam; all arrays but steps [N, 5] and rates have a line per row, moments the columns of all attributes."""
    i = cuda.grid(1)
    if i >= rows.shape[0] or rows[i] == 0:
        return
    fixed = corrections, keep1, add1, keep2, add2, epsilon
    _step_row(means, d_means, first[:, 0:3], second[:, 0:3], steps[:, 0], rates[0:3], *fixed, i)
    _step_row(log_scales, d_log_scales, first[:, 3:6], second[:, 3:6], steps[:, 1], rates[3:6], *fixed, i)
    _step_row(quaternions, d_quaternions, first[:, 6:10], second[:, 6:10], steps[:, 2], rates[6:10], *fixed, i)
    _step_row(logits, d_logits, first[:, 10:11], second[:, 10:11], steps[:, 3], rates[10:11], *fixed, i)
    _step_row(sh, d_sh, first[:, 11:], second[:, 11:], steps[:, 4], rates[11:], *fixed, i)


@cuda.jit
def _guard(means, log_scales, quaternions, logits, sh, d_means, d_log_scales, d_quaternions, d_logits, d_sh,
           good_means, good_log_scales, good_quaternions, good_logits, good_sh, first, second, steps, rows, limits,
           gradient_limit, number, told):  # fmt: skip
    """Keep the good rows, bring back the broken ones with fresh moments, and tell how many and which was the first."""
    i = cuda.grid(1)
    if i >= rows.shape[0] or rows[i] == 0:
        return
    fault = _fault_of_gradients(d_means, d_log_scales, d_quaternions, d_logits, d_sh, gradient_limit, i)
    if fault == 0:
        fault = _fault_of_values(means, log_scales, quaternions, logits, sh, limits, i)
    if fault == 0:
        _copy_row(means, log_scales, quaternions, logits, sh,
                  good_means, good_log_scales, good_quaternions, good_logits, good_sh, i)  # fmt: skip
        return
    _copy_row(good_means, good_log_scales, good_quaternions, good_logits, good_sh,
              means, log_scales, quaternions, logits, sh, i)  # fmt: skip
    for k in range(first.shape[1]):
        first[i, k], second[i, k] = _f32(0), _f32(0)
    for k in range(steps.shape[1]):
        steps[i, k] = 0
    cuda.atomic.add(told, 0, 1)
    cuda.atomic.min(told, 1, (np.int64(number) << np.int64(36)) | (np.int64(i) << np.int64(4)) | np.int64(fault))


@cuda.jit
def _code(means, log_scales, quaternions, logits, sh, rows, centre, unit, edge, low, per_step, xyz_table, table, xyz,
          attributes, drawn_means, drawn_log_scales, drawn_quaternions, drawn_logits, drawn_sh):  # fmt: skip
    """Encode the chosen rows and decode them again."""
    i = cuda.grid(1)
    if i >= rows.shape[0] or rows[i] == 0:
        return
    _encode_row(means, log_scales, quaternions, logits, sh, centre, unit, edge, low, per_step, xyz, attributes, i)
    _decode_row(xyz, attributes, xyz_table, table, drawn_means, drawn_log_scales, drawn_quaternions, drawn_logits,
                drawn_sh, i)  # fmt: skip
