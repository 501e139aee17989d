"""What a scene file stores of each segment, as plain pictures of bytes (layout `compact`).

A row (one Gaussian) has 6 + A channels: the high and low bytes of its position, then its 8-bit attributes. The key
holds rows as they are; for later frames a residual picture holds the dynamic rows that changed, and what to add to
them, modulo 2^16 or 2^8, so that the very integers come back. A tolerance makes residuals coarser; prediction starts
from what the reader has, so errors do not add up. docs/scene-format.md is the specification.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from packuv.gaussians.codes import DC, OPACITY, Codes
from packuv.gaussians.segment import Segment
from packuv.kernels.compile import kernel
from packuv.scene.mosaic import NEUTRAL

DC_START = DC.start
"""As a plain number for the compiled loops."""
POSITION_CHANNELS = 6
"""High bytes of x y z, then low bytes: channels before the attributes."""
GONE = -NEUTRAL
"""With a tolerance, the opacity residual of a row that disappears."""
REPEAT, PREVIOUS, LINEAR = 0, 1, 2
"""How a frame's positions are predicted: nothing changed and no picture is stored; as the last frame; moving on."""


def channel_names(sh_degree: int) -> tuple[str, ...]:
    """Name of every channel, in order."""
    fixed = ("x_hi", "y_hi", "z_hi", "x_lo", "y_lo", "z_lo", "scale_0", "scale_1", "scale_2")
    sh = (f"sh{k}_{colour}" for k in range((sh_degree + 1) ** 2) for colour in ("r-g", "g", "b-g"))
    return (*fixed, "rotation_x", "rotation_y", "rotation_z", "opacity", *sh)


# The key frame


def key_rows(codes: Codes) -> np.ndarray:
    """Bytes of the key picture, uint8 [N, channels]: red and blue as differences to green, around 128."""
    rows = np.concatenate([codes.xyz >> 8, codes.xyz & 255, codes.attributes], axis=1).astype(np.uint8)
    _colours_to_differences(rows)
    return rows


def key_codes(rows: np.ndarray) -> Codes:
    """Inverse of `key_rows`."""
    rows = rows.copy()
    sh = _colours(rows)  # a view
    sh[:, :, ::2] += sh[:, :, 1:2] - np.uint8(NEUTRAL)
    xyz = rows[:, :3].astype(np.uint16) << 8 | rows[:, 3:6]
    return Codes(xyz, np.ascontiguousarray(rows[:, POSITION_CHANNELS:]))


