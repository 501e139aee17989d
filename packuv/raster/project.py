"""From Gaussians in the world to ellipses in the picture, and the gradients back (EWA splatting).

Scalar code in double precision: the determinant of a large ellipse leaves the range of float32. An invalid Gaussian is
skipped and counted: an attribute that is not finite, a position beyond `MAX_LENGTH` or a scale beyond
`MAX_LOG_SCALE`, a colour beyond `MAX_COLOUR`, a quaternion of length zero.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from packuv.gaussians.floats import ALPHA_MIN, DRAWN_LOGIT
from packuv.kernels.compile import kernel
from packuv.kernels.simd import ALL, load, store, zeros
from packuv.raster import ewa
from packuv.raster.sh import basis, direction_gradient
from packuv.raster.view import (
    MAX_COLOUR,
    MAX_LENGTH,
    MAX_LOG_SCALE,
    VIEW_CENTRE,
    VIEW_CX,
    VIEW_CY,
    VIEW_FX,
    VIEW_FY,
    VIEW_HEIGHT,
    VIEW_LOW_PASS,
    VIEW_NEAR,
    VIEW_SLOPES,
    VIEW_WIDTH,
)

CHUNKS = 64
"""Pieces of work of a loop over Gaussians; fixed, so that no result depends on the number of threads."""

# Columns of a record: one Gaussian as the blending needs it, a cache line of 16 float32.
# alpha = 2 ** (8 (LOG_OPACITY + XX dx^2 + XY dx dy + YY dy^2)), the argument that `simd.exp2_8` takes
X, Y, XX, XY, YY, LOG_OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
# The outline where alpha = 1/255, for the exact test of rows of pixels against it:
SHEAR, INVERSE_XX, INVERSE_VARIANCE_Y, REACH = range(10, 14)
RECORD = 16


EXPONENT_UNIT = 8.0
_LOG2E = 1.4426950408889634
_LOG_ALPHA_MIN = math.log(ALPHA_MIN)
_REACH_MAX = -2 * _LOG_ALPHA_MIN
_f32 = np.float32
_FAST = frozenset({"contract", "nsz"})


_in_camera, _linear_map, _rotation, _screen_axes, _covariance = (
    kernel(inline=True, fastmath=_FAST)(function)
    for function in (ewa.in_camera, ewa.linear_map, ewa.rotation, ewa.screen_axes, ewa.covariance)
)


@kernel(inline=True, fastmath=_FAST)
def is_valid(means, log_scales, quaternions, logits, i):
    length = max(abs(means[i, 0]), max(abs(means[i, 1]), abs(means[i, 2])))
    size = max(log_scales[i, 0], max(log_scales[i, 1], log_scales[i, 2]))
    # One sum finds every value that is not finite; in double precision finite float32 values cannot overflow it.
    total = np.float64(means[i, 0]) + means[i, 1] + means[i, 2] + logits[i]
    total += np.float64(log_scales[i, 0]) + log_scales[i, 1] + log_scales[i, 2]
    square = 0.0
    for k in range(4):
        square += np.float64(quaternions[i, k]) * quaternions[i, k]
    return math.isfinite(total + square) and length <= MAX_LENGTH and size <= MAX_LOG_SCALE and square > 1e-24


@kernel(inline=True, fastmath=_FAST)
def _touches(view, x, y, half_x, half_y, active_sum, box, i):
    """Write the tiles [x0, y0, x1, y1], both ends included, that a box of pixels touches; False if none is active."""
    # Clamped before they become integers, which far positions would overflow.
    x0, x1 = max(x - half_x - 0.5, 0.0), min(x + half_x - 0.5, view[VIEW_WIDTH] - 1)
    y0, y1 = max(y - half_y - 0.5, 0.0), min(y + half_y - 0.5, view[VIEW_HEIGHT] - 1)
    if not (x0 <= x1 and y0 <= y1):
        return False
    left, top = np.int64(math.ceil(x0)), np.int64(math.ceil(y0))  # on CUDA ceil is a float
    right, bottom = int(x1), int(y1)
    if left > right or top > bottom:
        return False
    c0, r0, c1, r1 = left >> 4, top >> 4, right >> 4, bottom >> 4
    box[i, 0], box[i, 1], box[i, 2], box[i, 3] = c0, r0, c1, r1
    inside = active_sum[r1 + 1, c1 + 1] - active_sum[r0, c1 + 1] - active_sum[r1 + 1, c0] + active_sum[r0, c0]
    return inside > 0


@kernel(inline=True, fastmath=_FAST)
def _direction(view, means, i):
    """Unit vector from the camera to a Gaussian, world, and one over the distance."""
    x, y, z = means[i, 0] - view[VIEW_CENTRE], means[i, 1] - view[VIEW_CENTRE + 1], means[i, 2] - view[VIEW_CENTRE + 2]
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return _f32(x * inverse), _f32(y * inverse), _f32(z * inverse), inverse


@kernel(inline=True, fastmath=_FAST)
def colour(view, means, sh, degree, values, record, i):
    """Write max(0, 0.5 + SH); False if it is not a usable number. `values` is scratch, float32 [16]."""
    x, y, z, _ = _direction(view, means, i)
    basis(degree, x, y, z, values)
    r = g = b = _f32(0.5)
    for k in range((degree + 1) * (degree + 1)):
        r += values[k] * sh[i, k, 0]
        g += values[k] * sh[i, k, 1]
        b += values[k] * sh[i, k, 2]
    record[i, RED], record[i, GREEN], record[i, BLUE] = max(r, _f32(0)), max(g, _f32(0)), max(b, _f32(0))
    return abs(r) <= MAX_COLOUR and abs(g) <= MAX_COLOUR and abs(b) <= MAX_COLOUR


@kernel(inline=True, fastmath=_FAST)
def project_one(means, log_scales, quaternions, logits, view, active_sum, record, box, i):
    """Fill the record (but for the colour) and the box of one valid Gaussian; False if it is not drawn."""
    x, y, z = _in_camera(view, means[i, 0], means[i, 1], means[i, 2])
    if not (z >= view[VIEW_NEAR] and logits[i] >= DRAWN_LOGIT):
        return False
    inverse_z = 1.0 / z
    u, v = x * inverse_z, y * inverse_z
    px, py = view[VIEW_FX] * u + view[VIEW_CX], view[VIEW_FY] * v + view[VIEW_CY]
    (a, b, c, d), axes = _linear_map(view, u, v, inverse_z)
    # A circle around the largest ellipse that these scales allow spares most Gaussians that are not drawn the rest.
    size = math.exp(max(log_scales[i, 0], max(log_scales[i, 1], log_scales[i, 2])))
    bound = math.sqrt(_REACH_MAX * ((a * a + b * b + c * c + d * d) * size * size + view[VIEW_LOW_PASS]))
    if not _touches(view, px, py, bound, bound, active_sum, box, i):
        return False
    q0, q1, q2, q3, _ = _unit(quaternions, i)
    s0, s1, s2 = math.exp(log_scales[i, 0]), math.exp(log_scales[i, 1]), math.exp(log_scales[i, 2])
    xx, xy, yy, determinant = _covariance(
        _screen_axes(axes, _rotation(q0, q1, q2, q3), s0, s1, s2), view[VIEW_LOW_PASS]
    )
    log_opacity = -math.log1p(math.exp(-np.float64(logits[i])))
    reach = max(2.0 * (log_opacity - _LOG_ALPHA_MIN), 0.0)
    if not _touches(view, px, py, math.sqrt(reach * xx), math.sqrt(reach * yy), active_sum, box, i):
        return False
    record[i, X], record[i, Y], record[i, DEPTH] = px, py, z
    scale = _LOG2E / EXPONENT_UNIT / determinant
    record[i, XX], record[i, XY], record[i, YY] = -0.5 * scale * yy, scale * xy, -0.5 * scale * xx
    record[i, LOG_OPACITY] = log_opacity * _LOG2E / EXPONENT_UNIT
    record[i, SHEAR], record[i, INVERSE_VARIANCE_Y], record[i, REACH] = -xy / yy, 1.0 / yy, reach
    record[i, INVERSE_XX] = min(determinant / yy, 1e30)
    return True


@kernel(inline=True, fastmath=_FAST)
def _unit(quaternions, i):
    """The unit quaternion, and one over the length of the given one."""
    w, x, y, z = (
        np.float64(quaternions[i, 0]),
        np.float64(quaternions[i, 1]),
        np.float64(quaternions[i, 2]),
        np.float64(quaternions[i, 3]),
    )
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel(parallel=True, fastmath=_FAST)
def project(means, log_scales, quaternions, logits, sh, degree, view, active_sum, record, box, cells, invalid):
    """Fill records [N, 16], boxes [N, 4] (tiles) and `cells` [N], the number of tiles in the box, 0 if not drawn.

    `active_sum` [tiles_y + 1, tiles_x + 1] is the summed-area table of the active tiles; `invalid` [CHUNKS] receives
    how many Gaussians were skipped as invalid.
    """
    count = means.shape[0]
    for chunk in prange(CHUNKS):
        values = np.empty(16, np.float32)
        bad = 0
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            cells[i] = 0
            if not is_valid(means, log_scales, quaternions, logits, i):
                bad += 1
            elif project_one(means, log_scales, quaternions, logits, view, active_sum, record, box, i):
                if colour(view, means, sh, degree, values, record, i):
                    cells[i] = (box[i, 2] - box[i, 0] + 1) * (box[i, 3] - box[i, 1] + 1)
                else:
                    bad += 1
        invalid[chunk] = bad


# -- gradients ------------------------------------------------------------------------------------------------------


@kernel(inline=True)
def _sum_pairs(partial, used, begin, end, out):
    """Sum the partial gradients of one Gaussian over its tiles, in their order; False if no tile drew it."""
    total = zeros(ALL)
    hit = False
    for slot in range(begin, end):
        if used[slot] != 0:
            hit = True
            total = total + load(partial, slot * RECORD)
    store(out, 0, total)
    return hit


@kernel(inline=True, fastmath=_FAST)
def colour_gradient(view, means, sh, degree, record, g, values, d_values, d_sh, i):
    """Write the gradient of the coefficients; return that of the position through the viewing direction."""
    x, y, z, inverse = _direction(view, means, i)
    basis(degree, x, y, z, values)
    r = g[6] if record[i, RED] > 0 else _f32(0)
    gr = g[7] if record[i, GREEN] > 0 else _f32(0)
    b = g[8] if record[i, BLUE] > 0 else _f32(0)
    for k in range((degree + 1) * (degree + 1)):
        d_sh[i, k, 0], d_sh[i, k, 1], d_sh[i, k, 2] = values[k] * r, values[k] * gr, values[k] * b
        d_values[k] = r * sh[i, k, 0] + gr * sh[i, k, 1] + b * sh[i, k, 2]
    for k in range((degree + 1) * (degree + 1), sh.shape[1]):
        d_sh[i, k, 0], d_sh[i, k, 1], d_sh[i, k, 2] = _f32(0), _f32(0), _f32(0)
    gx, gy, gz = direction_gradient(degree, x, y, z, d_values)
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse


@kernel(inline=True, fastmath=_FAST)
def _axes_gradient(m, a, b, c, g):
    """Gradient of M [2, 3] by rows, from the inverse covariance and the moments of the exponent's gradient."""
    ga, gb, gc = -0.5 * g[3], -0.5 * g[4], -0.5 * g[5]
    t00, t01, t10, t11 = a * ga + b * gb, a * gb + b * gc, b * ga + c * gb, b * gb + c * gc
    k00, k01, k11 = -(t00 * a + t01 * b), -(t00 * b + t01 * c), -(t10 * b + t11 * c)
    return (
        2 * (k00 * m[0] + k01 * m[3]), 2 * (k00 * m[1] + k01 * m[4]), 2 * (k00 * m[2] + k01 * m[5]),
        2 * (k01 * m[0] + k11 * m[3]), 2 * (k01 * m[1] + k11 * m[4]), 2 * (k01 * m[2] + k11 * m[5]),
    )  # fmt: skip


