"""A solver whose iterations stay on the GPU: pictures, masters, moments, codes, last good values, screen gradients.

The model comes home, to the host's memory, where a run of iterations of a keyframe, or a frame, ends. In between a
camera and a few numbers go up in an iteration, and the number of its pairs comes down; where the number of rows
changes, which of them stay and their screen gradients come down, those that are born go up. Choices at random are
drawn by `Solver`, on the host, so that both devices walk the same schedule.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from packuv.fit.backdrop import Backdrop
from packuv.fit.density import Population, ScreenGradient
from packuv.fit.density_cuda import prune, views_showing
from packuv.fit.model import Model, Rates
from packuv.fit.options import SolverOptions
from packuv.fit.rows_cuda import RowsOnGpu, rates_of
from packuv.fit.shots import Shot
from packuv.fit.shots_cuda import ShotOnGpu
from packuv.fit.solver import Losses, Solver
from packuv.fit.start.bounds import Bounds
from packuv.fit.terms import summed
from packuv.fit.terms_cuda import PullOnGpu, SeenOnGpu, pulls
from packuv.gaussians.floats import ATTRIBUTES
from packuv.raster import RasterOptions
from packuv.raster.cuda.launch import MEMORY, on_device
from packuv.raster.cuda.render import OnGpu, carry, draw


class _Away:
    """The model on the GPU, and what iterations there have not told the host yet."""

    def __init__(self, rows: RowsOnGpu) -> None:
        self.rows = rows
        self.overflown = torch.zeros(1, dtype=torch.int64, device=MEMORY)
        self.forget()

    def forget(self) -> None:
        """Begin anew, with the rows as they are now."""
        count = len(self.rows)
        self.length = torch.zeros(count, dtype=torch.float64, device=MEMORY)
        """As `ScreenGradient.total`"""
        self.seen = torch.zeros(count, dtype=torch.int64, device=MEMORY)
        self.losses: list[tuple[str, dict[str, Any]]] = []
        """Camera and losses of each iteration"""


class ResidentSolver(Solver):
    """Iterations over the pictures of one instant, on a GPU."""

    def __init__(
        self,
        model: Model,
        bounds: Bounds,
        options: SolverOptions,
        rng: np.random.Generator,
        backdrop: Backdrop | None = None,
    ) -> None:
        super().__init__(model, bounds, options, rng, backdrop)
        self._away: _Away | None = None
        self._shots: dict[str, ShotOnGpu] = {}
        """The last shot of each camera"""

    def _iterate(
        self,
        shots: Sequence[Shot],
        index: int,
        near: float,
        *,
        progress: float,
        rates: Rates | None = None,
        opaque: bool = False,
    ) -> Losses:
        options, shot, away = self._options, self._on_gpu(shots[index]), self._left()
        camera, rows, target = shot.shot.camera, away.rows, shot.target
        behind = None
        if opaque:
            target, behind = self._target_before_colour(shot, target, self._is_bare(shots))
        rendering = draw(
            rows.drawn,
            camera,
            options=RasterOptions(near, device=options.device),
            sh_degree=self.model.gaussians.sh_degree,
            tiles=shot.shot.tiles,
            over=self.backdrop.layer(camera, shot.shot.tiles),
        )
        moving = (rows.rows > 0) & (rendering.visible > 0)
        colour, _, alpha = rendering.pictures
        picture = shot.shown(colour if behind is None else colour + (1 - alpha) * behind)
        wanted = shot.wanted(target, picture)
        found = pulls(SeenOnGpu(rendering, picture, wanted, shot, rows.masters, moving, self.bounds.radius), options)
        slopes = self._slopes(rendering, found, shot, behind)
        (*gradients, screen), overflown = carry(rendering, slopes, rows.rows)
        away.length += torch.hypot(screen[:, 0] * (camera.width / 2), screen[:, 1] * (camera.height / 2))
        away.seen += rendering.visible > 0
        for pull in found.values():
            for name, gradient in pull.gaussians.items():
                gradients[ATTRIBUTES.index(name)] += gradient
        now = rates_of(rates or options.rates, self.model.gaussians, radius=self.bounds.radius, progress=progress)
        rows.step(gradients, now, moving.to(torch.uint8), self.done)
        away.overflown += overflown
        self.done += 1
        losses: dict[str, Any] = {name: pull.value for name, pull in found.items()}
        away.losses.append((camera.name, losses))
        return losses

    def _left(self) -> _Away:
        """What is on the GPU; the model goes there if it is at home."""
        if self._away is None:
            quantizer = self._quantizer if self._options.low_precision else None
            self._away = _Away(RowsOnGpu(self.model, self.rows, self.bounds, quantizer))
        return self._away

    @property
    def _population(self) -> Population:
        return self.model if self._away is None else self._away.rows

    def _tell(self) -> None:
        if (away := self._away) is None:
            return
        _to_numbers(away.losses)
        self.gradient.total += away.length.cpu().numpy()
        self.gradient.seen += away.seen.cpu().numpy()
        away.forget()

    def _come_home(self) -> None:
        self._tell()
        away, self._away = self._away, None
        if away is None:
            return
        self._guard.count += away.rows.bring_home(self.model)
        self._guard.renew(self.model)
        self._overflown += int(away.overflown)
        self._drawn = None

    def _start_afresh(self) -> None:
        if self._away is None:
            super()._start_afresh()
            return
        self._away.rows.renew()
        self._away.forget()
        self.gradient = ScreenGradient(len(self._away.rows))

    def worth_keeping(self) -> np.ndarray:
        if self._away is None:
            return super().worth_keeping()
        options, taken, masters = self._options, self.backdrop.gaussians.means, self._away.rows.masters
        kept = prune(masters, self.gradient, taken, bounds=self.bounds, options=options.density, uv=options.uv)
        return kept.cpu().numpy()

    def supported(self, shots: Sequence[Shot]) -> np.ndarray:
        rows, density = self._left().rows, self._options.density
        raster, degree = RasterOptions(self.bounds.near, device=self._options.device), self.model.gaussians.sh_degree
        views = torch.zeros(len(rows), dtype=torch.int64, device=MEMORY)
        held = torch.zeros(len(rows), dtype=torch.bool, device=MEMORY)
        for shot in shots:
            rendering = draw(rows.drawn, shot.camera, options=raster, sh_degree=degree, weights=True)
            views += views_showing(rendering, rows.masters[0], shot.camera, density)
            held |= rendering.weights > 0
        self._come_home()
        return (~held | (views >= density.least_views)).cpu().numpy()

    def _on_gpu(self, shot: Shot) -> ShotOnGpu:
        held = self._shots.get(shot.camera.name)
        if held is None or held.shot is not shot:
            self._shots[shot.camera.name] = held = ShotOnGpu(shot)
        return held

    def _void_share(self, shot: Shot) -> float:
        return self._on_gpu(shot).void_share

    def _target_before_colour(self, shot: ShotOnGpu, target: Tensor, bare: bool) -> tuple[Tensor, Tensor]:
        """As `_before_colour`."""
        void, colour = shot.void(target), on_device(self._colour_behind())
        if not bare:
            return target, colour * ~void
        behind = colour.expand_as(target).contiguous()
        return torch.where(void, shot.shown(behind), target), behind

    def _slopes(
        self, rendering: OnGpu, found: Mapping[str, PullOnGpu], shot: ShotOnGpu, behind: Tensor | None
    ) -> list[Tensor]:
        """Derivatives by colour, depth and alpha, of what pulls at what is shown before the colour `behind`."""
        d_shown, d_depth, d_alpha = (
            summed(getattr(pull, name) for pull in found.values()) for name in ("colour", "depth", "alpha")
        )
        colour, depth, alpha = rendering.pictures
        d_colour = torch.zeros_like(colour) if d_shown is None else shot.carried(d_shown)
        if behind is not None:
            through = (d_colour * behind).sum(dim=0)
            d_alpha = -through if d_alpha is None else d_alpha - through
        return [d_colour, *(torch.zeros_like(p) if d is None else d for d, p in ((d_depth, depth), (d_alpha, alpha)))]


def _to_numbers(losses: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Replace the values by numbers, all at once. Raises ValueError for one that is not finite."""
    places = [(camera, part, name) for camera, part in losses for name in part]
    values = torch.stack([part[name] for _, part, name in places]).tolist() if places else []
    for (camera, part, name), value in zip(places, values, strict=True):
        if not np.isfinite(value):
            raise ValueError(
                f"the {name} loss of camera {camera!r} is {value}: its picture or the Gaussians hold values that are "
                "not finite"
            )
        part[name] = value
