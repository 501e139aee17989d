"""Who renders, compares and labels. What the CUDA kernels make is tried in the files `test_cuda.py`, here and under
`raster`, whose tests need a GPU or numba's simulator: here they run in the latter.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from packuv.camera import PinholeCamera
from packuv.fit import device
from packuv.fit.backdrop import Backdrop, joined
from packuv.fit.device import choose_device, drawn_differently, gpu_is_full, obstacle
from packuv.gaussians.floats import Gaussians, rows_of
from packuv.raster import render
from tests.support.dense_raster import OPTIONS, camera, scene
from tests.support.places import ROOT


@pytest.mark.slow
@pytest.mark.parametrize("tests", ["raster/test_cuda.py", "fit/test_cuda.py", "fit/test_rows_cuda.py",
                                   "fit/test_density_cuda.py", "fit/test_resident.py",
                                   "fit/test_memory_cuda.py"])  # fmt: skip
def test_the_cuda_kernels_do_what_the_cpus_do_in_the_simulator(tests):
    """In an interpreter of its own, since numba reads the switch when it is imported."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", f"tests/packuv/{tests}"]
    environment.pop("PACKUV_REQUIRE", None)
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (" passed, 2 skipped" if tests == "fit/test_cuda.py" else " passed in ") in done.stdout


def erring(change):
    """`render` by a GPU that draws something else: as the CPU draws with other options."""

    def draw(gaussians: Gaussians, view: PinholeCamera, *, options, **given):
        asked = replace(options, device="cpu")
        return render(gaussians, view, options=replace(asked, **change) if options.device == "cuda" else asked, **given)

    return draw


@pytest.mark.parametrize(
    ("change", "sentence"), [({"low_pass_px2": 0.5}, "its colour differs"), ({"near": 4.0}, "its colour differs")]
)
def test_a_gpu_that_draws_something_else_is_refused(monkeypatch, change, sentence):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("numba.cuda.is_available", lambda: True)
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(device, "render", erring(change))
    assert sentence in obstacle()
    assert choose_device("auto") == "cpu"
    with pytest.raises(ValueError, match=f"the GPU cannot be used: .*{sentence}.*--device cpu"):
        choose_device("cuda")


def test_gradients_that_differ_are_refused(monkeypatch):
    monkeypatch.setattr(device, "render", erring({}))
    assert drawn_differently("cuda") is None
    exact, calls = device.gradients, []

    def doubled(rendering, *slopes, **given):
        calls.append(rendering)
        found = exact(rendering, *slopes, **given)
        return replace(found, sh=found.sh * len(calls))

    monkeypatch.setattr(device, "gradients", doubled)
    assert drawn_differently("cuda").startswith("its gradient of sh differs from the CPU's by 1,")


def test_a_backdrop_has_layers():
    backdrop = Backdrop(scene(60), OPTIONS.near)
    layer = backdrop.layer(camera(), None)
    assert backdrop.layer(camera(), None) is layer
    moving = scene(20, seed=1)
    plain = render(joined(scene(60), moving), camera(), options=OPTIONS)
    drawn = render(moving, camera(), options=OPTIONS, over=layer)
    assert np.abs(drawn.colour - plain.colour).max() < 2e-4
    nothing = rows_of(scene(4), slice(0, 0))
    assert Backdrop(nothing, OPTIONS.near).layer(camera(), None) is None


def test_used_up_memory_is_told_from_other_errors():
    assert gpu_is_full(torch.OutOfMemoryError("CUDA out of memory."))
    assert gpu_is_full(RuntimeError("CUDA error: out of memory\nSearch for `cudaErrorMemoryAllocation'"))
    assert gpu_is_full(RuntimeError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY"))
    assert not gpu_is_full(RuntimeError("[700] Call to cuCtxSynchronize results in CUDA_ERROR_ILLEGAL_ADDRESS"))
    assert not gpu_is_full(MemoryError())


def test_without_numba_cuda_the_cpu_does_everything(monkeypatch):
    monkeypatch.setattr(device.importlib.util, "find_spec", lambda name: None)
    assert choose_device("auto") == choose_device("cpu") == "cpu"
    with pytest.raises(
        ValueError, match=r"numba-cuda is not installed \(pip install 'packuv\[cuda12\]', .*; --device cpu"
    ):
        choose_device("cuda")
