"""Iterations over the pictures of one instant: render, compare, step, and keep the number of Gaussians in hand.

`Solver` holds the schedule and all choices at random, and iterates on the CPU; `packuv.fit.resident` iterates on a GPU
by the same schedule. `packuv.fit.solvers` gives the one that the options' device asks for.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from packuv.fit.backdrop import Backdrop
from packuv.fit.density import Population, ScreenGradient, grow, prune, relocate, views_showing
from packuv.fit.guard import Guard
from packuv.fit.labels import active_tiles
from packuv.fit.model import Model, Rates
from packuv.fit.options import FrameOptions, SolverOptions
from packuv.fit.shots import Shot
from packuv.fit.start.bounds import Bounds
from packuv.fit.terms import Pull, Seen, pulls, summed
from packuv.footage import Response, Views
from packuv.gaussians.codes import Quantizer
from packuv.gaussians.floats import ALPHA_MIN, ATTRIBUTES, Gaussians, opacity, rows_of
from packuv.progress import Ticks
from packuv.raster import Arena, Gradients, RasterOptions, Rendering, gradients, render

_BARE = 0.25
"""Share of all pixels that may show nothing from which on they do: the stage is black, or was masked"""

_ROUND = 24
"""Iterations, at least, before a frame asks how it fares: few cameras are passed over several times"""

_FAINT = 1.02 * ALPHA_MIN
"""Up to this opacity a Gaussian makes no tile active: codes round what lies so near to the least that is drawn"""

_GREY = 1 / 255
"""A loss below one grey level is as good as none: what it gains does not count in full"""


Losses = Mapping[str, float]
"""Values of the terms by name; the loss is their sum"""


def mean_losses(losses: Sequence[Losses]) -> Losses:
    """Mean of each term over the iterations in which it applied."""
    names = dict.fromkeys(name for part in losses for name in part)
    return {name: float(np.mean([part[name] for part in losses if name in part])) for name in names}


class Solver:
    """Iterations over the pictures of one instant, on the CPU."""

    def __init__(
        self,
        model: Model,
        bounds: Bounds,
        options: SolverOptions,
        rng: np.random.Generator,
        backdrop: Backdrop | None = None,
    ) -> None:
        """`backdrop` is drawn with the model's Gaussians, and is not changed."""
        self.model = model
        if backdrop is None:
            backdrop = Backdrop(rows_of(model.gaussians, slice(0, 0)), bounds.near, options.device)
        backdrop.forget()
        self.backdrop = backdrop
        self.rows = np.ones(len(model), bool)
        """Which Gaussians may change"""
        self.gradient = ScreenGradient(len(model))
        self._quantizer: Quantizer | None = None
        self._drawn: Gaussians | None = None
        self.bounds = bounds
        self.cap = max(0, options.density.cap - len(self.backdrop))
        """Gaussians of the model at most"""
        self._options = options
        self._rng = rng
        self._order: list[int] = []
        self._arena = Arena()
        self._guard = Guard(model, bounds)
        self._overflown = 0
        self._bare: bool | None = None
        self.done = 0

    @property
    def known_quantizer(self) -> Quantizer:
        if self._quantizer is None:
            raise RuntimeError("the quantizer is fixed after the first iterations only")
        return self._quantizer

    @property
    def guarded(self) -> int:
        """Times that a Gaussian lost a step because its values or gradients were not finite."""
        return self._guard.count + self._overflown

    def branch(self) -> Solver:
        """Another one in the same state, which goes on by itself."""
        twin = copy.copy(self)
        twin.model, twin.gradient, twin._rng = copy.deepcopy((self.model, self.gradient, self._rng))
        twin.rows, twin._order, twin._drawn = self.rows.copy(), [], None
        twin._guard, twin._arena = Guard(twin.model, self.bounds), Arena()
        return twin

    def merge(self, twin: Solver) -> None:
        """Go on with the Gaussians of a branch, and by its options."""
        self.model.gaussians, self.model.moments = twin.model.gaussians, twin.model.moments
        self._options, self._drawn = twin._options, None
        self._guard.renew(self.model)

    def give_bands(self, degree: int) -> None:
        """Gaussians without view dependence may get as much from now on."""
        self.model.give_sh(degree)
        self._guard.renew(self.model)
        self._drawn = None

    def hold_bands(self) -> None:
        """Rows that may change lose their view dependence, and get none."""
        self.model.gaussians.sh[self.rows, 1:] = 0
        self._options = replace(self._options, rates=replace(self._options.rates, sh_rest=0.0))
        self._drawn = None

    def shown(self, shot: Shot) -> np.ndarray:
        """What the camera makes of the Gaussians, float32 [3, H, W]."""
        raster = RasterOptions(self.bounds.near, device=self._options.device)
        layer = self.backdrop.layer(shot.camera, shot.tiles)
        given: dict[str, Any] = {"options": raster, "tiles": shot.tiles, "arena": self._arena, "over": layer}
        return shot.response.shown(render(self._decoded(), shot.camera, **given).colour)

    def fix(self, quantizer: Quantizer) -> None:
        """From now on render what the codes decode to."""
        self._quantizer, self._drawn = quantizer, None
        self._guard.renew(self.model)

    def free(self, rows: np.ndarray) -> None:
        """Only these rows, bool [N], may change."""
        self.rows = rows.copy()
        self._guard.check(self.model, None, rows, "before the first iteration")

    def append(self, born: Gaussians) -> None:
        """Add Gaussians that may change, the first ones as far as the cap leaves room."""
        born = rows_of(born, slice(0, max(0, self.cap - len(self.model))))
        self.model.append(born)
        self.rows = np.concatenate([self.rows, np.ones(len(born), bool)])
        self._start_afresh()

    def make_room(self, shots: Sequence[Shot]) -> None:
        """Drop what exceeds the cap: of the rows that may change, those that show least in the pictures."""
        excess = len(self.model) - self.cap
        if excess <= 0:
            return
        shown = [self.backdrop.shares(self._decoded(), shot.camera, self._arena) for shot in shots]
        rows, stays = np.flatnonzero(self.rows), np.ones(len(self.model), bool)
        stays[rows[np.argsort(np.sum(shown, axis=0)[rows], kind="stable")[:excess]]] = False
        self.keep(stays)

    def keep(self, rows: np.ndarray) -> None:
        self._population.keep(rows)
        self.rows = self.rows[rows]
        self._start_afresh()

    def run(
        self, shots: Sequence[Shot], count: int, *, of: int, grow_from: int | None = None, ticks: Ticks | None = None
    ) -> Losses:
        """`count` iterations of `of`; returns the mean losses of the last pass.

        With `grow_from` Gaussians in the beginning, their number grows towards the cap; without it stays.
        """
        losses: list[Losses] = []
        self._order = []
        density = self._options.density
        for _ in range(count):
            index, opaque = self._next(shots), self._options.random_background
            losses.append(self._iterate(shots, index, self._near(), progress=self.done / of, opaque=opaque))
            if grow_from is not None and self.done % density.every == 0 and self.done < of * density.until:
                self._tell()
                self._change_density(of, grow_from)
            if ticks:
                ticks.advance()
        self._come_home()
        return mean_losses(losses[-len(shots) :])

    def settle(self, shots: Sequence[Shot], options: FrameOptions, *, usual: float) -> tuple[Losses | None, int]:
        """Rounds over the cameras until they gain little and the loss is near the `usual` one; returns the mean losses
        and the iterations that it took.

        A gain compares each picture with itself, in iterations that draw everything; the losses are None if none did.
        Empty rows are used for what the pictures lack after each of the first rounds.
        """
        limit, done = options.frame_iterations, 0
        losses, gains = dict[int, Losses](), list[float]()
        near = options.near_key * usual
        while done < limit and not (gains and np.mean(gains[-2:]) < options.settle and _total(losses) <= near):
            count = min(max(len(shots), _ROUND), limit - done)
            fresh, done = self._round(shots, count, options.rates.faster(options.frame_rate_scale)), done + count
            if both := sorted(losses.keys() & fresh.keys()):
                before, now = (np.array([sum(part[shot].values()) for shot in both]) for part in (losses, fresh))
                gains.append((before - now).mean() / max(before.mean(), _GREY))
            losses |= fresh
            if done <= limit * options.density.until:
                relocate(
                    self._population,
                    self.gradient.mean,
                    self.rows,
                    bounds=self.bounds,
                    options=options.density,
                    share=options.births_share,
                    rng=self._rng,
                )
                self._start_afresh()
        self._come_home()
        return (mean_losses([losses[shot] for shot in sorted(losses)]) if losses else None), done

    def _round(self, shots: Sequence[Shot], count: int, rates: Rates) -> dict[int, Losses]:
        """`count` iterations of a frame; the last losses of each shot that was drawn whole, by its index."""
        losses: dict[int, Losses] = {}
        for _ in range(count):
            index, near = self._next(shots), self._near()
            found = self._iterate(shots, index, near, progress=0.0, rates=rates)
            if near == self.bounds.near:
                losses[index] = found
        self._tell()
        return losses

    def _next(self, shots: Sequence[Shot]) -> int:
        """The next shot: each once, in an order at random, then again."""
        if not self._order:
            self._order = list(self._rng.permutation(len(shots)))
        return self._order.pop()

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
        """One iteration; its losses are numbers from the next `_tell` on."""
        options, shot = self._options, shots[index].opened()
        behind = None
        if opaque:
            shot, behind = self._before_colour(shot, self._is_bare(shots))
        rendering = render(
            self._decoded(),
            shot.camera,
            options=RasterOptions(near),
            tiles=shot.tiles,
            arena=self._arena,
            over=self.backdrop.layer(shot.camera, shot.tiles),
        )
        moving = self.rows & (rendering.visible > 0)
        colour = rendering.colour if behind is None else rendering.colour + (1 - rendering.alpha) * behind
        picture = shot.response.shown(colour)
        found = pulls(
            Seen(rendering, picture, shot.wanted(picture), shot, self.model.gaussians, moving, self.bounds.radius),
            options,
        )
        drawn = self._carried_back(rendering, found, shot.response, behind)
        self.gradient.add(drawn.means2d, rendering.visible, shot.camera.width, shot.camera.height)
        values = {name: getattr(drawn, name) for name in ATTRIBUTES}
        for pull in found.values():
            for name, gradient in pull.gaussians.items():
                values[name] = values[name] + gradient
        self.model.step(values, rates or options.rates, radius=self.bounds.radius, progress=progress, rows=moving)
        self._guard.check(self.model, values, moving, f"camera {shot.camera.name!r}, iteration {self.done}")
        self._overflown += drawn.overflow_count
        self.done += 1
        return {name: pull.value for name, pull in found.items()}

    def _carried_back(
        self, rendering: Rendering, found: Mapping[str, Pull], response: Response, behind: np.ndarray | None
    ) -> Gradients:
        """Derivatives by the Gaussians of what pulls at what is shown, before the colour `behind` them."""
        d_shown = summed(pull.colour for pull in found.values())
        d_depth, d_alpha = (summed(getattr(pull, name) for pull in found.values()) for name in ("depth", "alpha"))
        d_colour = np.zeros_like(rendering.colour) if d_shown is None else response.carried(d_shown)
        if behind is not None:
            through = (d_colour * behind).sum(axis=0)
            d_alpha = (np.zeros_like(rendering.alpha) if d_alpha is None else d_alpha) - through
        return gradients(rendering, d_colour, d_depth, d_alpha, rows=self.rows)

    def _is_bare(self, shots: Sequence[Shot]) -> bool:
        """Whether people and things stand before black, judged once."""
        if self._bare is None:
            self._bare = float(np.mean([self._void_share(shot) for shot in shots])) > _BARE
        return self._bare

    def _void_share(self, shot: Shot) -> float:
        """Share of the picture that may show nothing."""
        return float(shot.void.mean())

    @property
    def _population(self) -> Population:
        """The Gaussians, where they are."""
        return self.model

    def _tell(self) -> None:
        """From here on the losses of the iterations so far are numbers, and `gradient` knows of them."""

    def _come_home(self) -> None:
        """From here on the model is as the iterations so far have left it, and `_tell` has been done."""

    def _colour_behind(self) -> np.ndarray:
        """At random, float32 [3, 1, 1]."""
        return self._rng.random(3).astype(np.float32)[:, None, None]

    def _before_colour(self, shot: Shot, bare: bool) -> tuple[Shot, np.ndarray]:
        """What to explain, and a colour at random behind all Gaussians, float32 [3, H, W].

        Where the target is black nobody knows whether something is: black stays behind. On a bare stage nothing is
        there: that colour is to be seen, or else black Gaussians fill the stage and hide from unseen cameras what is
        on it.
        """
        void, colour = shot.void, self._colour_behind()
        if not bare:
            return shot, np.asarray(colour * ~void)
        behind = np.broadcast_to(colour, shot.target.shape).copy()
        return replace(shot, source=np.where(void, shot.response.shown(behind), shot.target)), behind

    def _decoded(self) -> Gaussians:
        """What the renderer draws; only rows that may change are decoded again."""
        if self._quantizer is None or not self._options.low_precision:
            return self.model.gaussians
        if self._drawn is None or self.rows.all():
            self._drawn = self._quantizer.decode(self._quantizer.encode(self.model.gaussians))
        else:
            rows = np.flatnonzero(self.rows)
            fresh = self._quantizer.decode(self._quantizer.encode(rows_of(self.model.gaussians, rows)))
            for name in ATTRIBUTES:
                getattr(self._drawn, name)[rows] = getattr(fresh, name)
        return self._drawn

    def _near(self) -> float:
        options, near = self._options, self.bounds.near
        if options.near_jitter and self._rng.random() < options.near_jitter:
            return float(self._rng.uniform(near, max(near, options.near_reach * self.bounds.radius)))
        return near

    def worth_keeping(self) -> np.ndarray:
        """Rows that pruning leaves, bool [N]."""
        options, taken = self._options, self.backdrop.gaussians.means
        return prune(self.model, self.gradient, taken, bounds=self.bounds, options=options.density, uv=options.uv)

    def supported(self, shots: Sequence[Shot]) -> np.ndarray:
        """Rows that enough cameras show, or that no picture holds, bool [N]; for a fit of all that cameras see."""
        raster, density = RasterOptions(self.bounds.near, device=self._options.device), self._options.density
        views, held = np.zeros(len(self.model), np.int64), np.zeros(len(self.model), bool)
        for shot in shots:
            rendering = render(self._decoded(), shot.camera, options=raster, weights=True, arena=self._arena)
            views += views_showing(rendering, self.model.gaussians.means, shot.camera, density)
            held |= rendering.weights > 0
        return ~held | (views >= density.least_views)

    def _change_density(self, of: int, grow_from: int) -> None:
        """Prune, then grow towards the cap."""
        options = self._options.density
        kept = ~self.rows | self.worth_keeping()
        score = np.where(self.rows & kept & (self.gradient.seen > 0), self.gradient.mean, 0)[kept]
        self.keep(kept)
        share = min(1.0, self.done / (of * options.until))
        target = round(grow_from + (self.cap - grow_from) * share)
        before = len(self._population)
        count = max(0, min(target, self.cap) - before)
        grow(self._population, score, count, bounds=self.bounds, options=options, rng=self._rng)
        self.rows = np.concatenate([self.rows, np.ones(len(self._population) - before, bool)])
        self._start_afresh()

    def _start_afresh(self) -> None:
        self.gradient = ScreenGradient(len(self._population))
        self._drawn = None
        self._guard.renew(self.model)


def _total(losses: Mapping[int, Losses]) -> float:
    """Mean over the shots of the sum of the terms."""
    return float(np.mean([sum(terms.values()) for terms in losses.values()]))


def tiled(shots: Sequence[Shot], masks: Sequence[np.ndarray | None], solver: Solver, views: Views) -> list[Shot]:
    """The same pictures, limited to the tiles that a mask or a Gaussian that may change touches."""
    by_name = {camera.name: mask for camera, mask in zip(views.cameras, masks, strict=True)}
    gaussians, near = solver.model.gaussians, solver.bounds.near
    moving = rows_of(gaussians, np.flatnonzero(solver.rows & (opacity(gaussians) > _FAINT)))
    return [
        replace(shot, tiles=active_tiles(by_name[shot.camera.name], moving, shot.camera, near=near)) for shot in shots
    ]
