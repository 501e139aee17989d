"""What moves in the pictures of a camera, instant by instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class Activity:
    """Where the pictures of one camera change from instant to instant, in the cells of a coarse grid."""

    moving: np.ndarray
    """float32 [T, P]: share of each cell that changed since the instant before"""
    there: np.ndarray
    """bool [T]: whether the camera has a picture at this instant and the one before"""
    centre: np.ndarray | None = None
    """float64 [3], world axes; None where nobody knows how the cameras stand"""
    rays: np.ndarray | None = None
    """float64 [P, 3]: through the middles of the cells, world axes, all up to the same depth; likewise"""
    width: int = 0
    """Cells in a row of the grid; likewise"""

    @cached_property
    def changes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Instants and cells [n] where something moves, and the shares of these cells."""
        instants, cells = np.nonzero(self.moving)
        return instants, cells, self.moving[instants, cells]

    @property
    def posed(self) -> bool:
        """Whether it is known how the camera stands."""
        return self.centre is not None and self.rays is not None

    def later(self, by: int) -> Activity:
        """The same at instants that are so many later; what comes in is not there."""
        if not by:
            return self
        moving, there = np.roll(self.moving, by, axis=0), np.roll(self.there, by)
        outside = slice(by) if by > 0 else slice(by, None)
        moving[outside], there[outside] = 0, False
        return replace(self, moving=moving, there=there)