@kernel(inline=True, fastmath=_FAST)
def _quaternion_gradient(w, x, y, z, d, u):
    """Gradient of the unit quaternion, from d = dL/d(U R) [2, 3] and U [2, 3]."""
    r00, r01, r02 = u[0] * d[0] + u[3] * d[3], u[0] * d[1] + u[3] * d[4], u[0] * d[2] + u[3] * d[5]
    r10, r11, r12 = u[1] * d[0] + u[4] * d[3], u[1] * d[1] + u[4] * d[4], u[1] * d[2] + u[4] * d[5]
    r20, r21, r22 = u[2] * d[0] + u[5] * d[3], u[2] * d[1] + u[5] * d[4], u[2] * d[2] + u[5] * d[5]
    gw = 2 * (x * (r21 - r12) + y * (r02 - r20) + z * (r10 - r01))
    gx = 2 * (-2 * x * (r11 + r22) + y * (r01 + r10) + z * (r02 + r20) + w * (r21 - r12))
    gy = 2 * (x * (r01 + r10) - 2 * y * (r00 + r22) + z * (r12 + r21) + w * (r02 - r20))
    gz = 2 * (x * (r02 + r20) + y * (r12 + r21) - 2 * z * (r00 + r11) + w * (r10 - r01))
    along = gw * w + gx * x + gy * y + gz * z
    return gw - along * w, gx - along * x, gy - along * y, gz - along * z


