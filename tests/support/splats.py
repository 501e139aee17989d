"""Gaussians to write into files, for the tests of packuv.interchange."""

import struct

import numpy as np

from packuv.gaussians.floats import SH_C0, Gaussians, arrays

FIELDS = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def random_gaussians(count, degree, seed=0):
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (degree + 1) ** 2, 3)]
    means, scales, quaternions, opacity, sh = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Gaussians(means, scales, quaternions, opacity, sh)


def wall(degree):
    """Large opaque Gaussians that cover a picture from the origin along z, of colours far from both limits."""
    rng, count = np.random.default_rng(0), 600
    means = rng.uniform([-4, -3, 3], [4, 3, 5], (count, 3))
    sh = rng.uniform(-0.02, 0.02, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = (rng.uniform(0.15, 0.65, (count, 3)) - 0.5) / SH_C0
    values = means, np.full((count, 3), np.log(0.4)), rng.normal(size=(count, 4)), np.full(count, 6.0), sh
    return Gaussians(*(value.astype(np.float32) for value in values))


def alpha_of(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def rotation_error(a, b):
    """Distance between unit quaternions, either sign, [n]."""
    sign = np.where((a.quaternions * b.quaternions).sum(axis=1, keepdims=True) < 0, -1, 1)
    return np.linalg.norm(sign * a.quaternions - b.quaternions, axis=1)


# Files that are only read, written from their description


def colour_bytes(gaussians):
    """r g b alpha, uint8 [n, 4]."""
    share = np.column_stack([0.5 + SH_C0 * gaussians.sh[:, 0], alpha_of(gaussians)])
    return np.rint(np.clip(share, 0, 1) * 255).astype(np.uint8)


def splat_bytes(gaussians):
    """A `.splat` file."""
    rows = [
        np.column_stack([gaussians.means, np.exp(gaussians.log_scales)]).astype("<f4").view(np.uint8),
        colour_bytes(gaussians),
        np.clip(np.rint(gaussians.quaternions * 128 + 128), 0, 255).astype(np.uint8),
    ]
    return np.concatenate(rows, axis=1).tobytes()


def ksplat_bytes(gaussians, level, *, bucket=8, block=5.0, sections=2):
    """A `.ksplat` file of version 0.1; rows are in buckets of neighbours along x, the last of a section not full."""
    order = np.argsort(gaussians.means[:, 0], kind="stable")
    parts = np.array_split(order, sections)
    header = bytearray(4096)
    header[:2] = b"\0\1"
    struct.pack_into("<IIII", header, 4, sections, sections, len(order), len(order))
    struct.pack_into("<H", header, 20, level)
    struct.pack_into("<ff", header, 36, -2.5, 2.5)
    headers, bodies = b"", b""
    for part in parts:
        said, body = _ksplat_section(Gaussians(*(array[part] for array in arrays(gaussians))), level, bucket, block)
        headers, bodies = headers + said, bodies + body
    return bytes(header) + headers + bodies, order


def _ksplat_section(gaussians, level, bucket, block):
    count, degree = len(gaussians), gaussians.sh_degree
    full, rest = divmod(count, bucket)
    buckets = full + (rest > 0)
    header = bytearray(1024)
    struct.pack_into("<II", header, 0, count, count)
    struct.pack_into("<H", header, 40, degree)
    bands = [gaussians.sh[:, low:high].transpose(0, 2, 1) for low, high in ((1, 4), (4, 9), (9, 16))]
    sh = np.concatenate([band.reshape(count, 3 * band.shape[2]) for band in bands], axis=1)
    kind = "<f2" if level else "<f4"
    means, before = gaussians.means.astype("<f4"), b""
    if level:
        struct.pack_into("<IIfH", header, 8, bucket, buckets, block, 12)
        struct.pack_into("<I", header, 24, 32767)
        struct.pack_into("<II", header, 32, full, int(rest > 0))
        of_row = np.arange(count) // bucket
        centres = np.array([gaussians.means[of_row == k].mean(axis=0) for k in range(buckets)]).reshape(-1, 3)
        means = np.rint((gaussians.means - centres[of_row]) * (32767 / (block / 2)) + 32767).astype("<u2")
        before = (struct.pack("<I", rest) if rest else b"") + centres.astype("<f4").tobytes()
    coded = np.rint((np.clip(sh, -2.5, 2.5) + 2.5) / 5 * 255).astype(np.uint8) if level == 2 else sh.astype(kind)
    parts = [
        means,
        np.exp(gaussians.log_scales).astype(kind),
        gaussians.quaternions.astype(kind),
        colour_bytes(gaussians),
    ]
    rows = [
        np.frombuffer(part.tobytes(), np.uint8).reshape(count, part.nbytes // max(count, 1)) for part in (*parts, coded)
    ]
    return bytes(header), before + np.concatenate(rows, axis=1).tobytes()
