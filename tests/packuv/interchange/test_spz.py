"""SPZ: round trips, the bytes that the format's own library writes, the other versions, a real file."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.gaussians.codes import OPACITY_RANGE
from packuv.gaussians.floats import Gaussians, rotation_matrices, rows_of
from packuv.interchange import read_gaussians, read_spz, write_spz
from packuv.interchange.conventions import half_turn as turned_to
from packuv.raster import RasterOptions, render
from tests.support.needs import needs_data
from tests.support.places import DATA
from tests.support.splats import FIELDS, alpha_of, random_gaussians, rotation_error

SPLATS = DATA / "splats"
# Two of the three stored components err by half a step of 0.7071 / 511, and the largest, at least 0.5, makes up for it.
ROTATION_V3 = 0.0025
ROTATION_V2 = 0.015  # 8 bits for -1..1, and w from the rest, which is worst where w is near 0
SH_STEP = {1: 8 / 128, 2: 16 / 128, 3: 16 / 128}
"""Values between codes by degree of the coefficient"""


def degrees(coefficients):
    return np.repeat([1, 2, 3], [3, 5, 7])[:coefficients]


def assert_near(back, truth):
    """Within half a step of every encoding."""
    reach = np.abs(truth.means).max(initial=1)
    assert np.abs(back.means - truth.means).max(initial=0) <= 0.501 * max(2.0**-20, 4 * reach / 2**23) + reach * 1e-7
    scales = np.clip(truth.log_scales, -10, 5.9375)
    assert np.abs(back.log_scales - scales).max(initial=0) <= 0.501 / 16
    assert np.abs(alpha_of(back) - alpha_of(truth)).max(initial=0) <= 0.501 / 255
    colour = np.clip(truth.sh[:, 0], -0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(back.sh[:, 0] - colour).max(initial=0) <= 0.501 / 255 / 0.15
    steps = np.array([SH_STEP[d] for d in degrees(truth.sh.shape[1] - 1)])[:, None]
    higher = np.clip(truth.sh[:, 1:], -1, 1)
    # Codes stop at 255, or at the last whole step below: 1 is cut to 1 less a step.
    assert (np.abs(back.sh[:, 1:] - higher) <= np.where(np.abs(higher) > 1 - steps, 1.01, 0.501) * steps).all()


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 60), st.integers(0, 3), st.integers(0, 2**32 - 1), st.sampled_from([0.01, 1.0, 300.0, 9e5]))
def test_what_is_written_is_read_within_half_a_step(tmp_path, count, degree, seed, size):
    truth = random_gaussians(count, degree, seed)
    truth.means[:] *= size
    truth.sh[:, 1:] *= 0.4
    assert write_spz(tmp_path / "a.spz", truth) == write_spz(tmp_path / "b.spz", truth, version=3) == count
    back, older = (read_spz(tmp_path / name) for name in ("a.spz", "b.spz"))
    assert all(np.array_equal(getattr(back, name), getattr(older, name)) for name in FIELDS)
    assert back.sh_degree == degree
    assert_near(back, truth)
    assert rotation_error(back, truth).max(initial=0) < ROTATION_V3
    for name in FIELDS:
        assert getattr(back, name).dtype == np.float32


def test_writing_again_changes_no_byte(tmp_path):
    truth = random_gaussians(50, 3)
    write_spz(tmp_path / "a.spz", truth)
    first = read_spz(tmp_path / "a.spz")
    write_spz(tmp_path / "b.spz", first)
    second = read_spz(tmp_path / "b.spz")
    for name in ("means", "log_scales", "sh", "opacity_logits"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    write_spz(tmp_path / "c.spz", first)
    assert (tmp_path / "b.spz").read_bytes() == (tmp_path / "c.spz").read_bytes()


def test_absent_gaussians_are_left_out(tmp_path):
    gaussians = random_gaussians(4, 0)
    gaussians.opacity_logits[:] = [OPACITY_RANGE[0], 0, OPACITY_RANGE[0], 1]
    assert write_spz(tmp_path / "a.spz", gaussians) == 2


def test_positions_that_do_not_fit_are_refused(tmp_path):
    gaussians = random_gaussians(2, 0)
    gaussians.means[0, 0] = 1e7
    with pytest.raises(ValueError, match="positions up to 8388607 units"):
        write_spz(tmp_path / "a.spz", gaussians)
    assert not list(tmp_path.iterdir())


def test_one_gaussian_byte_by_byte(tmp_path):
    """Values whose codes the format's documentation gives by hand."""
    gaussian = Gaussians(
        np.array([[1.0, -2.0, 0.5]], np.float32),
        np.array([[-10.0, 0.0, 5.0]], np.float32),
        np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.array([0.0], np.float32),
        np.array([[[0.0, 1.0, -1.0]]], np.float32),
    )
    write_spz(tmp_path / "a.spz", gaussian, version=3)
    body = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<4sIIBBBB", body)
    assert (magic, version, count, degree, flags, reserved) == (b"NGSP", 3, 1, 0, 0, 0)
    x, y, z = (int.from_bytes(body[16 + 3 * k : 19 + 3 * k], "little", signed=True) / 2**bits for k in range(3))
    assert (x, y, z) == (1.0, 2.0, -0.5)  # x right, y up, z back
    assert body[25] == 128  # alpha one half
    assert list(body[26:29]) == [128, 166, 89]  # 127.5, 127.5 + 38.25, 127.5 - 38.25
    assert list(body[29:32]) == [0, 160, 240]
    assert struct.unpack("<I", body[32:36])[0] == 3 << 30  # x y z w: w is the largest, the rest is 0
    assert len(body) == 36


