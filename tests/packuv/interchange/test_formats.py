import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from packuv.gaussians.codes import OPACITY_RANGE
from packuv.gaussians.floats import rows_of
from packuv.interchange import (
    CHUNK,
    DRAWN_LOGIT,
    SH_C0,
    WRITTEN,
    read_gaussians,
    read_ply,
    write_compressed_ply,
    write_gaussians,
    write_ply,
)
from tests.support.needs import needs_data
from tests.support.places import DATA
from tests.support.splats import FIELDS, alpha_of, random_gaussians, rotation_error

SPLATS = DATA / "splats"


def header_of(path):
    return path.read_bytes().split(b"end_header\n")[0].decode().splitlines()


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 50), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_what_is_written_is_read_exactly(tmp_path, count, degree, seed):
    gaussians = random_gaussians(count, degree, seed)
    assert write_ply(tmp_path / "a.ply", gaussians) == count
    back = read_ply(tmp_path / "a.ply")
    assert back.sh_degree == degree
    for name in FIELDS:
        assert getattr(back, name).dtype == np.float32
        assert np.array_equal(getattr(back, name), getattr(gaussians, name))


def test_the_header_is_that_of_3d_gaussian_splatting(tmp_path):
    write_ply(tmp_path / "a.ply", random_gaussians(3, 1))
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert header_of(tmp_path / "a.ply") == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 3",
        *(f"property float {name}" for name in names),
    ]


def test_higher_bands_run_channel_by_channel(tmp_path):
    gaussians = random_gaussians(1, 1)
    gaussians.sh[0] = [[0, 1, 2], [10, 20, 30], [11, 21, 31], [12, 22, 32]]  # [coefficient, r g b]
    write_ply(tmp_path / "a.ply", gaussians)
    body = np.frombuffer(tmp_path.joinpath("a.ply").read_bytes().split(b"end_header\n", 1)[1], "<f4")
    assert body[6:18].tolist() == [0, 1, 2, 10, 11, 12, 20, 21, 22, 30, 31, 32]
    assert body[3:6].tolist() == [0, 0, 0]


def test_absent_gaussians_are_left_out(tmp_path):
    gaussians = random_gaussians(4, 0)
    gaussians.opacity_logits[:] = [OPACITY_RANGE[0], 0.0, DRAWN_LOGIT - 1e-3, DRAWN_LOGIT + 1e-3]
    assert write_ply(tmp_path / "a.ply", gaussians) == 2
    assert np.array_equal(read_ply(tmp_path / "a.ply").means, gaussians.means[[1, 3]])


def test_columns_are_found_by_name_in_any_order_and_type(tmp_path):
    gaussians = random_gaussians(5, 0)
    write_ply(tmp_path / "a.ply", gaussians)
    names = [line.split()[2] for line in header_of(tmp_path / "a.ply")[3:]]
    body = np.frombuffer(tmp_path.joinpath("a.ply").read_bytes().split(b"end_header\n", 1)[1], "<f4").reshape(5, -1)
    kept = [name for name in names if not name.startswith("n")][::-1]
    table = np.zeros(5, [("label", ">u1"), *((name, ">f8") for name in kept)])
    for name in kept:
        table[name] = body[:, names.index(name)]
    header = ["ply", "format binary_big_endian 1.0", "comment by a test", "element vertex 5", "property uchar label"]
    header += [*(f"property double {name}" for name in kept), "end_header\n"]
    (tmp_path / "b.ply").write_bytes("\n".join(header).encode() + table.tobytes())
    back = read_ply(tmp_path / "b.ply")
    for name in FIELDS:
        assert np.array_equal(getattr(back, name), getattr(gaussians, name))


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_file_cut_anywhere_is_refused(tmp_path, data):
    write_ply(tmp_path / "a.ply", random_gaussians(7, 1))
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(ValueError, match=r"cut\.ply"):
        read_ply(tmp_path / "cut.ply")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((b"ply\n", b"plx\n"), "not a PLY file"),
        ((b"binary_little_endian", b"binary_middle_endian"), "export it as a binary PLY"),
        ((b"binary_little_endian", b"ascii"), "must hold 2 lines of"),
        ((b"float opacity", b"float opacitx"), r"lacks the columns \['opacity'\]"),
        ((b"float f_rest_0", b"float g_rest_0"), "8 columns"),
        ((b"element vertex", b"element point"), "no element vertex"),
        ((b"property float x", b"property list uchar int x"), "this one has a list"),
        ((b"property float x", b"property long x"), "no header line"),
    ],
)
def test_what_is_no_ply_of_gaussians_is_refused(tmp_path, change, message):
    write_ply(tmp_path / "a.ply", random_gaussians(2, 1))
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(*change))
    with pytest.raises(ValueError, match=message):
        read_ply(tmp_path / "a.ply")