@kernel(inline=True, fastmath=_FAST)
def _map_gradient(view, d, r):
    """Gradient of the four entries of the projection's Jacobian, from d = dL/d(U R) and the rotation R."""
    e0, e1, e2 = (
        d[0] * r[0] + d[1] * r[1] + d[2] * r[2],
        d[0] * r[3] + d[1] * r[4] + d[2] * r[5],
        d[0] * r[6] + d[1] * r[7] + d[2] * r[8],
    )
    e3, e4, e5 = (
        d[3] * r[0] + d[4] * r[1] + d[5] * r[2],
        d[3] * r[3] + d[4] * r[4] + d[5] * r[5],
        d[3] * r[6] + d[4] * r[7] + d[5] * r[8],
    )
    return (
        e0 * view[0] + e1 * view[1] + e2 * view[2], e0 * view[6] + e1 * view[7] + e2 * view[8],
        e3 * view[3] + e4 * view[4] + e5 * view[5], e3 * view[6] + e4 * view[7] + e5 * view[8],
    )  # fmt: skip


@kernel(inline=True, fastmath=_FAST)
def _point_gradient(view, u, v, inverse_z, d_depth, screen, jacobian, d_jacobian):
    """Gradient of the position, world, from those of the depth, the picture's position and the Jacobian."""
    px, py = screen[0] * view[VIEW_FX] * inverse_z, screen[1] * view[VIEW_FY] * inverse_z
    pz = d_depth - px * u - py * v
    a, c, b, d = jacobian
    pz -= (d_jacobian[0] * a + d_jacobian[1] * c + d_jacobian[2] * b + d_jacobian[3] * d) * inverse_z
    if view[VIEW_SLOPES] < u < view[VIEW_SLOPES + 1]:
        through = -a * inverse_z * d_jacobian[1]
        px, pz = px + through, pz - through * u
    if view[VIEW_SLOPES + 2] < v < view[VIEW_SLOPES + 3]:
        through = -b * inverse_z * d_jacobian[3]
        py, pz = py + through, pz - through * v
    return (
        view[0] * px + view[3] * py + view[6] * pz,
        view[1] * px + view[4] * py + view[7] * pz,
        view[2] * px + view[5] * py + view[8] * pz,
    )


