"""All that the ray caster compiles, and what its compiled code reads.

Numba keeps machine code until the file that holds the function changes, whatever happens in other files. Functions,
constants and the order of a tuple's fields are compiled in, so all these stand together here, and what other modules
know (linear light of sRGB) comes as an argument.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

BOX, ELLIPSOID, CYLINDER, CONE = range(4)
"""Canonical forms: the cube [-1, 1]^3; the unit sphere; radius 1 and z in [-1, 1], closed; and the hull of two
spheres of radius size[0] about the origin and size[1] about (0, 0, size[2])"""
DEEPEST = 96
"""Entries of the stack with which a tree is walked; the trees here are under 30 levels deep"""
NOWHERE = np.inf
MOVED_M = 1e-6
"""A point that is displaced by less between two frames stands still; rounding stays below 1e-12"""
NEAREST = 1e-9
"""Hits closer than this part of a ray's length are the surface that the ray starts from"""
BLACK = 0.0
APERTURE_PX, PAINT_BLUR_PX = 1.6, 1.2
"""A pixel's rays spread over this width, and paint is averaged over that. A real lens and sensor are no sharper; with
rays inside the pixel alone, halving the chroma left 30 to 32 dB of a 320x180 picture, with this 34 to 35"""
_PI = float(np.pi)


class View(NamedTuple):
    """A pinhole camera as the kernels read it."""

    width: int
    height: int
    intrinsics: np.ndarray
    """float64 [4]: fx, fy, cx, cy, pixels"""
    rotation: np.ndarray
    """float64 [3, 3], camera from world"""
    centre: np.ndarray
    """float64 [3], world"""


class Shapes(NamedTuple):
    """Shapes at one time: P solids, then F triangles over V vertices. An item is a solid or a triangle.

    A tree of N nodes, each with the bounds of all items below it, finds what a ray meets; node 0 is the root.
    """

    kind: np.ndarray
    """int32 [P]"""
    matrix: np.ndarray
    """float64 [P, 3, 4], world from canonical"""
    inverse: np.ndarray
    """float64 [P, 3, 4], canonical from world"""
    size: np.ndarray
    """float64 [P, 3], metres: half sides, radii, or the cone's radii and length"""
    vertices: np.ndarray
    """float64 [V, 3], world"""
    normals: np.ndarray
    """float64 [V, 3], unit"""
    uv: np.ndarray
    """float64 [V, 2]"""
    triangles: np.ndarray
    """int32 [F, 3]"""
    look: np.ndarray
    """int32 [P + F]: row in `looks`"""
    owner: np.ndarray
    """uint8 [P + F]: object that the item belongs to"""
    looks: np.ndarray
    """float64 [L, 12]: texture, scale u v, offset u v, tint r g b, gloss, emission, texels per metre, polished"""
    lower: np.ndarray
    """float64 [N, 3]: bounds of the nodes"""
    upper: np.ndarray
    """float64 [N, 3]"""
    first: np.ndarray
    """int32 [N]: the left child (the right one follows it), or a leaf's first place in `order`"""
    fill: np.ndarray
    """int32 [N]: items of a leaf, 0 for an inner node"""
    order: np.ndarray
    """int32 [P + F]: items, leaf by leaf"""


class Light(NamedTuple):
    """What lights the room, and never changes."""

    lamps: np.ndarray
    """float64 [L, 3]: points of the key light; sample k of a pixel sees lamp k modulo L, which makes shadows soft"""
    power: np.ndarray
    """float64 [3]: radiance of white paper at one metre, facing the lamp"""
    sky: np.ndarray
    """float64 [3]: ambient radiance of white paper that faces up"""
    ground: np.ndarray
    """float64 [3]: the same for paper that faces down"""
    clearance: np.ndarray
    """float32 [Z, Y, X]: distance to the nearest surface that never moves, metres"""
    corner: np.ndarray
    """float64 [4]: place of voxel (0, 0, 0)'s centre x y z, and the voxels' side, metres"""


class Paints(NamedTuple):
    """Textures as the kernels read them; see `Textures`."""

    texels: np.ndarray
    start: np.ndarray
    size: np.ndarray
    light: np.ndarray
    """float32 [256]: linear light of a texel's sRGB values"""


