"""`packuv compress`: what it writes says what was lost; what cannot be is exit code 2, and nothing is written."""

from __future__ import annotations

import json

import pytest

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
    def scores(arguments, scene):
        """Footage that shows a loss larger by a factor than the header reckons."""
        with open_scene(scene) as opened:
            said = opened.header.extra.get("compression", {"loss_db": 0.0})
        return {"psnr_db": 30 - factor * said["loss_db"], "ssim": 0.9}

    monkeypatch.setattr(compress, "_scores", scores)
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
