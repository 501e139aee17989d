"""Frames on their way out: every format, row by row, parts, light, and what other people's programs read."""

from __future__ import annotations

import json
import struct
import zipfile
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from packuv.colour import linear_from_srgb, srgb_from_linear
from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.floats import SH_C0, drawn, lit_gaussians, opacity, rows_of
from packuv.interchange import DOORS, WRITTEN, SplatFormat, antialiased, format_of, read_gaussians, write_gaussians
from packuv.interchange.clip import Baking, Clip, ClipOptions, Part, baking_error
from packuv.interchange.conventions import half_turn, is_drawn, rows_out
from packuv.interchange.sog_writer import _codebook, _groups
from packuv.scene import Sound, open_scene
from packuv.scene.sound import RATE
from pipelines.cli import SPLAT_FORMATS
from tests.support.needs import needs
from tests.support.small_scene import FRAMES, MOVING, ROWS, small_scene, small_segments
from tests.support.splats import FIELDS, alpha_of, random_gaussians, rotation_error

FRAME_FORMATS = [kind for kind in WRITTEN if kind.door.write and kind.door.read]
ROTATION = {SplatFormat.SOG: 0.0081, SplatFormat.SPLAT: 0.017}
"""Distance of unit quaternions: three components of 8 bits over sqrt(2), four of 8 bits over -1..1"""
needs_usd = needs("usd", find_spec("pxr"), "no usd-core; pip install 'packuv[usd]'")
needs_fourdgs = needs("fourdgs", find_spec("fourdgs"), "no fourdgs; pip install 'packuv[4dgs]'")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("out") / "a.mkv")


def soft(count, degree, seed=0):
    """Random Gaussians within what every format holds."""
    gaussians = random_gaussians(count, degree, seed)
    gaussians.sh[:, 0], gaussians.log_scales[:] = np.clip(gaussians.sh[:, 0], -1.7, 1.7), gaussians.log_scales - 2
    gaussians.sh[:, 1:] *= 0.2
    gaussians.opacity_logits[:] = np.clip(gaussians.opacity_logits, -4, 4)
    return gaussians


# The table


def test_the_command_offers_what_is_written():
    assert tuple(WRITTEN) == SPLAT_FORMATS
    assert all(door.lacks for kind, door in DOORS.items() if kind in WRITTEN)


def test_names_tell_formats(tmp_path):
    for kind in WRITTEN:
        assert format_of(tmp_path / f"a{kind.suffix}") == (SplatFormat.SPZ if kind == SplatFormat.SPZ_3 else kind)
    assert format_of(tmp_path / "a.usda") == SplatFormat.USD
    assert format_of(tmp_path / "a.txt") is None


@pytest.mark.parametrize("kind", [SplatFormat.USD, SplatFormat.FOURDGS, SplatFormat.KSPLAT])
def test_what_holds_no_single_frame_says_so(tmp_path, kind):
    with pytest.raises(ValueError, match="no format that one frame is written in"):
        write_gaussians(tmp_path / "a", soft(3, 0), kind=kind)


# Rows


@pytest.mark.parametrize("kind", FRAME_FORMATS)
def test_kept_rows_are_the_same_gaussians(tmp_path, kind):
    """Row N comes back as row N, absent ones with alpha 0, and without a stray setting ranges."""
    truth = soft(600, 1)
    truth.opacity_logits[::5] = -9
    truth.means[5] = 1e6  # absent, and far away
    path = tmp_path / f"a{kind.suffix}"
    assert write_gaussians(path, truth, kind=kind, keep_rows=True) == 480
    back = read_gaussians(path)
    shown = is_drawn(truth)
    assert len(back) == 600
    assert np.array_equal(is_drawn(back), shown)
    assert np.abs(back.means - truth.means)[shown].max() < 0.01


def test_rows_of_a_clip_are_those_of_the_scene(scene):
    with open_scene(scene) as opened:
        clip = Clip(opened, range(FRAMES), ClipOptions(keep_rows=True))
        for number, gaussians in enumerate(clip):
            assert all(np.array_equal(getattr(gaussians, n), getattr(opened.gaussians(number), n)) for n in FIELDS)
        assert clip.segments == [0, 0, 0, 1, 1, 1]
        assert clip.drawn == sum(len(drawn(opened.gaussians(number))) for number in range(FRAMES))
        assert np.allclose(clip.seconds, np.arange(FRAMES) / 25)