@kernel(inline=True, fastmath=_FAST)
def project_one_backward(
    means, log_scales, quaternions, logits, view, g, d_log_scales, d_quaternions, d_logits, d_screen, i
):
    """Write every gradient of one Gaussian but those through its colour; return that of its position."""
    x, y, z = _in_camera(view, means[i, 0], means[i, 1], means[i, 2])
    inverse_z = 1.0 / z
    u, v = x * inverse_z, y * inverse_z
    jacobian, axes = _linear_map(view, u, v, inverse_z)
    q0, q1, q2, q3, inverse = _unit(quaternions, i)
    r = _rotation(q0, q1, q2, q3)
    s0, s1, s2 = math.exp(log_scales[i, 0]), math.exp(log_scales[i, 1]), math.exp(log_scales[i, 2])
    m = _screen_axes(axes, r, s0, s1, s2)
    xx, xy, yy, determinant = _covariance(m, view[VIEW_LOW_PASS])
    scale = 1.0 / determinant
    a, b, c = yy * scale, -xy * scale, xx * scale
    screen = a * g[1] + b * g[2], b * g[1] + c * g[2]
    d_screen[i, 0], d_screen[i, 1] = screen[0], screen[1]
    d = _axes_gradient(m, a, b, c, g)
    d_log_scales[i, 0], d_log_scales[i, 1] = d[0] * m[0] + d[3] * m[3], d[1] * m[1] + d[4] * m[4]
    d_log_scales[i, 2] = d[2] * m[2] + d[5] * m[5]
    d = d[0] * s0, d[1] * s1, d[2] * s2, d[3] * s0, d[4] * s1, d[5] * s2
    h = _quaternion_gradient(q0, q1, q2, q3, d, axes)
    d_quaternions[i, 0], d_quaternions[i, 1] = h[0] * inverse, h[1] * inverse
    d_quaternions[i, 2], d_quaternions[i, 3] = h[2] * inverse, h[3] * inverse
    d_logits[i] = g[0] / (1.0 + math.exp(np.float64(logits[i])))  # d alpha / d logit = alpha (1 - opacity)
    return _point_gradient(view, u, v, inverse_z, g[9], screen, jacobian, _map_gradient(view, d, r))


