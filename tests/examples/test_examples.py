"""The examples do what their docstrings say."""

from __future__ import annotations

import ast
import re
import runpy
import sys
from typing import Any

import numpy as np
import pytest

import packuv
from packuv.interchange import read_gaussians, write_ply
from packuv.interchange.adopt import AdoptOptions, adopt
from packuv.metrics import psnr
from packuv.raster import RasterOptions, render
from packuv.scene import verify_scene
from tests.support.gallery import FRAMES, MOST_BYTES, PICTURES, SCENE
from tests.support.places import ROOT
from tests.support.splats import random_gaussians

FOLDER = ROOT / "examples"
MOST_LINES = 50


@pytest.fixture
def run(monkeypatch):
    """Runs a script as its docstring says; returns its names."""

    def start(name: str, *words: object) -> dict[str, Any]:
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        return runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")

    return start


@pytest.fixture
def splats(tmp_path):
    path = tmp_path / "in.ply"
    write_ply(path, random_gaussians(200, 0))
    return path


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_examples_are_short_and_say_how_to_run_them(path):
    text = path.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    assert f"\n    python examples/{path.name} " in (ast.get_docstring(ast.parse(text)) or "")


def test_the_scene_is_whole_and_small():
    assert SCENE.stat().st_size <= MOST_BYTES
    assert verify_scene(SCENE).ok
    with packuv.open_scene(SCENE) as scene:
        assert 2 <= len(scene) <= FRAMES
        assert scene.header.cameras


def test_pictures_are_small_and_shown():
    pictures = sorted(PICTURES.iterdir())
    assert sum(path.stat().st_size for path in pictures) <= MOST_BYTES
    text = "".join(path.read_text() for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")))
    assert [path.name for path in pictures if f"pictures/{path.name})" not in text] == []
    assert all((PICTURES / name).is_file() for name in re.findall(r"pictures/(\w+\.webp)\)", text))


def test_convert_splat(run, splats, tmp_path, capsys):
    run("convert_splat", splats, tmp_path / "out.spz")
    assert len(read_gaussians(tmp_path / "out.spz")) > 150  # the rest is too faint to be drawn
    assert "100.0% of what is drawn is kept" in capsys.readouterr().out


def test_decode_to_tensors(run, splats, tmp_path, capsys):
    scene = tmp_path / "scene.mkv"
    adopt([splats, splats], scene, options=AdoptOptions(uv=None, compared_frames=0))
    run("decode_to_tensors", scene)
    with packuv.open_scene(scene) as opened:
        count = len(opened.gaussians(1))
    text = capsys.readouterr().out
    assert f"frame 1  means          torch.float32  [{count}, 3]" in text
    assert "2 frames at 30 a second; their centre moves 0 units" in text


def test_fit_one_instant(run, tmp_path):
    names = run("fit_one_instant", tmp_path / "out.ply")
    camera = names["CAMERAS"]["cam3"]
    shown = render(read_gaussians(tmp_path / "out.ply"), camera, options=RasterOptions(near=0.1)).colour
    truth = names["picture"](camera).transpose(2, 0, 1).astype(np.float32) / 255
    assert psnr(shown, truth) > 20  # measured 23; black has 15
