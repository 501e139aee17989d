"""Real spherical harmonics up to degree 3, in the convention of 3D Gaussian Splatting."""

from __future__ import annotations

import numpy as np

from packuv.kernels.compile import kernel

MAX_DEGREE = 3

_f32 = np.float32
_C0 = _f32(0.28209479177387814)
_C1 = _f32(0.4886025119029199)
_C2 = tuple(_f32(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
_C3 = tuple(
    _f32(c) for c in (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
)
_2, _3, _4, _6, _8 = _f32(2), _f32(3), _f32(4), _f32(6), _f32(8)


@kernel(inline=True)
def basis(degree, x, y, z, out):
    """Write the (degree + 1) ** 2 basis values of the unit vector (x, y, z), float32, to `out` [16]."""
    out[0] = _C0
    if degree > 0:
        out[1], out[2], out[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        out[4], out[5], out[7] = _C2[0] * x * y, -_C2[0] * y * z, -_C2[0] * x * z
        out[6] = _C2[1] * (_2 * z * z - x * x - y * y)
        out[8] = _C2[2] * (x * x - y * y)
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        out[9] = -_C3[0] * y * (_3 * xx - yy)
        out[10] = _C3[1] * x * y * z
        out[11] = -_C3[2] * y * (_4 * zz - xx - yy)
        out[12] = _C3[3] * z * (_2 * zz - _3 * xx - _3 * yy)
        out[13] = -_C3[2] * x * (_4 * zz - xx - yy)
        out[14] = _C3[4] * z * (xx - yy)
        out[15] = -_C3[0] * x * (xx - _3 * yy)


@kernel(inline=True)
def direction_gradient(degree, x, y, z, d):
    """Gradient with respect to (x, y, z), from that with respect to the basis values, `d` [16]."""
    gx, gy, gz = _f32(0), _f32(0), _f32(0)
    if degree > 0:
        gx, gy, gz = -_C1 * d[3], -_C1 * d[1], _C1 * d[2]
    if degree > 1:
        gx += _C2[0] * (y * d[4] - z * d[7]) + _2 * x * (_C2[2] * d[8] - _C2[1] * d[6])
        gy += _C2[0] * (x * d[4] - z * d[5]) - _2 * y * (_C2[2] * d[8] + _C2[1] * d[6])
        gz += -_C2[0] * (y * d[5] + x * d[7]) + _4 * _C2[1] * z * d[6]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        gx += -_C3[0] * (_6 * x * y * d[9] + _3 * (xx - yy) * d[15]) + _C3[1] * y * z * d[10]
        gx += _C3[2] * (_2 * x * y * d[11] - (_4 * zz - _3 * xx - yy) * d[13])
        gx += -_6 * _C3[3] * x * z * d[12] + _2 * _C3[4] * x * z * d[14]
        gy += -_C3[0] * (_3 * (xx - yy) * d[9] - _6 * x * y * d[15]) + _C3[1] * x * z * d[10]
        gy += _C3[2] * (_2 * x * y * d[13] - (_4 * zz - xx - _3 * yy) * d[11])
        gy += -_6 * _C3[3] * y * z * d[12] - _2 * _C3[4] * y * z * d[14]
        gz += _C3[1] * x * y * d[10] - _8 * _C3[2] * z * (y * d[11] + x * d[13])
        gz += _3 * _C3[3] * (_2 * zz - xx - yy) * d[12] + _C3[4] * (xx - yy) * d[14]
    return gx, gy, gz
