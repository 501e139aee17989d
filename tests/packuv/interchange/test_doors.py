"""What other programs write and ours does not: infinite values, 2D Gaussians, lists, text, `.splat` and `.ksplat`."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from packuv.gaussians.floats import SH_C0, rows_of
from packuv.gaussians.orbit import OrbitOptions
from packuv.interchange import antialiased, read_gaussians, read_spz, write_ply, write_spz
from packuv.interchange.adopt import ANTIALIASED, AdoptOptions, adopt
from packuv.interchange.conventions import finite
from packuv.interchange.spz import COARSE
from packuv.scene import open_scene, verify_scene
from tests.support.splats import FIELDS, alpha_of, ksplat_bytes, random_gaussians, rotation_error, splat_bytes

SMALL = AdoptOptions(orbit=OrbitOptions(cameras=2, size=(64, 48)))
HYPOTHESIS = {"max_examples": 20, "deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture]}


def room(count=300, degree=0, seed=0):
    gaussians = random_gaussians(count, degree, seed)
    gaussians.log_scales[:] = gaussians.log_scales * 0.3 - 2
    gaussians.sh[:, 1:] *= 0.1
    return gaussians


# Values that are not finite


def test_what_is_finite_stays_and_infinite_values_get_their_meaning():
    gaussians = random_gaussians(20, 1)
    for name in FIELDS:
        assert np.array_equal(getattr(finite(gaussians), name), getattr(gaussians, name))
    gaussians.opacity_logits[:3] = [np.inf, -np.inf, np.nan]
    gaussians.log_scales[3] = [0, -np.inf, -1]
    gaussians.log_scales[4] = -np.inf
    found = finite(gaussians)
    assert np.float32(alpha_of(found)[0]) == 1
    assert np.array_equal(found.opacity_logits[1:3], [-np.inf, np.nan], equal_nan=True)
    assert found.log_scales[3, 1] < -1 - np.log(50)
    assert np.isfinite(found.log_scales).all()


@pytest.mark.parametrize(("name", "value"), [("opacity_logits", np.inf), ("log_scales", -np.inf)])
def test_opaque_and_flat_gaussians_come_over(tmp_path, name, value):
    """Pictures are those of very opaque and very thin ones."""
    truth, like = room(), room()
    getattr(truth, name)[:40].T[-1:] = value
    getattr(like, name)[:40].T[-1:] = 20 if value > 0 else -9
    reports = []
    for label, gaussians in (("a", truth), ("b", like)):
        write_ply(tmp_path / f"{label}.ply", gaussians)
        reports.append(adopt([tmp_path / f"{label}.ply"], tmp_path / f"{label}.mkv", options=SMALL))
    assert [report.broken for report in reports] == [0, 0]
    assert [report.kept_share for report in reports] == [1, 1]
    assert min(reports[0].psnr_db) > 40


def test_what_is_broken_counts_as_lost(tmp_path):
    truth = room(100)
    truth.opacity_logits[:] = 3
    truth.means[:10] = np.nan
    write_ply(tmp_path / "a.ply", truth)
    report = adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=SMALL)
    assert (report.gaussians, report.broken, report.faint, report.kept_share) == (100, 10, 0, 0.9)
    assert np.isclose(report.kept_alpha_share, 0.9, atol=0.002)
    body = bytearray((tmp_path / "a.ply").read_bytes())
    logits = np.frombuffer(body, "<f4", offset=body.index(b"end_header\n") + 11).reshape(100, -1)[:, 9]
    logits[8:14] = [
        -9,
        -np.inf,
        -9,
        -np.inf,
        np.nan,
        np.nan,
    ]  # what nobody would see, broken or not, and what is unknown
    (tmp_path / "a.ply").write_bytes(body)
    report = adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=SMALL)
    assert (report.broken, report.faint, report.kept_share) == (10, 4, 86 / 96)


@pytest.mark.parametrize("value", [-90, -103.3, -1e20])
def test_what_has_no_thickness_as_float32_is_flat_and_spoils_no_range(tmp_path, value):
    flat, like = room(), room()
    flat.log_scales[:, 2], like.log_scales[:, 2] = value, -np.inf
    for label, gaussians in (("a", flat), ("b", like)):
        write_ply(tmp_path / f"{label}.ply", gaussians)
        adopt([tmp_path / f"{label}.ply"], tmp_path / f"{label}.mkv", options=SMALL)
    with open_scene(tmp_path / "a.mkv") as a, open_scene(tmp_path / "b.mkv") as b:
        assert np.array_equal(a.gaussians(0).log_scales, b.gaussians(0).log_scales)


def test_a_size_that_no_number_holds_or_a_rotation_of_no_length_is_broken(tmp_path):
    truth = room(60)
    truth.opacity_logits[:] = 1
    truth.log_scales[3, 0], truth.log_scales[4] = 1e20, 90
    truth.quaternions[5] *= 1e-15
    write_ply(tmp_path / "a.ply", truth)
    report = adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=SMALL)
    assert (report.broken, report.kept_share) == (3, 57 / 60)
    assert min(report.psnr_db) > 40


@pytest.mark.parametrize("value", [3e38, 1e37, -2e30])
def test_what_is_absurd_is_broken(tmp_path, value):
    truth = room(60)
    truth.opacity_logits[:] = 1
    truth.means[3, 0] = truth.sh[5, 0, 1] = value
    write_ply(tmp_path / "a.ply", truth)
    assert adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=SMALL).broken == 2


# Strays


def test_strays_do_not_set_the_range_of_colours(tmp_path):
    """Some colours far beyond white: the others keep theirs, and a display shows no difference."""
    truth = room(500)
    truth.sh[:] = np.clip(truth.sh, -1.5, 1.5)
    truth.sh[:4] = 1000
    write_ply(tmp_path / "a.ply", truth)
    report = adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=SMALL)
    with open_scene(tmp_path / "a.mkv") as scene:
        span = scene.header.quantizer.high[7:] - scene.header.quantizer.low[7:]
    assert (span < 2 / SH_C0).all()
    assert report.saturated >= 4 * 3


def test_colours_without_strays_keep_their_ends(tmp_path):
    truth = room(500)
    write_ply(tmp_path / "a.ply", truth)
    adopt([tmp_path / "a.ply"], tmp_path / "a.mkv", options=SMALL)
    with open_scene(tmp_path / "a.mkv") as scene:
        assert np.isclose(scene.header.quantizer.high[7:].max(), truth.sh.max(), atol=0.05)


def test_spz_leaves_out_a_stray_that_makes_all_others_coarse(tmp_path):
    truth = room(500)
    truth.log_scales[:] -= 2
    truth.opacity_logits[:] = 1
    write_spz(tmp_path / "near.spz", truth)
    truth.means[7] = [1e5, 0, 0]
    assert write_spz(tmp_path / "a.spz", truth) == 499
    others = np.arange(500) != 7
    assert np.array_equal(read_spz(tmp_path / "a.spz").means, read_spz(tmp_path / "near.spz").means[others])
    truth.means[7] = [100, 0, 0]  # far, but a step is still finer than what is there
    assert COARSE * np.exp(np.median(truth.log_scales)) > 2.0**-16
    assert write_spz(tmp_path / "b.spz", truth) == 500


def test_what_is_spread_wide_is_kept_whole(tmp_path):
    truth = room(500)
    truth.opacity_logits[:] = 1
    truth.means[:] *= 1e4
    assert write_spz(tmp_path / "a.spz", truth) == 500


# Sequences


def test_an_empty_frame_is_a_frame(tmp_path):
    full = room(50)
    full.opacity_logits[:] = 2
    frames = [full, rows_of(full, slice(0, 0)), rows_of(full, slice(0, 0)), full]
    for order in (frames, frames[::-1], frames[1:]):
        paths = []
        for number, frame in enumerate(order):
            paths.append(tmp_path / f"{number}.ply")
            write_ply(paths[-1], frame)
        report = adopt(paths, tmp_path / "a.mkv", options=replace(SMALL, compared_frames=4))
        assert (report.frames, report.empty, report.kept_share) == (len(order), 2, 1)
        assert verify_scene(tmp_path / "a.mkv").ok
        with open_scene(tmp_path / "a.mkv") as scene:
            counts = [int((scene.codes(k).attributes[:, 6] > 0).sum()) for k in range(len(order))]
        assert counts == [len(frame) for frame in order]


def test_cameras_see_where_a_sequence_goes(tmp_path):
    paths = []
    for number in range(3):
        frame = room(200)
        frame.means[:, 0] += 20 * number
        paths.append(tmp_path / f"{number}.ply")
        write_ply(paths[-1], frame)
    adopt(paths, tmp_path / "a.mkv", options=SMALL)
    with open_scene(tmp_path / "a.mkv") as scene:
        for number in range(3):
            means = scene.gaussians(number).means
            for camera in scene.header.cameras:
                pixel, depth = camera.project(means)
                inside = ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all(axis=1) & (depth > 0)
                assert inside.mean() > 0.8


# PLY of other programs


def as_text(path, gaussians):
    """The same PLY as text."""
    write_ply(path, gaussians)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    columns = header.count(b"property")
    rows = np.frombuffer(body, "<f4").reshape(-1, columns)
    lines = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
    path.write_bytes(header.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode() + b"\n")


@settings(**HYPOTHESIS)
@given(st.integers(0, 20), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_text_reads_as_the_same_numbers(tmp_path, count, degree, seed):
    gaussians = random_gaussians(count, degree, seed)
    as_text(tmp_path / "a.ply", gaussians)
    found = read_gaussians(tmp_path / "a.ply")
    for name in FIELDS:
        assert np.array_equal(getattr(found, name), getattr(gaussians, name))


def test_text_that_is_cut_short_is_refused(tmp_path):
    as_text(tmp_path / "a.ply", random_gaussians(5, 0))
    lines = (tmp_path / "a.ply").read_text().splitlines()
    (tmp_path / "b.ply").write_text("\n".join([*lines[:-2], "", *lines[-2:]]))  # blank lines are none
    assert len(read_gaussians(tmp_path / "b.ply")) == 5
    for text, message in (
        ("\n".join(lines[:-1]), "needs 5 lines"),
        ("\n".join(lines[:-5]), "needs 5 lines"),
        ("\n".join(lines)[:-20], "must hold 5 lines"),
    ):
        (tmp_path / "b.ply").write_text(text + "\n")
        with pytest.raises(ValueError, match=message):
            read_gaussians(tmp_path / "b.ply")


FACES = b"element face %d\nproperty list uchar int vertex_indices\nproperty float weight\n"


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("text", [False, True])
def test_faces_are_passed_over(tmp_path, first, text):
    gaussians = random_gaussians(6, 1)
    (as_text if text else write_ply)(tmp_path / "a.ply", gaussians)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    faces = b"3 0 1 2 0.5\n" * 4 if text else (b"\3" + np.arange(3, dtype="<i4").tobytes() + b"\0\0\0?") * 4
    if first:
        header, body = header.replace(b"element vertex", FACES % 4 + b"element vertex"), faces + body
    else:
        header, body = header + FACES % 4, body + faces
    (tmp_path / "b.ply").write_bytes(header + b"end_header\n" + body)
    found = read_gaussians(tmp_path / "b.ply")
    for name in FIELDS:
        assert np.array_equal(getattr(found, name), getattr(gaussians, name))


def test_lists_of_different_lengths_before_the_gaussians_are_named(tmp_path):
    write_ply(tmp_path / "a.ply", random_gaussians(6, 0))
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    header = header.replace(b"element vertex", b"element face 2\nproperty list uchar int of\nelement vertex")
    (tmp_path / "a.ply").write_bytes(header + b"end_header\n" + b"\1\0\0\0\0\0" + bytes(4) + body)
    with pytest.raises(ValueError, match="lists of different lengths"):
        read_gaussians(tmp_path / "a.ply")


def test_two_dimensional_gaussians_are_flat(tmp_path):
    gaussians = random_gaussians(9, 0)
    gaussians.log_scales[:, 2] = -7.5
    write_ply(tmp_path / "a.ply", gaussians)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.split(b"\n") if line.startswith(b"property")]
    rows = np.frombuffer(body, "<f4").reshape(9, -1)[:, [name != b"scale_2" for name in names]]
    content = header.replace(b"property float scale_2\n", b"") + b"end_header\n" + rows.tobytes()
    (tmp_path / "a.ply").write_bytes(content)
    found = read_gaussians(tmp_path / "a.ply")
    assert np.array_equal(found.log_scales[:, :2], gaussians.log_scales[:, :2])
    assert (found.log_scales[:, 2] < found.log_scales[:, :2].min(axis=1) - 4).all()


def test_bands_above_the_third_are_left_out_where_asked_for(tmp_path):
    gaussians = random_gaussians(9, 4)
    write_ply(tmp_path / "a.ply", gaussians)
    with pytest.raises(ValueError, match=r"degree 4, but a scene holds 3 at most; --sh-degree 3"):
        read_gaussians(tmp_path / "a.ply")
    assert np.array_equal(read_gaussians(tmp_path / "a.ply", sh_degree=3).sh, gaussians.sh[:, :16])


# Files of web viewers


def assert_read(found, truth, position, scale, sh):
    assert np.abs(found.means - truth.means).max(initial=0) <= position
    assert np.abs(found.log_scales - truth.log_scales).max(initial=0) <= scale
    assert rotation_error(found, truth).max(initial=0) < 0.02
    assert np.abs(alpha_of(found) - alpha_of(truth)).max(initial=0) <= 0.5 / 255 + 1e-6
    colour = np.clip(truth.sh[:, 0], -0.5 / SH_C0, 0.5 / SH_C0)
    assert np.abs(found.sh[:, 0] - colour).max(initial=0) <= 0.5 / 255 / SH_C0 + 1e-5
    assert found.sh.shape[1] == truth.sh.shape[1]
    assert np.abs(found.sh[:, 1:] - truth.sh[:, 1:]).max(initial=0) <= sh


@settings(**HYPOTHESIS)
@given(st.integers(0, 40), st.integers(0, 2**32 - 1))
def test_splat_is_read_within_its_steps(tmp_path, count, seed):
    truth = random_gaussians(count, 0, seed)
    (tmp_path / "a.splat").write_bytes(splat_bytes(truth))
    assert_read(read_gaussians(tmp_path / "a.splat"), truth, 0, 1e-6, 0)


@settings(**HYPOTHESIS)
@given(st.integers(2, 40), st.integers(0, 3), st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_ksplat_is_read_within_its_steps(tmp_path, count, degree, level, seed):
    truth = random_gaussians(count, degree, seed)
    truth.sh[:] = np.clip(truth.sh, -2.4, 2.4)
    truth.means[:] = np.clip(truth.means, -1.2, 1.2)
    content, order = ksplat_bytes(truth, level)
    (tmp_path / "a.ksplat").write_bytes(content)
    steps = ((0, 1e-6, 0), (1e-4, 1e-3, 2e-3), (1e-4, 1e-3, 2.5 / 255 + 1e-5))[level]
    assert_read(read_gaussians(tmp_path / "a.ksplat"), rows_of(truth, order), *steps)


@pytest.mark.parametrize("level", range(3))
def test_ksplat_may_have_empty_sections(tmp_path, level):
    truth = random_gaussians(2, 1)
    content, order = ksplat_bytes(truth, level, sections=3)
    (tmp_path / "a.ksplat").write_bytes(content)
    found = read_gaussians(tmp_path / "a.ksplat")
    assert len(found) == 2
    assert rotation_error(found, rows_of(truth, order)).max() < 0.02


@settings(**HYPOTHESIS)
@given(st.data())
def test_files_of_web_viewers_that_are_cut_short_are_refused(tmp_path, data):
    gaussians = random_gaussians(11, 1)
    suffix, whole = data.draw(
        st.sampled_from([(".splat", splat_bytes(gaussians)), (".ksplat", ksplat_bytes(gaussians, 1)[0])])
    )
    size = data.draw(st.integers(1, len(whole) - 1).filter(lambda size: suffix == ".ksplat" or size % 32))
    (tmp_path / f"a{suffix}").write_bytes(whole[:size])
    with pytest.raises(ValueError, match=f"a{suffix} must "):
        read_gaussians(tmp_path / f"a{suffix}")


# Marks


def test_the_mark_of_mip_splatting_stays(tmp_path):
    gaussians = room()
    for smooth in (False, True):
        write_spz(tmp_path / "a.spz", gaussians, antialiased=smooth)
        assert antialiased(tmp_path / "a.spz") is smooth
        report = adopt([tmp_path / "a.spz"], tmp_path / "a.mkv", options=SMALL)
        assert report.antialiased is smooth
        with open_scene(tmp_path / "a.mkv") as scene:
            assert scene.header.extra.get(ANTIALIASED, False) is smooth
