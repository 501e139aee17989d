"""What a scene file stores of each segment, as plain pictures of bytes (layout `compact`).

A row (one Gaussian) has 6 + A channels: the high and low bytes of its position, then its 8-bit attributes. Each
channel is a plane, the planes tile one picture (a mosaic), and row i of a segment has the same cell in every plane.
The key picture holds all rows of the first frame; for later frames a residual picture holds what changed in the
dynamic rows, modulo 2^16 or 2^8, so that adding it gives back the very integers. docs/scene-format.md is the
specification.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np

from packuv.quantize import DC, OPACITY, Codes
from packuv.segment import Segment

BLOCK = 32
"""Side of the square blocks that a Hilbert curve fills with 1,024 neighbouring rows."""
DC_START = DC.start
"""As a plain number for the compiled loops."""
POSITION_CHANNELS = 6
"""High bytes of x y z, then low bytes: channels before the attributes."""
NEUTRAL = 128
"""Value of a cell that holds no row, and of a residual of nothing."""

REPEAT, PREVIOUS, LINEAR = 0, 1, 2
"""How a frame's positions are predicted: nothing changed and no picture is stored; as the last frame; moving on."""


def channel_names(sh_degree: int) -> tuple[str, ...]:
    """Name of every channel, in order."""
    fixed = ("x_hi", "y_hi", "z_hi", "x_lo", "y_lo", "z_lo", "scale_0", "scale_1", "scale_2")
    sh = (f"sh{k}_{colour}" for k in range((sh_degree + 1) ** 2) for colour in ("r-g", "g", "b-g"))
    return (*fixed, "rotation_x", "rotation_y", "rotation_z", "opacity", *sh)


# Order of rows


