"""Content: whether pictures that are paired by their times show the same moment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from packuv.camera import PinholeCamera
from packuv.files import load_json, save_json
from packuv.motion import MotionBackend, MotionCache, MotionOptions, measure_motion
from sync.align import FrameGroups, frame_period
from sync.content import Activity, Content, ContentOptions, Offset, Window, find_offsets
from tasks.artefacts.stage import Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.footage import Footage, Take
from tasks.stages.track import MOTION

OFFSETS = "offsets.json"
GRID_WIDTH = 160
"""Cells across a picture in which motion is counted"""
LONGEST_STEP = 2
"""Instants between two pictures of a camera that films fewer than most: a third of them tells wrong times"""


@dataclass(frozen=True, kw_only=True)
class CompareContent(Stage):
    """Measure by what moves how far each camera's pictures lie from the others' at the same instants: offsets.json."""

    name, version = "content", 6
    take: Take
    """Of the cameras whose motion is measured"""
    unseen: tuple[str, ...]
    """Further cameras; their motion is measured here"""
    motion: Key
    motion_options: MotionOptions
    options: ContentOptions

    def build(self, work: Work) -> Notes:
        cache = MotionCache.load(work.path(self.motion) / MOTION)
        groups = Footage(self.take, work.site).load_groups()
        windows = choose_windows(np.nan_to_num(cache.steps["share"]).mean(axis=1), self.options)
        found = []
        for number, window in enumerate(windows):
            work.progress(number, len(windows))
            seen = {**self._fitted(work, cache, window), **self._others(work, window)}
            offsets = find_offsets(seen, self.options.reach, expected_offsets(groups, window))
            found.append({"instants": [window.start, window.stop], "offsets": offsets})
        save_json(work.out / OFFSETS, {"cameras": [*self.take.cameras, *self.unseen], "windows": _plain(found)})
        return {"windows": len(windows), "lie": sorted({name for name, _ in _lies(found)})}

    def _fitted(self, work: Work, cache: MotionCache, window: range) -> Mapping[str, Activity]:
        cameras = Footage(self.take, work.site).open_views().cameras
        return {camera.name: activity_of(cache, column, camera, window) for column, camera in enumerate(cameras)}

    def _others(self, work: Work, window: range) -> Mapping[str, Activity]:
        if not self.unseen:
            return {}
        first = self.take.first + window.start
        take = replace(self.take, cameras=self.unseen, light=None, first=first, stop=first + len(window))
        views = Footage(take, work.site).open_views()
        options = replace(self.motion_options, keep_flow=False, backend=MotionBackend.DIS)  # only masks are wanted
        cache = measure_motion(views, work.scratch / f"motion-{window.start}", options, workers=work.site.threads)
        whole = range(len(window))
        return {camera.name: activity_of(cache, column, camera, whole) for column, camera in enumerate(views.cameras)}

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if not any(window.offsets for window in read_content(folder).windows):
            yield (
                "content",
                "the pictures show too little motion that several cameras see to tell whether times are right",
            )


def choose_windows(moving: np.ndarray, options: ContentOptions) -> list[range]:
    """Where most moves in each equal part of a sequence, float [T]; all of it where that is hardly more."""
    count, length = len(moving), options.instants
    if count <= options.windows * length:
        parts = max(1, round(count / length))
        edges = np.linspace(0, count, parts + 1).round().astype(int)
        return [range(start, stop) for start, stop in pairwise(edges.tolist())]
    edges = np.linspace(0, count, options.windows + 1).round().astype(int)
    sums = np.concatenate([[0.0], np.cumsum(moving)])
    found = []
    for start, stop in pairwise(edges.tolist()):
        best = start + int((sums[start + length : stop + 1] - sums[start : stop + 1 - length]).argmax())
        found.append(range(best, best + length))
    return found


def activity_of(
    cache: MotionCache, column: int, camera: PinholeCamera, window: range, *, posed: bool = True
) -> Activity:
    """Motion of one camera in the cells of a grid, and where the cells are if its pose is known.

    What changed in a longer step, of a camera that films every second instant, counts for both.
    """
    height = max(1, round(GRID_WIDTH * camera.height / camera.width))
    moving = np.zeros((len(window), height, GRID_WIDTH), np.float32)
    previous = np.array([cache.previous[instant, column] for instant in window])
    steps = np.where(previous >= window.start, np.array(window) - previous, LONGEST_STEP + 1)
    usual = int(steps.min(initial=LONGEST_STEP + 1))
    there = np.zeros(len(window), bool)
    for row in np.flatnonzero((steps == usual) & (usual <= LONGEST_STEP)):
        measured = cache.measured(column, window[row])
        assert measured is not None, "there is a step to this instant"
        within = slice(row - usual + 1, row + 1)
        moving[within] = cv2.resize(measured.astype(np.float32), (GRID_WIDTH, height), interpolation=cv2.INTER_AREA)
        there[within] = True
    own = Activity(moving.reshape(len(window), -1), there)
    return (
        replace(own, centre=camera.centre, rays=_rays(camera, GRID_WIDTH, height), width=GRID_WIDTH) if posed else own
    )


def _rays(camera: PinholeCamera, width: int, height: int) -> np.ndarray:
    """Through the middles of the cells of a grid, world axes, float64 [height * width, 3]."""
    across = (np.arange(width) + 0.5) * camera.width / width
    down = (np.arange(height) + 0.5) * camera.height / height
    pixels = np.stack([*(axis.ravel() for axis in np.meshgrid(across, down)), np.ones(width * height)])
    rays: np.ndarray = (camera.camera_from_world[:3, :3].T @ np.linalg.solve(camera.matrix, pixels)).T
    return rays


def expected_offsets(groups: FrameGroups, window: range) -> dict[str, float]:
    """What the times say of each camera, in instants: by how much later than most it films."""
    rows, period = slice(window.start, window.stop), frame_period(groups.times_ns)
    there, residuals = groups.frames[rows] >= 0, groups.residuals_ns[rows]
    own = {
        name: float(np.median(residuals[there[:, column], column])) / period
        for column, name in enumerate(groups.cameras)
        if period and there[:, column].any()
    }
    usual = float(np.median(list(own.values()))) if own else 0.0
    return {name: offset - usual for name, offset in own.items()}


def read_content(folder: Path) -> Content:
    """What `CompareContent` found."""
    data = load_json(folder / OFFSETS)
    return Content(tuple(data["cameras"]), tuple(map(_window, data["windows"])))


def _window(item: Mapping[str, Any]) -> Window:
    offsets = {name: Offset(**own) for name, own in item["offsets"].items()}
    return Window(item["instants"][0], item["instants"][1] - 1, offsets)


def _lies(found: list[dict[str, Any]]) -> Iterator[tuple[str, Offset]]:
    for item in found:
        yield from ((name, offset) for name, offset in item["offsets"].items() if offset.lies)


def _plain(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{**item, "offsets": {name: own.to_json() for name, own in item["offsets"].items()}} for item in found]
