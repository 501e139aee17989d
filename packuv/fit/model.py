"""What the fit optimises: float32 Gaussians and the optimizer's memory of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from packuv.fit.adam import AdamState, adam_step
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, rows_of


@dataclass(frozen=True)
class Rates:
    """Step sizes of Adam, per attribute; 3D Gaussian Splatting's values unless a reason is given."""

    means: float = 1.6e-4
    """Times the scene's radius"""
    means_end: float = 0.02
    """Share of the means' rate that is left at the end of a keyframe; falls exponentially"""
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    opacity_logits: float = 5e-2
    sh_base: float = 2.5e-3
    sh_rest: float = 1.25e-4

    def faster(self, factor: float) -> Rates:
        """The same, but means move so many times as far."""
        return replace(self, means=factor * self.means)

    def columns(self, name: str, width: int, *, radius: float, progress: float) -> np.ndarray:
        """float [width]: rate of each column of an attribute's flattened row."""
        if name == "means":
            return np.full(width, self.means * radius * self.means_end**progress)
        if name == "sh":
            rates = np.full(width, self.sh_rest)
            rates[:3] = self.sh_base
            return rates
        return np.full(width, getattr(self, name))


class Model:
    """N Gaussians under optimisation. Rows are never reordered while they live."""

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = Gaussians(*(np.array(getattr(gaussians, name), np.float32, order="C") for name in ATTRIBUTES))
        self.moments = {name: AdamState.zeros(getattr(self.gaussians, name)) for name in ATTRIBUTES}

    def __len__(self) -> int:
        return len(self.gaussians)

    def step(
        self, gradients: Mapping[str, np.ndarray], rates: Rates, *, radius: float, progress: float, rows: np.ndarray
    ) -> None:
        """One step of Adam for the rows, bool [N]; the other rows keep values and moments bit for bit."""
        for name in ATTRIBUTES:
            values, gradient = getattr(self.gaussians, name), gradients[name]
            width = math.prod(values.shape[1:])
            adam_step(values, gradient, self.moments[name], rows=rows,
                      rate=rates.columns(name, width, radius=radius, progress=progress))  # fmt: skip

    def column(self, name: str) -> np.ndarray:
        """An attribute of all rows, float32 [N, ...]."""
        return np.asarray(getattr(self.gaussians, name))

    def some(self, rows: np.ndarray) -> Gaussians:
        """Copies of rows, by index."""
        return rows_of(self.gaussians, rows)

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Change an attribute of rows, indices [n], to values [n, ...]; moments stay."""
        getattr(self.gaussians, name)[rows] = values

    def keep(self, rows: np.ndarray) -> None:
        """Forget every row that is not in `rows`, bool [N] or ascending indices."""
        self.gaussians = Gaussians(*(np.ascontiguousarray(getattr(self.gaussians, name)[rows]) for name in ATTRIBUTES))
        self.moments = {name: state.take(rows) for name, state in self.moments.items()}

    def append(self, born: Gaussians) -> None:
        """Add rows after the last one, with fresh moments."""
        merged = [np.concatenate([getattr(g, name) for g in (self.gaussians, born)]) for name in ATTRIBUTES]
        self.gaussians = Gaussians(*merged)
        self.moments = {name: state.grown(len(born)) for name, state in self.moments.items()}

    def give_sh(self, degree: int) -> None:
        """Add the spherical harmonics up to a degree, all 0, to a model that has those of degree 0."""
        bands = (degree + 1) ** 2 - 1
        self.gaussians = replace(self.gaussians, sh=np.pad(self.gaussians.sh, ((0, 0), (0, bands), (0, 0))))
        state = self.moments["sh"]
        first, second = (np.pad(moment, ((0, 0), (0, 3 * bands))) for moment in (state.first, state.second))
        self.moments["sh"] = AdamState(first, second, state.steps)

    def overwrite(self, rows: np.ndarray, values: Gaussians) -> None:
        """Give the rows, indices [n], new lives: values of n Gaussians and fresh moments."""
        for name in ATTRIBUTES:
            getattr(self.gaussians, name)[rows] = getattr(values, name)
            state = self.moments[name]
            state.first[rows], state.second[rows], state.steps[rows] = 0, 0, 0

    def forget_moments(self, rows: np.ndarray, names: Sequence[str] = ATTRIBUTES) -> None:
        """Start the optimizer afresh for the rows, as a new frame does."""
        for name in names:
            state = self.moments[name]
            state.first[rows], state.second[rows], state.steps[rows] = 0, 0, 0