class Backdrop(NamedTuple):
    """What the S x S rays of each pixel see of the standing room."""

    depth: np.ndarray
    """float32 [H, W, S * S], metres; infinite where a ray meets nothing"""
    normal: np.ndarray
    """float32 [H, W, S * S, 3], unit, facing the camera"""
    ambient: np.ndarray
    """float32 [H, W, S * S, 3]: radiance but for the key light's, with what a polished surface mirrors"""
    key: np.ndarray
    """float32 [H, W, S * S, 3]: radiance that the key light adds unless a mover shadows the point"""
    centre_depth: np.ndarray
    """float64 [H, W]: depth along the ray through the pixel's centre"""
    centre_owner: np.ndarray
    """uint8 [H, W]: object it meets"""


# Only compiled code calls these. They allocate nothing, so they need no reference counts of arrays: left on, these take
# half of the run time, for each call counts every array of the tuples that it is given.
_INNER: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "_nrt": False,
}
_kernel = numba.njit(**_INNER)
_inline = numba.njit(**_INNER, forceinline=True)


# Rays and shapes. Each returns the nearest t beyond NEAREST, or infinity.


@_inline
def _through(m, i, x, y, z):
    """The i-th of some affine maps [..., 3, 4], of a point."""
    return (
        m[i, 0, 0] * x + m[i, 0, 1] * y + m[i, 0, 2] * z + m[i, 0, 3],
        m[i, 1, 0] * x + m[i, 1, 1] * y + m[i, 1, 2] * z + m[i, 1, 3],
        m[i, 2, 0] * x + m[i, 2, 1] * y + m[i, 2, 2] * z + m[i, 2, 3],
    )


@_inline
def _turned(m, i, x, y, z):
    """The linear part of the i-th of some affine maps [..., 3, 4], of a direction."""
    return (
        m[i, 0, 0] * x + m[i, 0, 1] * y + m[i, 0, 2] * z,
        m[i, 1, 0] * x + m[i, 1, 1] * y + m[i, 1, 2] * z,
        m[i, 2, 0] * x + m[i, 2, 1] * y + m[i, 2, 2] * z,
    )


@_inline
def _meet_box(ox, oy, oz, dx, dy, dz):
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    ax, bx = (-1 - ox) * ix, (1 - ox) * ix
    ay, by = (-1 - oy) * iy, (1 - oy) * iy
    az, bz = (-1 - oz) * iz, (1 - oz) * iz
    near = max(min(ax, bx), min(ay, by), min(az, bz))
    far = min(max(ax, bx), max(ay, by), max(az, bz))
    return near if near <= far and near > NEAREST else NOWHERE


@_kernel
def _meet_sphere(ox, oy, oz, dx, dy, dz, radius):
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    # the ray's closest point gives a better conditioned root than b^2 - a c far from the sphere
    f = -b / a
    px, py, pz = ox + f * dx, oy + f * dy, oz + f * dz
    inside = radius * radius - (px * px + py * py + pz * pz)
    if inside < 0:
        return NOWHERE
    t = f - np.sqrt(inside / a)
    return t if t > NEAREST else NOWHERE


@_kernel
def _meet_cylinder(ox, oy, oz, dx, dy, dz):
    best = NOWHERE
    a = dx * dx + dy * dy
    f = -(ox * dx + oy * dy) / a
    px, py = ox + f * dx, oy + f * dy
    inside = 1 - (px * px + py * py)
    if inside >= 0 and a > 0:
        t = f - np.sqrt(inside / a)
        if t > NEAREST and abs(oz + t * dz) <= 1:
            best = t
    t = ((1.0 if dz < 0 else -1.0) - oz) / dz
    x, y = ox + t * dx, oy + t * dy
    if t > NEAREST and t < best and x * x + y * y <= 1:
        best = t
    return best


@_kernel
def _meet_cone(ox, oy, oz, dx, dy, dz, r1, r2, length):
    """Two spheres and the cone that touches both; its normal is (cos, sin) in (distance from the axis, z)."""
    sine = (r1 - r2) / length
    cosine2 = 1 - sine * sine
    low, high = r1 * sine, length + r2 * sine
    best = NOWHERE
    a = cosine2 * (dx * dx + dy * dy) - sine * sine * dz * dz
    b = cosine2 * (ox * dx + oy * dy) + sine * dz * (r1 - oz * sine)
    c = cosine2 * (ox * ox + oy * oy) - (r1 - oz * sine) ** 2
    disc = b * b - a * c
    if disc >= 0 and a != 0:
        root = np.sqrt(disc)
        for sign in (-1.0, 1.0):
            t = (-b + sign * root) / a
            z = oz + t * dz
            if t > NEAREST and t < best and z >= low and z <= high:
                best = t
    t = _meet_sphere(ox, oy, oz, dx, dy, dz, r1)
    if t < best and oz + t * dz <= low:
        best = t
    t = _meet_sphere(ox, oy, oz - length, dx, dy, dz, r2)
    if t < best and oz + t * dz >= high:
        best = t
    return best


