"""Patches of the backdrop: what changes for good at a date is fitted anew, and all other rows stay, to the bit."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from packuv.camera import PinholeCamera
from packuv.each import Each
from packuv.fit.backdrop import Backdrop, joined
from packuv.fit.keyframe import DEAD_CODE, KeyState, born_in_hull, figures_of, inside, still_shot, undone
from packuv.fit.model import Model
from packuv.fit.options import FirstOptions, NextOptions
from packuv.fit.solver import tiled
from packuv.fit.solvers import open_solver
from packuv.fit.start.bounds import find_bounds
from packuv.fit.start.first import StartOptions
from packuv.fit.start.hull import hull_points
from packuv.footage import Views
from packuv.gaussians.codes import OPACITY
from packuv.gaussians.floats import rows_of
from packuv.motion import Still
from packuv.motion.step import grown
from packuv.progress import Progress, Ticks, no_progress

GROWTH = 0.006
"""Growth of a changed place, share of the picture's width: its edge is blurred, and it was seen in a small picture"""
DENSITY = 3.0
"""Gaussians that a patch may bring, over those that the backdrop has for as much of the pictures"""
TRIALS = 200
"""Points that are sought where the views of a change meet"""


def in_one_place(places: Mapping[int, np.ndarray], cameras: Sequence[PinholeCamera]) -> bool:
    """Whether the changed places of some cameras, bool [h, w] small pictures, are views of one thing: their hull holds
    something."""
    small = [cameras[index].scaled(mask.shape[1], mask.shape[0]) for index, mask in places.items()]
    blank = [np.zeros((3, *mask.shape), np.float32) for mask in places.values()]
    bounds, rng = find_bounds(cameras, near_share=FirstOptions.near_share), np.random.default_rng(0)
    points = hull_points(
        small, blank, list(places.values()), bounds=bounds, options=StartOptions(), count=TRIALS, rng=rng
    )
    return len(points.xyz) > 0


def whole_places(mask: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """The changed places of a small picture in the camera's own, bool [H, W], with the edge that blurs them."""
    radius = max(2, round(GROWTH * camera.width))
    full = cv2.resize(mask.astype(np.uint8), (camera.width, camera.height), interpolation=cv2.INTER_NEAREST) > 0
    return grown(full, camera.width, camera.height, radius)


def fit_patch(
    previous: KeyState,
    views: Views,
    before: Sequence[Still],
    after: Sequence[Still],
    *,
    options: NextOptions,
    progress: Progress = no_progress,
) -> KeyState:
    """Fit the backdrop of the time after a date, or before it, from that of the other side.

    `before` stands still in what `previous` shows, `after` in what is sought; they differ in the changed places only.
    Gaussians in the hull of these may change and go, and new ones are born there. The rows that stay come first.
    """
    started = time.monotonic()
    bounds, quantizer, total = previous.bounds, previous.quantizer, options.key_iterations
    rng = np.random.default_rng([options.seed, 4])
    old = {still.camera: still for still in before}
    places = [index for index, still in enumerate(after) if still.camera in old]
    changed = {after[index].camera: _changed(old[after[index].camera], after[index]) for index in places}
    masks = [changed.get(camera) for camera in range(len(views.cameras))]
    saw = [None if mask is None or not mask.any() else mask for mask in masks]
    loose = inside(previous.gaussians, views, saw, bounds, options)
    kept = rows_of(previous.gaussians, ~loose)
    share = float(np.mean([mask.mean() for mask in changed.values()] or [0]))
    spare = (options.density.cap - len(previous.gaussians)) // 2  # the rest is for what stands before
    fresh = max(0, min(spare, round(DENSITY * share * len(previous.gaussians))))
    density = replace(options.density, cap=len(previous.gaussians) + fresh)
    still = Backdrop(quantizer.decode(quantizer.encode(kept)), bounds.near, options.device, views.budget)
    solver = open_solver(
        Model(rows_of(previous.gaussians, loose)), bounds, replace(options, density=density), rng, backdrop=still
    )
    solver.fix(quantizer)
    # Others saw too little of it to have the median of these instants: there they show the state of the other time.
    seeing = [(still_shot(views, after, index), mask) for index, mask in zip(places, changed.values(), strict=True)
              if mask.any()]  # fmt: skip
    pictures = Each(lambda place: undone(seeing[place][0]), len(seeing))
    births = min(options.key_births, fresh // 2)  # the others where the first ones do not suffice
    cameras, seen = [shot.camera for shot, _ in seeing], [mask for _, mask in seeing]
    solver.append(born_in_hull(cameras, pictures, seen, bounds, options, rng, quantizer.sh_degree, births))
    if not len(solver.model):
        return previous
    shots = tiled([shot for shot, _ in seeing], masks, solver, views)
    losses = solver.run(shots, total, of=total, grow_from=len(solver.model), ticks=Ticks(progress, total))
    solver.keep(solver.worth_keeping())
    codes = quantizer.encode(solver.model.gaussians)
    solver.keep(codes.attributes[:, OPACITY] > DEAD_CODE)
    figures = {**figures_of(started, losses, solver), "kept": len(kept), "loose": int(loose.sum())}
    whole = joined(kept, solver.model.gaussians)
    return replace(previous, gaussians=whole, backdrop=len(whole), figures=figures)


def _changed(before: Still, after: Still) -> np.ndarray:
    """Where two backgrounds of a camera differ, bool [H, W]: in the changed places by noise at least."""
    differs = ((before.pixels != after.pixels).any(axis=2) | (before.known != after.known)).astype(np.uint8)
    return cv2.morphologyEx(differs, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0
