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
LEAST_SHARE = 1e-3
"""Of a cell: the motion of less is taken to be smaller, not divided by nothing"""
LONGEST_STEP = 2
"""Instants between two pictures of a camera that films fewer than most: a third of them tells wrong times"""


@dataclass(frozen=True, kw_only=True)
class CompareContent(Stage):
    """Measure by what moves how far each camera's pictures lie from the others' at the same instants: offsets.json."""

    name, version = "content", 8
    take: Take
    """Of the cameras whose motion is measured"""
    unseen: tuple[str, ...]
    """Further cameras; their motion is measured here"""
    motion: Key
    motion_options: MotionOptions
    options: ContentOptions

    def build(self, work: Work) -> Notes:
        groups = Footage(self.take, work.site).load_groups()
        cache = MotionCache.load(work.path(self.motion) / MOTION)
        windows = choose_windows(np.nan_to_num(cache.steps["share"]).mean(axis=1), self.options)
        found = []
        for number, window in enumerate(windows):
            work.progress(number, len(windows))
            offsets = find_offsets(
                self._seen(work, cache, window), self.options.reach, expected_offsets(groups, window)
            )
            found.append({"instants": [window.start, window.stop], "offsets": offsets})
        save_json(work.out / OFFSETS, {"cameras": [*self.take.cameras, *self.unseen], "windows": _plain(found)})
        return {"windows": len(windows), "lie": sorted({name for name, _ in _lies(found)})}

    def _seen(self, work: Work, cache: MotionCache, window: range) -> Mapping[str, Activity]:
        """Of the measured cameras, and of those that the measurement lacks or of which it kept no flow."""
        kept = self.take.cameras if cache.options.keep_flow else ()
        cameras = Footage(self.take, work.site).open_views().cameras if kept else ()
        known = {camera.name: activity_of(cache, column, camera, window) for column, camera in enumerate(cameras)}
        others = tuple(name for name in (*self.take.cameras, *self.unseen) if name not in kept)
        return {**known, **self._measured(work, others, window)}

    def _measured(self, work: Work, cameras: tuple[str, ...], window: range) -> Mapping[str, Activity]:
        if not cameras:
            return {}
        first = self.take.first + window.start
        take = replace(self.take, cameras=cameras, light=None, first=first, stop=first + len(window))
        views = Footage(take, work.site).open_views()
        options = replace(self.motion_options, keep_flow=True, backend=MotionBackend.DIS)
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
    """Motion of one camera in the cells of a grid; if its pose is known, also which way, and where the cells are.

    What changed in a longer step, of a camera that films every second instant, counts for both.
    """
    height = max(1, round(GRID_WIDTH * camera.height / camera.width))
    previous = np.array([cache.previous[instant, column] for instant in window])
    steps = np.where(previous >= window.start, np.array(window) - previous, LONGEST_STEP + 1)
    usual = int(steps.min(initial=LONGEST_STEP + 1))
    there, found = np.zeros(len(window), bool), [_nothing()]
    for row in np.flatnonzero((steps == usual) & (usual <= LONGEST_STEP)):
        shares, flow = _changed(cache, column, window[row], (GRID_WIDTH, height), flow=posed)
        cells = np.flatnonzero(shares)
        for instant in range(row - usual + 1, row + 1):
            there[instant] = True
            found.append((np.full(len(cells), instant), cells, shares[cells], flow[cells] / usual))
    instants, cells, shares, flow = (np.concatenate(parts) for parts in zip(*found, strict=True))
    own = Activity(there, instants, cells, shares, flow * np.float32(GRID_WIDTH / camera.width), GRID_WIDTH * height)
    return (
        replace(own, centre=camera.centre, rays=_rays(camera, GRID_WIDTH, height), width=GRID_WIDTH) if posed else own
    )


def _nothing() -> tuple[np.ndarray, ...]:
    """Instants, cells, shares and flow of no cell."""
    return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32), np.empty((0, 2), np.float32)


def _changed(
    cache: MotionCache, column: int, instant: int, size: tuple[int, int], *, flow: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell of a grid that changed, float32 [P], and its mean motion, pixels of the picture [P, 2]; 0
    where nothing changed, and if it is not asked for."""
    measured = cache.measured(column, instant)
    assert measured is not None, "there is a step to this instant"
    mask = measured.astype(np.float32)
    shares = cv2.resize(mask, size, interpolation=cv2.INTER_AREA).reshape(-1)
    if not flow:
        return shares, np.zeros((len(shares), 2), np.float32)
    vectors = cache.optical_flow(column, instant)
    assert vectors is not None, "there is a step to this instant"
    vectors = np.nan_to_num(vectors, posinf=0, neginf=0)
    weights = cv2.resize(mask, vectors.shape[1::-1], interpolation=cv2.INTER_AREA)[..., None]
    both = cv2.resize(np.dstack([vectors * weights, weights]), size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    return shares, both[:, :2] / np.maximum(both[:, 2:], LEAST_SHARE)


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