def test_a_missing_file_is_reported_as_such(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_ply(tmp_path / "missing.ply")


# Compressed PLY


def pack(share, bits):
    """Shares 0..1 [n, k] into one uint32 [n], first column in the top bits."""
    packed = np.zeros(len(share), np.uint32)
    for column, width in zip(share.T, bits, strict=True):
        packed = packed << np.uint32(width) | np.rint(column * (2**width - 1)).astype(np.uint32)
    return packed


def write_compressed(path, gaussians, alpha, sh_codes):
    """One chunk; ranges -3..3 for everything that has one."""

    def share(values):
        return (values + 3) / 6

    largest = np.abs(gaussians.quaternions).argmax(axis=1)
    rows = np.arange(len(largest))
    q = gaussians.quaternions * np.sign(gaussians.quaternions[rows, largest])[:, None]
    others = np.array([np.delete(row, k) for row, k in zip(q, largest, strict=True)])
    rotation = largest.astype(np.uint32) << 30 | pack(others / np.sqrt(2) + 0.5, (10, 10, 10))
    rgb = gaussians.sh[:, 0] * SH_C0 + 0.5
    vertex = np.stack(
        [
            pack(share(gaussians.means), (11, 10, 11)),
            rotation,
            pack(share(gaussians.log_scales), (11, 10, 11)),
            pack(np.concatenate([share(rgb), alpha[:, None]], axis=1), (8, 8, 8, 8)),
        ],
        axis=1,
    ).astype("<u4")
    ranges = [f"{end}_{name}" for kind in ("xyz", "s", "rgb") for end in ("min", "max") for name in kind]
    ranges = [name if "_s" not in name else f"{name[:3]}_scale_{axis}" for name in ranges for axis in _axes(name)]
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1"]
    header += [f"property float {name}" for name in ranges]
    header += [f"element vertex {len(vertex)}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    header += [f"element sh {len(vertex)}", *(f"property uchar f_rest_{k}" for k in range(9)), "end_header\n"]
    chunk = np.array([-3 if name.startswith("min") else 3 for name in ranges], "<f4")
    path.write_bytes("\n".join(header).encode() + chunk.tobytes() + vertex.tobytes() + sh_codes.tobytes())


def _axes(name):
    return "xyz" if name.endswith("_s") else "-"


def test_a_compressed_ply_is_read_within_its_own_precision(tmp_path):
    rng = np.random.default_rng(1)
    gaussians = random_gaussians(CHUNK, 1, seed=1)
    for name in ("means", "log_scales"):
        np.clip(getattr(gaussians, name), -3, 3, out=getattr(gaussians, name))
    alpha, sh_codes = rng.random(CHUNK), rng.integers(0, 256, (CHUNK, 9), np.uint8)
    write_compressed(tmp_path / "a.ply", gaussians, alpha, sh_codes)
    back = read_ply(tmp_path / "a.ply")
    assert np.abs(back.means - gaussians.means).max() <= 3.001 / 1023  # half of the coarsest step, 10 bits
    assert np.abs(back.log_scales - gaussians.log_scales).max() <= 3.001 / 1023
    sign = np.sign((back.quaternions * gaussians.quaternions).sum(axis=1, keepdims=True))
    # Three components err by at most half of sqrt(2) / 1023, and the largest, at least 0.5, makes up for it.
    assert np.linalg.norm(sign * back.quaternions - gaussians.quaternions, axis=1).max() < 0.0025
    assert np.abs(back.sh[:, 0] - gaussians.sh[:, 0]).max() <= 3.001 / 255 / SH_C0
    visible = (alpha > 0.01) & (alpha < 0.99)
    assert np.abs(1 / (1 + np.exp(-back.opacity_logits[visible])) - alpha[visible]).max() <= 0.501 / 255
    expected = ((sh_codes + 0.5) / 256 - 0.5) * 8
    expected[sh_codes == 0], expected[sh_codes == 255] = -4, 4
    assert np.allclose(back.sh[:, 1:].transpose(0, 2, 1).reshape(CHUNK, 9), expected, atol=1e-6)


def in_written_order(gaussians, written):
    """The rows of `gaussians` as a compressed PLY sorted them: nearest by position and scale."""
    ours, theirs = (np.concatenate([g.means, g.log_scales], axis=1) for g in (gaussians, written))
    rows = np.linalg.norm(ours[None] - theirs[:, None], axis=2).argmin(axis=1)
    assert len(set(rows.tolist())) == len(rows)
    return rows_of(gaussians, rows)


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 600), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_a_compressed_ply_that_is_written_is_read_within_its_own_precision(tmp_path, count, degree, seed):
    gaussians = random_gaussians(count, degree, seed)
    gaussians.means[:] *= 50  # far apart, so that the nearest is the same
    assert write_compressed_ply(tmp_path / "a.compressed.ply", gaussians) == count
    back = read_ply(tmp_path / "a.compressed.ply")
    assert (len(back), back.sh_degree) == (count, degree)
    if not count:
        return
    truth = in_written_order(gaussians, back)
    for start in range(0, count, CHUNK):
        part = slice(start, start + CHUNK)
        for name in ("means", "log_scales"):
            a, b = getattr(truth, name)[part], getattr(back, name)[part]
            # Half of the coarsest step, 10 bits of the chunk's range, and float32 rounding of the range.
            assert (np.abs(a - b) <= 0.501 / 1023 * np.ptp(a, axis=0) + 1e-5).all()
        colour = truth.sh[part, 0]
        assert (np.abs(colour - back.sh[part, 0]) <= 0.501 / 255 * np.ptp(colour, axis=0) + 1e-5).all()
    assert rotation_error(truth, back).max() < 0.0025  # as for a file of SuperSplat's, above
    assert np.abs(alpha_of(truth) - alpha_of(back)).max() <= 0.501 / 255
    inside = np.clip(truth.sh[:, 1:], -4 + 8 / 256, 4 - 8 / 256)
    assert np.abs(inside - np.clip(back.sh[:, 1:], -4 + 8 / 256, 4 - 8 / 256)).max(initial=0) <= 4.001 / 256


def test_a_chunk_of_equal_gaussians_and_wild_scales_stay_finite(tmp_path):
    gaussians = random_gaussians(3, 0)
    gaussians.means[:], gaussians.log_scales[:] = gaussians.means[0], [-np.inf, 3, np.inf]
    write_compressed_ply(tmp_path / "a.compressed.ply", gaussians)
    back = read_ply(tmp_path / "a.compressed.ply")
    assert np.array_equal(back.means, gaussians.means)
    assert np.allclose(back.log_scales, [-20, 3, 20], atol=40 / 1023)


@pytest.mark.parametrize("kind", [kind for kind in WRITTEN if kind.door.read])
def test_every_format_is_found_again_by_its_name_and_written_whole(tmp_path, kind):
    gaussians = random_gaussians(40, 1)
    gaussians.opacity_logits[:7] = OPACITY_RANGE[0]
    path = tmp_path / f"a{kind.suffix}"
    assert write_gaussians(path, gaussians, kind=kind) == 33
    assert len(read_gaussians(path)) == 33
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    with pytest.raises(FileNotFoundError, match="no folder"):
        write_gaussians(tmp_path / "missing" / "a.ply", gaussians, kind=kind)


def test_what_is_no_splat_file_is_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match="no splat file"):
        read_gaussians(tmp_path / "a.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0")
    for path in (tmp_path, tmp_path / "a.obj"):
        with pytest.raises(ValueError, match=r"no splat file that we read: \.ply, \.spz, \.sog"):
            read_gaussians(path)


@needs_data(SPLATS)
@pytest.mark.parametrize(("name", "count"), [("biker", 152746), ("guitar", 90854)])
def test_trained_scenes_are_read(tmp_path, name, count):
    scene = read_ply(SPLATS / f"{name}.compressed.ply")
    assert len(scene) == count
    assert np.abs(np.linalg.norm(scene.quaternions, axis=1) - 1).max() < 1e-5
    assert write_ply(tmp_path / "a.ply", scene) == (scene.opacity_logits >= DRAWN_LOGIT).sum()
