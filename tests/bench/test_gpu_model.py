"""The model of an iteration on a GPU: what it counts, and that more work never takes less."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from bench import gpu_model
from bench.gpu_model import CARDS, Host, Work, count_work, kernels, model
from packuv.fit.pace import FitSize, made_up
from packuv.raster import RasterOptions, render
from tests.support.places import ROOT

WORK = Work(60_000, 9_000, 136_000, 131_000, 660_000, 230_400)
HOST = Host(0.002, 13, 148, 60, 72, 1e8, 8)
SIZE = FitSize(96, 64, 500)


def test_work_is_what_the_cpu_draws():
    """Warps draw one or two blocks of 16 pixels at a time."""
    work, (solver, shots) = count_work(SIZE), made_up(SIZE)
    drawn = [render(solver.model.gaussians, shot.camera, options=RasterOptions(0.2)) for shot in shots]
    assert work.pairs == np.mean([rendering.visible.sum() for rendering in drawn])
    assert work.visible == np.mean([np.count_nonzero(rendering.visible) for rendering in drawn])
    blocks = np.mean([rendering._kept.visited.sum() for rendering in drawn])
    assert blocks / 2 <= work.steps <= blocks
    assert work.steps <= 8 * work.walked <= 8 * work.pairs


@pytest.mark.parametrize("card", CARDS)
def test_more_work_takes_longer_and_every_part_has_a_kernel(card):
    now = model(SIZE, card, WORK, HOST)
    for name, value in vars(WORK).items():
        more = model(SIZE, card, replace(WORK, **{name: 2 * value}), HOST)
        assert now["gpu_ms"] < more["gpu_ms"] <= 2 * now["gpu_ms"]
    parts = {name: part["ms"] for name, part in now["parts"].items()}
    assert parts.keys() == {*kernels(WORK, *CARDS[card]), "torch"}
    assert sum(parts.values()) == pytest.approx(now["gpu_ms"])
    assert now["host_ms"] == pytest.approx(2 + 13 * 0.007 + 148 * 0.015 + 60 * 0.014 + 72 * 0.004 + 8 * 0.01)
    assert now["least_ms"] == max(now["gpu_ms"], now["host_ms"]) < now["most_ms"]


def test_aims_are_of_the_presets_iterations():
    row = {"gpu_ms": 4.0, "host_ms": 6.0, "most_ms": 10.0}
    found = gpu_model.aims(row)
    assert found["first_fit_seconds"] == 30.0
    assert 170 * 0.006 < found["frame_seconds"] < 170 * 0.007


@pytest.mark.slow
def test_all_of_it_runs_on_tiny_scenes(tmp_path):
    """In an interpreter of its own, with the simulator."""
    command = [sys.executable, "-m", "bench.gpu_model", "--toy", "--out", str(tmp_path / "model")]
    given = {"NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=os.environ | given, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "model.json").read_text())
    host = found["counted"][0]["host"]
    assert host["kernels"] == 13
    assert host["tensors"] > 100
    assert 20 < host["wrapped"] < host["tensors"] - 60
    assert 0 < host["cpu_seconds"] < 0.1
    assert host["uploads"] >= 6
    assert "| blend backward | " in (tmp_path / "model.md").read_text()


def test_without_the_simulator_it_says_what_to_do(capsys):
    with pytest.raises(SystemExit):
        gpu_model.main([])
    assert "set NUMBA_ENABLE_CUDASIM=1" in capsys.readouterr().err
