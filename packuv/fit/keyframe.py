"""Fit the backdrop and keyframes to the pictures of many cameras (paper §4.2); `packuv.fit.frames` fits the frames
between them.

    fit_backdrop  what stands still in each camera -> Gaussians that no later fit touches
    fit_first     pictures of one instant -> a keyframe without a backdrop, where too little is known to stand still
    fit_next      the backdrop, or a keyframe, and the pictures of an instant -> its keyframe

The first of them also fixes the quantizer of the whole sequence. From then on every iteration renders decoded codes and
the gradient passes straight through to float32 masters (low-precision optimisation), so the codes that are stored are
the ones that were fitted.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from packuv.budget import Budget
from packuv.camera import PinholeCamera
from packuv.each import Each, as_bits, packed
from packuv.files import open_npz, save_json, save_npz
from packuv.fit.backdrop import Backdrop, joined
from packuv.fit.bands import Judgement, judge, left_out, still_bands
from packuv.fit.density import SUPPORTED_AT
from packuv.fit.model import Model
from packuv.fit.options import FirstOptions, KeyframeOptions, NextOptions
from packuv.fit.shots import Shot, find_shots, halved, moving_rows
from packuv.fit.solver import Losses, Solver, tiled
from packuv.fit.solvers import open_solver
from packuv.fit.start.bounds import Bounds, find_bounds
from packuv.fit.start.first import AIR_OPACITY, first_gaussians, neighbour_distance, round_gaussians
from packuv.fit.start.hull import hull_points, in_hull
from packuv.fit.start.points import Points, drawn, no_points, together
from packuv.fit.start.shell import Shell, sweep_shell
from packuv.footage import Silhouettes, Views
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Quantizer, attribute_values
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, rows_of, with_canonical_axes
from packuv.motion import Still
from packuv.motion.step import MotionOptions, changed_between, difference
from packuv.progress import Progress, Ticks, no_progress

LEAST_KNOWN = 0.5
"""Share of the pictures that must be known to stand still for a backdrop"""
FOREGROUND_GAIN = 0.01
"""Share of the loss that the bands of a keyframe's own Gaussians must gain; without, they cost nothing in the file"""
FOREGROUND_JUDGED_BY = 0.02
"""Share of a keyframe's iterations by which each degree shows what it can do"""
JUDGED_FROM, JUDGED_BY = 0.3, 0.1
"""Shares of the first fit's iterations: before bands are tried, without the cameras that judge, and for each degree"""
DEAD_CODE = 1
"""Opacity codes up to this one decode below 1/255, which no renderer draws"""


@dataclass(frozen=True)
class KeyState:
    """The backdrop or a fitted keyframe, from which segments and the next keyframe start."""

    instant: int | None
    """None of the backdrop alone"""
    gaussians: Gaussians
    """float32 masters, not rounded to codes"""
    backdrop: int
    """How many of the first rows are the backdrop's: the same in every keyframe and frame, to the bit"""
    quantizer: Quantizer
    bounds: Bounds
    figures: Mapping[str, Any]
    """What the fit measured: seconds, loss and its terms, Gaussians"""

    @property
    def foreground(self) -> Gaussians:
        """Rows after those of the backdrop"""
        return rows_of(self.gaussians, slice(self.backdrop, None))

    @property
    def still_bands(self) -> bool:
        """Whether rows after the backdrop's have no view dependence though the table has room for it."""
        return self.quantizer.sh_degree > 0 and self.figures.get("sh", {}).get("degree") == 0

    @property
    def usual_loss(self) -> float:
        """What frames of the segment may be expected to reach; infinite where the fit saw more than what changes."""
        return self.figures["loss"] if self.backdrop and self.figures.get("loss") else math.inf

    def open_backdrop(self, device: str, budget: Budget) -> Backdrop:
        """The backdrop, to draw over; the budget is for its layers."""
        still = rows_of(self.gaussians, slice(0, self.backdrop))
        return Backdrop(self.quantizer.decode(self.quantizer.encode(still)), self.bounds.near, device, budget)

    def save(self, folder: Path) -> None:
        """Write state.npz and key.json."""
        save_npz(folder / "state.npz", {name: getattr(self.gaussians, name) for name in ATTRIBUTES})
        bounds = {"centre": self.bounds.centre.tolist(), "radius": self.bounds.radius, "near": self.bounds.near}
        facts = {"instant": self.instant, "backdrop": self.backdrop, "quantizer": self.quantizer.to_json()}
        save_json(folder / "key.json", {**facts, "bounds": bounds, "figures": dict(self.figures)})

    @classmethod
    def load(cls, folder: Path) -> KeyState:
        data = json.loads((folder / "key.json").read_text())
        bounds = Bounds(np.array(data["bounds"]["centre"]), data["bounds"]["radius"], data["bounds"]["near"])
        with open_npz(folder / "state.npz") as arrays:
            gaussians = Gaussians(*(arrays[name] for name in ATTRIBUTES))
        quantizer = Quantizer.from_json(data["quantizer"])
        return cls(data["instant"], gaussians, data["backdrop"], quantizer, bounds, data["figures"])


