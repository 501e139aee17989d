"""Where Gaussians are added and taken away.

Growth follows the gradient of the screen position, as in 3D Gaussian Splatting, but by drawing a stated number of
parents instead of a threshold, so a run's size and memory are known beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.depth import COVERED
from packuv.fit.model import Model
from packuv.fit.start.bounds import Bounds
from packuv.gaussians.floats import Gaussians, logit, opacities, opacity, rotation_matrices
from packuv.gaussians.uvmap import assign_slots
from packuv.gaussians.uvsize import UvOptions

SHRINK = np.float32(np.log(1.6))
"""Logarithm of how much smaller the halves of a split Gaussian are, as in 3D Gaussian Splatting"""


@dataclass(frozen=True)
class DensityOptions:
    cap: int = 60_000
    """Gaussians at most; holds memory flat"""
    every: int = 100
    """Iterations between two rounds"""
    until: float = 0.6
    """Share of a keyframe's iterations after which nothing is added any more"""
    min_opacity: float = 0.006
    """Gaussians below are pruned"""
    max_scale: float = 0.5
    """Longest standard deviation allowed, in scene radii"""
    large: float = 0.005
    """A Gaussian with a standard deviation above this many radii is split, one below is cloned"""
    least_views: int = 2
    """Cameras that must show a Gaussian of what is fitted first, when `SUPPORTED_AT` tells; one that does so from afar
    counts as all. Others are pruned: hardly anybody sees them, or one camera alone explains its picture by them, close
    before it, where they hide what others would see. What no picture holds stays: it continues what is beside it.
    0 keeps all"""
    least_shown: float = 0.05
    """Blending weight from which on a camera shows a Gaussian, as a share of a picture's pixels for each of the cap.
    With 0.5 "basketball" loses 0.7 dB where nothing moves: small ones are detail"""
    afar: float = 0.5
    """Depth of a Gaussian, as a share of the median one in the picture; with 0.8 "basketball" loses 0.3 dB there: many
    of its cameras have places of their own"""
    min_gradient: float = 0.0
    """Mean screen gradient under which a Gaussian contributes nothing and is pruned (paper, appendix; with the sense
    of the inequality that its text states)"""


SUPPORTED_AT = (0.4, 0.75, 1.0)
"""Shares of the iterations in which Gaussians are added, after which those that too few cameras show are pruned"""


class Population(Protocol):
    """N Gaussians whose number changes, wherever they are: a `Model` on the host, `RowsOnGpu` on a GPU."""

    def __len__(self) -> int: ...

    def column(self, name: str) -> np.ndarray:
        """An attribute of all rows, float32 [N, ...], to be read only."""

    def some(self, rows: np.ndarray) -> Gaussians:
        """Copies of rows, by index."""

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Change an attribute of rows, indices [n], to values [n, ...]."""

    def keep(self, rows: np.ndarray) -> None:
        """Forget every row that is not in `rows`, bool [N] or ascending indices."""

    def append(self, born: Gaussians) -> None:
        """Add rows after the last one, with fresh moments."""

    def overwrite(self, rows: np.ndarray, values: Gaussians) -> None:
        """Give the rows, indices [n], new lives: values of n Gaussians and fresh moments."""


class ScreenGradient:
    """Mean length of the loss's gradient by the screen position, per Gaussian, over the renderings that drew it."""

    def __init__(self, count: int) -> None:
        self.total = np.zeros(count, np.float64)
        self.seen = np.zeros(count, np.int64)

    def add(self, means2d: np.ndarray, visible: np.ndarray, width: int, height: int) -> None:
        """`means2d` [N, 2] by pixels, `visible` int [N]; stored in units of half a picture, as the field does."""
        self.total += np.hypot(means2d[:, 0] * (width / 2), means2d[:, 1] * (height / 2))
        self.seen += visible > 0

    @property
    def mean(self) -> np.ndarray:
        """float64 [N]"""
        return self.total / np.maximum(self.seen, 1)