# The other axes


def half_turn(gaussians):
    """The same scene in the other axes, exactly: y and z change sign. No SH above band 0."""
    flip = np.array([1, -1, -1], np.float32)
    turned = np.array([[0, 1, 0, 0]], np.float32)  # a half turn about x: w x y z
    return Gaussians(
        gaussians.means * flip,
        gaussians.log_scales,
        times(turned, gaussians.quaternions),
        gaussians.opacity_logits,
        gaussians.sh.copy(),
    )


def times(a, b):
    """Product of quaternions w x y z."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    ).astype(np.float32)


def test_the_axes_of_the_file_are_a_half_turn_about_x(tmp_path):
    """Our reader, told nothing of axes, must see in the file the ellipsoids of the turned scene."""
    truth = random_gaussians(30, 0, seed=3)
    write_spz(tmp_path / "a.spz", truth, version=3)
    body = gzip.decompress((tmp_path / "a.spz").read_bytes())
    bits = body[13]
    wide = np.frombuffer(body[16 : 16 + 9 * 30], np.uint8).reshape(90, 3).astype(np.int64) @ (1, 256, 65536)
    points = (np.where(wide >= 2**23, wide - 2**24, wide) / 2.0**bits).reshape(30, 3)
    turned = half_turn(truth)
    assert np.abs(points - turned.means).max() < 1e-5
    back = read_spz(tmp_path / "a.spz")
    turn = np.diag([1.0, -1.0, -1.0])
    covariances = [
        np.einsum("nij,nj,nkj->nik", r, np.exp(2 * g.log_scales.astype(np.float64)), r)
        for g in (back, turned)
        for r in [rotation_matrices(g.quaternions.astype(np.float64))]
    ]
    assert np.allclose(turn @ covariances[0] @ turn, covariances[1], rtol=0.1, atol=0.1)


def test_signs_of_sh_are_those_of_the_half_turned_view():
    """A coefficient's sign is that of its basis function in the mirrored direction: colours seen stay the same."""
    rng = np.random.default_rng(0)
    gaussian = random_gaussians(1, 3)
    gaussian.means[:], gaussian.log_scales[:], gaussian.opacity_logits[:] = 0, -0.5, 6
    gaussian.sh[:, 0], gaussian.sh[:, 1:] = 0, rng.normal(size=(1, 15, 3)) * 0.2
    gaussian.quaternions[:] = [1, 0, 0, 0]
    turned = turned_to(gaussian)
    turned.quaternions[:] = [1, 0, 0, 0]
    for seed in range(5):
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[2, 3] = 4
        other = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        pictures = [
            render(g, PinholeCamera("c", 32, 32, 30, 30, 16, 16, p), options=RasterOptions(near=0.1)).colour
            for g, p in ((gaussian, pose), (turned, other))
        ]
        assert pictures[0].max() > 0.05
        assert np.abs(pictures[0] - pictures[1]).max() < 1e-5  # float32 sums


# Other versions, and damage


def stored_streams(truth, path):
    write_spz(path, truth, version=3)
    body = gzip.decompress(path.read_bytes())
    sizes = np.cumsum([9, 1, 3, 3, 4, 3 * ((truth.sh_degree + 1) ** 2 - 1)]) * len(truth)
    return body[:16], [body[16 + a : 16 + b] for a, b in zip([0, *sizes[:-1]], sizes, strict=True)]


def write_version_4(path, header, streams):
    packed = [pa.compress(stream, "zstd", asbytes=True) for stream in streams if stream]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, [s for s in streams if s], strict=True))
    start = header[:4] + struct.pack("<I", 4) + header[8:15] + bytes([len(packed)]) + struct.pack("<I", 32) + bytes(12)
    path.write_bytes(start + table + b"".join(packed))


