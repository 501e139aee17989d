"""Every CUDA kernel compiles for a real GPU. numba-cuda[cu12] or [cu13] brings the compiler, which needs no GPU."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

from tests.support.needs import needs

PROGRAM = r"""
import re
import sys
from types import SimpleNamespace

import numba.cuda.compiler, numba.cuda.dispatcher
import numpy as np
import torch
from numba import cuda, typeof

from packuv.raster.cuda import launch
from packuv.raster import RasterOptions

capability = int(sys.argv[1]), int(sys.argv[2])
for module in (numba.cuda.compiler, numba.cuda.dispatcher):
    module.get_current_device = lambda: SimpleNamespace(compute_capability=capability)


def compiled(kernel, blocks, *given):
    types = tuple(typeof(value.numpy() if isinstance(value, torch.Tensor) else value) for value in given)
    code, _ = cuda.compile_ptx(kernel.py_func, types, cc=capability)
    unordered = re.findall(r"\b(?:atom|red)[.a-z0-9]*[.]f(?:16|32|64)", code)
    print(kernel.py_func.__name__, code.count(".f64"), len(unordered))


launch.MEMORY, launch.run = torch.device("cpu"), compiled
launch.run_rows = lambda kernel, count, *given: compiled(kernel, count, *given)

from packuv.fit import rows_cuda
from packuv.fit.keyframe import choose_quantizer
from packuv.fit.labels import LabelOptions, count_hits
from packuv.fit.losses import PhotometricOptions, photometric_loss
from packuv.fit.model import Model, Rates
from packuv.fit.shots import Shot
from packuv.fit.shots_cuda import ShotOnGpu
from packuv.fit.start.bounds import Bounds
from packuv.raster.cuda import render
from tests.support.dense_raster import camera, scene, upstream

rendering = render.forward(scene(5), camera(), options=RasterOptions(0.05, device="cuda"), weights=True)
render.backward(rendering, *upstream(camera()))
masks = [np.ones((50, 70), bool)]
count_hits(scene(5), [camera()], masks, near=0.05, options=LabelOptions(), device="cuda")
photometric_loss(*np.zeros((2, 3, 9, 9), np.float32), options=PhotometricOptions(), device="cuda")
model, bounds = Model(scene(5)), Bounds(np.zeros(3), 2.0, 0.05)
rows = rows_cuda.RowsOnGpu(model, np.ones(5, bool), bounds, choose_quantizer(model.gaussians, bounds, 3))
rates = rows_cuda.rates_of(Rates(), model.gaussians, radius=1.0, progress=0.0)
rows.step(rows.masters, rates, rows.rows, 1)
held = ShotOnGpu(Shot(camera(), np.zeros((3, 50, 70), np.float32)))
held.carried(held.shown(held.target))
"""
DOUBLE = {"project", "project_backward", "vote_all", "_code"}
SINGLE = {"count_tiles", "list_tiles", "blend", "sum_shares", "blend_backward", "_compare", "_slopes"}
SINGLE |= {"_advance", "_guard", "_show", "_carry"}


def compiler() -> bool:
    """Whether numba-cuda and NVIDIA's libnvvm are installed, by pip or by the system."""
    try:
        places = [importlib.util.find_spec(f"nvidia.{name}") for name in ("cuda_nvcc", "cu13")]
    except ModuleNotFoundError:
        return False
    return importlib.util.find_spec("numba_cuda") is not None and any(places)


@pytest.mark.slow
@needs("nvvm", compiler(), "no numba-cuda with the compiler of CUDA 12 or 13")
@pytest.mark.parametrize("capability", ["7 5", "9 0"])
def test_every_kernel_compiles_sums_in_one_order_and_blending_needs_no_double_precision(capability):
    """Floats that threads add to one place as they come would be another sum each time."""
    command = [sys.executable, "-c", PROGRAM, *capability.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    doubles = {name: int(count) for name, count, _ in lines}
    assert all(unordered == "0" for _, _, unordered in lines)
    assert {name for name, count in doubles.items() if count} == DOUBLE
    assert {name for name, count in doubles.items() if not count} == SINGLE