@_inline
def _meet_solid(shapes, item, ox, oy, oz, dx, dy, dz):
    # whole arrays and an index: a slice would cost two atomic reference counts, shared by all threads
    lx, ly, lz = _through(shapes.inverse, item, ox, oy, oz)
    ex, ey, ez = _turned(shapes.inverse, item, dx, dy, dz)
    kind, size = shapes.kind[item], shapes.size
    if kind == BOX:
        return _meet_box(lx, ly, lz, ex, ey, ez)
    if kind == ELLIPSOID:
        return _meet_sphere(lx, ly, lz, ex, ey, ez, 1.0)
    if kind == CYLINDER:
        return _meet_cylinder(lx, ly, lz, ex, ey, ez)
    return _meet_cone(lx, ly, lz, ex, ey, ez, size[item, 0], size[item, 1], size[item, 2])


@_kernel
def _meet_triangle(shapes, face, ox, oy, oz, dx, dy, dz):
    """t and the weights of the second and third corner."""
    i, j, k = shapes.triangles[face, 0], shapes.triangles[face, 1], shapes.triangles[face, 2]
    p = shapes.vertices
    ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    nx, ny, nz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    scale = 1.0 / (ax * nx + ay * ny + az * nz)
    sx, sy, sz = ox - p[i, 0], oy - p[i, 1], oz - p[i, 2]
    u = (sx * nx + sy * ny + sz * nz) * scale
    qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
    v = (dx * qx + dy * qy + dz * qz) * scale
    t = (bx * qx + by * qy + bz * qz) * scale
    # the comparison is written so that NaN, from a triangle seen edge on, is a miss
    if u >= 0 and v >= 0 and u + v <= 1 and t > NEAREST:
        return t, u, v
    return NOWHERE, 0.0, 0.0


@_inline
def _enter(shapes, node, ox, oy, oz, ix, iy, iz, limit):
    """Where a ray enters a node's box, or infinity if it misses it or enters beyond the limit."""
    ax, bx = (shapes.lower[node, 0] - ox) * ix, (shapes.upper[node, 0] - ox) * ix
    ay, by = (shapes.lower[node, 1] - oy) * iy, (shapes.upper[node, 1] - oy) * iy
    az, bz = (shapes.lower[node, 2] - oz) * iz, (shapes.upper[node, 2] - oz) * iz
    near = max(min(ax, bx), min(ay, by), min(az, bz))
    far = min(max(ax, bx), max(ay, by), max(az, bz))
    return near if near <= far and far > 0 and near < limit else NOWHERE


@_kernel
def _first_hit(shapes, ox, oy, oz, dx, dy, dz, limit, stack, entries, any_hit):
    """The nearest hit before the limit: t, item, weights. With `any_hit` the first found will do."""
    solids = len(shapes.kind)
    ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
    best, item, best_u, best_v = limit, -1, 0.0, 0.0
    stack[0], entries[0], top = 0, 0.0, 1
    while top > 0:
        top -= 1
        node = stack[top]
        if entries[top] >= best:
            continue
        first, count = shapes.first[node], shapes.fill[node]
        if count == 0:
            near = _enter(shapes, first, ox, oy, oz, ix, iy, iz, best)
            far = _enter(shapes, first + 1, ox, oy, oz, ix, iy, iz, best)
            nearer = first
            if far < near:
                near, far, nearer = far, near, first + 1
            if far < NOWHERE:
                stack[top], entries[top] = 2 * first + 1 - nearer, far
                top += 1
            if near < NOWHERE:
                stack[top], entries[top] = nearer, near
                top += 1
            continue
        for place in range(first, first + count):
            candidate = shapes.order[place]
            u, v = 0.0, 0.0
            if candidate < solids:
                t = _meet_solid(shapes, candidate, ox, oy, oz, dx, dy, dz)
            else:
                t, u, v = _meet_triangle(shapes, candidate - solids, ox, oy, oz, dx, dy, dz)
            if t < best:
                best, item, best_u, best_v = t, candidate, u, v
                if any_hit:
                    return best, item, best_u, best_v
    return best, item, best_u, best_v


@_inline
def _ray(view, x, y):
    """World direction of the ray through a picture point, with length 1 along the camera's z axis."""
    a = (x - view.intrinsics[2]) / view.intrinsics[0]
    b = (y - view.intrinsics[3]) / view.intrinsics[1]
    r = view.rotation
    return (
        r[0, 0] * a + r[1, 0] * b + r[2, 0],
        r[0, 1] * a + r[1, 1] * b + r[2, 1],
        r[0, 2] * a + r[1, 2] * b + r[2, 2],
    )


