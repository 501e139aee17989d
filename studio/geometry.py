"""Shapes in the room as flat arrays that compiled code reads.

A shape is a solid with a canonical form and an affine matrix to the world, or a triangle of a mesh. A point of its
surface keeps its canonical coordinates (its weights, for a triangle) while the shape moves, bends or breathes: that is
what makes the optical flow exact. Lengths are metres, z is up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from studio.raycast import BOX, CONE, CYLINDER, ELLIPSOID, Shapes, item_bounds, tree_over
from studio.textures import Textures


@dataclass(frozen=True)
class Look:
    """What covers a surface. Boxes have u and v in metres; round shapes and meshes have them in [0, 1]."""

    texture: str
    scale: tuple[float, float] = (1.0, 1.0)
    """Repeats of the texture for one unit of u and of v"""
    offset: tuple[float, float] = (0.0, 0.0)
    """Added after scaling"""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor in linear light"""
    gloss: float = 0.0
    """Share of light mirrored at normal incidence"""
    emission: float = 0.0
    """Radiance of its own per unit of albedo"""
    polished: bool = False
    """What mirrors the lamp's light mirrors what stands in the room, too, and all the more the flatter it is seen"""


class _Mesh(NamedTuple):
    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray
    owner: int
    look: int


class Parts:
    """Collects shapes; `shapes` packs them."""

    def __init__(self, textures: Textures) -> None:
        self._textures = textures
        self._kinds: list[int] = []
        self._matrices: list[np.ndarray] = []
        self._sizes: list[tuple[float, float, float]] = []
        self._owners: list[int] = []
        self._looks: list[tuple[float, ...]] = []
        self._solid_looks: list[int] = []
        self._meshes: list[_Mesh] = []

    def box(self, owner: int, centre: np.ndarray, half: np.ndarray, look: Look, turn: np.ndarray | None = None) -> None:
        """A box with half sides; `turn` [3, 3] maps its axes to the world's."""
        density = self._texels(look, 1.0, 1.0)
        self._add(owner, BOX, _affine(turn, centre, half), tuple(half), look, density)

    def box_fit(
        self, owner: int, centre: np.ndarray, half: np.ndarray, look: Look, turn: np.ndarray | None = None
    ) -> None:
        """A board of which each of the two wide faces shows the texture once."""
        wide = [2 * side for axis, side in enumerate(half) if axis != int(np.argmin(half))]
        fitted = replace(look, scale=(1 / wide[0], 1 / wide[1]), offset=(0.5, 0.5))
        self.box(owner, centre, half, fitted, turn)

    def ellipsoid(
        self, owner: int, centre: np.ndarray, radii: np.ndarray, look: Look, turn: np.ndarray | None = None
    ) -> None:
        """An ellipsoid; u runs round its own z axis with 0.5 towards +x, v from +z (0) to -z (1)."""
        radius = float(np.mean(radii))
        density = self._texels(look, 2 * np.pi * radius, np.pi * radius)
        self._add(owner, ELLIPSOID, _affine(turn, centre, radii), tuple(radii), look, density)

    def cylinder(
        self, owner: int, centre: np.ndarray, radius: float, height: float, look: Look, turn: np.ndarray | None = None
    ) -> None:
        """A closed cylinder along its own z axis; the side's v runs from the top (0) to the bottom (1)."""
        half = np.array([radius, radius, height / 2])
        density = self._texels(look, 2 * np.pi * radius, height)
        self._add(owner, CYLINDER, _affine(turn, centre, half), tuple(half), look, density)

    def cone(self, owner: int, start: np.ndarray, end: np.ndarray, radii: tuple[float, float], look: Look) -> None:
        """The hull of a sphere about `start` and one about `end`; neither may hold the other."""
        axis = end - start
        length = float(np.linalg.norm(axis))
        if length <= abs(radii[0] - radii[1]):
            raise ValueError(f"a rounded cone's ends must stick out of each other, but {length=} and {radii=}")
        density = self._texels(look, 2 * np.pi * float(np.mean(radii)), length)
        matrix = np.concatenate([_frame(axis / length), start[:, None]], axis=1)
        self._add(owner, CONE, matrix, (*radii, length), look, density)

    def sheet(self, owner: int, points: np.ndarray, look: Look, *, closed: bool = False) -> None:
        """A mesh over a grid of points [R, C, 3], seen from both sides; u runs over columns, v over rows.

        closed: the last column repeats the first, as round a tube.
        """
        rows, columns = points.shape[:2]
        area = np.linalg.norm(_normals(points, closed), axis=2).mean() * (rows - 1) * (columns - 1)
        density = self._texels(look, 1.0, 1.0) / np.sqrt(max(area, 1e-9))
        self._looks.append(self._row(look, density))
        self._meshes.append(_Mesh(*_grid_mesh(points, closed), owner, len(self._looks) - 1))

    def shapes(self) -> Shapes:
        """Everything collected so far."""
        kind, size = np.array(self._kinds, np.int32), np.array(self._sizes, dtype=np.float64).reshape(-1, 3)
        matrix = np.array(self._matrices, dtype=np.float64).reshape(-1, 3, 4)
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in self._meshes])
        vertices, normals, uv = (
            _stacked([getattr(mesh, name) for mesh in self._meshes], width, np.float64)
            for name, width in (("vertices", 3), ("normals", 3), ("uv", 2))
        )
        corners = [mesh.triangles + start for mesh, start in zip(self._meshes, starts, strict=False)]
        triangles = _stacked(corners, 3, np.int32)
        faces = [len(mesh.triangles) for mesh in self._meshes]
        return Shapes(
            kind,
            matrix,
            _inverse(matrix),
            size,
            vertices,
            normals,
            uv,
            triangles,
            np.concatenate([self._solid_looks, np.repeat([mesh.look for mesh in self._meshes], faces)]).astype(
                np.int32
            ),
            np.concatenate([self._owners, np.repeat([mesh.owner for mesh in self._meshes], faces)]).astype(np.uint8),
            np.array(self._looks, dtype=np.float64).reshape(-1, 12),
            *tree_over(*item_bounds(kind, matrix, size, vertices, triangles)),
        )

    def _add(
        self, owner: int, kind: int, matrix: np.ndarray, size: tuple[float, ...], look: Look, density: float
    ) -> None:
        self._kinds.append(kind)
        self._matrices.append(matrix)
        self._sizes.append((size[0], size[1], size[2]))
        self._owners.append(owner)
        self._solid_looks.append(len(self._looks))
        self._looks.append(self._row(look, density))

    def _row(self, look: Look, density: float) -> tuple[float, ...]:
        texture = float(self._textures.index[look.texture])
        return (texture, *look.scale, *look.offset, *look.tint, look.gloss, look.emission, density, look.polished)

    def _texels(self, look: Look, along_u: float, along_v: float) -> float:
        """Texels per metre, the geometric mean of both directions; the lengths are metres for one unit of u and v."""
        width, height, _ = self._textures.size[self._textures.index[look.texture]]
        return float(np.sqrt(width * abs(look.scale[0]) / along_u * height * abs(look.scale[1]) / along_v))