def enough_stands_still(stills: int, known_share: float, pictures: int) -> bool:
    """Whether all keyframes may build on a backdrop: so many cameras have a background, of which this mean share of the
    pixels is known, and so many film at once."""
    return stills >= max(2, pictures) and known_share >= LEAST_KNOWN


def fit_backdrop(
    views: Views,
    stills: Sequence[Still],
    *,
    points: Points | None,
    options: FirstOptions,
    progress: Progress = no_progress,
) -> KeyState:
    """Fit what stands still, from sparse points, the shell around the scene and random Gaussians.

    `views` must hold the cameras to fit and no others. Raises ValueError for fewer than two stills.
    """
    if len(stills) < 2:
        raise ValueError(f"a backdrop needs what stands still in two cameras, but is given {len(stills)}")
    shots = [still_shot(views, stills, index) for index in range(len(stills))]
    room = replace(options.density, cap=round(options.backdrop_share * options.density.cap))
    state = _fit_all(views, shots, None, points, replace(options, density=room), progress)
    drawn = state.quantizer.encode(state.gaussians).attributes[:, OPACITY] > DEAD_CODE
    count = int(drawn.sum())
    figures = {**state.figures, "gaussians": count}
    return replace(state, gaussians=rows_of(state.gaussians, drawn), backdrop=count, figures=figures)


def fit_first(
    views: Views, instant: int, *, points: Points | None, options: FirstOptions, progress: Progress = no_progress
) -> KeyState:
    """Fit all that the pictures of an instant show, as `fit_backdrop` does. Raises ValueError for fewer than two."""
    return _fit_all(views, find_shots(views, instant), instant, points, options, progress)


def _fit_all(
    views: Views,
    shots: Sequence[Shot],
    instant: int | None,
    points: Points | None,
    options: FirstOptions,
    progress: Progress,
) -> KeyState:
    started = time.monotonic()
    options = replace(options, start=options.start.within(options.density.cap))
    bounds = find_bounds(views.cameras, near_share=options.near_share)
    rng = np.random.default_rng([options.seed, 0 if instant is None else instant, 0])
    cameras, targets = [shot.camera for shot in shots], Each(lambda index: undone(shots[index]), len(shots))
    shell = sweep_shell(cameras, targets, bounds=bounds, options=options.shell) if options.shell.enabled else None
    start = first_gaussians(cameras, targets, bounds=bounds, surface=_surface(shell, points, options),
                            options=options.start, sh_degree=0, seed=options.seed)  # fmt: skip
    model = Model(start)
    solver = open_solver(model, bounds, options, rng)
    total, grow_from = options.iterations, len(model)
    ticks = Ticks(progress, total)
    judges = left_out(cameras) if options.sh_degree else []
    coarse, floating = round(total * options.coarse_share), round(total * options.float_share)
    small = [halved(shot) for index, shot in enumerate(shots) if index not in judges]
    solver.run(small, coarse, of=total, grow_from=grow_from, ticks=ticks)
    if shell is not None:
        depths = (shell.depths(camera, index, bounds.near) for index, camera in enumerate(cameras))
        shots = [replace(shot, depths=known) for shot, known in zip(shots, depths, strict=True)]
        del shell
    judgement = None
    if options.sh_degree:
        part = [shot for index, shot in enumerate(shots) if index not in judges]
        solver.run(part, round(JUDGED_FROM * total) - coarse, of=total, grow_from=grow_from, ticks=ticks)
        done = solver.done
        degrees = range(options.sh_degree + 1)
        judgement, solver = judge(solver, shots, judges, degrees, Solver.give_bands, share=JUDGED_BY, of=total,
                                  gain=options.sh_gain, options=options.photometric)  # fmt: skip
        model = solver.model
        ticks.advance(solver.done - done)
    for share in SUPPORTED_AT if options.density.least_views else ():
        pause = min(round(share * options.density.until * total), floating)
        solver.run(shots, pause - solver.done, of=total, grow_from=grow_from, ticks=ticks)
        solver.keep(solver.supported(shots))
    solver.run(shots, floating - solver.done, of=total, grow_from=grow_from, ticks=ticks)
    solver.keep(solver.worth_keeping())
    model.gaussians = with_canonical_axes(model.gaussians)
    model.forget_moments(np.arange(len(model)), ("log_scales", "quaternions"))  # their axes have traded places
    solver.fix(choose_quantizer(model.gaussians, bounds, 0 if judgement is None else judgement.degree))
    losses = solver.run(shots, total - floating, of=total, ticks=ticks)
    figures = figures_of(started, losses, solver) | ({} if judgement is None else {"sh": judgement.to_json()})
    return KeyState(instant, model.gaussians, 0, solver.known_quantizer, bounds, figures)