def prune(
    model: Model,
    gradient: ScreenGradient,
    taken: np.ndarray,  # float32 [B, 3]
    *,
    bounds: Bounds,
    options: DensityOptions,
    uv: UvOptions,
) -> np.ndarray:
    """Rows worth keeping, bool [N]: opaque, not huge, contributing, and with a place in the UV map (max-K pruning)
    beside the Gaussians at `taken`, whose places are reserved."""
    g = model.gaussians
    keep = opacity(g) > options.min_opacity
    keep &= g.log_scales.max(axis=1) < np.log(options.max_scale * bounds.radius)
    keep &= np.isfinite(g.means).all(axis=1)
    if options.min_gradient > 0:
        keep &= (gradient.seen == 0) | (gradient.mean >= options.min_gradient)
    rows = np.flatnonzero(keep)
    means, reserved = np.concatenate([taken, g.means[rows]]), np.full(len(taken), np.inf)
    slots = assign_slots(means, np.concatenate([reserved, g.opacity_logits[rows]]), bounds.centre, options=uv)
    keep[rows] = slots.kept[len(taken) :]
    return keep


def views_showing(rendering: Any, means: np.ndarray, camera: PinholeCamera, options: DensityOptions) -> np.ndarray:
    """How much the picture of one camera, rendered with weights, counts for each Gaussian at `means`, float32 [N, 3]:
    0, 1, or `options.least_views` from afar; int [N]."""
    shown = rendering.weights >= options.least_shown * camera.width * camera.height / options.cap
    drawn = rendering.alpha > COVERED
    usual = float(np.median(rendering.depth[drawn] / rendering.alpha[drawn])) if drawn.any() else 0.0
    depth = means @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    return np.asarray(shown * np.where(depth >= options.afar * usual, options.least_views, 1))


def grow(
    model: Population,
    score: np.ndarray,
    count: int,
    *,
    bounds: Bounds,
    options: DensityOptions,
    rng: np.random.Generator,
) -> np.ndarray:
    """Add `count` children to parents drawn by `score` [N] (0: never); returns the parents, int [count]."""
    parents = draw(score, count, rng)
    if len(parents):
        born = divide(model, parents, bounds=bounds, options=options, rng=rng)
        model.append(born)
    return parents


def draw(score: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most `count` different rows, drawn in proportion to their score, int64 ascending."""
    count = min(count, int(np.count_nonzero(score > 0)))
    if count < 1:
        return np.empty(0, np.int64)
    weight = np.where(score > 0, score, 0).astype(np.float64)
    return np.sort(rng.choice(len(score), count, replace=False, p=weight / weight.sum()))


def divide(
    model: Population, parents: np.ndarray, *, bounds: Bounds, options: DensityOptions, rng: np.random.Generator
) -> Gaussians:
    """Children of the parents, int [n], which change too: large ones split in two, small ones share their opacity."""
    child = model.some(parents)
    scales = np.exp(child.log_scales)
    large = scales.max(axis=1) > options.large * bounds.radius
    noise = rng.standard_normal(scales.shape) * np.where(large[:, None], 1.0, 0.3)
    child.means[:] += np.einsum("nij,nj->ni", rotation_matrices(child.quaternions), scales * noise)
    halves = logit(1 - np.sqrt(1 - np.minimum(opacity(child), 0.999)))
    child.log_scales[large] -= SHRINK
    child.opacity_logits[~large] = halves[~large]
    model.put("log_scales", parents[large], child.log_scales[large])
    model.put("opacity_logits", parents[~large], halves[~large])
    return child


def relocate(
    model: Population,
    score: np.ndarray,  # [N]
    rows: np.ndarray,  # bool [N], the rows that may change
    *,
    bounds: Bounds,
    options: DensityOptions,
    share: float,
    rng: np.random.Generator,
) -> int:
    """Give dead rows a new life beside rows with a high score, so that the number of rows never changes.

    At most `share` of the living come back at once. Returns how many. As the relocation of 3DGS-MCMC, within `rows`.
    """
    dead = np.flatnonzero(rows & (opacities(model.column("opacity_logits")) <= options.min_opacity))
    alive = rows.copy()
    alive[dead] = False
    parents = draw(np.where(alive, score, 0), min(len(dead), round(share * alive.sum())), rng)
    if not len(parents):
        return 0
    child = divide(model, parents, bounds=bounds, options=options, rng=rng)
    model.overwrite(dead[: len(parents)], child)
    return len(parents)