def turn_about_z(angle_rad: float) -> np.ndarray:
    """Rotation counter-clockwise seen from above, float64 [3, 3]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _stacked(blocks: list[np.ndarray], width: int, kind: type) -> np.ndarray:
    return np.concatenate([np.zeros((0, width)), *blocks]).astype(kind)


def _affine(turn: np.ndarray | None, centre: np.ndarray, scale: np.ndarray) -> np.ndarray:
    axes = np.eye(3) if turn is None else turn
    return np.concatenate([axes * np.asarray(scale), np.asarray(centre, dtype=np.float64)[:, None]], axis=1)


def _frame(axis: np.ndarray) -> np.ndarray:
    """A rotation whose z axis is the given unit vector, float64 [3, 3]; its y axis is level."""
    x, y, z = (float(part) for part in axis)
    across = np.hypot(x, y)
    # straight up or down, every direction is level
    side = (-y / across, x / across) if across > 1e-9 else (0.0, 1.0)
    return np.array([[side[1] * z, side[0], x], [-side[0] * z, side[1], y], [side[0] * y - side[1] * x, 0.0, z]])


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverses of affine maps, float64 [P, 3, 4] -> [P, 3, 4]."""
    linear = np.linalg.inv(matrix[:, :, :3])
    return np.concatenate([linear, -linear @ matrix[:, :, 3:]], axis=2)


def _normals(points: np.ndarray, closed: bool) -> np.ndarray:
    """Cross products of the grid's directions, [R, C, 3]; their length is the area of a cell."""
    down = np.gradient(points, axis=0)
    if closed:
        around = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
        right = (around[:, 2:] - around[:, :-2]) / 2
    else:
        right = np.gradient(points, axis=1)
    return np.cross(right, -down)


def _grid_mesh(points: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, unit normals, uv and triangles of a grid of points [R, C, 3]."""
    rows, columns = points.shape[:2]
    normal = _normals(points, closed)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)[None, :]).ravel()
    first = np.stack([corner, corner + 1, corner + columns], axis=1)
    second = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    faces = np.concatenate([first, second]).astype(np.int32)
    return points.reshape(-1, 3), normal.reshape(-1, 3), np.stack([u, v], axis=2).reshape(-1, 2), faces