@kernel(inline=True, fastmath=_FAST)
def clear(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i):
    d_means[i, :] = _f32(0)
    d_log_scales[i, :] = _f32(0)
    d_quaternions[i, :] = _f32(0)
    d_logits[i] = _f32(0)
    d_screen[i, :] = _f32(0)
    d_sh[i, :, :] = _f32(0)


@kernel(inline=True, fastmath=_FAST)
def is_finite(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i):
    total = np.float64(d_logits[i]) + d_screen[i, 0] + d_screen[i, 1]
    for k in range(3):
        total += np.float64(d_means[i, k]) + d_log_scales[i, k] + d_quaternions[i, k] + d_sh[i, 0, k]
    return math.isfinite(total + d_quaternions[i, 3])


@kernel(parallel=True, fastmath=_FAST)
def project_backward(means, log_scales, quaternions, logits, sh, degree, view, record, rows, first_pair, used, partial,
                     d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, overflown):  # fmt: skip
    """Reduce the partial gradients, flat [pairs * 16], of every chosen Gaussian and carry them to its parameters.

    Rows that are not chosen or not drawn are zero; so are rows whose gradient overflows, and those are counted in
    `overflown` [CHUNKS].
    """
    count = means.shape[0]
    for chunk in prange(CHUNKS):
        values, d_values, g = np.empty(16, np.float32), np.empty(16, np.float32), np.empty(16, np.float32)
        bad = 0
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            if rows[i] == 0 or not _sum_pairs(partial, used, first_pair[i], first_pair[i + 1], g):
                clear(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i)
                continue
            x, y, z = project_one_backward(
                means, log_scales, quaternions, logits, view, g, d_log_scales, d_quaternions, d_logits, d_screen, i
            )
            cx, cy, cz = colour_gradient(view, means, sh, degree, record, g, values, d_values, d_sh, i)
            d_means[i, 0], d_means[i, 1], d_means[i, 2] = x + cx, y + cy, z + cz
            if not is_finite(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i):
                clear(d_means, d_log_scales, d_quaternions, d_logits, d_sh, d_screen, i)
                bad += 1
        overflown[chunk] = bad
