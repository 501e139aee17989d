"""The scene file beside other codecs and formats: what is said to be exact is, and what is missing is told."""

from __future__ import annotations

import json
import sys
from fractions import Fraction
from importlib.util import find_spec

import numpy as np
import pytest

from bench import codec
from bench.codec import CODECS, Codec, table
from bench.doors import MEASURED, USUAL, Pictures, measure_doors
from bench.made_up import SequenceOptions, _quantizer, made_up_gaussians, make_sequence
from packuv.gaussians.floats import with_canonical_axes
from packuv.gaussians.segment import Segment
from packuv.interchange import WRITTEN, SplatFormat
from packuv.scene import SceneHeader, open_scene, write_scene
from tests.support.needs import needs, needs_ffmpeg
from tests.support.small_scene import FRAMES, small_scene
from tests.support.splats import random_gaussians

needs_fourdgs = needs("fourdgs", find_spec("fourdgs"), "no fourdgs; pip install 'packuv[4dgs]'")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("codec") / "a.mkv")


def measured(path, folder, *kinds, frames=2):
    with open_scene(path) as opened:
        return list(measure_doors(opened, kinds, Pictures(opened, frames=frames), folder))


def test_the_whole_table_of_a_scene_file(scene, tmp_path, capsys):
    out = tmp_path / "r.json"
    words = ["--scene", str(scene), "--out", str(out), "--codecs", "ffv1", "--formats", "ply", "spz", "sog"]
    codec.main([*words, "--plain-frames", "0", "--render-frames", "2", "--threads", "1"])
    found = json.loads(out.read_text())
    rows = {row["layout"]: row for row in found["rows"]}
    assert list(rows) == [
        *(f"compact, {name}" for name in ("lossless", "high", "medium", "low", "no sharing")),
        *("pictures, ffv1", "codes, ffv1", "ply", "spz", "sog"),
    ]
    lossy = {"compact, high", "compact, medium", "compact, low", "spz", "sog"}
    assert {name for name, row in rows.items() if not row["exact"]} == lossy
    assert all(row["frames"] == FRAMES and row["bytes"] > 0 for row in rows.values())
    assert all(20 < rows[name]["psnr_to_lossless_db"] < 90 for name in lossy)
    assert rows["compact, high"]["psnr_to_lossless_db"] > rows["compact, low"]["psnr_to_lossless_db"]
    assert rows["spz"]["frames_measured"] == 2
    # Without differences all rows are there in every frame.
    assert rows["codes, ffv1"]["bytes"] > rows["pictures, ffv1"]["bytes"]
    printed = capsys.readouterr().out.splitlines()
    assert printed == table(found["rows"]).splitlines()
    assert [line.count("|") for line in printed] == [7] * len(printed)
    assert [line.split(" | ")[0][2:] for line in printed[2:] if line.endswith("| exact |")] == [
        name for name in rows if name not in lossy
    ]


@pytest.mark.slow
def test_the_plain_atlas_is_measured_on_some_frames(scene):
    with open_scene(scene) as opened:
        paths = codec._saved([opened.segment(number) for number in range(2)], scene.parent)
        row = codec.measure_plain_atlas(paths, opened.header.quantizer, frames_measured=1)
    assert (row["exact"], row["frames"], row["frames_measured"]) == (True, FRAMES, 1)
    assert row["track_bytes"][0] * FRAMES == row["bytes"]


@needs_fourdgs
@pytest.mark.parametrize("degree", [0, 1])
def test_4dgs_shows_what_it_was_given(degree, tmp_path):
    """PSNR is of its rounding alone: rows in another order, turned axes or bands would cost far more."""
    gaussians = random_gaussians(60, degree, 1)
    gaussians.sh[:] = np.clip(gaussians.sh, -1, 1) * 0.5
    gaussians.log_scales[:] = 0.3 * gaussians.log_scales - 2
    key = with_canonical_axes(gaussians)
    quantizer = _quantizer(key)
    codes = quantizer.encode(key)
    still = np.zeros((2, 0, 3), np.uint16), np.zeros((2, 0, codes.attributes.shape[1]), np.uint8)
    Segment(0, codes, np.zeros(len(key), bool), *still).save(tmp_path / "s.npz")
    times = np.arange(3, dtype=np.int64) * 40_000_000
    header = SceneHeader(quantizer, times, Fraction(25), (codec.CAMERA,), extra={"near": 0.01})
    write_scene(tmp_path / "s.mkv", [tmp_path / "s.npz"], header)
    (row,) = measured(tmp_path / "s.mkv", tmp_path, SplatFormat.FOURDGS)
    assert not row["exact"]
    assert row["frames_measured"] == 3
    assert row["psnr_to_lossless_db"] > 40


def test_what_is_not_installed_is_told(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fourdgs", None)
    gone, there = measured(scene, tmp_path, SplatFormat.FOURDGS, SplatFormat.SPLAT)
    assert gone["skipped"].endswith("which is not there; pip install 'packuv[4dgs]'")
    assert "| 4dgs | not measured: .4dgs is written by" in table([gone, there])
    monkeypatch.setitem(CODECS, "ffv1", Codec("none of FFmpeg's", "gray"))
    rows = list(codec.measure_codecs(scene, ["ffv1"]))
    assert [set(row) for row in rows] == [{"layout", "skipped"}] * 2


def test_a_codec_that_loses_is_not_said_to_be_exact(scene, monkeypatch):
    monkeypatch.setitem(CODECS, "hevc", Codec("libx264", "yuv420p", (("qp", "40"),)))
    rows = list(codec.measure_codecs(scene, ["hevc"]))
    assert [row["layout"] for row in rows] == ["pictures, hevc", "codes, hevc"]
    assert not any(row["exact"] for row in rows)
    assert table(rows).count("NOT EXACT") == 2


def test_pictures_alone_come_back_from_webp(scene):
    (row,) = codec.measure_codecs(scene, ["webp"])
    assert (row["layout"], row["exact"], row["frames"]) == ("pictures, webp", True, FRAMES)


@needs_ffmpeg
def test_pictures_alone_come_back_from_jpeg_xl_where_ffmpeg_has_it(scene):
    (row,) = codec.measure_codecs(scene, ["jxl"])
    assert row.get("exact") or "libjxl" in row["skipped"]


def test_no_program_is_told(scene, monkeypatch):
    monkeypatch.setenv("PATH", "")
    (row,) = codec.measure_codecs(scene, ["jxl"])
    assert "ffmpeg" in row["skipped"]


def test_formats_that_are_measured_are_read_and_written():
    assert set(USUAL) <= set(MEASURED) <= set(WRITTEN)
    assert {SplatFormat.GLTF, SplatFormat.USD, SplatFormat.KSPLAT}.isdisjoint(MEASURED)


def test_a_made_up_sequence_is_seen_by_its_camera(tmp_path):
    options = SequenceOptions(frames=2, still=1200, restless=100, actor=300)
    segments, quantizer, _ = make_sequence(made_up_gaussians(1500, np.random.default_rng(0)), options)
    (path,) = codec._saved(segments, tmp_path)
    header = SceneHeader(
        quantizer, np.array([0, 33_000_000]), Fraction(30), (codec.CAMERA,), extra={"near": codec.NEAR}
    )
    write_scene(tmp_path / "a.mkv", [path], header)
    with open_scene(tmp_path / "a.mkv") as opened:
        pictures = Pictures(opened, frames=2)
        assert pictures.psnr(opened.gaussians) is None
        assert 5 < pictures.psnr(lambda frame: opened.gaussians(1 - frame)) < 60