def _colours(rows: np.ndarray) -> np.ndarray:
    """The SH channels as a view [n, coefficients, 3] into rows [n, channels]."""
    first = POSITION_CHANNELS + DC.start
    return rows[:, first:].reshape(len(rows), (rows.shape[1] - first) // 3, 3)


def _colours_to_differences(rows: np.ndarray) -> None:
    """In place: r g b -> r - g + 128, g, b - g + 128 (modulo 256), for every SH coefficient."""
    sh = _colours(rows)
    sh[:, :, ::2] -= sh[:, :, 1:2] - np.uint8(NEUTRAL)


# The frames after it


@dataclass(frozen=True)
class Tolerance:
    """By how much a frame after its key may differ from what was fitted; keys never differ."""

    position: int = 0
    """Largest error of a coordinate, steps of its 16-bit scale"""
    attribute: int = 0
    """Largest error of every other code, which has 8 bits; presence is always exact"""

    def __post_init__(self) -> None:
        if not 0 <= self.position <= 8192 or not 0 <= self.attribute <= 32:
            raise ValueError(
                f"a tolerance must be 0 to 8192 for positions and 0 to 32 for attributes, but is {self.position} and "
                f"{self.attribute}"
            )

    @property
    def exact(self) -> bool:
        return self.position == self.attribute == 0

    @property
    def steps(self) -> tuple[int, int]:
        """What a residual of one stands for in positions and attributes: rounding to it errs by the tolerance."""
        return 2 * self.position + 1, 2 * self.attribute + 1


@dataclass(frozen=True)
class Change:
    """One frame after the key, as it is stored."""

    prediction: int
    """REPEAT, PREVIOUS or LINEAR"""
    differences: bool
    """Whether red and blue residuals are stored as differences to green's"""
    toggled: np.ndarray
    """uint8 [D]: 1 where a row is stored in this frame but not in the last one with a picture, or the reverse"""
    rows: np.ndarray
    """Residuals uint8 [stored rows, channels] around 128"""


class Playback:
    """The current frame of a segment while its changes are added, one after the other.

    `codes` is changed in place by every `advance`; copy what you keep.
    """

    def __init__(self, key: Codes, dynamic: int, tolerance: Tolerance) -> None:
        """Start at the key frame, whose first `dynamic` rows may change; `key` is taken over."""
        self.codes = key
        self.velocity = np.zeros((dynamic, 3), np.uint16)
        self.stored = np.zeros(dynamic, np.uint8)
        """1 for each row that the last picture held"""
        self._steps = tolerance.steps

    def toggle(self, toggled: np.ndarray) -> int:
        """Take over which rows come and go in the next picture, uint8 [D]; the number of rows that it holds."""
        self.stored ^= toggled
        return int(np.count_nonzero(self.stored))

    def advance(self, prediction: int, differences: bool, rows: np.ndarray) -> None:
        """Go on by one frame, after `toggle`; the residuals uint8 [stored rows, channels] are not read for REPEAT."""
        if prediction == REPEAT:
            self.velocity[:] = 0
            return
        linear, codes = prediction == LINEAR, self.codes
        _add(rows, self.stored, linear, differences, *self._steps, codes.xyz, codes.attributes, self.velocity)


class Coder:
    """Codes the frames after a key, each predicted from what the reader has, in the way that costs least."""

    def __init__(self, key: Codes, tolerance: Tolerance) -> None:
        """Start with the D dynamic rows of the key."""
        self._steps = tolerance.steps
        self._playback = Playback(Codes(key.xyz.copy(), key.attributes.copy()), len(key), tolerance)

    @property
    def codes(self) -> Codes:
        """The D rows as the reader has them; changed in place."""
        return self._playback.codes

    def change(self, now: Codes) -> Change:
        """Code the next frame, whose dynamic rows are `now`."""
        change = self._cheapest(now)
        self._playback.toggle(change.toggled)
        self._playback.advance(change.prediction, change.differences, change.rows)
        return change

    def _cheapest(self, now: Codes) -> Change:
        """Compare both position predictions and both colour forms by order-0 entropy."""
        shape = len(now), POSITION_CHANNELS
        previous, linear = np.empty(shape, np.uint8), np.empty(shape, np.uint8)
        attributes = np.empty_like(now.attributes)
        last = self._playback.codes
        _residuals(
            now.xyz,
            now.attributes,
            last.xyz,
            last.attributes,
            self._playback.velocity,
            *self._steps,
            previous,
            linear,
            attributes,
        )
        plain = np.concatenate([previous, attributes], axis=1)
        if (plain == NEUTRAL).all():
            return Change(REPEAT, False, np.zeros(len(now), np.uint8), plain[:0])
        moves_on = entropy_bits(linear) < entropy_bits(previous)
        if moves_on:
            plain[:, :POSITION_CHANNELS] = linear
        coupled = plain.copy()
        _colours_to_differences(coupled)
        differences = entropy_bits(_colours(coupled)) < entropy_bits(_colours(plain))
        rows = coupled if differences else plain
        stored = (rows != NEUTRAL).any(axis=1)
        toggled = stored.astype(np.uint8) ^ self._playback.stored
        return Change(LINEAR if moves_on else PREVIOUS, differences, toggled, rows[stored])


def changes(stored: Segment, tolerance: Tolerance) -> Iterator[tuple[Change, Codes]]:
    """The frames after the key of a segment in stored order, and the dynamic rows [D] that a reader then has."""
    coder = Coder(stored.key[: stored.xyz.shape[1]], tolerance)
    for xyz, attributes in zip(stored.xyz, stored.attributes, strict=True):
        yield coder.change(Codes(xyz, attributes)), coder.codes


@kernel()
def _residuals(
    xyz, attributes, last_xyz, last_attributes, velocity, position_step, attribute_step, previous, linear, others
):
    """Bytes of both position residuals [D, 6] and of the attributes' [D, A], around 128."""
    for i in range(len(xyz)):
        present = attributes[i, OPACITY] > 0
        for axis in range(3):
            now, last = np.int64(xyz[i, axis]), np.int64(last_xyz[i, axis])
            ahead = (last + velocity[i, axis]) & 65535 if present else last
            _put_position(previous, i, axis, _rounded(now - last, position_step))
            _put_position(linear, i, axis, _rounded(now - ahead, position_step))
        for k in range(attributes.shape[1]):
            now, last = np.int64(attributes[i, k]), np.int64(last_attributes[i, k])
            residual = _rounded(now - last, attribute_step)
            if k == OPACITY and attribute_step > 1:
                if last == 0:
                    residual = now
                elif now == 0:
                    residual = np.int64(GONE)
            others[i, k] = (residual + NEUTRAL) & 255


@kernel()
def _put_position(out, i, axis, residual):
    biased = residual + NEUTRAL * 257
    out[i, axis] = (biased >> 8) & 255
    out[i, axis + 3] = biased & 255


@kernel()
def _rounded(difference, step):
    """Nearest number of whole steps."""
    if step == 1:
        return difference
    count = (abs(difference) + step // 2) // step
    return count if difference >= 0 else -count


@kernel()
def _add(rows, stored, linear, differences, position_step, attribute_step, xyz, attributes, velocity):
    """Add the residuals of a frame to the first len(stored) rows; the inverse of `_residuals`."""
    place = 0
    change = np.zeros(rows.shape[1], np.int64)
    for i in range(len(stored)):
        was_opacity = np.int64(attributes[i, OPACITY])
        if stored[i]:
            for k in range(len(change)):
                change[k] = np.int64(rows[place, k]) - NEUTRAL
            place += 1
            if differences:
                for k in range(POSITION_CHANNELS + DC_START, len(change), 3):
                    change[k] += change[k + 1]
                    change[k + 2] += change[k + 1]
            for k in range(attributes.shape[1]):
                attributes[i, k] = _moved(attributes[i, k], change[POSITION_CHANNELS + k], attribute_step, 256)
            if attribute_step > 1:
                code = was_opacity + attribute_step * change[POSITION_CHANNELS + OPACITY]
                attributes[i, OPACITY] = min(max(code, 1), 255)
                if was_opacity == 0:
                    attributes[i, OPACITY] = change[POSITION_CHANNELS + OPACITY] & 255
                elif change[POSITION_CHANNELS + OPACITY] == GONE:
                    attributes[i, OPACITY] = 0
        else:
            change[:POSITION_CHANNELS] = 0  # it moves on if the frame does
        present = attributes[i, OPACITY] > 0
        for axis in range(3):
            last = np.int64(xyz[i, axis])
            expected = (last + velocity[i, axis]) & 65535 if linear and present else last
            now = _moved(expected, 256 * change[axis] + change[axis + 3], position_step, 65536)
            xyz[i, axis] = now
            velocity[i, axis] = now - last if present and was_opacity > 0 else 0


@kernel()
def _moved(value, residual, step, size):
    """A code 0 to size - 1, a residual of so many steps further: around the end if exact, else at most to the end."""
    if step == 1:
        return (np.int64(value) + residual) & (size - 1)
    residual = ((residual + size // 2) & (size - 1)) - size // 2
    return min(max(np.int64(value) + step * residual, 0), size - 1)


def entropy_bits(rows: np.ndarray) -> float:
    """Bits that an ideal coder without context spends on bytes [n, ...], each column with its own statistics."""
    counts = _histograms(rows.reshape(len(rows), math.prod(rows.shape[1:])))
    return float((counts * np.log2(max(1, len(rows)) / np.maximum(counts, 1))).sum())


@kernel()
def _histograms(rows):
    """Counts of each byte in each column, float64 [columns, 256]."""
    counts = np.zeros((rows.shape[1], 256))
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            counts[k, rows[i, k]] += 1
    return counts


# What need not be stored


def changing_channels(segment: Segment) -> np.ndarray:
    """Whether each channel may have a residual other than 128 in this segment, bool [channels].

    An SH coefficient counts as one, for the sake of its colour differences.
    """
    key = segment.key[segment.dynamic]
    xyz = _changed(key.xyz, segment.xyz)
    attributes = _changed(key.attributes, segment.attributes)
    sh = attributes[DC.start :].reshape(-1, 3)
    sh[:] = sh.any(axis=1, keepdims=True)
    return np.concatenate([xyz, xyz, attributes])


def _changed(key: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Whether each column of frames [T - 1, D, columns] ever differs from the frame before it, or from the key."""
    before = np.concatenate([key[None], frames])[:-1]
    changed: np.ndarray = (frames != before).any(axis=(0, 1))
    return changed
