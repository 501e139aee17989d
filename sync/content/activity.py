"""What moves in the pictures of a camera, instant by instant."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class Activity:
    """Where the pictures of one camera change from instant to instant, and which way, in the cells of a coarse grid."""

    there: np.ndarray
    """bool [T]: whether the camera has a picture at this instant and the one before"""
    instants: np.ndarray
    """int64 [n], ascending: when something moves"""
    cells: np.ndarray
    """int64 [n]: in which cell"""
    shares: np.ndarray
    """float32 [n]: of this cell that changed since the instant before"""
    flow: np.ndarray
    """float32 [n, 2]: mean motion of what changed there, cells across and down; 0 where nobody measured it"""
    count: int
    """Cells of a picture, P"""
    centre: np.ndarray | None = None
    """float64 [3], world axes; None where nobody knows how the cameras stand"""
    rays: np.ndarray | None = None
    """float64 [P, 3]: through the middles of the cells, world axes, all up to the same depth; likewise"""
    width: int = 0
    """Cells in a row of the grid; likewise"""

    @property
    def posed(self) -> bool:
        """Whether it is known how the camera stands."""
        return self.centre is not None and self.rays is not None

    def at(self, rows: np.ndarray) -> Activity:
        """The same at instants int64 [m] of its own; at -1 there is no picture."""
        starts, stops = (np.searchsorted(self.instants, rows, side) for side in ("left", "right"))
        lengths = stops - starts  # none at -1
        kept = np.repeat(starts - (np.cumsum(lengths) - lengths), lengths) + np.arange(lengths.sum())
        there = np.where(rows >= 0, self.there[rows], False)
        instants = np.repeat(np.arange(len(rows)), lengths)
        return replace(
            self,
            there=there,
            instants=instants,
            cells=self.cells[kept],
            shares=self.shares[kept],
            flow=self.flow[kept],
        )
