"""The commands that turn scenes into other programs' files, and those into scenes."""

from __future__ import annotations

import errno
import json
import os
import re
from dataclasses import replace
from fractions import Fraction

import cv2
import numpy as np
import pytest

from calibration.importers import load_rig
from packuv import score
from packuv.atlas import AtlasVideo
from packuv.camera import PinholeCamera
from packuv.colour import lit
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes, Quantizer
from packuv.gaussians.floats import drawn, lit_gaussians
from packuv.gaussians.segment import Segment
from packuv.interchange import read_gaussians
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.score import Artist
from pipelines.cli import FAILED, OK, WRONG, main

ATTRIBUTES = ("means", "log_scales", "quaternions", "opacity_logits", "sh")


def cameras(square):
    """Two that look at the origin from -z and from +x; the first is one that LLFF cannot hold unless `square`."""
    turned = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 5], [0, 0, 0, 1]])
    ahead = np.eye(4)
    ahead[2, 3] = 5
    return (
        PinholeCamera("b", 64, 48, 60.25, 60.25 if square else 61, 32, 24, ahead),
        PinholeCamera("a", 64, 48, 55.5, 55.5, 32, 24, turned),
    )


def write_small_scene(path, *, square=True, light=None):
    rng = np.random.default_rng(0)
    low, high = np.full(10, -3.0), np.full(10, 1.0)
    low[3:6], high[3:6] = -0.71, 0.71
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    quantizer = Quantizer(np.zeros(3), 1.0, np.full(3, 2.0), low, high)
    key = Codes(rng.integers(0, 65536, (90, 3), np.uint16), rng.integers(60, 200, (90, 10), np.uint8))
    moving = np.arange(90) < 30
    xyz = key.xyz[None, :30] + rng.integers(0, 50, (2, 30, 3), np.uint16)
    attributes = np.repeat(key.attributes[None, :30], 2, axis=0)
    attributes[1, :4, OPACITY] = 0
    Segment(0, key, moving, xyz, attributes).save(path.with_suffix(".npz"))
    times = np.array([0, 33_000_000, 67_000_000], dtype=np.int64)
    header = SceneHeader(quantizer, times, Fraction(30), cameras(square), extra={"near": 0.05})
    header = header if light is None else replace(header, light=light)
    write_scene(path, [path.with_suffix(".npz")], header)
    path.with_suffix(".npz").unlink()
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_small_scene(tmp_path_factory.mktemp("exchange") / "a.mkv")


LIGHT = np.array([[0.0, 0, 0], [0.3, -0.2, 0.1], [-1.5, 0.05, 0.6]])


@pytest.fixture(scope="module")
def lit_scene(tmp_path_factory):
    """The same scene in light that changes."""
    return write_small_scene(tmp_path_factory.mktemp("lit") / "a.mkv", light=LIGHT)


def run(*words):
    return main([str(word) for word in words])


@pytest.mark.parametrize("words", [["export"], ["export", "frames"]])
def test_a_frame_is_exported_exactly(scene, tmp_path, words, capsys):
    assert run(*words, scene, "--frame", 2, "-o", tmp_path / "a.ply") == OK
    assert "86 Gaussians of frame 2" in capsys.readouterr().out
    with open_scene(scene) as opened:
        truth = drawn(opened.gaussians(2))
    back = read_gaussians(tmp_path / "a.ply")
    assert all(np.array_equal(getattr(back, name), getattr(truth, name)) for name in ATTRIBUTES)


def test_the_format_is_asked_for_or_told_by_the_name(scene, tmp_path):
    for name in ("a.ply", "a.compressed.ply", "a.spz"):
        assert run("export", scene, "--frame", 0, "-o", tmp_path / name) == OK
    assert run("export", scene, "--frame", 0, "--format", "spz", "-o", tmp_path / "b.dat") == OK
    assert (tmp_path / "b.dat").read_bytes() == (tmp_path / "a.spz").read_bytes()
    assert (tmp_path / "a.compressed.ply").read_bytes() != (tmp_path / "a.ply").read_bytes()
    assert len({len(read_gaussians(path)) for path in tmp_path.glob("a.*")}) == 1


