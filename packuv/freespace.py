"""Where nothing can be: the air between a camera and the points that it sees.

Pictures of a grey wall do not tell a wall from grey haze before it, and a fit left alone prefers haze. A triangulated
point does tell: the line of sight from each camera that sees it is empty. Some thousand such lines sweep most of the
air of a studio, and Gaussians that try to live there are taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from packuv.start import Bounds


@dataclass(frozen=True)
class FreeSpaceOptions:
    cells: int = 96
    """Cells along each side of the volume"""
    reach: float = 1.6
    """Half a side, in scene radii"""
    margin_cells: float = 1.5
    """A line of sight ends this many cells before its point"""
    votes: int = 3
    """Lines through a cell that make it empty: one or two may belong to a wrong match"""


@dataclass(frozen=True)
class FreeSpace:
    """A cube of cells, each crossed by a number of lines of sight."""

    corner: np.ndarray
    """float64 [3], world"""
    cell: float
    """Side of a cell, world"""
    lines: np.ndarray
    """int32 [n, n, n]"""
    votes: int

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points [N, 3] lie in air that must be empty, bool [N]; outside the cube nothing is known."""
        index = np.floor((points - self.corner) / self.cell)
        inside = ((index >= 0) & (index < len(self.lines))).all(axis=1)
        x, y, z = np.where(inside[:, None], index, 0).astype(np.int64).T
        return np.asarray(inside & (self.lines[x, y, z] >= self.votes))

    @property
    def share(self) -> float:
        """Share of the cells that must be empty."""
        return float((self.lines >= self.votes).mean())


def sweep_free_space(
    origins: np.ndarray,  # [R, 3], camera centres, world
    ends: np.ndarray,  # [R, 3], the points they see
    *,
    bounds: Bounds,
    options: FreeSpaceOptions,
) -> FreeSpace:
    """Count the lines of sight through each cell. O(lines * cells along a side)."""
    n = options.cells
    cell = 2 * options.reach * bounds.radius / n
    corner = bounds.centre - options.reach * bounds.radius
    lines = np.zeros(n**3, np.int32)
    for origin, end in zip(origins, ends, strict=True):
        length = float(np.linalg.norm(end - origin))
        along = np.arange(0, max(length - options.margin_cells * cell, 0), cell / 2)
        index = np.floor((origin + (end - origin) / max(length, 1e-12) * along[:, None] - corner) / cell).astype(
            np.int64
        )
        index = index[((index >= 0) & (index < n)).all(axis=1)]
        lines[np.unique(index @ [n * n, n, 1])] += 1
    return FreeSpace(corner, cell, lines.reshape(n, n, n), options.votes)