def test_rows_that_are_not_shown_neither_show_nor_reach_out():
    truth = soft(20, 0)
    truth.means[3] = 500
    mask = np.arange(20) != 3
    kept = rows_out(truth, mask, keep_rows=True)
    assert opacity(kept)[3] < 1e-8
    assert np.abs(kept.means).max() == np.abs(truth.means[mask]).max()
    assert np.array_equal(rows_out(truth, mask, keep_rows=False).means, truth.means[mask])


def test_backdrop_and_people_make_the_whole(scene):
    with open_scene(scene) as opened:
        parts = [Clip(opened, range(FRAMES), ClipOptions(part=part)) for part in (Part.PEOPLE, Part.BACKDROP)]
        for people, backdrop, whole in zip(*parts, opened, strict=True):
            assert (len(people), len(backdrop)) == (MOVING, ROWS - MOVING)
            assert np.array_equal(np.concatenate([people.means, backdrop.means]), whole.means)
        first, last = (parts[1].frame(number) for number in (0, FRAMES // 2 - 1))
    assert np.array_equal(first.means, last.means)


# Light


def test_what_baking_costs_is_measured_against_linear_gains():
    gaussians, light = soft(400, 1), np.array([0.5, -0.4, 0.2])
    colours = np.clip(0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64), 0, 1)
    seen = np.clip(0.5 + SH_C0 * lit_gaussians(gaussians, light).sh[:, 0].astype(np.float64), 0, 1)
    truth = srgb_from_linear(linear_from_srgb(colours) * np.exp(light))
    found = baking_error(gaussians, light)
    assert found.largest == pytest.approx(np.abs(seen - truth).max(), rel=1e-4)
    assert 0 < found.rms < found.largest
    assert baking_error(gaussians, np.zeros(3)) == Baking()
    bright = replace(gaussians, sh=np.zeros_like(gaussians.sh))  # the curve is a power but for the darkest tones
    assert baking_error(bright, np.array([0.05, -0.05, 0.05])).largest < 1e-3


# Formats


@pytest.mark.parametrize("degree", [0, 3])
def test_sog_and_splat_are_read_within_their_steps(tmp_path, degree):
    truth = soft(3000, degree)
    for kind in (SplatFormat.SOG, SplatFormat.SPLAT):
        path = tmp_path / f"a{kind.suffix}"
        assert write_gaussians(path, truth, kind=kind) == 3000
        back = read_gaussians(path)
        span = np.ptp(np.sign(truth.means) * np.log1p(np.abs(truth.means)), axis=0)
        step = (1 + np.abs(truth.means)) * span / 65535 if kind == SplatFormat.SOG else 0
        assert (np.abs(back.means - truth.means) <= 0.51 * step + 1e-6).all()
        assert rotation_error(back, truth).max() < ROTATION[kind]
        assert np.abs(alpha_of(back) - alpha_of(truth)).max() <= 0.501 / 255
        # Of 256 evenly spread values; ours crowd where the values do, and are farther from the rare ones.
        half = 0.5 / 255 * np.ptp(truth.log_scales)
        assert np.abs(back.log_scales - truth.log_scales).max() < 3 * half  # measured 2.1
        assert np.sqrt(np.mean((back.log_scales - truth.log_scales) ** 2)) < half / np.sqrt(3)
        assert np.abs(back.sh[:, 0] - truth.sh[:, 0]).max() < 2 * 0.5 / 255 / SH_C0
    if degree:
        assert np.abs(read_gaussians(tmp_path / "a.sog").sh[:, 1:] - truth.sh[:, 1:]).max() < 0.012
    assert read_gaussians(tmp_path / "a.splat").sh_degree == 0


def test_sog_says_what_it_was_trained_with_and_is_the_same_for_the_same(tmp_path):
    for name, smooth in (("a", True), ("b", False), ("c", False)):
        write_gaussians(tmp_path / f"{name}.sog", soft(9, 1), kind=SplatFormat.SOG, antialiased=smooth)
        assert antialiased(tmp_path / f"{name}.sog") is smooth
    assert (tmp_path / "b.sog").read_bytes() == (tmp_path / "c.sog").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert json.loads(archive.read("meta.json"))["version"] == 2


@pytest.mark.parametrize("kind", FRAME_FORMATS)
def test_an_empty_frame_is_a_frame(tmp_path, kind):
    path = tmp_path / f"a{kind.suffix}"
    assert write_gaussians(path, rows_of(soft(3, 1), slice(0)), kind=kind) == 0
    assert len(read_gaussians(path)) == 0


def test_palettes_share_entries_only_where_they_must():
    rng = np.random.default_rng(0)
    rows = np.repeat(rng.normal(size=(50, 4)), 3, axis=0)
    assert len(set(_groups(rows, 64))) == 50
    few = _groups(rng.normal(size=(1000, 4)), 64)
    assert len(set(few)) == 64
    assert np.bincount(few).max() <= 16


def test_codebooks_hold_few_values_exactly_and_rise():
    values = np.random.default_rng(0).choice([-3.0, 0.25, 1.0, 8.0], (40, 3)).astype(np.float32)
    book, codes = _codebook(values)
    assert np.array_equal(np.asarray(book, np.float32)[codes], values)
    assert np.all(np.diff(book) >= 0)


def gltf_parts(path):
    """The document and the arrays of the one primitive, by attribute."""
    content = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, size, kind) == (b"glTF", 2, len(content), b"JSON")
    document = json.loads(content[20 : 20 + length])
    data = content[20 + length + 8 :]
    assert struct.unpack_from("<I4s", content, 20 + length) == (len(data), b"BIN\0")
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    found = {}
    for name, number in primitive["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(data, "<f4", accessor["count"] * width, view["byteOffset"])
        found[name.removeprefix("KHR_gaussian_splatting:")] = values.reshape(-1, width)
    return document, primitive, found


@pytest.mark.parametrize("degree", [0, 2])
def test_gltf_holds_every_number_as_the_extension_has_it(tmp_path, degree):
    truth = soft(50, degree)
    assert write_gaussians(tmp_path / "a.glb", truth, kind=SplatFormat.GLTF) == 50
    document, primitive, found = gltf_parts(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    said = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (primitive["mode"], said) == (0, {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"})
    turned = half_turn(truth)  # y up, z back
    assert np.array_equal(found["POSITION"], turned.means)
    assert document["accessors"][0]["min"] == turned.means.min(axis=0).tolist()
    assert np.allclose(found["ROTATION"], turned.quaternions[:, [1, 2, 3, 0]], atol=1e-6)
    assert np.allclose(found["SCALE"], np.exp(turned.log_scales), rtol=1e-6)
    assert np.allclose(found["OPACITY"][:, 0], alpha_of(turned), atol=1e-6)
    names = [f"SH_DEGREE_{band}_COEF_{n}" for band in range(degree + 1) for n in range(2 * band + 1)]
    assert [name for name in found if name.startswith("SH")] == names
    assert np.array_equal(np.stack([found[name] for name in names], axis=1), turned.sh)


def test_gltf_refuses_an_empty_frame(tmp_path):
    with pytest.raises(ValueError, match="glTF holds no frame without Gaussians"):
        write_gaussians(tmp_path / "a.glb", rows_of(soft(3, 0), slice(0)), kind=SplatFormat.GLTF)
    assert not list(tmp_path.iterdir())


# What other people's programs read


@needs_fourdgs
def test_gltf_is_read_by_another_program(tmp_path):
    import fourdgs

    truth = soft(200, 1)
    write_gaussians(tmp_path / "a.glb", truth, kind=SplatFormat.GLTF)
    read, turned = fourdgs.from_gltf(str(tmp_path / "a.glb")), half_turn(truth)
    assert read.metadata["color_space"] == "srgb-rec709-display"
    assert np.array_equal(read.gaussians.positions, turned.means)
    assert np.allclose(read.gaussians.scales, np.exp(turned.log_scales), rtol=1e-6)
    assert np.allclose(read.gaussians.rotations, turned.quaternions[:, [1, 2, 3, 0]], atol=1e-6)
    bands = read.gaussians.sh.reshape(200, 3, 3).transpose(0, 2, 1) * (8 / 255) - 4
    assert np.abs(bands - turned.sh[:, 1:]).max() <= 0.501 * 8 / 255  # of its own bytes


@needs_usd
@pytest.mark.parametrize("keep_rows", [False, True])
def test_usd_holds_every_frame_at_its_time(scene, tmp_path, keep_rows):
    from pxr import Usd, UsdGeom, UsdVol

    with open_scene(scene) as opened:
        clip = Clip(opened, range(1, FRAMES), ClipOptions(keep_rows=keep_rows))
        assert SplatFormat.USD.door.write_clip(tmp_path / "a.usdc", clip) == clip.drawn
        stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
        prim = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/scene/gaussians"))
        assert (UsdGeom.GetStageUpAxis(stage), stage.GetTimeCodesPerSecond()) == ("Y", 25)
        assert prim.GetPositionsAttr().GetTimeSamples() == [0, 1, 2, 3, 4]
        assert prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
        for time in range(FRAMES - 1):
            frame = opened.gaussians(time + 1)
            truth = half_turn(rows_out(frame, is_drawn(frame), keep_rows=keep_rows))
            assert np.array_equal(np.array(prim.GetPositionsAttr().Get(time)), truth.means)
            assert np.allclose(np.array(prim.GetScalesAttr().Get(time)), np.exp(truth.log_scales), rtol=1e-6)
            assert np.allclose(np.array(prim.GetOpacitiesAttr().Get(time)), opacity(truth), atol=1e-6)
            sh = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(time)).reshape(truth.sh.shape)
            assert np.array_equal(sh, truth.sh)
            turn = prim.GetOrientationsAttr().Get(time)[7]
            wxyz = np.array([turn.GetReal(), *turn.GetImaginary()])
            assert np.allclose(wxyz, truth.quaternions[7] / np.linalg.norm(truth.quaternions[7]), atol=1e-6)


@needs_usd
@needs_fourdgs
def test_a_still_in_usd_is_read_by_another_program(scene, tmp_path):
    import fourdgs

    with open_scene(scene) as opened:
        SplatFormat.USD.door.write_clip(tmp_path / "a.usda", Clip(opened, range(2, 3), ClipOptions()))
        truth = half_turn(drawn(opened.gaussians(2)))
    read = fourdgs.from_usd(str(tmp_path / "a.usda"))
    assert read.metadata["coordinate_system"] == "y-up-right-handed"
    assert np.allclose(read.gaussians.positions, truth.means, rtol=1e-6)
    assert np.allclose(read.gaussians.scales, np.exp(truth.log_scales), rtol=1e-5)
    assert np.allclose(read.gaussians.colors[:, 3], opacity(truth), atol=1e-6)
    turns = truth.quaternions / np.linalg.norm(truth.quaternions, axis=1, keepdims=True)
    assert np.allclose(read.gaussians.rotations, turns[:, [1, 2, 3, 0]], atol=1e-6)


def fourdgs_sources(content):
    """Segment and row of all Gaussians, int [n, 2], from the streams that the library writes and does not show."""
    from fourdgs import opcode, records, serialization, stream_reader

    found = []
    for record in serialization.iter_records(content, len(serialization.MAGIC)):
        if record.opcode == opcode.CHUNK:
            head, streams = records.parse_chunk(record.content)
            cursor = serialization.Cursor(stream_reader.chunk_stream_bytes(head, streams))
            parts = {}
            while cursor.remaining():
                name, values = serialization.decode_stream(cursor)
                parts[name] = values
            found.append(np.column_stack([parts[opcode.A_SOURCE_GROUP], parts[opcode.A_SOURCE_INDEX]]))
    return np.concatenate(found)


@needs_fourdgs
def test_fourdgs_shows_each_frame_at_its_time(scene, tmp_path):
    import fourdgs

    with open_scene(scene) as opened:
        clip = Clip(opened, range(FRAMES), ClipOptions())
        assert SplatFormat.FOURDGS.door.write_clip(tmp_path / "a.4dgs", clip) == clip.drawn
        read = fourdgs.read(str(tmp_path / "a.4dgs"))
        assert read.header.duration_sec == pytest.approx(FRAMES / 25)
        whole = read.gaussians
        # What stands still is there once, and what moves once for every frame in which it is another.
        assert ROWS < whole.count < ROWS - MOVING + FRAMES * MOVING + 1
        for number in range(FRAMES):
            shown, truth = whole.state_at(number / 25 + 1e-6), half_turn(drawn(opened.gaussians(number)))
            assert len(shown["indices"]) == len(truth)
            a, b = np.lexsort(shown["centers"].round(2).T), np.lexsort(truth.means.round(2).T)
            assert np.median(np.abs(shown["centers"][a] - truth.means[b])) < 0.01
            nearest = np.abs(shown["centers"][:, None] - truth.means[None]).max(axis=2)
            row = nearest.argmin(axis=1)
            step = 0.02 * np.exp(np.median(truth.log_scales))  # of the library's finest profile
            assert nearest.min(axis=1).max() <= 2 * step
            assert np.abs(shown["opacity"] - opacity(truth)[row]).max() <= 0.51 / 255
            colour = np.clip(0.5 + SH_C0 * truth.sh[row, 0], 0, 1)
            assert np.abs(whole.colors[shown["indices"], :3] - colour).max() <= 0.51 / 255
        sources = fourdgs_sources((tmp_path / "a.4dgs").read_bytes())
        born = np.rint(whole.win_lo * 25).astype(int)
        truth = np.stack([half_turn(frame).means for frame in opened])  # [T, N, 3]
        assert np.array_equal(sources[:, 0] == 1, born >= FRAMES // 2)
        assert np.abs(whole.positions - truth[born, sources[:, 1]]).max() <= 2 * step  # the row says which it is


@needs_fourdgs
def test_fourdgs_holds_what_is_heard_of_its_frames(scene, tmp_path):
    import fourdgs

    samples = np.random.default_rng(0).integers(-9000, 9000, (2, round(FRAMES / 25 * RATE))) / 2**15
    loud = small_scene(tmp_path / "loud.mkv", sound=Sound.of("cam1", samples.astype(np.float32)))
    for path, frames in ((loud, range(FRAMES)), (loud, range(2, 4)), (scene, range(FRAMES))):
        with open_scene(path) as opened:
            SplatFormat.FOURDGS.door.write_clip(tmp_path / "a.4dgs", Clip(opened, frames, ClipOptions()))
        sources = fourdgs.read(str(tmp_path / "a.4dgs")).audio_sources
        assert len(sources) == (path is loud)
        for source in sources:
            assert (source.codec, source.name, source.start_sec, source.spatial) == ("flac", "cam1", 0, False)
            assert source.duration_sec == pytest.approx(len(frames) / 25)
            heard = Sound(source.name, source.data).samples()
            assert np.array_equal(heard, samples[:, frames.start * RATE // 25 : frames.stop * RATE // 25])


@needs_fourdgs
def test_a_frame_without_anybody_is_a_frame_of_4dgs(tmp_path):
    segments = small_segments()
    nobody = segments[0].key.attributes.copy()
    nobody[:, OPACITY] = 0
    segments[0].attributes[:, :, OPACITY] = 0
    segments[0] = replace(segments[0], key=Codes(segments[0].key.xyz, nobody))
    with open_scene(small_scene(tmp_path / "scene.mkv", segments)) as opened:
        later = len(drawn(opened.gaussians(FRAMES - 1)))
        clip = Clip(opened, range(FRAMES), ClipOptions())
        assert SplatFormat.FOURDGS.door.write_clip(tmp_path / "a.4dgs", clip) == clip.drawn >= later > 0
        with pytest.raises(ValueError, match="holds a Gaussian at least"):
            SplatFormat.FOURDGS.door.write_clip(tmp_path / "b.4dgs", Clip(opened, range(1), ClipOptions()))
    assert not (tmp_path / "b.4dgs").exists()


@pytest.mark.parametrize(
    ("kind", "module", "word"), [(SplatFormat.USD, "pxr", "usd-core"), (SplatFormat.FOURDGS, "fourdgs", "fourdgs")]
)
def test_a_library_that_is_missing_is_named(scene, tmp_path, monkeypatch, kind, module, word):
    for name in (module, f"{module}.Usd"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    with open_scene(scene) as opened, pytest.raises(ValueError, match=f"{word}.* pip install"):
        kind.door.write_clip(tmp_path / f"a{kind.suffix}", Clip(opened, range(2), ClipOptions()))
    assert not list(tmp_path.iterdir())