def morton_codes(xyz: np.ndarray) -> np.ndarray:
    """Place of positions uint16 [N, 3] on the 3D Morton curve, uint64 [N]; bit 3 b + a is bit b of axis a."""
    spread = xyz.astype(np.uint64)
    for shift, mask in ((32, 0xFFFF00000000FFFF), (16, 0x00FF0000FF0000FF), (8, 0xF00F00F00F00F00F)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    for shift, mask in ((4, 0x30C30C30C30C30C3), (2, 0x9249249249249249)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    return spread[:, 0] | spread[:, 1] << np.uint64(1) | spread[:, 2] << np.uint64(2)


def storage_order(segment: Segment) -> np.ndarray:
    """Row of the segment that each stored row holds, int64 [N].

    The D dynamic rows come first, so that no mask is stored and a frame changes one contiguous part; each part runs
    along the Morton curve of its key positions, and ties keep their order.
    """
    code = morton_codes(segment.key.xyz) | (~segment.dynamic).astype(np.uint64) << np.uint64(63)
    return np.argsort(code, kind="stable")


def in_storage_order(segment: Segment) -> Segment:
    """The same segment with its rows as a scene file stores and returns them."""
    order = storage_order(segment)
    place = np.cumsum(segment.dynamic) - 1  # [N]: dynamic row -> its place in segment.xyz
    count = int(segment.dynamic.sum())
    moving = place[order[:count]]
    return Segment(
        segment.first,
        segment.key[order],
        np.arange(len(order)) < count,
        segment.xyz[:, moving],
        segment.attributes[:, moving],
    )


def hold_absent(segment: Segment) -> Segment:
    """The same segment, with rows that stand still while they are absent and so cost nothing to store.

    Before its birth a dynamic row carries what it is born with, after its death what it died with, and opacity code 0
    throughout. Every picture of the scene stays the same, the codes of absent rows do not: call it before codes are
    digested or compared. Rows that never appear repeat their key.
    """
    xyz = np.concatenate([segment.key.xyz[None, segment.dynamic], segment.xyz])  # [T, D, 3]
    attributes = np.concatenate([segment.key.attributes[None, segment.dynamic], segment.attributes])
    present = attributes[:, :, OPACITY] > 0  # [T, D]
    source = np.where(present, np.arange(len(present))[:, None], 0)  # [T, D]: frame whose values a row shows
    source = np.maximum.accumulate(source, axis=0)
    source = np.where(np.logical_or.accumulate(present, axis=0), source, present.argmax(axis=0))
    rows = np.arange(xyz.shape[1])
    xyz, attributes = xyz[source, rows], attributes[source, rows]
    attributes[:, :, OPACITY][~present] = 0
    key = Codes(segment.key.xyz.copy(), segment.key.attributes.copy())
    key.xyz[segment.dynamic], key.attributes[segment.dynamic] = xyz[0], attributes[0]
    return Segment(segment.first, key, segment.dynamic, xyz[1:], attributes[1:])


# Pictures


@dataclass(frozen=True)
class Mosaic:
    """How planes tile a picture, and where row i lies in a plane."""

    channels: tuple[int, ...]
    """The channel that each plane holds, planes from left to right, then top to bottom"""
    channel_count: int
    """Number of channels of a row; those without a plane are constant"""
    blocks_across: int
    """Size of a plane, in blocks of BLOCK x BLOCK cells"""
    blocks_down: int

    @classmethod
    def of(cls, capacity: int, channels: tuple[int, ...], channel_count: int) -> Mosaic:
        """The mosaic of nearly square planes that holds `capacity` rows."""
        blocks = max(1, -(-capacity // BLOCK**2))
        across = int(np.ceil(np.sqrt(blocks)))
        return cls(channels, channel_count, across, -(-blocks // across))

    @cached_property
    def grid(self) -> tuple[int, int]:
        """Planes across and down: the smallest grid that FFV1 can cut into one slice a plane."""
        shapes: dict[int, tuple[int, int]] = {}
        for down in range(2, 33):
            for across in range(down, 2 * down + 1):
                shapes.setdefault(across * down, (across, down))
        return shapes[min(count for count in shapes if count >= len(self.channels))]

    @property
    def capacity(self) -> int:
        """Number of rows that fit."""
        return self.blocks_across * self.blocks_down * BLOCK**2

    @property
    def width(self) -> int:
        return self.grid[0] * self.blocks_across * BLOCK

    @property
    def height(self) -> int:
        return self.grid[1] * self.blocks_down * BLOCK

    @cached_property
    def corners(self) -> np.ndarray:
        """Flat picture index of the first cell of each channel's plane, int64 [channels]; -1 without a plane."""
        corners = np.full(self.channel_count, -1, np.int64)
        down, across = np.divmod(np.arange(len(self.channels)), self.grid[0])
        corners[list(self.channels)] = (down * self.blocks_down * self.width + across * self.blocks_across) * BLOCK
        return corners

    @cached_property
    def cells(self) -> np.ndarray:
        """Flat picture index of each row, relative to its plane's corner, int64 [capacity].

        Blocks run in a serpentine from the top, a Hilbert curve fills each block.
        """
        row = np.arange(self.capacity)
        block_y, block_x = np.divmod(row // BLOCK**2, self.blocks_across)
        x, y = hilbert(row % BLOCK**2)
        backwards = block_y % 2 == 1
        block_x = np.where(backwards, self.blocks_across - 1 - block_x, block_x)
        x = np.where(backwards, BLOCK - 1 - x, x)
        return (block_y * BLOCK + y) * self.width + block_x * BLOCK + x

    def blank(self) -> np.ndarray:
        """A picture without rows, uint8 [height, width]."""
        return np.full((self.height, self.width), NEUTRAL, np.uint8)

    def draw(self, rows: np.ndarray) -> np.ndarray:
        """The picture of rows uint8 [n, channels]."""
        picture = self.blank()
        flat, cells = picture.reshape(-1), self.cells[: len(rows)]
        for channel in self.channels:
            flat[self.corners[channel] + cells] = rows[:, channel]
        return picture

    def read(self, picture: np.ndarray, constants: np.ndarray, count: int) -> np.ndarray:
        """Rows uint8 [count, channels] of a picture; `constants` uint8 [channels] stand for missing planes."""
        rows = np.empty((count, self.channel_count), np.uint8)
        rows[:] = constants
        flat, cells = picture.reshape(-1), self.cells[:count]
        for channel in self.channels:
            rows[:, channel] = flat[self.corners[channel] + cells]
        return rows


def hilbert(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y of points along the Hilbert curve of a BLOCK x BLOCK square, from (0, 0) to (BLOCK - 1, 0)."""
    x, y, rest, side = np.zeros_like(distance), np.zeros_like(distance), distance, 1
    while side < BLOCK:
        right = rest // 2 & 1
        below = (rest ^ right) & 1
        flip = (below == 0) & (right == 1)
        x, y = np.where(flip, side - 1 - x, x), np.where(flip, side - 1 - y, y)
        x, y = np.where(below == 0, y, x), np.where(below == 0, x, y)
        x, y, rest, side = x + side * right, y + side * below, rest // 4, side * 2
    return x, y


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
class Change:
    """One frame after the key, as it is stored."""

    prediction: int
    """REPEAT, PREVIOUS or LINEAR"""
    differences: bool
    """Whether red and blue residuals are stored as differences to green's"""
    rows: np.ndarray | None
    """Residuals uint8 [D, channels] around 128; None for REPEAT"""


def changes(stored: Segment) -> Iterator[Change]:
    """The frames after the key of a segment in storage order, each predicted in the way that costs least."""
    count = int(stored.dynamic.sum())
    last, velocity = stored.key[:count], np.zeros((count, 3), np.uint16)
    for xyz, attributes in zip(stored.xyz, stored.attributes, strict=True):
        now = Codes(xyz, attributes)
        if np.array_equal(now.xyz, last.xyz) and np.array_equal(now.attributes, last.attributes):
            yield Change(REPEAT, False, None)
        else:
            yield _cheapest(now, last, velocity)
        present = (now.attributes[:, OPACITY] > 0) & (last.attributes[:, OPACITY] > 0)
        velocity = np.where(present[:, None], now.xyz - last.xyz, np.uint16(0))
        last = now


def _cheapest(now: Codes, last: Codes, velocity: np.ndarray) -> Change:
    """Compare both position predictions and both colour forms by order-0 entropy."""
    step = now.xyz - last.xyz
    present = now.attributes[:, OPACITY, None] > 0
    positions = [_position_bytes(step), _position_bytes(step - np.where(present, velocity, np.uint16(0)))]
    linear = entropy_bits(positions[1]) < entropy_bits(positions[0])
    colours = now.attributes - last.attributes + np.uint8(NEUTRAL)
    plain = np.concatenate([positions[linear], colours], axis=1)
    coupled = plain.copy()
    _colours_to_differences(coupled)
    differences = entropy_bits(_colours(coupled)) < entropy_bits(_colours(plain))
    return Change(LINEAR if linear else PREVIOUS, differences, coupled if differences else plain)


def _position_bytes(residual: np.ndarray) -> np.ndarray:
    """High bytes, then low bytes of uint16 [n, 3], both around 128."""
    biased = residual + np.uint16(NEUTRAL * 257)
    return np.concatenate([biased >> 8, biased & 255], axis=1).astype(np.uint8)


def entropy_bits(rows: np.ndarray) -> float:
    """Bits that an ideal coder without context spends on bytes [n, ...], each column with its own statistics."""
    counts = _histograms(rows.reshape(len(rows), math.prod(rows.shape[1:])))
    return float((counts * np.log2(max(1, len(rows)) / np.maximum(counts, 1))).sum())


@numba.njit(cache=True, error_model="numpy")
def _histograms(rows):
    """Counts of each byte in each column, float64 [columns, 256]."""
    counts = np.zeros((rows.shape[1], 256))
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            counts[k, rows[i, k]] += 1
    return counts


class Playback:
    """The current frame of a segment while its changes are added, one after the other.

    `codes` is changed in place by every `advance`; copy what you keep.
    """

    def __init__(self, key: Codes, dynamic: int) -> None:
        """Start at the key frame, whose first `dynamic` rows may change; `key` is taken over."""
        self.codes = key
        self._velocity = np.zeros((dynamic, 3), np.uint16)

    def advance(self, prediction: int, differences: bool, mosaic: Mosaic, picture: np.ndarray | None) -> None:
        """Go on by one frame, whose residual picture uint8 [height, width] is absent for REPEAT."""
        if prediction == REPEAT or picture is None:
            self._velocity[:] = 0
            return
        codes = self.codes
        _integrate(
            picture.reshape(-1), mosaic.cells, mosaic.corners, prediction == LINEAR, differences,
            codes.xyz, codes.attributes, self._velocity,
        )  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def _integrate(flat, cells, corners, linear, differences, xyz, attributes, velocity):
    """Add a residual picture to the first len(velocity) rows; the inverse of `changes`."""
    for i in range(len(velocity)):
        cell = cells[i]
        was_present = attributes[i, OPACITY] > 0
        for k in range(attributes.shape[1]):
            corner = corners[POSITION_CHANNELS + k]
            if corner >= 0:
                attributes[i, k] += flat[corner + cell] - NEUTRAL
        if differences:
            for k in range(DC_START, attributes.shape[1], 3):
                corner = corners[POSITION_CHANNELS + k + 1]
                if corner >= 0:
                    green = flat[corner + cell] - NEUTRAL
                    attributes[i, k] += green
                    attributes[i, k + 2] += green
        present = attributes[i, OPACITY] > 0
        for axis in range(3):
            residual = 0
            if corners[axis] >= 0:
                residual = (flat[corners[axis] + cell] - NEUTRAL) * 256
            if corners[axis + 3] >= 0:
                residual += flat[corners[axis + 3] + cell] - NEUTRAL
            step = residual + (velocity[i, axis] if linear and present else 0)
            xyz[i, axis] += step
            velocity[i, axis] = step if present and was_present else 0


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
    return (frames != before).any(axis=(0, 1))
