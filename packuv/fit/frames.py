"""Fit the frames of a segment, each from the one before it (paper §4.2)."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from packuv.files import open_npz, save_json, save_npz
from packuv.fit.backdrop import Backdrop
from packuv.fit.keyframe import DEAD_CODE, KeyState
from packuv.fit.lift import lift_motion
from packuv.fit.model import Model
from packuv.fit.options import FrameOptions
from packuv.fit.prepare import Instant, Send, prepared
from packuv.fit.shots import find_shots, moving_rows
from packuv.fit.solver import tiled
from packuv.fit.solvers import open_solver
from packuv.fit.start.first import empty_gaussians
from packuv.footage import Views
from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.floats import ATTRIBUTES, Gaussians, opacity, rows_of
from packuv.gaussians.segment import Segment
from packuv.motion import MotionCache
from packuv.progress import Progress, Ticks, no_progress

TRACK = "track.json"
"""Figures of the frames that are done; their list decides what counts"""


def fit_segment(
    key: KeyState,
    views: Views,
    instants: range,
    *,
    motion: MotionCache,
    options: FrameOptions,
    scratch: Path,
    workers: int = 2,
    progress: Progress = no_progress,
) -> tuple[Segment, list[dict[str, Any]]]:
    """Fit the frames of one segment; `instants` starts with the keyframe's own. Also returns figures per frame.

    After every frame the state goes to `scratch`, from which a later call continues with the same result. For a GPU,
    `workers` threads prepare the next frame meanwhile.
    """
    if instants.start != key.instant:
        raise ValueError(f"a segment starts at its keyframe, instant {key.instant}, not at {instants.start}")
    if key.still_bands:
        options = replace(options, rates=replace(options.rates, sh_rest=0.0))
    track, backdrop = Track.resume(key, options.spare, scratch), key.open_backdrop(options.device, views.budget)
    ticks = Ticks(progress, len(instants) - 1, done=len(track.frames))
    flows = options.lift.enabled and motion.options.keep_flow  # without, as of hours, Gaussians start where they were
    rows, send = instants[1 + len(track.frames) :], _sender(options.device)
    with prepared(views, motion, rows, flows=flows, send=send, workers=workers) as coming:
        for instant in coming:
            views.forget()
            track.add(_fit_frame(track.model, key, backdrop, views, instant, options))
            track.checkpoint()
            ticks.advance()
    return track.segment(instants.start), track.figures


def _sender(device: str) -> Send | None:
    if device == "cpu":
        return None
    from packuv.raster.cuda.launch import send  # late, for it needs a GPU's libraries

    return send


def _fit_frame(
    model: Model,
    key: KeyState,
    backdrop: Backdrop,
    views: Views,
    instant: Instant,
    options: FrameOptions,
) -> tuple[np.ndarray, dict[str, Any]]:
    """Carry the model on to one instant; returns the rows that it changed, bool [N], and figures."""
    masks, rows = instant.masks, np.zeros(len(model), bool)
    if not any(mask is not None and mask.any() for mask in masks):
        return rows, {
            "instant": instant.row,
            "seconds": time.monotonic() - instant.asked,
            "iterations": 0,
            "dynamic": 0,
        }
    rng = np.random.default_rng([options.seed, instant.row, 2])
    solver = open_solver(model, key.bounds, options, rng, backdrop)
    solver.fix(key.quantizer)
    rows = moving_rows(model.gaussians, key.quantizer, views, masks, key.bounds, options)
    model.gaussians.means[rows] += lift_motion(model.gaussians.means[rows], views.cameras, instant.optical_flows, masks,
                                               near=key.bounds.near, options=options.lift)  # fmt: skip
    spare = opacity(model.gaussians) <= options.density.min_opacity
    model.forget_moments(np.flatnonzero(rows | spare))
    solver.free(rows | spare)
    shots = tiled(find_shots(views, instant.row, masks, instant.sent), masks, solver, views)
    losses, count = solver.settle(shots, options, usual=key.usual_loss)
    changed = solver.rows & ~(spare & (opacity(model.gaussians) <= options.density.min_opacity))
    figures = {
        "instant": instant.row,
        "seconds": time.monotonic() - instant.asked,
        "iterations": count,
        "dynamic": int(changed.sum()),
        "tiles": float(np.mean([shot.tiles.mean() for shot in shots if shot.tiles is not None])),
        "guarded": solver.guarded,
    }
    return changed, figures if losses is None else {**figures, "loss": sum(losses.values()), "losses": dict(losses)}


def done_so_far(scratch: Path) -> tuple[int, int] | None:
    """Instant of the keyframe and number of frames, with that one, of a segment whose fit keeps its state in this
    folder; None where no frame is done."""
    try:
        figures = json.loads((scratch / TRACK).read_text())["figures"]
    except FileNotFoundError:
        return None
    return figures[0]["instant"] - 1, 1 + len(figures)


def unfinished_segment(key: KeyState, scratch: Path) -> Segment:
    """What is done of a segment whose fit keeps its state in this folder; `key` is its keyframe.

    Raises FileNotFoundError where the fit goes on or ends meanwhile.
    """
    with open_npz(scratch / _frame_name(1)) as data:
        spare = len(data["xyz"]) - len(key.foreground)
    track = Track.resume(key, spare, scratch)
    assert key.instant is not None, "a segment starts at a keyframe"
    return track.segment(key.instant)


class Track:
    """A segment while it is fitted: the model, and the codes and figures of the frames that are done; none of them
    holds the backdrop."""

    def __init__(self, key: KeyState, model: Model, scratch: Path) -> None:
        self.model = model
        self.frames: list[Codes] = []
        self.figures: list[dict[str, Any]] = []
        self._key = key
        self._scratch = scratch
        self._first = key.quantizer.encode(model.gaussians)
        self._changed = np.zeros(len(model), bool)

    @classmethod
    def resume(cls, key: KeyState, spare: int, scratch: Path) -> Track:
        """Where the last call was cut off, or at the keyframe; with as many spare rows."""
        model = Model(key.foreground)
        model.append(empty_gaussians(spare, key.bounds, sh_degree=key.quantizer.sh_degree))
        track = cls(key, model, scratch)
        path = scratch / TRACK
        if path.exists():
            track._load(json.loads(path.read_text())["figures"])
        return track

    def add(self, frame: tuple[np.ndarray, dict[str, Any]]) -> None:
        """Take over the model as the next frame; `frame` tells which rows it changed, and figures."""
        rows, figures = frame
        self._changed |= rows
        self.frames.append(self._key.quantizer.encode(self.model.gaussians))
        self.figures.append(figures)

    def checkpoint(self) -> None:
        """Everything a later call needs. The list of frames is written last and decides what counts."""
        count = len(self.frames)
        codes = self.frames[-1]
        save_npz(self._scratch / _frame_name(count), {"xyz": codes.xyz, "attributes": codes.attributes})
        state = {name: getattr(self.model.gaussians, name) for name in ATTRIBUTES}
        save_npz(self._scratch / f"state_{count:06d}.npz", {**state, "changed": self._changed})
        save_json(self._scratch / TRACK, {"figures": self.figures})
        (self._scratch / f"state_{count - 1:06d}.npz").unlink(missing_ok=True)

    def segment(self, first: int) -> Segment:
        """The codes of all frames from instant `first` on, after those of the backdrop; rows that are never visible are
        left out."""
        ever = self._first.attributes[:, OPACITY] > DEAD_CODE
        for codes in self.frames:
            ever |= codes.attributes[:, OPACITY] > DEAD_CODE
        dynamic, own = self._changed & ever, self._first[ever]
        width = self._first.attributes.shape[1]
        xyz = (
            np.stack([c.xyz[dynamic] for c in self.frames])
            if self.frames
            else np.empty((0, dynamic.sum(), 3), np.uint16)
        )
        attributes = (np.stack([c.attributes[dynamic] for c in self.frames])
                      if self.frames else np.empty((0, dynamic.sum(), width), np.uint8))  # fmt: skip
        still = self._key.quantizer.encode(rows_of(self._key.gaussians, slice(0, self._key.backdrop)))
        whole = Codes(*(np.concatenate(pair) for pair in ((still.xyz, own.xyz), (still.attributes, own.attributes))))
        return Segment(first, whole, np.concatenate([np.zeros(len(still), bool), dynamic[ever]]), xyz, attributes)

    def _load(self, figures: list[dict[str, Any]]) -> None:
        count = len(figures)
        with open_npz(self._scratch / f"state_{count:06d}.npz") as data:
            self.model.overwrite(np.arange(len(self.model)), Gaussians(*(data[name] for name in ATTRIBUTES)))
            self._changed = data["changed"]
        for number in range(1, count + 1):
            with open_npz(self._scratch / _frame_name(number)) as data:
                self.frames.append(Codes(data["xyz"], data["attributes"]))
        self.figures = figures


def _frame_name(number: int) -> str:
    """Of a frame's codes; the first after the keyframe has number 1."""
    return f"frame_{number:06d}.npz"