def test_a_sequence_goes_out_and_comes_back(scene, tmp_path, capsys):
    assert run("export", scene, "--frames", ":", "-o", tmp_path / "frames") == OK
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["000000.ply", "000001.ply", "000002.ply"]
    assert run("export", scene, "--frames", "1:3", "-o", tmp_path / "frames") == WRONG
    assert "must be new or an empty folder" in capsys.readouterr().err
    assert run("export", scene, "--frames", "1:4", "-o", tmp_path / "more") == WRONG
    assert run("import", tmp_path / "frames", "--fps", "30000/1001", "-o", tmp_path / "b.mkv", "--json") == OK
    facts = json.loads(capsys.readouterr().out)
    assert (facts["frames"], facts["gaussians"], facts["broken"]) == (3, 90 + 90 + 86, 0)
    assert facts["kept_share"] <= 1
    assert len(facts["psnr_db"]) == 18
    with open_scene(tmp_path / "b.mkv") as back, open_scene(scene) as first:
        assert back.header.rate == Fraction(30000, 1001)
        a, b = drawn(first.gaussians(2)), drawn(back.gaussians(2))
        if facts["pruned"] == 0:
            order = [np.lexsort(g.means.T) for g in (a, b)]
            # Half a step of 16 bits on a scale of about this scene's size.
            assert np.abs(a.means[order[0]] - b.means[order[1]]).max() < 1e-3
    assert run("import", tmp_path / "frames", "--keep-all", "-o", tmp_path / "c.mkv") == OK
    assert "the UV map has no texel for 0" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--frame", 2, "-o", "a.ply"], ["--frames", "2:3", "-o", "a"]])
def test_a_frame_goes_out_as_it_is_seen_in_its_light(scene, lit_scene, tmp_path, words, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("export", lit_scene, *words) == OK
    back = read_gaussians(next(path for path in tmp_path.rglob("*.ply") if path.is_file()))
    with open_scene(scene) as opened:
        truth = lit_gaussians(drawn(opened.gaussians(2)), LIGHT[2])
    assert all(np.array_equal(getattr(back, name), getattr(truth, name)) for name in ATTRIBUTES)


def test_parts_rows_and_light_are_chosen(scene, lit_scene, tmp_path, capsys):
    words = ["export", lit_scene, "--frames", ":", "--part", "people", "--keep-rows"]
    assert run(*words, "--light", "left", "-o", tmp_path / "a") == OK
    told = capsys.readouterr().out
    assert "a: 3 files, frames 0 to 2" in told
    assert "format     PLY keeps a frame exactly, but not its time" in told
    assert "rows       are the same Gaussians until they begin anew at frames 0" in told
    assert "light      is left out: of 22.3% to 182.2% of steady light" in told
    with open_scene(scene) as opened:
        for frame in range(3):
            back, truth = read_gaussians(tmp_path / "a" / f"{frame:06d}.ply"), opened.gaussians(frame)
            assert np.array_equal(back.means, truth.means[:30])
            assert np.array_equal(back.sh, truth.sh[:30])
    assert (back.opacity_logits < -10).sum() == 4
    gains = json.loads((tmp_path / "a" / "light.json").read_text())
    assert gains["frames"] == [0, 1, 2]
    assert np.allclose(gains["gains"], np.exp(LIGHT), atol=1e-4)
    assert run("import", tmp_path / "a", "--keep-all", "-o", tmp_path / "a.mkv") == OK
    capsys.readouterr()
    assert run(*words, "-o", tmp_path / "b") == OK
    told = capsys.readouterr().out
    assert re.search(
        r"light      is baked into colours, \d+\.\d\d of 255 off in the worst frame, \d+\.\d at most", told
    )
    assert run("export", scene, "--frame", 0, "-o", tmp_path / "c.sog") == OK
    told = capsys.readouterr().out
    assert "light  " not in told
    assert "left out" not in told


@pytest.mark.parametrize(
    ("words", "name", "told"),
    [
        (
            ["--frames", ":", "--format", "usd"],
            "frames",
            "usd is one file, named .usdc or .usda or .usd, but",
        ),
        (["--frame", "0", "--format", "spz"], "a.ply", "spz is one file, named .spz, but not a.ply"),
        (["--frames", "0:2"], "a.ply", "several frames of ply are a folder of files, but a.ply names a file"),
        (["--frame", "0"], "a.ksplat", "ksplat is read, but not written; choose one with --format: ply, "),
    ],
)
def test_a_name_that_tells_something_else_is_refused(scene, tmp_path, capsys, words, name, told):
    assert run("export", scene, *words, "-o", tmp_path / name) == WRONG
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_formats_that_share_a_suffix_are_told_by_name(scene, tmp_path):
    for kind, name in (("spz3", "a.spz"), ("compressed-ply", "b.ply"), ("ply", "c.PLY")):
        assert run("export", scene, "--frame", 0, "--format", kind, "-o", tmp_path / name) == OK


def test_pictures_are_drawn_in_the_light_of_their_frame(scene, lit_scene, tmp_path):
    for path, folder in ((scene, "steady"), (lit_scene, "lit")):
        assert run("render", path, "--camera", "b", "-o", tmp_path / folder) == OK
    for frame in range(3):
        steady, seen = (cv2.imread(str(tmp_path / name / f"{frame:06d}.png")) for name in ("steady", "lit"))
        with open_scene(scene) as opened:
            picture = lit(Artist(opened).draw(opened.gaussians(frame), cameras(True)[0]), LIGHT[frame])
        wanted = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8).transpose(1, 2, 0)[..., ::-1]
        assert np.array_equal(seen, wanted)
        assert np.array_equal(seen, steady) == (frame == 0)