def fit_next(
    previous: KeyState,
    views: Views,
    instant: int,
    *,
    stills: Sequence[Still],
    silhouettes: Silhouettes | None = None,
    motion: MotionOptions,
    options: NextOptions,
    progress: Progress = no_progress,
) -> KeyState:
    """Fit a keyframe from the backdrop, or from a neighbouring keyframe, later or earlier.

    Only what differs from there may change: Gaussians that no difference touches keep every code, and those of the
    backdrop keep it in any case. What stood before the background and has gone is dropped, and new Gaussians are born
    in the hull of what stands there now; `stills` may be empty, then nothing is known to have gone. `silhouettes` of
    some cameras say what stands there: half of the new ones are born in their hull. What exceeds the
    cap makes room: of the Gaussians that may change, those that show least.
    """
    started = time.monotonic()
    bounds, quantizer = previous.bounds, previous.quantizer
    if previous.instant is None:
        options = replace(options, rates=options.rates.faster(options.key_rate_scale))
    rng = np.random.default_rng([options.seed, instant, 1])
    model = Model(previous.foreground)
    solver = open_solver(model, bounds, options, rng, previous.open_backdrop(options.device, views.budget))
    solver.fix(quantizer)
    standing = unlike_background(views, instant, stills, motion)
    ahead = _ahead(views, instant, standing, silhouettes)
    masks = _either(standing, ahead) if previous.instant is None else _changes(views, previous.instant, instant, motion)
    shots = find_shots(views, instant, masks)
    if not shots:
        return replace(previous, instant=instant, figures=figures_of(started, {}, solver) | _unjudged(previous))
    if previous.instant is not None:
        before = _ahead(
            views, previous.instant, unlike_background(views, previous.instant, stills, motion), silhouettes
        )
        gone = inside(model.gaussians, views, before, bounds, options)
        solver.keep(~gone | inside(model.gaussians, views, ahead, bounds, options))
    solver.free(moving_rows(model.gaussians, quantizer, views, masks, bounds, options))
    solver.make_room(shots)
    foregrounds = [ahead] if ahead is standing else [ahead, standing]  # shadows need Gaussians, too
    part = replace(options, key_births=options.key_births // len(foregrounds))
    for foreground in foregrounds:
        seen = _first_known(foreground, masks)
        solver.append(_hull_gaussians(views, instant, seen, bounds, part, rng, quantizer.sh_degree))
    shots = tiled(shots, masks, solver, views)
    if not solver.rows.any():  # nothing that enough cameras see
        figures = figures_of(started, {}, solver) | _unjudged(previous)
        return replace(previous, instant=instant, gaussians=_whole(previous, model), figures=figures)
    ticks, judgement, born_from = Ticks(progress, options.key_iterations), None, len(model)
    if quantizer.sh_degree:
        judgement = _judge_foreground(solver, shots, quantizer.sh_degree, options, ticks)
    count = options.key_iterations
    losses = solver.run(shots, count - solver.done, of=count, grow_from=born_from, ticks=ticks)
    solver.keep(~solver.rows | solver.worth_keeping())
    figures = figures_of(started, losses, solver) | ({} if judgement is None else {"sh": judgement.to_json()})
    return replace(previous, instant=instant, gaussians=_whole(previous, model), figures=figures)


def _unjudged(previous: KeyState) -> dict[str, Any]:
    """Figures of a keyframe in which nothing is fitted: before a backdrop, what comes into view later has no bands that
    nobody judged."""
    if previous.quantizer.sh_degree and previous.instant is None:
        return {"sh": {"degree": 0}}
    return {"sh": previous.figures["sh"]} if "sh" in previous.figures else {}


def _judge_foreground(
    solver: Solver, shots: Sequence[Shot], degree: int, options: NextOptions, ticks: Ticks
) -> Judgement:
    """Spend half of the iterations to find out whether what may change needs the bands that the backdrop has."""
    judges, count = left_out([shot.camera for shot in shots]), options.key_iterations
    part = [shot for index, shot in enumerate(shots) if index not in judges]
    solver.run(part, count // 2, of=count, grow_from=len(solver.model), ticks=ticks)
    judgement, best = judge(solver, shots, judges, (0, degree), still_bands, share=FOREGROUND_JUDGED_BY, of=count,
                            gain=FOREGROUND_GAIN, options=options.photometric)  # fmt: skip
    solver.merge(best)
    return judgement


def _whole(previous: KeyState, model: Model) -> Gaussians:
    """The backdrop and what stands before it."""
    return joined(rows_of(previous.gaussians, slice(0, previous.backdrop)), model.gaussians)


def _changes(views: Views, first: int, last: int, motion: MotionOptions) -> Sequence[np.ndarray | None]:
    return as_bits(changed_between(views, camera, first, last, motion) for camera in range(len(views.cameras)))


def still_shot(views: Views, stills: Sequence[Still], index: int) -> Shot:
    """What stands still in a camera, as a picture to explain."""
    still = stills[index]
    camera, response = views.cameras[still.camera], views.response(still.camera, None)
    return Shot(camera, lambda: stills[index].pixels, response, known=packed(still.known))


def undone(shot: Shot) -> np.ndarray:
    """The picture in the rig's common colour, float32 [3, H, W]."""
    return shot.response.undone(shot.target)


def unlike_background(
    views: Views, instant: int, stills: Sequence[Still], motion: MotionOptions
) -> Sequence[np.ndarray | None]:
    """Where each camera's picture shows what its background lacks, or nobody knows that, bool [H, W]; None without
    one of the two pictures."""
    numbers = {still.camera: index for index, still in enumerate(stills)}

    def mask(camera: int) -> np.ndarray | None:
        pixels = views.steady(camera, instant) if camera in numbers else None
        if pixels is None:
            return None
        still = stills[numbers[camera]]
        return np.asarray(difference(still.pixels, pixels, motion) | ~still.known)

    return as_bits(mask(camera) for camera in range(len(views.cameras)))


def _ahead(
    views: Views, instant: int, standing: Sequence[np.ndarray | None], silhouettes: Silhouettes | None
) -> Sequence[np.ndarray | None]:
    """What stands before the background, bool [H, W] by camera: what a mask says, and `standing` without one. Both
    together would have shadows and noise stand there, too."""
    if silhouettes is None:
        return standing
    masks = as_bits(silhouettes.of(name, instant) for name in views.names)
    if all(mask is None for mask in masks):
        return standing
    return _first_known(masks, standing)


def _first_known(
    masks: Sequence[np.ndarray | None], others: Sequence[np.ndarray | None]
) -> Sequence[np.ndarray | None]:
    """The masks, and the others where there is none; one at a time in memory."""
    return Each(lambda index: others[index] if masks[index] is None else masks[index], len(masks))


def _either(first: Sequence[np.ndarray | None], second: Sequence[np.ndarray | None]) -> Sequence[np.ndarray | None]:
    """What one of two masks has, or both, by camera."""
    if first is second:
        return first

    def one(index: int) -> np.ndarray | None:
        known = [mask for mask in (first[index], second[index]) if mask is not None]
        return np.asarray(np.logical_or.reduce(known)) if known else None

    return Each(one, len(first))


def inside(
    gaussians: Gaussians,
    views: Views,
    masks: Sequence[np.ndarray | None],
    bounds: Bounds,
    options: KeyframeOptions,
) -> np.ndarray:
    """Gaussians in the hull of the masks, bool [N]; none if too few cameras have one."""
    seeing = [index for index, mask in enumerate(masks) if mask is not None]
    if len(seeing) < min(options.start.min_views, len(views.cameras)):
        return np.zeros(len(gaussians), bool)
    cameras, known = [views.cameras[index] for index in seeing], _those(masks, seeing)
    return in_hull(gaussians.means.astype(np.float64), cameras, known, bounds=bounds, options=options.start)


def _those(things: Sequence[np.ndarray | None], places: Sequence[int]) -> Each[np.ndarray]:
    """Those at some places, where there are some."""

    def one(index: int) -> np.ndarray:
        thing = things[places[index]]
        assert thing is not None, "nothing is at a place where something was"
        return thing

    return Each(one, len(places))


def _surface(shell: Shell | None, points: Points | None, options: FirstOptions) -> Points:
    """Where surfaces are: sparse points, and the shell as far as it explains the pictures."""
    start, rng = options.start, np.random.default_rng([options.seed, 3])
    room = round(start.count * start.surface_share * (1 if shell is None else shell.explained))
    sparse = no_points() if points is None else drawn(points, room // 2, rng)
    return sparse if shell is None else together(sparse, shell.places(room - len(sparse.xyz), rng))


def choose_quantizer(gaussians: Gaussians, bounds: Bounds, sh_degree: int) -> Quantizer:
    """Ranges from what is fitted first with room for what later frames bring; frozen for the sequence."""
    values = attribute_values(gaussians)  # [N, A]
    low, high = (np.quantile(values, q, axis=0).astype(np.float64) for q in (0.0005, 0.9995))
    margin = 0.15 * np.maximum(high - low, 1e-3)
    low, high = low - margin, high + margin
    # Axes trade places while they are fitted: one range for all three.
    low[:3], high[:3] = low[:3].min(), high[:3].max()
    # A canonical rotation starts below 0.71 and may turn on by some ten degrees.
    low[3:6], high[3:6] = -0.8, 0.8
    low[6], high[6] = OPACITY_RANGE
    # What comes into view later may have any colour of the picture.
    low[7:10], high[7:10] = np.minimum(low[7:10], -1.9).min(), np.maximum(high[7:10], 1.9).max()
    if sh_degree > 0:
        reach = max(np.abs(low[10:]).max(), np.abs(high[10:]).max())
        low[10:], high[10:] = -reach, reach
    distance = np.abs(gaussians.means.astype(np.float64) - bounds.centre).max(axis=0)
    reach_xyz = 1.1 * np.maximum(distance, 1.5 * bounds.radius)
    return Quantizer(bounds.centre.copy(), 0.5 * bounds.radius, reach_xyz, low, high, sh_degree)


def _hull_gaussians(
    views: Views,
    instant: int,
    masks: Sequence[np.ndarray | None],
    bounds: Bounds,
    options: NextOptions,
    rng: np.random.Generator,
    sh_degree: int,
) -> Gaussians:
    """New Gaussians inside the hull of the masks: what moved there since the last keyframe has none yet."""
    seeing = [index for index, mask in enumerate(masks) if mask is not None and views.has(index, instant)]
    pictures = Each(lambda camera: views.picture(camera, instant), len(views.cameras))
    cameras = [views.cameras[index] for index in seeing]
    return born_in_hull(cameras, _those(pictures, seeing), _those(masks, seeing), bounds, options, rng,
                        sh_degree, options.key_births)  # fmt: skip


def born_in_hull(
    cameras: Sequence[PinholeCamera],
    pictures: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    bounds: Bounds,
    options: KeyframeOptions,
    rng: np.random.Generator,
    sh_degree: int,
    count: int,
) -> Gaussians:
    """At most `count` Gaussians in the hull of masks, bool [H, W], coloured by the pictures, float32 [3, H, W], in the
    rig's colours."""
    points = hull_points(cameras, pictures, masks, bounds=bounds, options=options.start, count=count, rng=rng)
    spacing = neighbour_distance(points.xyz.astype(np.float32))
    scale = np.clip(spacing, 1e-4 * bounds.radius, 0.02 * bounds.radius)
    born = round_gaussians(points.xyz, points.rgb, scale, opacity=AIR_OPACITY, sh_degree=sh_degree)
    return with_canonical_axes(born)


def figures_of(started: float, losses: Losses, solver: Solver) -> dict[str, Any]:
    """What a fit that began at `started`, monotonic seconds, measured."""
    return {
        "seconds": time.monotonic() - started,
        "loss": sum(losses.values()),
        "losses": dict(losses),
        "gaussians": len(solver.backdrop) + len(solver.model),
        "changed": int(solver.rows.sum()),
        "iterations": solver.done,
        "guarded": solver.guarded,
        "saturated": solver.known_quantizer.saturation(solver.model.gaussians),
    }
