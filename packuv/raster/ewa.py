"""One Gaussian seen by one camera: its ellipse in the picture (EWA splatting).

Scalar functions that every kernel shares. Each module compiles them for itself, since renderers may contract multiply
and add where labels, which a GPU counts too, must not; they are `inline`, so numba's cache never mixes the two. A
`view` is what `view_constants` makes.
"""

from __future__ import annotations

from packuv.raster.view import VIEW_FX, VIEW_FY, VIEW_SLOPES


def in_camera(view, x, y, z):
    """A world point on the camera's axes."""
    return (
        view[0] * x + view[1] * y + view[2] * z + view[9],
        view[3] * x + view[4] * y + view[5] * z + view[10],
        view[6] * x + view[7] * y + view[8] * z + view[11],
    )


def linear_map(view, u, v, inverse_z):
    """Jacobian of the projection at slopes u = x / z and v = y / z (its four entries that are not zero), and the same
    after the camera's rotation, [2, 3] by rows."""
    u = min(max(u, view[VIEW_SLOPES]), view[VIEW_SLOPES + 1])
    v = min(max(v, view[VIEW_SLOPES + 2]), view[VIEW_SLOPES + 3])
    a, b = view[VIEW_FX] * inverse_z, view[VIEW_FY] * inverse_z
    c, d = -a * u, -b * v
    return (a, c, b, d), (
        a * view[0] + c * view[6], a * view[1] + c * view[7], a * view[2] + c * view[8],
        b * view[3] + d * view[6], b * view[4] + d * view[7], b * view[5] + d * view[8],
    )  # fmt: skip


def rotation(w, x, y, z):
    """Rotation matrix of a unit quaternion, by rows."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


def screen_axes(u, r, s0, s1, s2):
    """The three axes of a Gaussian in the picture, pixels: M = U R S, [2, 3] by rows."""
    return (
        s0 * (u[0] * r[0] + u[1] * r[3] + u[2] * r[6]),
        s1 * (u[0] * r[1] + u[1] * r[4] + u[2] * r[7]),
        s2 * (u[0] * r[2] + u[1] * r[5] + u[2] * r[8]),
        s0 * (u[3] * r[0] + u[4] * r[3] + u[5] * r[6]),
        s1 * (u[3] * r[1] + u[4] * r[4] + u[5] * r[7]),
        s2 * (u[3] * r[2] + u[4] * r[5] + u[5] * r[8]),
    )


def covariance(m, low_pass):
    """xx, xy, yy of M M^T plus the low-pass filter, pixels^2, and the determinant.

    The determinant is |row0 x row1|^2 + low_pass * trace - low_pass^2 (Lagrange): a thin ellipse cancels nothing.
    """
    xx = m[0] * m[0] + m[1] * m[1] + m[2] * m[2] + low_pass
    xy = m[0] * m[3] + m[1] * m[4] + m[2] * m[5]
    yy = m[3] * m[3] + m[4] * m[4] + m[5] * m[5] + low_pass
    n0, n1, n2 = m[1] * m[5] - m[2] * m[4], m[2] * m[3] - m[0] * m[5], m[0] * m[4] - m[1] * m[3]
    return xx, xy, yy, n0 * n0 + n1 * n1 + n2 * n2 + low_pass * (xx + yy) - low_pass * low_pass