def test_the_command_tells_that_light_changes(scene, lit_scene, capsys):
    assert run("info", lit_scene) == OK
    assert "light      22.3% to 182.2% of steady light" in capsys.readouterr().out
    assert run("info", scene) == OK
    assert "light" not in capsys.readouterr().out


def test_an_atlas_video_keeps_codes_and_light_apart(lit_scene, tmp_path):
    assert run("export", "atlas", lit_scene, "--map", 64, "-o", tmp_path / "a.mkv") == OK
    assert np.array_equal(AtlasVideo(tmp_path / "a.mkv").header.light, LIGHT)
    assert run("import", tmp_path / "a.mkv", "-o", tmp_path / "back.mkv") == OK
    with open_scene(tmp_path / "back.mkv") as back, open_scene(lit_scene) as first:
        assert np.array_equal(back.light(2), LIGHT[2])
        a, b = (drawn(scene.gaussians(2)).means for scene in (back, first))
        assert np.array_equal(a[np.lexsort(a.T)], b[np.lexsort(b.T)])


def test_the_sheet_shows_colours_in_the_light_of_the_frame(scene, lit_scene, tmp_path):
    pages = []
    for number, path in enumerate((scene, lit_scene, scene, lit_scene)):
        page = tmp_path / f"{number}.png"
        assert run("atlas", path, "--frame", number // 2, "--map", 64, "--layers", 4, "-o", page) == OK
        pages.append(cv2.imread(str(page)))
    assert np.array_equal(pages[0], pages[1])  # frame 0, steady
    assert (pages[2] != pages[3]).any()


@pytest.mark.parametrize(("to", "file"), [("colmap", "images.txt"), ("transforms", "transforms.json")])
def test_cameras_go_out_and_come_back(tmp_path, to, file):
    scene = write_small_scene(tmp_path / "a.mkv", square=False)
    assert run("export", "cameras", scene, "--to", to, "-o", tmp_path / "rig") == OK
    assert (tmp_path / "rig" / file).is_file()
    assert_same_cameras(load_rig(tmp_path / "rig", ["a", "b"]), square=False)


def assert_same_cameras(rig, *, square):
    for camera in cameras(square):
        back = rig[camera.name]
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(back, name) == getattr(camera, name)
        assert np.allclose(back.camera_from_world, camera.camera_from_world, rtol=0, atol=1e-12)  # roundings near 1


def test_llff_gets_rows_by_name_and_depths_of_what_is_seen(scene, tmp_path, capsys):
    assert run("export", "cameras", scene, "--to", "poses-bounds", "-o", tmp_path / "llff") == OK
    assert_same_cameras(load_rig(tmp_path / "llff", ["a", "b"]), square=True)
    rows = np.load(tmp_path / "llff" / "poses_bounds.npy")
    assert rows[:, 4].tolist() == [48, 48]
    assert rows[:, 14].tolist() == [55.5, 60.25]  # a, then b
    near, far = rows[:, 15:].T
    assert ((near > 2.5) & (near < 4.5) & (far > 5.5) & (far < 7.5)).all()  # 5 away, 2 in each direction
    other = write_small_scene(tmp_path / "a.mkv", square=False)
    assert run("export", "cameras", other, "--to", "poses-bounds", "-o", tmp_path / "no") == WRONG
    assert "write COLMAP or transforms.json instead" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_the_atlas_is_a_picture_and_a_video(scene, tmp_path, capsys):
    assert run("atlas", scene, "--frame", 1, "--map", 64, "--layers", 4, "-o", tmp_path / "a.png") == OK
    assert cv2.imread(str(tmp_path / "a.png")).shape == (3 * 104, 264, 3)
    assert run("atlas", scene, "--frame", 1, "--map", 64, "--triplet", "scale", "-o", tmp_path / "b.png") == OK
    assert cv2.imread(str(tmp_path / "b.png")).shape == (64, 128, 3)
    assert run("atlas", scene, "--frame", 3, "-o", tmp_path / "c.png") == WRONG
    assert "frames 0 to 2, but frame 3" in capsys.readouterr().err
    assert run("export", "atlas", scene, "--map", 64, "-o", tmp_path / "a.mkv", "--json") == OK
    facts = json.loads(capsys.readouterr().out)
    assert facts["exact"]
    assert facts["frames"] == len(AtlasVideo(tmp_path / "a.mkv")) == 3
    assert run("import", tmp_path / "a.mkv", "-o", tmp_path / "back.mkv") == OK
    assert "all 3 frames are the integers that the atlas was made from" in capsys.readouterr().out
    words = ["export", "atlas", scene, "--codec", "x264", "--crf", 30, "--map", 64, "-o", tmp_path / "b.mkv"]
    assert run(*words) == OK
    assert "rms in steps: position_hi 0.00" in capsys.readouterr().out


def test_nothing_is_left_behind_by_what_fails(scene, tmp_path):
    (tmp_path / "junk.ply").write_bytes(b"ply\n")
    assert run("import", tmp_path / "junk.ply", "-o", tmp_path / "a.mkv") == WRONG
    assert run("export", scene, "--frame", 9, "-o", tmp_path / "a.ply") == WRONG
    assert run("export", scene, "--frame", 0, "-o", tmp_path / "none" / "a.ply") == WRONG
    assert [path.name for path in tmp_path.iterdir()] == ["junk.ply"]


@pytest.mark.parametrize(
    "words",
    [
        ["export", "{scene}", "--frame", "0", "--format", "ply"],
        ["export", "atlas", "{scene}", "--map", "64"],
        ["atlas", "{scene}", "--frame", "0"],
        ["compress", "{scene}", "--ratio", "1.5"],
        ["import", "{scene}"],
    ],
)
def test_what_is_read_is_not_written_over(scene, tmp_path, words, capsys):
    own = tmp_path / "own.mkv"
    own.write_bytes(scene.read_bytes())
    other = tmp_path / "link.mkv"
    other.symlink_to(own)
    for output in (own, other):
        assert run(*(word.format(scene=own) for word in words), "-o", output) == WRONG
        assert "name another file to write" in capsys.readouterr().err
    assert own.read_bytes() == scene.read_bytes()
    assert other.is_symlink()


def test_splat_files_are_not_written_over(scene, tmp_path, capsys):
    frames = tmp_path / "frames"
    assert run("export", scene, "--frames", "0:2", "-o", frames) == OK
    before = {path: path.read_bytes() for path in frames.iterdir()}
    for source in (frames, frames / "000001.ply"):
        assert run("import", source, "-o", frames / "000001.ply") == WRONG
        assert "name another file to write" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in frames.iterdir()} == before
    assert run("import", frames, "-o", tmp_path) == WRONG
    assert f"{tmp_path} is a folder; name a file to write" in capsys.readouterr().err


def test_pictures_are_whole_or_not_there(scene, tmp_path, monkeypatch, capsys):
    def on_a_full_disk(path, picture):
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(score, "write_picture", on_a_full_disk)
    assert run("render", scene, "--camera", "a", "-o", tmp_path) == FAILED
    assert "No space left on device" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    assert run("render", scene, "--camera", "a", "--frames", "1:3", "-o", tmp_path) == OK
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000001.png", "000002.png"]
