"""How long an iteration takes on this machine, measured on a made-up scene."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.density import DensityOptions
from packuv.fit.model import Model
from packuv.fit.options import FirstOptions
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.fit.solvers import open_solver
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.floats import Gaussians

WARM, ROUNDS = 4, 12
"""Iterations before the clock runs, and those of which the median is taken"""
LAYERS = 12.0
"""Gaussians that a pixel of the made-up scene lies within one deviation of, on average"""


@dataclass(frozen=True)
class FitSize:
    """What decides how long an iteration takes."""

    width: int
    """Of the pictures, pixels"""
    height: int
    gaussians: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}, {self.gaussians}"


def step_seconds(size: FitSize) -> float:
    """Of one iteration of a fit on whole pictures, median."""
    solver, shots = made_up(size)
    solver.run(shots, WARM, of=1000)
    found = list[float]()
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        solver.run(shots, 1, of=1000)
        found.append(time.perf_counter() - begun)
    return float(np.median(found))


def made_up(size: FitSize, device: str = "cpu") -> tuple[Solver, list[Shot]]:
    """A ball of Gaussians that hides all behind it, filmed from within, with as many layers as a fit has."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(size.gaussians, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * rng.uniform(2.0, 2.4, (size.gaussians, 1))
    deviation = 2.2 * np.sqrt(4 * LAYERS / size.gaussians)  # of a disc with its share of the sphere, LAYERS times
    scales = np.log(deviation) + rng.normal(0, 0.5, (size.gaussians, 3)) - [0, 0, 1.5]
    arrays = (means, scales, rng.normal(size=(size.gaussians, 4)), rng.normal(0, 2, size.gaussians),
              rng.normal(0, 0.3, (size.gaussians, 1, 3)))  # fmt: skip
    gaussians = Gaussians(*(array.astype(np.float32) for array in arrays))
    target = rng.random((3, size.height, size.width)).astype(np.float32)
    shots = [Shot(_camera(size, angle), target) for angle in (0.0, 1.5, 3.0, 4.5)]
    bounds = Bounds(np.zeros(3), 1.0, 0.2)
    room = DensityOptions(cap=5 * size.gaussians // 4)
    return open_solver(Model(gaussians), bounds, FirstOptions(device=device, density=room), rng), shots


def _camera(size: FitSize, angle: float) -> PinholeCamera:
    cos, sin = np.cos(angle), np.sin(angle)
    pose = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 1.0], [0, 0, 0, 1]])
    focal = 0.75 * size.width
    return PinholeCamera(f"at {angle:g}", size.width, size.height, focal, focal, size.width / 2, size.height / 2, pose)
