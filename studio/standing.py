"""How far each place of the room is from what stands still: a field of voxels, for contact shading and clearance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from studio.raycast import BOX, CONE, CYLINDER, ELLIPSOID, Shapes, item_bounds

VOXEL_M = 0.07
REACH_M = 0.6
"""Distances beyond this are of no interest and are stored as this"""

Place = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Canonical coordinates of many points, arrays of one shape"""


def clearance_of(shapes: Shapes, corner: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Distance to the nearest solid at the voxels' centres, metres, float32 [Z, Y, X]; meshes are left out.

    Args:
        corner: place of the first voxel's centre x, y, z, and the voxels' side.
        shape: Z, Y, X.
    """
    field = np.full(shape, REACH_M, np.float32)
    lower, upper = item_bounds(shapes.kind, shapes.matrix, shapes.size, shapes.vertices, shapes.triangles)
    for item, kind in enumerate(shapes.kind.tolist()):
        first = np.maximum(((lower[item] - REACH_M - corner[:3]) / corner[3]).astype(int), 0)
        stop = np.minimum(((upper[item] + REACH_M - corner[:3]) / corner[3]).astype(int) + 2, shape[::-1])
        x, y, z = (corner[axis] + np.arange(first[axis], stop[axis]) * corner[3] for axis in range(3))
        near = field[first[2] : stop[2], first[1] : stop[1], first[0] : stop[0]]
        place = _canonical(shapes.inverse[item], x, y[:, None], z[:, None, None])
        near[...] = np.minimum(near, np.maximum(DISTANCES[kind](place, shapes.size[item]), 0.0))
    return field


def _canonical(
    m: np.ndarray,  # [3, 4], canonical from world
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
) -> Place:
    a, b, c = (m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3] for axis in range(3))
    return a, b, c


# Distances from points, in canonical coordinates, to solids, metres; negative inside.


def _from_box(place: Place, size: np.ndarray) -> np.ndarray:
    x, y, z = place
    a, b, c = (np.abs(x) - 1) * size[0], (np.abs(y) - 1) * size[1], (np.abs(z) - 1) * size[2]
    outside = np.sqrt(np.maximum(a, 0) ** 2 + np.maximum(b, 0) ** 2 + np.maximum(c, 0) ** 2)
    distance: np.ndarray = outside + np.minimum(np.maximum(np.maximum(a, b), c), 0)
    return distance


def _from_ellipsoid(place: Place, size: np.ndarray) -> np.ndarray:
    """An estimate that is good near the surface."""
    x, y, z = place
    distance: np.ndarray = (np.sqrt(x * x + y * y + z * z) - 1) * size.min()
    return distance


def _from_cylinder(place: Place, size: np.ndarray) -> np.ndarray:
    x, y, z = place
    a, c = (np.sqrt(x * x + y * y) - 1) * size[0], (np.abs(z) - 1) * size[2]
    distance: np.ndarray = np.sqrt(np.maximum(a, 0) ** 2 + np.maximum(c, 0) ** 2) + np.minimum(np.maximum(a, c), 0)
    return distance


def _from_cone(place: Place, size: np.ndarray) -> np.ndarray:
    x, y, z = place
    share = np.clip(z / size[2], 0, 1)
    distance: np.ndarray = np.sqrt(x * x + y * y + (z - share * size[2]) ** 2) - (size[0] + share * (size[1] - size[0]))
    return distance


DISTANCES: dict[int, Callable[[Place, np.ndarray], np.ndarray]] = {
    BOX: _from_box,
    ELLIPSOID: _from_ellipsoid,
    CYLINDER: _from_cylinder,
    CONE: _from_cone,
}
