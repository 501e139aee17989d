"""Who iterates: the CPU, or a GPU on which all stays."""

from __future__ import annotations

import numpy as np

from packuv.fit.backdrop import Backdrop
from packuv.fit.model import Model
from packuv.fit.options import SolverOptions
from packuv.fit.solver import Solver
from packuv.fit.start.bounds import Bounds


def open_solver(
    model: Model,
    bounds: Bounds,
    options: SolverOptions,
    rng: np.random.Generator,
    backdrop: Backdrop | None = None,
) -> Solver:
    """A solver on the options' device, with the arguments of `Solver`."""
    if options.device == "cpu":
        return Solver(model, bounds, options, rng, backdrop)
    from packuv.fit.resident import ResidentSolver  # late, for it needs a GPU's libraries

    return ResidentSolver(model, bounds, options, rng, backdrop)
