"""`packuv compress`: what it writes says what was lost; what cannot be is exit code 2, and nothing is written."""

from __future__ import annotations

import json

import pytest

from pipelines.cli import main
from tests.support.small_scene import small_scene


@pytest.fixture(scope="module")
def lossless(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("lossless") / "scene.mkv")


def test_info_and_verify_know_a_compressed_scene(lossless, tmp_path, capsys):
    small = tmp_path / "small.mkv"
    assert main(["compress", str(lossless), "--ratio", "1.8", "-o", str(small), "--json"]) == 0
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
    "goal", [[], ["--ratio", "2", "--loss-db", "1"], ["--ratio", "0.5"], ["--ratio", "1000"], ["--loss-db", "nan"]]
)
def test_goals_that_cannot_be_are_refused(lossless, tmp_path, goal, capsys):
    assert main(["compress", str(lossless), *goal, "-o", str(tmp_path / "small.mkv")]) == 2
    assert len(capsys.readouterr().err.splitlines()[-1]) > 20
    assert not list(tmp_path.iterdir())
