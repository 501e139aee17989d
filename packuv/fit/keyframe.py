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

from packuv.camera import PinholeCamera
from packuv.files import save_json, save_npz
from packuv.fit.backdrop import Backdrop, joined
from packuv.fit.losses import photometric_loss
from packuv.fit.model import Model
from packuv.fit.options import FirstOptions, KeyframeOptions, NextOptions
from packuv.fit.shots import Shot, find_shots, halved, moving_rows
from packuv.fit.solver import Losses, Solver, tiled
from packuv.fit.start.bounds import Bounds, find_bounds
from packuv.fit.start.first import first_gaussians, neighbour_distance, round_gaussians
from packuv.fit.start.hull import hull_points, in_hull
from packuv.fit.start.points import Points, drawn, no_points
from packuv.fit.start.shell import Shell, sweep_shell
from packuv.footage import Views, as_planes
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Quantizer, attribute_values
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, rows_of, with_canonical_axes
from packuv.motion import Still
from packuv.motion.step import MotionOptions, changed_between, difference
from packuv.progress import Progress, Ticks, no_progress
from packuv.raster import Arena, RasterOptions, render

LEAST_KNOWN = 0.5
"""Share of the pictures that must be known to stand still for a backdrop"""
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
    def usual_loss(self) -> float:
        """What frames of the segment may be expected to reach; infinite where the fit saw more than what changes."""
        return self.figures["loss"] if self.backdrop and self.figures.get("loss") else math.inf

    def open_backdrop(self, device: str) -> Backdrop:
        """The backdrop, to draw over."""
        still = rows_of(self.gaussians, slice(0, self.backdrop))
        return Backdrop(self.quantizer.decode(self.quantizer.encode(still)), self.bounds.near, device)

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
        with np.load(folder / "state.npz") as arrays:
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
    shots = [still_shot(views, still) for still in stills]
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
    bounds = find_bounds(views.cameras, near_share=options.near_share)
    rng = np.random.default_rng([options.seed, 0 if instant is None else instant, 0])
    cameras, targets = [shot.camera for shot in shots], [shot.response.undone(shot.target) for shot in shots]
    shell = sweep_shell(cameras, targets, bounds=bounds, options=options.shell) if options.shell.enabled else None
    start = first_gaussians(cameras, targets, bounds=bounds, surface=_surface(shell, points, options),
                            options=options.start, sh_degree=options.sh_degree, seed=options.seed)  # fmt: skip
    model = Model(start)
    solver = Solver(model, bounds, options, rng)
    total, grow_from = options.iterations, options.start.count
    ticks = Ticks(progress, total)
    coarse, floating = round(total * options.coarse_share), round(total * options.float_share)
    solver.run([halved(shot) for shot in shots], coarse, of=total, grow_from=grow_from, ticks=ticks)
    if shell is not None:
        depths = (shell.depths(camera, index, bounds.near) for index, camera in enumerate(cameras))
        shots = [replace(shot, depths=known) for shot, known in zip(shots, depths, strict=True)]
    solver.run(shots, floating - solver.done, of=total, grow_from=grow_from, ticks=ticks)
    solver.keep(solver.worth_keeping())
    model.gaussians = with_canonical_axes(model.gaussians)
    model.forget_moments(np.arange(len(model)), ("log_scales", "quaternions"))  # their axes have traded places
    degree = needed_degree(model.gaussians, shots, near=bounds.near, options=options)
    model.limit_sh(degree)
    solver.fix(choose_quantizer(model.gaussians, bounds, degree))
    losses = solver.run(shots, total - floating, of=total, ticks=ticks)
    return KeyState(instant, model.gaussians, 0, solver.known_quantizer, bounds, figures_of(started, losses, solver))


def fit_next(
    previous: KeyState,
    views: Views,
    instant: int,
    *,
    stills: Sequence[Still],
    motion: MotionOptions,
    options: NextOptions,
    progress: Progress = no_progress,
) -> KeyState:
    """Fit a keyframe from the backdrop, or from a neighbouring keyframe, later or earlier.

    Only what differs from there may change: Gaussians that no difference touches keep every code, and those of the
    backdrop keep it in any case. What stood before the background and has gone is dropped, and new Gaussians are born
    in the hull of what stands there now; `stills` may be empty, then nothing is known to have gone. What exceeds the
    cap makes room: of the Gaussians that may change, those that show least.
    """
    started = time.monotonic()
    bounds, quantizer = previous.bounds, previous.quantizer
    rng = np.random.default_rng([options.seed, instant, 1])
    model = Model(previous.foreground)
    solver = Solver(model, bounds, options, rng, previous.open_backdrop(options.device))
    solver.fix(quantizer)
    standing = _standing(views, instant, stills, motion)
    masks = standing if previous.instant is None else _changes(views, previous.instant, instant, motion)
    shots = find_shots(views, instant, masks)
    if not shots:
        return replace(previous, instant=instant, figures=figures_of(started, {}, solver))
    if previous.instant is not None:
        before = _standing(views, previous.instant, stills, motion)
        gone = inside(model.gaussians, views, before, bounds, options)
        solver.keep(~gone | inside(model.gaussians, views, standing, bounds, options))
    solver.free(moving_rows(model.gaussians, quantizer, views, masks, bounds, options))
    solver.make_room(shots)
    seen = [mask if alone is None else alone for alone, mask in zip(standing, masks, strict=True)]
    solver.append(_hull_gaussians(views, instant, seen, bounds, options, rng, quantizer.sh_degree))
    shots = tiled(shots, masks, solver, views)
    if not solver.rows.any():  # nothing that enough cameras see
        figures = figures_of(started, {}, solver)
        return replace(previous, instant=instant, gaussians=_whole(previous, model), figures=figures)
    losses = solver.run(shots, options.key_iterations, of=options.key_iterations, grow_from=len(model),
                      ticks=Ticks(progress, options.key_iterations))  # fmt: skip
    solver.keep(~solver.rows | solver.worth_keeping())
    figures = figures_of(started, losses, solver)
    return replace(previous, instant=instant, gaussians=_whole(previous, model), figures=figures)


