"""How far each place of the room is from what stands still: a field of voxels, for contact shading and clearance."""

from __future__ import annotations

import numba
import numpy as np

from studio.geometry import item_bounds
from studio.raycast import BOX, CYLINDER, ELLIPSOID, Shapes

VOXEL_M = 0.07
REACH_M = 0.6
"""Distances beyond this are of no interest and are stored as this"""


def clearance_of(shapes: Shapes, corner: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Distance to the nearest solid at the voxels' centres, metres, float32 [Z, Y, X]; meshes are left out.

    Args:
        corner: place of the first voxel's centre x, y, z, and the voxels' side.
        shape: Z, Y, X.
    """
    field = np.full(shape, REACH_M, np.float32)
    lower, upper = item_bounds(shapes.kind, shapes.matrix, shapes.size, shapes.vertices, shapes.triangles)
    _carve(shapes.kind, shapes.inverse, shapes.size, corner, lower, upper, field)
    return field


@numba.njit(cache=True, error_model="numpy")
def _carve(kind, inverse, size, corner, lower, upper, field):
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for item in range(len(kind)):
        for axis in range(3):
            cells = field.shape[2 - axis]
            low[axis] = max(int((lower[item, axis] - REACH_M - corner[axis]) / corner[3]), 0)
            high[axis] = min(int((upper[item, axis] + REACH_M - corner[axis]) / corner[3]) + 2, cells)
        for k in range(low[2], high[2]):
            for j in range(low[1], high[1]):
                for i in range(low[0], high[0]):
                    x, y, z = corner[0] + i * corner[3], corner[1] + j * corner[3], corner[2] + k * corner[3]
                    field[k, j, i] = min(
                        field[k, j, i], max(_distance(kind[item], inverse[item], size[item], x, y, z), 0.0)
                    )


@numba.njit(cache=True, error_model="numpy")
def _distance(kind, m, size, px, py, pz):
    """Distance from a point to a solid, metres; for an ellipsoid an estimate that is good near its surface."""
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
    if kind == BOX:
        a, b, c = (abs(x) - 1) * size[0], (abs(y) - 1) * size[1], (abs(z) - 1) * size[2]
        outside = np.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
        return outside + min(max(a, b, c), 0.0)
    if kind == ELLIPSOID:
        return (np.sqrt(x * x + y * y + z * z) - 1) * min(size[0], size[1], size[2])
    if kind == CYLINDER:
        a, c = (np.sqrt(x * x + y * y) - 1) * size[0], (abs(z) - 1) * size[2]
        return np.sqrt(max(a, 0.0) ** 2 + max(c, 0.0) ** 2) + min(max(a, c), 0.0)
    share = min(max(z / size[2], 0.0), 1.0)
    return np.sqrt(x * x + y * y + (z - share * size[2]) ** 2) - (size[0] + share * (size[1] - size[0]))
