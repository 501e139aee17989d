"""`packuv compress`: what it writes says what was lost; what cannot be is exit code 2, and nothing is written."""

from __future__ import annotations

import json

import pytest

from packuv.interchange import write_ply
from packuv.interchange.adopt import AdoptOptions, adopt
from packuv.scene import open_scene
from pipelines.cli import main
from pipelines.commands import compress
from tests.support.small_scene import small_scene


@pytest.fixture(scope="module")
def lossless(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("lossless") / "scene.mkv")


def test_info_and_verify_know_a_compressed_scene(lossless, tmp_path, capsys):
    small = tmp_path / "small.mkv"
    assert main(["compress", str(lossless), "--ratio", "1.8", "--iterations", "20", "-o", str(small), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["bytes"] == small.stat().st_size
    assert main(["info", str(small), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert not facts["lossless"]
    assert facts["compression"]["ratio"] == said["ratio"]
    assert main(["info", str(small)]) == 0
    assert "codes      lossy, " in capsys.readouterr().out
    assert main(["verify", str(small)]) == 0
    assert main(["compress", str(small), "--ratio", "2", "-o", str(tmp_path / "smaller.mkv")]) == 2
    assert "must be lossless" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["small.mkv"]


@pytest.mark.parametrize(
    "goal",
    [
        [],
        ["--ratio", "2", "--loss-db", "1"],
        ["--ratio", "0.5"],
        ["--ratio", "1000"],
        ["--loss-db", "nan"],
        ["--ratio", "2", "--iterations", "-1"],
    ],
)
def test_goals_that_cannot_be_are_refused(lossless, tmp_path, goal, capsys):
    assert main(["compress", str(lossless), *goal, "-o", str(tmp_path / "small.mkv")]) == 2
    assert len(capsys.readouterr().err.splitlines()[-1]) > 20
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("factor", "code"), [(1.3, 0), (1e6, 2)])
def test_the_loss_that_footage_shows_is_what_was_asked_for_at_most(
    lossless, tmp_path, factor, code, capsys, monkeypatch
):
    def scores(arguments, scene, matched):
        """Footage that shows a loss larger by a factor than the header reckons."""
        with open_scene(scene) as opened:
            said = opened.header.extra.get("compression", {"loss_db": 0.0})
        return {"psnr_db": 30 - factor * said["loss_db"], "ssim": 0.9}

    monkeypatch.setattr(compress, "_scores", scores)
    monkeypatch.setattr(compress, "_matched", lambda *_: "which pictures are whose")
    monkeypatch.setattr(compress, "_footage", lambda *_: None)
    small = tmp_path / "small.mkv"
    words = ["compress", str(lossless), "--loss-db", "0.5", "--capture", str(tmp_path), "-o", str(small), "--json"]
    words += ["--iterations", "10"]
    assert main(words) == code
    said = capsys.readouterr()
    if code:
        assert "at most 0.5 dB, but footage shows" in said.err
        assert not list(tmp_path.iterdir())
    else:
        filmed = json.loads(said.out)["filmed"]
        assert 0.4 < filmed["lossless"]["psnr_db"] - filmed["compressed"]["psnr_db"] <= 0.5


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    """A scene of a splat file, which no camera filmed."""
    folder = tmp_path_factory.mktemp("splats")
    with open_scene(small_scene(folder / "filmed.mkv")) as scene:
        write_ply(folder / "a.ply", scene.gaussians(0))
    adopt([folder / "a.ply"], folder / "a.mkv", options=AdoptOptions(compared_frames=0))
    return folder / "a.mkv"


def test_who_compresses_what_nobody_filmed_is_told_so(splats, tmp_path, capsys):
    small = tmp_path / "small.mkv"
    assert main(["compress", str(splats), "--loss-db", "1", "--iterations", "0", "-o", str(small)]) == 0
    said = capsys.readouterr().out
    assert "from views that were imagined, for no camera filmed it" in said
    assert "of 30.00 dB against footage (assumed; there is none)" in said
    assert main(["info", str(small)]) == 0
    assert "dB to its from imagined views" in capsys.readouterr().out
    with open_scene(small) as scene:
        assert "imagined" in scene.header.extra["compression"]
        assert [camera.name for camera in scene.header.cameras] == [f"orbit{number:02d}" for number in range(6)]


def test_no_capture_scores_what_nobody_filmed(splats, tmp_path, capsys):
    words = ["--loss-db", "1", "--capture", str(tmp_path), "-o", str(tmp_path / "small.mkv")]
    assert main(["compress", str(splats), *words]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "no camera filmed" in said
    assert not list(tmp_path.iterdir())
