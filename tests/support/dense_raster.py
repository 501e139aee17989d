"""The rasterizers' reference: every Gaussian at every pixel, in float64, without tiles or termination; and scenes."""

from __future__ import annotations

import numpy as np
import torch

from packuv.camera import PinholeCamera
from packuv.gaussians.floats import Gaussians
from packuv.raster import RasterOptions

OPTIONS = RasterOptions(near=0.05)
BACKGROUND = (0.2, 0.5, 0.9)
FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def sh_colour(degree: int, sh: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    x, y, z = direction.unbind(-1)
    values = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        values += [0.4886025119029199 * v for v in (-y, z, -x)]
    if degree > 1:
        values += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
        values += [0.31539156525252005 * (2 * z * z - x * x - y * y)]
        values += [-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        values += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z]
        values += [-0.4570457994644658 * y * (4 * z * z - x * x - y * y)]
        values += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        values += [-0.4570457994644658 * x * (4 * z * z - x * x - y * y)]
        values += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    basis = torch.stack(values, -1)
    return (torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]]) + 0.5).clamp_min(0)


def rotation_matrices(quaternions: torch.Tensor) -> torch.Tensor:
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).view(-1, 3, 3)


def clamped_slope(slope, centre, focal, size):
    """The local linear map is taken at most 15 % of the picture beyond its edge."""
    return slope.clamp(-(centre + 0.15 * size) / focal, (size - centre + 0.15 * size) / focal)


def ellipses(means, log_scales, quaternions, camera, options):
    """Centres in the picture [N, 2], inverse covariances [N, 2, 2], depth [N]."""
    pose = torch.from_numpy(camera.camera_from_world)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    slopes = (
        clamped_slope(x / z, camera.cx, camera.fx, camera.width),
        clamped_slope(y / z, camera.cy, camera.fy, camera.height),
    )
    o = torch.zeros_like(x)
    rows = [camera.fx / z, o, -camera.fx * slopes[0] / z, o, camera.fy / z, -camera.fy * slopes[1] / z]
    jacobian = torch.stack(rows, -1).view(-1, 2, 3)
    axes = jacobian @ pose[:3, :3] @ (rotation_matrices(quaternions) * log_scales.exp()[:, None, :])
    covariance = axes @ axes.transpose(1, 2) + options.low_pass_px2 * torch.eye(2, dtype=torch.float64)
    centre = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    return centre, torch.linalg.inv(covariance), z


def reference(fields, camera, degree, options=OPTIONS, background=BACKGROUND, shift=0.0):
    """Colour [3, H, W], depth [H, W], alpha [H, W], weights [N], float64; differentiable.

    `shift` [N, 2] moves the centres in the picture.
    """
    means, log_scales, quaternions, logits, sh = fields
    centre, conic, z = ellipses(means, log_scales, quaternions, camera, options)
    eye = torch.from_numpy(camera.centre)
    colour = sh_colour(degree, sh, torch.nn.functional.normalize(means - eye, dim=-1))
    picture, alpha, sums = blend(
        centre + shift, conic, z, torch.sigmoid(logits), torch.cat([colour, z[:, None]], 1), camera, options.near
    )
    behind = torch.tensor(background, dtype=torch.float64)
    return picture[:3] + (1 - alpha) * behind[:, None, None], picture[3], alpha, sums


def blend(centre, conic, z, opacity, values, camera, near):
    """Sums of weight times values [D, H, W], alpha [H, W], weights [N], before black."""
    drawn = torch.nonzero(z >= near)[:, 0]
    order = drawn[torch.argsort(z[drawn], stable=True)]
    ys, xs = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    offset = torch.stack([xs, ys], -1).double().view(1, -1, 2) - centre[order][:, None]
    power = torch.einsum("npi,nij,npj->np", offset, conic[order], offset)
    raw = opacity[order][:, None] * torch.exp(-0.5 * power)
    alpha = torch.where(raw >= 1 / 255, raw.clamp_max(0.99), 0)
    after = torch.cumprod(1 - alpha, 0)
    weight = alpha * torch.cat([torch.ones_like(after[:1]), after[:-1]], 0)
    picture = torch.einsum("np,nd->dp", weight, values[order])
    sums = torch.zeros_like(z).index_put((order,), weight.sum(1))
    shape = (camera.height, camera.width)
    return picture.view(-1, *shape), (1 - after[-1]).view(shape), sums


def camera(width: int = 70, height: int = 50) -> PinholeCamera:
    """Turned by 0.2 rad, four units from the origin."""
    c, s = np.cos(0.2), np.sin(0.2)
    pose = np.array([[c, 0, s, 0.1], [0, 1, 0, -0.05], [-s, 0, c, 4.0], [0, 0, 0, 1.0]])
    return PinholeCamera("test", width, height, 0.9 * width, 0.92 * width, width / 2 + 1.3, height / 2 - 0.7, pose)


def scene(count: int, *, seed: int = 0, size: float = 1.0, spread: float = 1.0, degree: int = 3) -> Gaussians:
    rng = np.random.default_rng(seed)
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.25
    sh[:, 0] *= 3
    arrays = (
        rng.normal(size=(count, 3)) * (1.2, 0.9, 1.0),
        -2.6 + 0.5 * spread * rng.normal(size=(count, 3)) + np.log(size),
        rng.normal(size=(count, 4)),
        rng.normal(size=count) * 1.5,
        sh,
    )
    return Gaussians(*(a.astype(np.float32) for a in arrays))


def upstream(view: PinholeCamera, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random derivatives of some scalar by colour, depth and alpha."""
    rng, shape = np.random.default_rng(seed), (view.height, view.width)
    return tuple(rng.normal(size=s).astype(np.float32) for s in ((3, *shape), shape, shape))
