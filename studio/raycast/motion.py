"""What each pixel's centre ray meets, and where that goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studio.raycast.kernels import Backdrop, Shapes, View, fill_hits, fill_motion


@dataclass(frozen=True, eq=False)
class Hits:
    """What the centre ray of each pixel meets."""

    depth: np.ndarray
    """float64 [H, W]: along the camera's z axis, metres"""
    owner: np.ndarray
    """uint8 [H, W]: object"""
    item: np.ndarray
    """int32 [H, W]: item of the movers' shapes, -1 where the standing room is seen"""
    place: np.ndarray
    """float64 [H, W, 3]: canonical coordinates on a solid, weights of the corners on a triangle"""


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the points that the pixels' centre rays meet go."""

    flow: np.ndarray
    """float64 [H, W, 2]: displacement in x and y, pixels; 0 for what stands still"""
    moves: np.ndarray
    """bool [H, W]: the point moves in the world"""
    seen: np.ndarray
    """bool [H, W]: the point is inside the next picture and nothing hides it there"""


def cast(view: View, backdrop: Backdrop, movers: Shapes) -> Hits:
    """What the ray through each pixel's centre meets first."""
    shape = (view.height, view.width)
    hits = Hits(
        backdrop.centre_depth.copy(), backdrop.centre_owner.copy(), np.empty(shape, np.int32), np.empty((*shape, 3))
    )
    fill_hits(view, movers, hits.depth, hits.owner, hits.item, hits.place)
    return hits


def follow(view: View, hits: Hits, standing: Shapes, now: Shapes, later: Shapes) -> Motion:
    """Carry the points hit now to where their surface is later, and look at them again with the same camera.

    Args:
        now, later: the movers at both times.
    """
    shape = (view.height, view.width)
    motion = Motion(np.empty((*shape, 2)), np.empty(shape, np.bool_), np.empty(shape, np.bool_))
    fill_motion(view, hits.depth, hits.item, hits.place, standing, now, later, motion.flow, motion.moves, motion.seen)
    return motion
