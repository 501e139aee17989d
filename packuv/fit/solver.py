"""Iterations over the pictures of one instant: render, compare, step, and keep the number of Gaussians in hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from packuv.fit.density import ScreenGradient, grow, prune, relocate
from packuv.fit.depth import depth_loss
from packuv.fit.guard import Guard
from packuv.fit.labels import active_tiles
from packuv.fit.losses import photometric_loss
from packuv.fit.model import Model
from packuv.fit.options import FitOptions
from packuv.fit.shots import Shot
from packuv.fit.start.bounds import Bounds
from packuv.footage.views import Views
from packuv.gaussians.codes import Quantizer
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, opacity, rows_of
from packuv.progress import Ticks
from packuv.raster import Arena, RasterOptions, Rendering, gradients, render

_VOID = 16 / 255
"""A pixel whose channels are all below may show nothing: decoded black is not quite black"""

_ROUND = 24
"""Iterations, at least, before a frame asks how it fares: few cameras are passed over several times"""

_GREY = 1 / 255
"""A loss below one grey level is as good as none: what it gains does not count in full"""


class Solver:
    """Iterations over the pictures of one instant."""

    def __init__(self, model: Model, bounds: Bounds, options: FitOptions, rng: np.random.Generator) -> None:
        self.model = model
        self.rows = np.ones(len(model), bool)
        """Which Gaussians may change"""
        self.gradient = ScreenGradient(len(model))
        self._quantizer: Quantizer | None = None
        self._drawn: Gaussians | None = None
        self.bounds = bounds
        self._options = options
        self._rng = rng
        self._order: list[int] = []
        self._arena = Arena()
        self._guard = Guard(model, bounds)
        self._overflown = 0
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
        born = rows_of(born, slice(0, max(0, self._options.density.cap - len(self.model))))
        self.model.append(born)
        self.rows = np.concatenate([self.rows, np.ones(len(born), bool)])
        self._start_afresh()

    def make_room(self, shots: Sequence[Shot]) -> None:
        """Drop what exceeds the cap: of the rows that may change, those that show least in the pictures."""
        excess = len(self.model) - self._options.density.cap
        if excess <= 0:
            return
        drawn, raster = self._decoded(), RasterOptions(self.bounds.near, device=self._options.device)
        shown = [render(drawn, shot.camera, options=raster, weights=True, arena=self._arena).weights
                 for shot in shots]  # fmt: skip
        rows, stays = np.flatnonzero(self.rows), np.ones(len(self.model), bool)
        stays[rows[np.argsort(np.sum(shown, axis=0)[rows], kind="stable")[:excess]]] = False
        self.keep(stays)

    def keep(self, rows: np.ndarray) -> None:
        self.model.keep(rows)
        self.rows = self.rows[rows]
        self._start_afresh()

    def run(
        self, shots: Sequence[Shot], count: int, *, of: int, dense: bool = False, ticks: Ticks | None = None
    ) -> float:
        """`count` iterations of `of`, if `dense` with growth and pruning; returns the mean loss of the last pass."""
        losses = []
        self._order = []
        for _ in range(count):
            shot, opaque = shots[self._next(shots)], self._options.random_background
            losses.append(self._iterate(shot, self._near(), progress=self.done / of, opaque=opaque))
            if dense and self.done % self._options.density.every == 0 and self.done < of * self._options.density.until:
                self._change_density(of)
            if ticks:
                ticks.advance()
        return float(np.mean(losses[-len(shots) :])) if losses else 0.0

    def settle(self, shots: Sequence[Shot], limit: int) -> tuple[float | None, int]:
        """Rounds over the cameras until they gain little or `limit` iterations; returns the mean loss and the count.

        A gain compares each picture with itself, in iterations that draw everything; the loss is None if none did.
        Empty rows are used for what the pictures lack after each of the first rounds.
        """
        losses, gains, done = np.full(len(shots), np.nan), list[float](), 0
        while done < limit and not (gains and np.mean(gains[-2:]) < self._options.settle):
            count = min(max(len(shots), _ROUND), limit - done)
            fresh, done = self._round(shots, count), done + count
            both = np.isfinite(losses) & np.isfinite(fresh)
            if both.any():
                gains.append((losses - fresh)[both].mean() / max(losses[both].mean(), _GREY))
            losses = np.where(np.isfinite(fresh), fresh, losses)
            if done <= limit * self._options.density.until:
                relocate(self.model, self.gradient.mean, self.rows, bounds=self.bounds,
                         options=self._options.density, share=self._options.births_share, rng=self._rng)  # fmt: skip
                self._start_afresh()
        return (float(np.nanmean(losses)) if np.isfinite(losses).any() else None), done

    def _round(self, shots: Sequence[Shot], count: int) -> np.ndarray:
        """`count` iterations of a frame; the last loss of each shot that was drawn whole, NaN for others, [shots]."""
        losses = np.full(len(shots), np.nan)
        for _ in range(count):
            index, near = self._next(shots), self._near()
            loss = self._iterate(shots[index], near, progress=0.0, scale=self._options.frame_rate_scale)
            if near == self.bounds.near:
                losses[index] = loss
        return losses

    def _next(self, shots: Sequence[Shot]) -> int:
        """The next shot: each once, in an order at random, then again."""
        if not self._order:
            self._order = list(self._rng.permutation(len(shots)))
        return self._order.pop()

    def _iterate(self, shot: Shot, near: float, *, progress: float, scale: float = 1.0, opaque: bool = False) -> float:
        options, drawn = self._options, self._decoded()
        rendering = render(drawn, shot.camera, options=RasterOptions(near, device=options.device),
                           tiles=shot.tiles, arena=self._arena)  # fmt: skip
        behind = self._behind(shot.target) if opaque else None
        picture = rendering.colour if behind is None else rendering.colour + (1 - rendering.alpha) * behind
        # What is not known is taken for right as it is.
        target = shot.target if shot.known is None else np.where(shot.known, shot.target, picture)
        loss = photometric_loss(picture, target, options=options.photometric, tiles=shot.tiles)
        if not np.isfinite(loss.value):
            raise ValueError(f"the loss of camera {shot.camera.name!r} is {loss.value} in iteration {self.done}: its "
                             "picture or the Gaussians hold values that are not finite")  # fmt: skip
        d_depth, d_alpha = self._depth_gradients(rendering, shot)
        if behind is not None:
            d_alpha = d_alpha - (loss.gradient * behind).sum(axis=0)
        found = gradients(rendering, loss.gradient, d_depth, d_alpha, rows=self.rows)
        self.gradient.add(found.means2d, rendering.visible, shot.camera.width, shot.camera.height)
        moving = self.rows & (rendering.visible > 0)
        values = {name: getattr(found, name) for name in ATTRIBUTES}
        self._regularise(values, moving)
        self.model.step(values, options.rates, radius=self.bounds.radius * scale, progress=progress, rows=moving)
        self._guard.check(self.model, values, moving, f"camera {shot.camera.name!r}, iteration {self.done}")
        self._overflown += found.overflow_count
        self.done += 1
        return loss.value

    def _behind(self, target: np.ndarray) -> np.ndarray:
        """A colour at random behind all Gaussians, black where the target is, float32 [3, H, W]."""
        colour = self._rng.random(3).astype(np.float32)
        return colour[:, None, None] * (target.max(axis=0) > _VOID)

    def _depth_gradients(self, rendering: Rendering, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
        weight = np.float32(self._options.depth_weight)
        if shot.depths is None or not weight:
            return np.zeros_like(rendering.depth), np.zeros_like(rendering.alpha)
        _, d_depth, d_alpha = depth_loss(rendering.depth, rendering.alpha, shot.depths, scale=self.bounds.radius)
        return weight * d_depth, weight * d_alpha

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

    def _regularise(self, values: dict[str, np.ndarray], rows: np.ndarray) -> None:
        """Add the gradients of the opacity and scale terms, means over the rows that may change."""
        options, g, count = self._options, self.model.gaussians, max(1, int(rows.sum()))
        if options.opacity_weight:
            alpha = opacity(g)
            slope = alpha * (1 - alpha) * (1 - 2 * alpha) * (options.opacity_weight / count)
            values["opacity_logits"] = values["opacity_logits"] + (slope * rows).astype(np.float32)
        if options.scale_weight:
            axis = g.log_scales.argmax(axis=1)[:, None]
            longest = np.exp(np.take_along_axis(g.log_scales, axis, 1)) / self.bounds.radius
            excess = np.maximum(longest - options.scale_limit, 0) * rows[:, None]
            pull = np.zeros_like(g.log_scales)
            np.put_along_axis(pull, axis, (2 * options.scale_weight / count * excess * longest).astype(np.float32), 1)
            values["log_scales"] = values["log_scales"] + pull

    def worth_keeping(self) -> np.ndarray:
        """Rows that pruning leaves, bool [N]."""
        return prune(self.model, self.gradient, bounds=self.bounds, options=self._options.density, uv=self._options.uv)

    def _change_density(self, of: int) -> None:
        """Prune, then grow towards the cap."""
        options = self._options.density
        kept = ~self.rows | self.worth_keeping()
        score = np.where(self.rows & kept & (self.gradient.seen > 0), self.gradient.mean, 0)[kept]
        self.keep(kept)
        share = min(1.0, self.done / (of * options.until))
        target = round(self._options.start.count + (options.cap - self._options.start.count) * share)
        count = max(0, min(target, options.cap) - len(self.model))
        before = len(self.model)
        grow(self.model, score, count, bounds=self.bounds, options=options, rng=self._rng)
        self.rows = np.concatenate([self.rows, np.ones(len(self.model) - before, bool)])
        self._start_afresh()

    def _start_afresh(self) -> None:
        self.gradient = ScreenGradient(len(self.model))
        self._drawn = None
        self._guard.renew(self.model)


def tiled(shots: Sequence[Shot], masks: Sequence[np.ndarray | None], solver: Solver, views: Views) -> list[Shot]:
    """The same pictures, limited to the tiles that a mask or a Gaussian that may change touches."""
    by_name = {camera.name: mask for camera, mask in zip(views.cameras, masks, strict=True)}
    moving = rows_of(solver.model.gaussians, np.flatnonzero(solver.rows & (opacity(solver.model.gaussians) > 0.004)))
    near = solver.bounds.near
    return [
        replace(shot, tiles=active_tiles(by_name[shot.camera.name], moving, shot.camera, near=near)) for shot in shots
    ]
