"""Rows of bytes as one picture: a plane for each channel, planes tiled into a mosaic, neighbouring rows close together.

Row i of a segment has the same cell in every plane. docs/scene-format.md is the specification.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from packuv.kernels.compile import kernel

BLOCK = 32
"""Side of the square blocks that a Hilbert curve fills with 1,024 neighbouring rows."""
NEUTRAL = 128
"""Value of a cell that holds no row, of a residual of nothing, and of a flag that is down."""


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
    flagged: bool = False
    """Whether a plane of flags follows those of the channels"""

    @classmethod
    def of(cls, capacity: int, channels: tuple[int, ...], channel_count: int, *, flagged: bool = False) -> Mosaic:
        """The mosaic of nearly square planes that holds `capacity` rows."""
        blocks = max(1, -(-capacity // BLOCK**2))
        across = int(np.ceil(np.sqrt(blocks)))
        return cls(channels, channel_count, across, -(-blocks // across), flagged)

    @property
    def planes(self) -> int:
        """Number of planes, that of the flags included."""
        return len(self.channels) + self.flagged

    @cached_property
    def grid(self) -> tuple[int, int]:
        """Planes across and down: the smallest grid that FFV1 can cut into one slice a plane."""
        shapes: dict[int, tuple[int, int]] = {}
        for down in range(2, 33):
            for across in range(down, 2 * down + 1):
                shapes.setdefault(across * down, (across, down))
        return shapes[min(count for count in shapes if count >= self.planes)]

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
        corners[list(self.channels)] = [self._corner(plane) for plane in range(len(self.channels))]
        return corners

    @property
    def flag_corner(self) -> int:
        """Flat picture index of the first cell of the plane of flags, -1 without one."""
        return self._corner(len(self.channels)) if self.flagged else -1

    def _corner(self, plane: int) -> int:
        down, across = divmod(plane, self.grid[0])
        return (down * self.blocks_down * self.width + across * self.blocks_across) * BLOCK

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
        cells: np.ndarray = (block_y * BLOCK + y) * self.width + block_x * BLOCK + x
        return cells

    def blank(self) -> np.ndarray:
        """A picture without rows, uint8 [height, width]."""
        return np.full((self.height, self.width), NEUTRAL, np.uint8)

    def draw(self, rows: np.ndarray, flags: np.ndarray | None = None) -> np.ndarray:
        """The picture of rows uint8 [n, channels] and flags uint8 [m], both by their own place."""
        picture = self.blank()
        flat = picture.reshape(-1)
        _draw(rows, self.cells, self.corners, flat)
        if flags is not None and self.flagged:
            flat[self.flag_corner + self.cells[: len(flags)]] = flags + np.uint8(NEUTRAL)
        return picture

    def read(self, picture: np.ndarray, constants: np.ndarray, count: int) -> np.ndarray:
        """Rows uint8 [count, channels] of a picture; `constants` uint8 [channels] stand for missing planes."""
        rows = np.empty((count, self.channel_count), np.uint8)
        _read(picture.reshape(-1), self.cells, self.corners, constants, rows)
        return rows

    def read_flags(self, picture: np.ndarray, count: int) -> np.ndarray:
        """The first `count` flags of a picture, uint8."""
        flags: np.ndarray = picture.reshape(-1)[self.flag_corner + self.cells[:count]] - np.uint8(NEUTRAL)
        return flags


@kernel()
def _draw(rows, cells, corners, flat):
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            if corners[k] >= 0:
                flat[corners[k] + cells[i]] = rows[i, k]


@kernel()
def _read(flat, cells, corners, constants, rows):
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            rows[i, k] = flat[corners[k] + cells[i]] if corners[k] >= 0 else constants[k]


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