@_inline
def _sample_ray(view, column, row, k, samples):
    """The k-th ray of a pixel, on an even grid about its centre."""
    x = 0.5 + APERTURE_PX * ((k % samples + 0.5) / samples - 0.5)
    y = 0.5 + APERTURE_PX * ((k // samples + 0.5) / samples - 0.5)
    return _ray(view, column + x, row + y)


# What the surface looks like


@_inline
def _unit(x, y, z):
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@_kernel
def _box_surface(x, y, z, half_x, half_y, half_z):
    """Canonical normal, u and v of a point on a box: upright and unmirrored seen from outside, metres."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        side = 1.0 if x > 0 else -1.0
        return side, 0.0, 0.0, side * y * half_y, -z * half_z
    if ay >= az:
        side = 1.0 if y > 0 else -1.0
        return 0.0, side, 0.0, -side * x * half_x, -z * half_z
    side = 1.0 if z > 0 else -1.0
    return 0.0, 0.0, side, x * half_x, -side * y * half_y


@_kernel
def _around(x, y):
    """Turn about the z axis in [0, 1], 0.5 towards +x."""
    return np.arctan2(y, x) / (2 * _PI) + 0.5


@_kernel
def _solid_surface(shapes, item, x, y, z):
    """World normal (any length), u and v at canonical coordinates of a solid."""
    kind, m = shapes.kind[item], shapes.inverse
    s1, s2, s3 = shapes.size[item, 0], shapes.size[item, 1], shapes.size[item, 2]
    if kind == BOX:
        a, b, c, u, v = _box_surface(x, y, z, s1, s2, s3)
    elif kind == ELLIPSOID:
        a, b, c, u, v = x, y, z, _around(x, y), np.arccos(min(max(z, -1.0), 1.0)) / _PI
    elif kind == CYLINDER and abs(z) > 1 - 1e-7:
        a, b, c, u, v = 0.0, 0.0, z, 0.5 + x / 2, 0.5 - y / 2
    elif kind == CYLINDER:
        a, b, c, u, v = x, y, 0.0, _around(x, y), (1 - z) / 2
    else:
        sine = (s1 - s2) / s3
        # on a sphere the normal points from its centre, on the cone between it has the cone's slope
        middle = min(max(z - np.sqrt(x * x + y * y) * sine / np.sqrt(1 - sine * sine), 0.0), s3)
        a, b, c, u, v = x, y, z - middle, _around(x, y), z / s3
    # normals go to the world with the transpose of the inverse
    return (
        m[item, 0, 0] * a + m[item, 1, 0] * b + m[item, 2, 0] * c,
        m[item, 0, 1] * a + m[item, 1, 1] * b + m[item, 2, 1] * c,
        m[item, 0, 2] * a + m[item, 1, 2] * b + m[item, 2, 2] * c,
        u,
        v,
    )


@_kernel
def _mesh_surface(shapes, face, second, third):
    """World normal (any length), u and v inside a triangle."""
    i, j, k = shapes.triangles[face, 0], shapes.triangles[face, 1], shapes.triangles[face, 2]
    first = 1 - second - third
    n, w = shapes.normals, shapes.uv
    return (
        first * n[i, 0] + second * n[j, 0] + third * n[k, 0],
        first * n[i, 1] + second * n[j, 1] + third * n[k, 1],
        first * n[i, 2] + second * n[j, 2] + third * n[k, 2],
        first * w[i, 0] + second * w[j, 0] + third * w[k, 0],
        first * w[i, 1] + second * w[j, 1] + third * w[k, 1],
    )


@_kernel
def _texel(colours, texture, level, u, v):
    """Bilinear look-up in one level, linear light."""
    start, size = colours.start[texture, level], colours.size
    width, height = max(size[texture, 0] >> level, 1), max(size[texture, 1] >> level, 1)
    x, y = u * width - 0.5, v * height - 0.5
    fx, fy = np.floor(x), np.floor(y)
    sx, sy = np.float32(x - fx), np.float32(y - fy)
    # sides are powers of two, so that a mask wraps
    left, right = int(fx) & (width - 1), (int(fx) + 1) & (width - 1)
    upper, lower = start + (int(fy) & (height - 1)) * width, start + ((int(fy) + 1) & (height - 1)) * width
    t, light, one = colours.texels, colours.light, np.float32(1)
    a, b, c, d = (one - sx) * (one - sy), sx * (one - sy), (one - sx) * sy, sx * sy
    i, j, k, m = upper + left, upper + right, lower + left, lower + right
    return (
        a * light[t[i, 0]] + b * light[t[j, 0]] + c * light[t[k, 0]] + d * light[t[m, 0]],
        a * light[t[i, 1]] + b * light[t[j, 1]] + c * light[t[k, 1]] + d * light[t[m, 1]],
        a * light[t[i, 2]] + b * light[t[j, 2]] + c * light[t[k, 2]] + d * light[t[m, 2]],
    )


@_kernel
def _albedo(colours, looks, row, u, v, footprint_m):
    """Filtered paint of a surface, linear light, for a ray that covers a patch of the given size."""
    texture = int(looks[row, 0])
    u, v = u * looks[row, 1] + looks[row, 3], v * looks[row, 2] + looks[row, 4]
    level = np.log2(max(looks[row, 10] * footprint_m, 1.0))
    level = min(level, colours.size[texture, 2] - 1.0)
    low = int(level)
    share = np.float32(level - low)
    r, g, b = _texel(colours, texture, low, u, v)
    if share > 0:
        r2, g2, b2 = _texel(colours, texture, low + 1, u, v)
        r, g, b = r + share * (r2 - r), g + share * (g2 - g), b + share * (b2 - b)
    return r * looks[row, 5], g * looks[row, 6], b * looks[row, 7]


# Light


@_kernel
def _clear(light, x, y, z):
    """Distance to the nearest standing surface, interpolated from the voxels, metres."""
    grid, side = light.clearance, light.corner[3]
    a = min(max((x - light.corner[0]) / side, 0.0), grid.shape[2] - 1.001)
    b = min(max((y - light.corner[1]) / side, 0.0), grid.shape[1] - 1.001)
    c = min(max((z - light.corner[2]) / side, 0.0), grid.shape[0] - 1.001)
    i, j, k = int(a), int(b), int(c)
    a, b, c = a - i, b - j, c - k
    low = (grid[k, j, i] * (1 - a) + grid[k, j, i + 1] * a) * (1 - b) + (
        grid[k, j + 1, i] * (1 - a) + grid[k, j + 1, i + 1] * a
    ) * b
    high = (grid[k + 1, j, i] * (1 - a) + grid[k + 1, j, i + 1] * a) * (1 - b) + (
        grid[k + 1, j + 1, i] * (1 - a) + grid[k + 1, j + 1, i + 1] * a
    ) * b
    return low * (1 - c) + high * c


@_kernel
def _opening(light, px, py, pz, nx, ny, nz):
    """Share of ambient light that what stands still lets through to a point: corners are darker."""
    closed = 0.0
    for reach, weight in ((0.12, 0.40), (0.45, 0.35)):
        clear = _clear(light, px + nx * reach, py + ny * reach, pz + nz * reach)
        closed += weight * min(max(1 - clear / reach, 0.0), 1.0)
    return 1 - closed


@_kernel
def _passing(blockers, px, py, pz, nx, ny, nz):
    """Share of ambient light that the movers' balls let through to a point."""
    share = 1.0
    for ball in range(len(blockers)):
        x, y, z, radius = blockers[ball, 0] - px, blockers[ball, 1] - py, blockers[ball, 2] - pz, blockers[ball, 3]
        away2 = x * x + y * y + z * z
        if away2 > 25 * radius * radius:
            continue
        # solid angle of the ball, weighted by the cosine; fades to 0 at five radii
        away = np.sqrt(away2)
        cosine = (x * nx + y * ny + z * nz) / away
        near = radius / max(away, radius)
        share *= 1 - 0.75 * max(cosine, 0.0) * max(near * near - 0.04, 0.0)
    return share


@_kernel
def _lamp(light, lamp, px, py, pz):
    """Unit direction to a lamp and the distance."""
    x, y, z = light.lamps[lamp, 0] - px, light.lamps[lamp, 1] - py, light.lamps[lamp, 2] - pz
    away = np.sqrt(x * x + y * y + z * z)
    return x / away, y / away, z / away, away


@_inline
def _lit(shapes, light, lamp, px, py, pz, nx, ny, nz, stack, entries):
    """Whether no shape of the given ones is between a point and a lamp."""
    lx, ly, lz, away = _lamp(light, lamp, px, py, pz)
    # starts a little off the surface, or the surface would shadow itself
    px, py, pz = px + nx * 1e-4, py + ny * 1e-4, pz + nz * 1e-4
    _, item, _, _ = _first_hit(shapes, px, py, pz, lx, ly, lz, away - 1e-3, stack, entries, True)
    return item < 0


@_kernel
def _shade(light, gloss, glow, paint, lamp, px, py, pz, nx, ny, nz, dx, dy, dz):
    """Radiance of a point seen along the unit direction d: the ambient part and what the lamp adds if it is lit."""
    r, g, b = paint
    opening, up = _opening(light, px, py, pz, nx, ny, nz), 0.5 + 0.5 * nz
    sky, ground = light.sky, light.ground
    ar = r * (opening * (ground[0] + up * (sky[0] - ground[0])) + glow)
    ag = g * (opening * (ground[1] + up * (sky[1] - ground[1])) + glow)
    ab = b * (opening * (ground[2] + up * (sky[2] - ground[2])) + glow)
    lx, ly, lz, away = _lamp(light, lamp, px, py, pz)
    cosine = nx * lx + ny * ly + nz * lz
    if cosine <= 0:
        return ar, ag, ab, BLACK, BLACK, BLACK
    # softer than 1 / r^2, as the light that walls throw back makes it in a real room
    key, mirror = cosine * 2 / (1 + away * away), BLACK
    if gloss > 0:
        hx, hy, hz = _unit(lx - dx, ly - dy, lz - dz)
        mirror = gloss * 12 * max(nx * hx + ny * hy + nz * hz, 0.0) ** 60
    power = light.power
    return ar, ag, ab, (r + mirror) * key * power[0], (g + mirror) * key * power[1], (b + mirror) * key * power[2]


@_kernel
def _surface(shapes, item, second, third, px, py, pz, dx, dy, dz):
    """At a hit: unit normal facing the ray, u, v, and the cosine between ray and normal; d is a unit vector."""
    if item < len(shapes.kind):
        x, y, z = _through(shapes.inverse, item, px, py, pz)
        nx, ny, nz, u, v = _solid_surface(shapes, item, x, y, z)
    else:
        nx, ny, nz, u, v = _mesh_surface(shapes, item - len(shapes.kind), second, third)
    nx, ny, nz = _unit(nx, ny, nz)
    facing = -(nx * dx + ny * dy + nz * dz)
    if facing < 0:
        return -nx, -ny, -nz, u, v, -facing
    return nx, ny, nz, u, v, facing


@_kernel
def _appearance(view, shapes, light, colours, hit, px, py, pz, dx, dy, dz, lamp):
    """Normal, ambient and key radiance at a hit (t, item, weights)."""
    t, item, second, third = hit
    dx, dy, dz = _unit(dx, dy, dz)
    nx, ny, nz, u, v, facing = _surface(shapes, item, second, third, px, py, pz, dx, dy, dz)
    looks, row = shapes.looks, shapes.look[item]
    footprint = t * PAINT_BLUR_PX / view.intrinsics[0] / np.sqrt(max(facing, 0.05))
    paint = _albedo(colours, looks, row, u, v, footprint)
    return nx, ny, nz, _shade(light, looks[row, 8], looks[row, 9], paint, lamp, px, py, pz, nx, ny, nz, dx, dy, dz)


@_kernel
def _mirrored(view, standing, light, colours, hit, px, py, pz, dx, dy, dz, nx, ny, nz, lamp, stack, entries):
    """Radiance of what stands still that a polished surface mirrors (Schlick's approximation), nothing elsewhere."""
    row = standing.look[hit[1]]
    if standing.looks[row, 11] == 0:
        return BLACK, BLACK, BLACK
    dx, dy, dz = _unit(dx, dy, dz)
    cosine, gloss = -(nx * dx + ny * dy + nz * dz), standing.looks[row, 8]
    share = gloss + (1 - gloss) * (1 - cosine) ** 5
    dx, dy, dz = dx + 2 * cosine * nx, dy + 2 * cosine * ny, dz + 2 * cosine * nz
    # starts a little off the surface, as rays to lamps do
    px, py, pz = px + nx * 1e-4, py + ny * 1e-4, pz + nz * 1e-4
    t, item, second, third = _first_hit(standing, px, py, pz, dx, dy, dz, NOWHERE, stack, entries, False)
    if item < 0:
        return BLACK, BLACK, BLACK
    px, py, pz = px + t * dx, py + t * dy, pz + t * dz
    there = (hit[0] + t, item, second, third)
    nx, ny, nz, shade = _appearance(view, standing, light, colours, there, px, py, pz, dx, dy, dz, lamp)
    r, g, b = shade[0], shade[1], shade[2]
    if shade[4] > 0 and _lit(standing, light, lamp, px, py, pz, nx, ny, nz, stack, entries):
        r, g, b = r + shade[3], g + shade[4], b + shade[5]
    return share * r, share * g, share * b


# Whole pictures. Rows run in parallel; each pixel's sum has a fixed order.


@numba.njit(cache=True, error_model="numpy", parallel=True)
def fill_backdrop(view, standing, light, colours, samples, out):
    for row in numba.prange(view.height):
        stack, entries = np.empty(DEEPEST, np.int32), np.empty(DEEPEST)
        for column in range(view.width):
            _look_centre(view, standing, column, row, out, stack, entries)
            for k in range(samples * samples):
                _look_sample(view, standing, light, colours, samples, column, row, k, out, stack, entries)


@_kernel
def _look_centre(view, standing, column, row, out, stack, entries):
    # a store to an array of a tuple must not stand in the parallel loop itself: Numba drops it there as dead
    dx, dy, dz = _ray(view, column + 0.5, row + 0.5)
    o = view.centre
    t, item, _, _ = _first_hit(standing, o[0], o[1], o[2], dx, dy, dz, NOWHERE, stack, entries, False)
    out.centre_depth[row, column] = t
    out.centre_owner[row, column] = standing.owner[max(item, 0)]


@_inline
def _look_sample(view, standing, light, colours, samples, column, row, k, out, stack, entries):
    dx, dy, dz = _sample_ray(view, column, row, k, samples)
    o = view.centre
    hit = _first_hit(standing, o[0], o[1], o[2], dx, dy, dz, NOWHERE, stack, entries, False)
    out.depth[row, column, k] = hit[0]
    nx, ny, nz, shade = 0.0, 0.0, 1.0, (BLACK, BLACK, BLACK, BLACK, BLACK, BLACK)
    if hit[1] >= 0:
        px, py, pz = o[0] + hit[0] * dx, o[1] + hit[0] * dy, o[2] + hit[0] * dz
        lamp = k % len(light.lamps)
        nx, ny, nz, shade = _appearance(view, standing, light, colours, hit, px, py, pz, dx, dy, dz, lamp)
        if shade[4] > 0 and not _lit(standing, light, lamp, px, py, pz, nx, ny, nz, stack, entries):
            shade = (shade[0], shade[1], shade[2], BLACK, BLACK, BLACK)
        r, g, b = _mirrored(
            view, standing, light, colours, hit, px, py, pz, dx, dy, dz, nx, ny, nz, lamp, stack, entries
        )
        shade = (shade[0] + r, shade[1] + g, shade[2] + b, shade[3], shade[4], shade[5])
    _store(out.normal, row, column, k, nx, ny, nz)
    _store(out.ambient, row, column, k, shade[0], shade[1], shade[2])
    _store(out.key, row, column, k, shade[3], shade[4], shade[5])


@numba.njit(cache=True, error_model="numpy", parallel=True)
def fill_picture(view, backdrop, standing, movers, blockers, light, colours, out):
    count = backdrop.depth.shape[2]
    for row in numba.prange(view.height):
        stack, entries = np.empty(DEEPEST, np.int32), np.empty(DEEPEST)
        for column in range(view.width):
            r, g, b = 0.0, 0.0, 0.0
            for k in range(count):
                sr, sg, sb = _sample(
                    view, backdrop, standing, movers, blockers, light, colours, column, row, k, stack, entries
                )
                r, g, b = r + sr, g + sg, b + sb
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = r / count, g / count, b / count


@_inline
def _triple(values, row, column, k):
    return (
        np.float64(values[row, column, k, 0]),
        np.float64(values[row, column, k, 1]),
        np.float64(values[row, column, k, 2]),
    )


@_inline
def _store(values, row, column, k, x, y, z):
    values[row, column, k, 0], values[row, column, k, 1], values[row, column, k, 2] = x, y, z


@_inline
def _sample(view, backdrop, standing, movers, blockers, light, colours, column, row, k, stack, entries):
    """Radiance along one ray of a pixel."""
    samples = int(np.sqrt(backdrop.depth.shape[2]) + 0.5)
    dx, dy, dz = _sample_ray(view, column, row, k, samples)
    o, behind, lamp = view.centre, np.float64(backdrop.depth[row, column, k]), k % len(light.lamps)
    hit = _first_hit(movers, o[0], o[1], o[2], dx, dy, dz, behind, stack, entries, False)
    t = hit[0]
    px, py, pz = o[0] + t * dx, o[1] + t * dy, o[2] + t * dz
    if hit[1] >= 0:
        nx, ny, nz, shade = _appearance(view, movers, light, colours, hit, px, py, pz, dx, dy, dz, lamp)
        ar, ag, ab, kr, kg, kb = shade
        lit = kg > 0 and _lit(standing, light, lamp, px, py, pz, nx, ny, nz, stack, entries)
    else:
        if t == NOWHERE:
            return BLACK, BLACK, BLACK
        nx, ny, nz = _triple(backdrop.normal, row, column, k)
        ar, ag, ab = _triple(backdrop.ambient, row, column, k)
        kr, kg, kb = _triple(backdrop.key, row, column, k)
        lit = kg > 0
    share = _passing(blockers, px, py, pz, nx, ny, nz)
    if lit and _lit(movers, light, lamp, px, py, pz, nx, ny, nz, stack, entries):
        return ar * share + kr, ag * share + kg, ab * share + kb
    return ar * share, ag * share, ab * share


@numba.njit(cache=True, error_model="numpy", parallel=True)
def fill_hits(view, movers, depth, owner, items, place):
    for row in numba.prange(view.height):
        stack, entries = np.empty(DEEPEST, np.int32), np.empty(DEEPEST)
        o = view.centre
        for column in range(view.width):
            dx, dy, dz = _ray(view, column + 0.5, row + 0.5)
            t, item, u, v = _first_hit(movers, o[0], o[1], o[2], dx, dy, dz, depth[row, column], stack, entries, False)
            x, y, z = 1 - u - v, u, v
            if item >= 0:
                depth[row, column], owner[row, column] = t, movers.owner[item]
                if item < len(movers.kind):
                    x, y, z = _through(movers.inverse, item, o[0] + t * dx, o[1] + t * dy, o[2] + t * dz)
            items[row, column] = item
            place[row, column, 0], place[row, column, 1], place[row, column, 2] = x, y, z


@_kernel
def _point(shapes, item, x, y, z):
    """World point of a place on an item."""
    if item < len(shapes.kind):
        return _through(shapes.matrix, item, x, y, z)
    face = item - len(shapes.kind)
    i, j, k = shapes.triangles[face, 0], shapes.triangles[face, 1], shapes.triangles[face, 2]
    p = shapes.vertices
    return (
        x * p[i, 0] + y * p[j, 0] + z * p[k, 0],
        x * p[i, 1] + y * p[j, 1] + z * p[k, 1],
        x * p[i, 2] + y * p[j, 2] + z * p[k, 2],
    )


@_kernel
def _project(view, px, py, pz):
    """Picture point and depth of a world point; the picture point means nothing where the depth is not positive."""
    x, y, z = px - view.centre[0], py - view.centre[1], pz - view.centre[2]
    r, k = view.rotation, view.intrinsics
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
    u = k[0] * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z) / depth + k[2]
    v = k[1] * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z) / depth + k[3]
    return u, v, depth


