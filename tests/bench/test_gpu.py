"""What is measured on a GPU, whole and tiny in numba's simulator, with no package but torch, numba and numpy."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench import bare, gpu
from packuv.gaussians.codes import Codes
from packuv.gaussians.segment import Segment
from tests.support.places import ROOT

BLOCK = """
import sys


class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"av", "cv2", "h5py", "lpips", "prefect", "pyarrow", "pycolmap", "rich", "scipy",
                                  "skimage", "sortedcontainers", "sqlalchemy", "tbb", "torchcodec", "torchvision"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Blocked())
"""


@pytest.mark.slow
def test_all_of_it_runs_in_the_simulator_without_other_packages(tmp_path):
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(BLOCK)
    path = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    given = {"OUT": str(tmp_path / "out"), "PYTHON": sys.executable, "NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": path}
    command = ["sh", str(ROOT / "bench" / "gpu.sh"), "--toy"]
    done = subprocess.run(command, env=os.environ | given, capture_output=True, text=True, timeout=540)
    log = tmp_path / "out" / "tests.txt"
    assert done.returncode == 0, done.stdout + done.stderr + (log.read_text() if log.exists() else "")
    found = json.loads((tmp_path / "out" / "gpu.json").read_text())
    assert {"av", "cv2", "prefect", "torchcodec"} <= set(found["machine"]["stood_in_for"])
    assert found["tests"]["figures"]["pytest"].startswith("1 passed")
    (iteration,) = found["iteration"]["figures"]
    assert min(iteration["stages_ms"].values()) > 0
    assert iteration["ms"] > sum(iteration["stages_ms"].values()) / 10
    sequence = found["sequence"]["figures"]
    assert sequence["cuda"]["frame_iterations_mean"] > 0
    assert sequence["cuda"]["frames"] == sequence["cpu"]["frames"] == 2
    assert abs(sequence["psnr_db_cuda_minus_cpu"]) < 0.01
    assert len(list((tmp_path / "out").iterdir())) <= 8


def test_a_part_that_fails_or_has_no_time_left_is_told_and_the_others_go_on(tmp_path, monkeypatch):
    def failing(options: gpu.GpuOptions, out: Path) -> None:
        raise ValueError("no such luck")

    parts = (("first", 0, failing), ("long", 100, failing), ("last", 0, lambda options, out: {"ms": 3}))
    monkeypatch.setattr(gpu, "PARTS", parts)
    monkeypatch.setattr(gpu, "machine", dict)
    assert not gpu.measure(replace(gpu.TOY, seconds=50), tmp_path)
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert "no such luck" in found["first"]["failed"]
    assert found["long"]["skipped"] == "50 s are left, it needs 100 s"
    assert found["last"]["figures"] == {"ms": 3}


def test_a_missing_package_can_be_named_and_says_so_when_called(monkeypatch):
    monkeypatch.setattr(bare, "NAMES", ("no_such_package", "no_such_package.part"))
    bare.stand_in()
    import no_such_package

    assert bare.missing() == ["no_such_package", "no_such_package.part"]
    with pytest.raises(RuntimeError, match=r"no_such_package\.part\.function is called, but this machine lacks"):
        no_such_package.part.function(3)
    for name in bare.NAMES:
        del sys.modules[name]


def test_sums_of_masks_are_opencvs():
    mask = (np.random.default_rng(0).random((13, 9)) < 0.4).astype(np.uint8)
    assert np.array_equal(bare._integral(mask, sdepth=cv2.CV_32S), cv2.integral(mask, sdepth=cv2.CV_32S))


def test_cameras_look_at_the_middle_from_all_around_and_the_last_stands_between_two():
    cameras = [gpu._around(gpu.GpuOptions().scene, k, 9) for k in range(9)]
    for camera in cameras:
        pixels, depth = camera.project(np.array([[0.0, 0, 0], [0, 0, 0.5]]))
        assert pixels[0] == pytest.approx([320, 180])
        assert pixels[1, 1] < 180
        assert depth[0] == pytest.approx(np.hypot(2.5, 0.6))
    distance = np.linalg.norm([camera.centre - cameras[8].centre for camera in cameras[:8]], axis=1)
    assert distance[0] == pytest.approx(distance[1])
    assert distance[0] < distance[2:].min()


def test_a_frame_that_repeats_the_one_before_takes_few_bytes():
    rng = np.random.default_rng(0)
    key = Codes(rng.integers(0, 60000, (500, 3)).astype("u2"), rng.integers(0, 256, (500, 10)).astype("u1"))
    still = Segment(0, key, np.ones(500, bool), key.xyz[None].copy(), key.attributes[None].copy())
    moved = replace(still, xyz=still.xyz[:, ::-1].copy())
    assert gpu.zlib_bytes(still)["frame_mean"] < 100
    assert gpu.zlib_bytes(moved)["frame_mean"] > 2500
    assert gpu.zlib_bytes(still)["key"] > 7500