@pytest.mark.parametrize("degree", [0, 2])
def test_version_4_holds_the_same(tmp_path, degree):
    truth = random_gaussians(20, degree)
    header, streams = stored_streams(truth, tmp_path / "a.spz")
    write_version_4(tmp_path / "b.spz", header, streams)
    a, b = read_spz(tmp_path / "a.spz"), read_spz(tmp_path / "b.spz")
    for name in FIELDS:
        assert np.array_equal(getattr(a, name), getattr(b, name))


def test_version_2_keeps_x_y_z_of_the_rotation(tmp_path):
    truth = random_gaussians(20, 1)
    header, streams = stored_streams(truth, tmp_path / "a.spz")
    vector = truth.quaternions[:, 1:] * np.where(truth.quaternions[:, :1] < 0, -1, 1) * (1, -1, -1)
    streams[4] = np.rint(vector * 127.5 + 127.5).astype(np.uint8).tobytes()
    (tmp_path / "b.spz").write_bytes(gzip.compress(header[:4] + struct.pack("<I", 2) + header[8:] + b"".join(streams)))
    back = read_spz(tmp_path / "b.spz")
    assert_near(back, rows_of(truth, slice(None)))
    steady = np.abs(truth.quaternions[:, 0]) > 0.3
    assert rotation_error(back, truth)[steady].max() < ROTATION_V2


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_file_cut_or_changed_anywhere_is_read_or_refused_in_one_sentence(tmp_path, data):
    header, streams = stored_streams(random_gaussians(9, 1), tmp_path / "a.spz")
    write_version_4(tmp_path / "b.spz", header, streams)
    whole = (tmp_path / data.draw(st.sampled_from(["a.spz", "b.spz"]))).read_bytes()
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    if damaged:
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    (tmp_path / "c.spz").write_bytes(damaged)
    problem = "c.spz"
    try:
        read_spz(tmp_path / "c.spz")
    except ValueError as error:
        problem = str(error)
    assert "c.spz" in problem


@pytest.mark.parametrize("lost", [1, 4, 8])
def test_a_file_that_lost_its_checksum_is_cut_short(tmp_path, lost):
    write_spz(tmp_path / "a.spz", random_gaussians(30, 1), version=3)
    (tmp_path / "a.spz").write_bytes((tmp_path / "a.spz").read_bytes()[:-lost])
    with pytest.raises(ValueError, match="the end of its gzip stream, with the checksum, is missing"):
        read_spz(tmp_path / "a.spz")


def test_what_it_cannot_hold_is_said(tmp_path):
    header, streams = stored_streams(random_gaussians(2, 0), tmp_path / "a.spz")
    body = b"".join(streams)
    for place, value, message in ((12, 4, "SH of degree 4"), (14, 2, "extensions"), (4, 9, "version 1 to 4")):
        changed = bytearray(header + body)
        changed[place] = value
        (tmp_path / "b.spz").write_bytes(gzip.compress(changed))
        with pytest.raises(ValueError, match=message):
            read_gaussians(tmp_path / "b.spz")


def test_a_file_that_is_not_packed_as_its_version_says_is_told_so(tmp_path):
    header, streams = stored_streams(random_gaussians(2, 0), tmp_path / "a.spz")
    (tmp_path / "b.spz").write_bytes(header + b"".join(streams))
    with pytest.raises(ValueError, match="version 3 is one gzip stream, but this file is not packed by gzip"):
        read_gaussians(tmp_path / "b.spz")


@needs_data(SPLATS)
def test_one_scene_in_two_formats_is_one_scene():
    """biker.spz (version 4) and biker.compressed.ply were made from one training, row by row."""
    a, b = read_gaussians(SPLATS / "biker.spz"), read_gaussians(SPLATS / "biker.compressed.ply")
    assert len(a) == len(b) == 152746
    assert np.abs(a.means - b.means).max() < 2 / 4096  # 12 fractional bits
    assert np.quantile(np.abs(alpha_of(a) - alpha_of(b)), 0.99) <= 1 / 255
    assert np.quantile(np.abs(a.sh - b.sh), 0.99) < 0.03  # one step of colour is 0.026
    covariances = [
        np.einsum("nij,nj,nkj->nik", r, np.exp(2 * g.log_scales.astype(np.float64)), r)
        for g in (a, b)
        for r in [rotation_matrices(g.quaternions.astype(np.float64))]
    ]
    error = np.linalg.norm(covariances[0] - covariances[1], axis=(1, 2)) / np.linalg.norm(covariances[1], axis=(1, 2))
    assert np.median(error) < 0.05  # a step of scale, 1/16, is 6 % of it and 13 % of the variance
    assert np.quantile(error, 0.99) < 0.15