@_kernel
def _visible(view, shapes, px, py, pz, stack, entries):
    """Whether none of the shapes hides a world point from the camera."""
    o = view.centre
    # the direction ends at the point, and the point's own surface must not count
    _, item, _, _ = _first_hit(
        shapes, o[0], o[1], o[2], px - o[0], py - o[1], pz - o[2], 1 - 1e-6, stack, entries, True
    )
    return item < 0


@numba.njit(cache=True, error_model="numpy", parallel=True)
def fill_motion(view, depth, items, place, standing, now, later, flow, moves, seen):
    for row in numba.prange(view.height):
        stack, entries = np.empty(DEEPEST, np.int32), np.empty(DEEPEST)
        for column in range(view.width):
            flow[row, column, 0], flow[row, column, 1] = 0.0, 0.0
            moves[row, column], seen[row, column] = False, False
            item, t = items[row, column], depth[row, column]
            if item < 0:
                if t < NOWHERE:
                    dx, dy, dz = _ray(view, column + 0.5, row + 0.5)
                    x, y, z = view.centre[0] + t * dx, view.centre[1] + t * dy, view.centre[2] + t * dz
                    seen[row, column] = _visible(view, later, x, y, z, stack, entries)
                continue
            a, b, c = place[row, column, 0], place[row, column, 1], place[row, column, 2]
            x, y, z = _point(later, item, a, b, c)
            u, v, w = _point(now, item, a, b, c)
            moves[row, column] = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2 > MOVED_M * MOVED_M
            u, v, ahead = _project(view, x, y, z)
            if ahead <= 0:
                continue
            if moves[row, column]:
                flow[row, column, 0], flow[row, column, 1] = u - (column + 0.5), v - (row + 0.5)
            seen[row, column] = (
                0 <= u < view.width
                and 0 <= v < view.height
                and _visible(view, later, x, y, z, stack, entries)
                and _visible(view, standing, x, y, z, stack, entries)
            )