def _whole(previous: KeyState, model: Model) -> Gaussians:
    """The backdrop and what stands before it."""
    return joined(rows_of(previous.gaussians, slice(0, previous.backdrop)), model.gaussians)


def _changes(views: Views, first: int, last: int, motion: MotionOptions) -> list[np.ndarray | None]:
    return [changed_between(views, camera, first, last, motion) for camera in range(len(views.cameras))]


def still_shot(views: Views, still: Still) -> Shot:
    """What stands still in a camera, as a picture to explain."""
    response = views.response(still.camera, None)
    return Shot(views.cameras[still.camera], as_planes(still.pixels), response, known=still.known)


def _standing(views: Views, instant: int, stills: Sequence[Still], motion: MotionOptions) -> list[np.ndarray | None]:
    """Where each camera's picture shows what its background lacks, or nobody knows that, bool [H, W]; None without
    one of the two pictures."""
    masks: list[np.ndarray | None] = [None] * len(views.cameras)
    for still in stills:
        pixels = views.steady(still.camera, instant)
        if pixels is not None:
            masks[still.camera] = difference(still.pixels, pixels, motion) | ~still.known
    return masks


def inside(
    gaussians: Gaussians,
    views: Views,
    masks: Sequence[np.ndarray | None],
    bounds: Bounds,
    options: KeyframeOptions,
) -> np.ndarray:
    """Gaussians in the hull of the masks, bool [N]; none if too few cameras have one."""
    seeing = [(camera, mask) for camera, mask in zip(views.cameras, masks, strict=True) if mask is not None]
    if len(seeing) < min(options.start.min_views, len(views.cameras)):
        return np.zeros(len(gaussians), bool)
    cameras, known = [pair[0] for pair in seeing], [pair[1] for pair in seeing]
    return in_hull(gaussians.means.astype(np.float64), cameras, known, bounds=bounds, options=options.start)


def _surface(shell: Shell | None, points: Points | None, options: FirstOptions) -> Points:
    """Where surfaces are: sparse points, sure places of the shell, and the rest of the shell evenly."""
    start, rng = options.start, np.random.default_rng([options.seed, 3])
    room = round(start.count * start.surface_share)
    parts = [] if points is None else [drawn(points, room, rng)]
    if shell is not None:
        parts.append(shell.sure_points(room - sum(len(part.xyz) for part in parts), rng))
        parts.append(shell.cover(round(start.count * start.shell_share)))
    parts = parts or [no_points()]
    return Points(np.concatenate([part.xyz for part in parts]), np.concatenate([part.rgb for part in parts]))


def needed_degree(gaussians: Gaussians, shots: Sequence[Shot], *, near: float, options: FirstOptions) -> int:
    """The lowest SH degree whose pictures are nearly as good as those of all bands: view dependence that a scene does
    not show is not carried. Nothing is fitted again, so a band that helps is kept rather than lost."""
    full, arena, raster = options.sh_degree, Arena(), RasterOptions(near, device=options.device)

    def loss(degree: int) -> float:
        cut = replace(gaussians, sh=np.ascontiguousarray(gaussians.sh[:, : (degree + 1) ** 2]))
        values = []
        for shot in shots:
            picture = shot.response.shown(render(cut, shot.camera, options=raster, arena=arena).colour)
            values.append(photometric_loss(picture, shot.wanted(picture), options=options.photometric).value)
        return float(np.mean(values))

    if not full:
        return 0
    enough = loss(full) * (1 + options.sh_gain)
    return next(degree for degree in range(full + 1) if degree == full or loss(degree) <= enough)


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
    found = [(camera, views.picture(i, instant), masks[i]) for i, camera in enumerate(views.cameras)]
    seeing = [(camera, picture, mask) for camera, picture, mask in found if picture is not None and mask is not None]
    return born_in_hull(seeing, bounds, options, rng, sh_degree, options.key_births)


def born_in_hull(
    seeing: Sequence[tuple[PinholeCamera, np.ndarray, np.ndarray]],
    bounds: Bounds,
    options: KeyframeOptions,
    rng: np.random.Generator,
    sh_degree: int,
    count: int,
) -> Gaussians:
    """At most `count` Gaussians in the hull of masks; of each camera its picture in the rig's colours, float32
    [3, H, W], and its mask, bool [H, W]."""
    points = hull_points([s[0] for s in seeing], [s[1] for s in seeing], [s[2] for s in seeing], bounds=bounds,
                         options=options.start, count=count, rng=rng)  # fmt: skip
    spacing = neighbour_distance(points.xyz.astype(np.float32))
    scale = np.clip(spacing, 1e-4 * bounds.radius, 0.02 * bounds.radius)
    born = round_gaussians(points.xyz, points.rgb, scale, opacity=options.start.opacity, sh_degree=sh_degree)
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
