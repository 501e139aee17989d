"""What moves: optical flow and motion masks between successive pictures of each camera (paper §4.2.2).

The paper's mask is |flow| > tau, dilated. Flow alone bleeds from a moving outline far into a plain wall and misses
slow parts (bench/motion.py measures both), so by default brightness that changes by more than the camera's own noise
is the evidence, at the place that a thing leaves as well as where it arrives, and flow decides which outlines enclose
something that moves.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from packuv.camera import PinholeCamera
from packuv.files import write_json
from packuv.frames import Views

FORMAT = 1
"""Version of the cache on disk."""

COMMIT_FRAMES = 16
"""Frames that a kill can cost each camera that is being measured."""

UNFINISHED, NO_STEP = -2, -1
"""`previous` of an instant not measured yet, and of one without a picture or without one before it."""

STEP_RECORD = np.dtype([("previous", "<i4"), ("magnitude", "<f4"), ("noise", "<f4"), ("share", "<f4")])


class FlowBackend(StrEnum):
    """Who estimates optical flow."""

    DIS = "dis"
    """OpenCV's dense inverse search, on the CPU"""


class FlowPreset(StrEnum):
    """Effort of DIS."""

    ULTRAFAST = "ultrafast"
    FAST = "fast"
    MEDIUM = "medium"


class Evidence(StrEnum):
    """What makes a pixel part of a motion mask."""

    CHANGE = "change"
    """Brightness changes above the noise; flow fills what the changed outlines enclose"""
    FLOW = "flow"
    """The paper's |flow| > tau alone"""


@dataclass(frozen=True)
class MotionOptions:
    """How motion is measured. Lengths named _px are pixels of the views' pictures unless said otherwise."""

    evidence: Evidence = Evidence.CHANGE
    width: int = 640
    """Pictures are compared at most this wide, pixels; noise averages out in wider ones at no loss to a mask"""
    backend: FlowBackend = FlowBackend.DIS
    flow_width: int = 320
    """Width at which flow is estimated and stored, pixels; never more than `width`"""
    preset: FlowPreset = FlowPreset.MEDIUM
    """Medium at a width of 320 is as quick as fast at 640, as exact, and a quarter of the size"""
    tau_px: float = 0.5
    """Flow from one picture to the next that counts as motion"""
    low_sigmas: float = 2.0
    """Change, in deviations of the noise, that belongs to a mask if connected to ..."""
    high_sigmas: float = 6.0
    """... change of this many; at 5, each picture of a real capture has a false speck, at 6 every eighth"""
    noise_floor: float = 0.7
    """Least deviation assumed, grey values of 255: codecs repeat still blocks exactly, then refresh them in jumps"""
    blur_px: float = 1.0
    """Deviation of the blur on differences, pixels at `width`"""
    least_area_px: int = 60
    """Smaller changed spots are noise, pixels at `width`"""
    closing_px: int = 6
    """Gaps up to twice this in a changed outline are closed, pixels at `width`"""
    hole_share: float = 0.05
    """Largest hole in an outline, share of the picture, that flow may fill: on plain walls and floors flow is chance"""
    dilation_px: int = 3
    """Growth of a mask when it is read: the blur of its edges, plus a pixel of pose error"""
    keep_flow: bool = True
    """Store flow: 0.23 MB a frame at 320x180. Off, 88 cameras for half an hour at 30 fps save a terabyte"""

    def __post_init__(self) -> None:
        if self.width < 16 or self.flow_width < 16:
            raise ValueError(f"pictures narrower than 16 px show no flow: {self.width=}, {self.flow_width=}")
        if not 0 < self.low_sigmas <= self.high_sigmas or not self.noise_floor > 0 or not self.tau_px > 0:
            raise ValueError(
                f"thresholds must satisfy 0 < low <= high and be positive: {self.low_sigmas=}, {self.high_sigmas=}, "
                f"{self.noise_floor=}, {self.tau_px=}"
            )
        if min(self.closing_px, self.dilation_px, self.least_area_px) < 0 or not self.blur_px > 0:
            raise ValueError("closing_px, dilation_px and least_area_px must not be negative, blur_px positive")


@dataclass(frozen=True)
class Step:
    """Motion from one picture of a camera to a later one."""

    flow: np.ndarray
    """float32 [h, w, 2]: x and y motion of the earlier picture's content, in pixels of the full picture"""
    mask: np.ndarray
    """bool [hm, wm]: what moved, where it was and where it is; not dilated"""
    magnitude: float
    """Mean over the picture of |flow| inside the mask, pixels of the full picture"""
    noise: float
    """Standard deviation of the blurred difference where nothing moves, grey values"""


def measure_step(before: np.ndarray, after: np.ndarray, options: MotionOptions) -> Step:
    """Motion between two grey pictures of one camera, uint8 [H, W] each."""
    if before.shape != after.shape or before.ndim != 2 or before.dtype != np.uint8 or after.dtype != np.uint8:
        raise ValueError(
            f"motion needs two grey uint8 pictures of one size, but has {before.dtype} {before.shape} "
            f"and {after.dtype} {after.shape}"
        )
    flow = optical_flow(before, after, options)
    size = fitted_size(before.shape[1], before.shape[0], options.width)
    speed = cv2.resize(np.hypot(flow[..., 0], flow[..., 1]), size)  # [hm, wm]
    mask, noise = changed(_shrunk(before, size), _shrunk(after, size), options)
    if options.evidence is Evidence.CHANGE:
        mask = _filled(_closed(mask, options.closing_px), speed > options.tau_px, options.hole_share)
    else:
        mask = speed > options.tau_px
    return Step(flow, mask, float((speed * mask).mean()), noise)


def optical_flow(before: np.ndarray, after: np.ndarray, options: MotionOptions) -> np.ndarray:
    """Flow from `before` to `after`, uint8 [H, W] each: float32 [h, w, 2], in pixels of the given pictures."""
    height, width = before.shape
    size = fitted_size(width, height, min(options.flow_width, options.width))
    presets = {
        FlowPreset.ULTRAFAST: cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
        FlowPreset.FAST: cv2.DISOPTICAL_FLOW_PRESET_FAST,
        FlowPreset.MEDIUM: cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
    }
    engine = cv2.DISOpticalFlow.create(presets[options.preset])
    empty = np.zeros((size[1], size[0], 2), dtype=np.float32)
    flow = np.asarray(engine.calc(_shrunk(before, size), _shrunk(after, size), empty))
    return flow * np.array([width / size[0], height / size[1]], dtype=np.float32)


def changed(before: np.ndarray, after: np.ndarray, options: MotionOptions) -> tuple[np.ndarray, float]:
    """Pixels whose brightness changes by more than the noise, bool [h, w], and that noise in grey values.

    A pixel needs `low_sigmas`, and a connection to one with `high_sigmas`. A change of the whole picture by the same
    amount (mains flicker) does not count.
    """
    difference = after.astype(np.float32) - before
    difference -= np.median(difference[::2, ::2])
    size = np.abs(cv2.GaussianBlur(difference, (0, 0), options.blur_px))
    noise = max(_still_deviation(size), options.noise_floor)
    # Codecs spend fewer bits on edges, and a shaking rig moves them: 2 % of the local contrast is no change.
    smooth = cv2.GaussianBlur(before, (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8))
    score = size / (noise + 0.02 * slope)
    return _connected(score > options.low_sigmas, score > options.high_sigmas, options.least_area_px), noise


def fitted_size(width: int, height: int, limit: int) -> tuple[int, int]:
    """Width and height of a picture shrunk to at most `limit` wide; at least 16 each, below which no flow is found."""
    if width <= limit:
        return width, height
    return limit, max(16, round(height * limit / width))


def grown(mask: np.ndarray, width: int, height: int, radius_px: int) -> np.ndarray:
    """A mask at another size, bool [height, width], dilated by a disc of `radius_px` pixels of that size."""
    full = 255 * mask.astype(np.uint8)
    if mask.shape != (height, width):
        # Any contact counts: interpolated 255 rounds to 0 only where no masked pixel weighs in.
        shrinking = width < mask.shape[1]
        full = np.asarray(
            cv2.resize(full, (width, height), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)
        )
    return cv2.dilate(full, _disc(radius_px)) > 0 if radius_px else full > 0


def changed_between(views: Views, camera: int, first: int, last: int, options: MotionOptions) -> np.ndarray | None:
    """What differs between two instants of a camera that need not be neighbours, bool [H, W], dilated.

    None where the camera lacks one of the two pictures. Slow motion that no single step shows adds up to a change here.
    """
    before, after = views.pixels(camera, first), views.pixels(camera, last)
    return None if before is None or after is None else difference(before, after, options)


def difference(before: np.ndarray, after: np.ndarray, options: MotionOptions) -> np.ndarray:
    """What differs between two pictures of a camera, uint8 [H, W, 3] each: bool [H, W], dilated."""
    step = measure_step(_grey(before), _grey(after), options)
    return grown(step.mask, before.shape[1], before.shape[0], options.dilation_px)


def _shrunk(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return picture if picture.shape[::-1] == size else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _grey(pixels: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)


def _disc(radius_px: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))


def _still_deviation(size: np.ndarray) -> float:
    """Deviation of the noise from its magnitudes, float32 [h, w], while up to half of the picture moves.

    Each tile of 32 pixels gives its upper quartile, 1.15 deviations of a normal distribution; the median tile is
    still as long as half of the tiles are.
    """
    rows, columns = size.shape[0] // 32, size.shape[1] // 32
    if not rows or not columns:
        return float(np.median(size)) / 0.6745
    tiles = size[: rows * 32 : 2, : columns * 32 : 2].reshape(rows, 16, columns, 16).transpose(0, 2, 1, 3)
    quartiles = np.partition(tiles.reshape(rows * columns, 256), 191, axis=1)[:, 191]
    return float(np.median(quartiles)) / 1.15


def _connected(low: np.ndarray, high: np.ndarray, least_area: int) -> np.ndarray:
    """Components of `low` that hold a pixel of `high` and at least `least_area` pixels, bool [h, w]."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(low.astype(np.uint8), connectivity=8)
    keep = np.zeros(count, dtype=bool)
    keep[labels[high]] = True
    keep &= stats[:, cv2.CC_STAT_AREA] >= least_area
    keep[0] = False
    return keep[labels]


def _closed(mask: np.ndarray, radius_px: int) -> np.ndarray:
    """Closing by a disc, as if the mask went on beyond the border by nothing, bool [h, w]."""
    if not radius_px:
        return mask
    padded = np.pad(mask.astype(np.uint8), radius_px)
    inner = slice(radius_px, -radius_px)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(radius_px))[inner, inner] > 0


def _filled(outline: np.ndarray, moving: np.ndarray, hole_share: float) -> np.ndarray:
    """The outline with its holes, bounded by the border too, if small and more than half moving, bool [h, w]."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~outline).astype(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA]
    inside = (np.bincount(labels[moving], minlength=count) > 0.5 * area) & (area <= hole_share * outline.size)
    inside[0] = True  # label 0 is the outline itself
    return inside[labels]


def measure_motion(
    views: Views,
    folder: Path,
    options: MotionOptions,
    *,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> MotionCache:
    """Measure every step of every camera into `folder`, going on where an earlier call was cut off.

    A step leads from the last instant at which the camera has a picture to this one, so a dropped frame makes a longer
    step. `progress` gets the picture count done and in all. Raises ValueError if the folder holds another measurement.
    """
    _claim(folder, _recipe(views, options))
    todo = [_Track(folder, views.cameras[index], len(views), options) for index in range(len(views.cameras))]
    report = _Progress(len(views) * len(todo), progress)
    with _one_opencv_thread(), ThreadPoolExecutor(workers) as pool:
        jobs = [pool.submit(_measure_camera, views, index, todo[index], options, report) for index in range(len(todo))]
        try:
            for job in as_completed(jobs):
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return MotionCache.load(folder)


class _Progress:
    """A count shared by threads."""

    def __init__(self, total: int, callback: Callable[[int, int], None] | None) -> None:
        self._done, self._total, self._callback, self._lock = 0, total, callback, Lock()

    def add(self, count: int) -> None:
        with self._lock:
            self._done += count
            if self._callback:
                self._callback(self._done, self._total)


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Cameras run in parallel, so OpenCV need not split each picture as well."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _measure_camera(views: Views, camera: int, track: _Track, options: MotionOptions, report: _Progress) -> None:
    available = np.flatnonzero(views.frames[:, camera] >= 0)
    start = track.finished
    report.add(start)
    earlier = available[available < start]
    previous = int(earlier[-1]) if len(earlier) else NO_STEP
    before = _grey(_pixels(views, camera, previous)) if previous >= 0 and start < len(views) else None
    for instant in range(start, len(views)):
        if views.frames[instant, camera] < 0:
            track.skip(instant)
        else:
            after = _grey(_pixels(views, camera, instant))
            if before is None:
                track.skip(instant)
            else:
                track.write(instant, previous, measure_step(before, after, options))
            before, previous = after, instant
        report.add(1)
    track.commit()


def _pixels(views: Views, camera: int, instant: int) -> np.ndarray:
    """A picture that is there, left out of the views' memory: one pass needs it once."""
    pixels = views.pixels(camera, instant, remember=False)
    if pixels is None:
        raise ValueError(f"camera {views.names[camera]!r} has no picture at instant {instant}")
    return pixels


def _recipe(views: Views, options: MotionOptions) -> dict[str, Any]:
    """What a cache depends on, as JSON."""
    spec = json.dumps(views.to_spec(), sort_keys=True)
    return {
        "format": FORMAT,
        "options": asdict(options),
        "cameras": [{"name": c.name, "width": c.width, "height": c.height} for c in views.cameras],
        "instants": len(views),
        "views": hashlib.sha256(spec.encode()).hexdigest(),
    }


def _claim(folder: Path, recipe: Mapping[str, Any]) -> None:
    """Write the recipe into a new folder, or check that the folder holds the same one."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "motion.json"
    if path.exists():
        found = json.loads(path.read_text())
        if differing := sorted(key for key in {*found, *recipe} if found.get(key) != recipe.get(key)):
            raise ValueError(f"{folder} holds a motion measurement with other {', '.join(differing)}; delete it first")
        return
    write_json(path, recipe)


class _Track:
    """The files of one camera: steps (always), masks as bits, flow as float16."""

    def __init__(self, folder: Path, camera: PinholeCamera, instants: int, options: MotionOptions) -> None:
        size = fitted_size(camera.width, camera.height, options.width)
        flow = fitted_size(camera.width, camera.height, min(options.flow_width, options.width))
        steps, masks, flows = _paths(folder, camera.name)
        if not steps.exists():
            _new_array(masks, np.uint8, (instants, size[1], -(-size[0] // 8)))
            if options.keep_flow:
                _new_array(flows, np.float16, (instants, flow[1], flow[0], 2))
            # Last, so that its presence says that the others are whole.
            empty = np.full(instants, np.array((UNFINISHED, np.nan, np.nan, np.nan), dtype=STEP_RECORD))
            np.save(steps.with_suffix(".scratch.npy"), empty)
            os.replace(steps.with_suffix(".scratch.npy"), steps)
        self._steps = np.lib.format.open_memmap(steps, mode="r+")
        self._masks = np.lib.format.open_memmap(masks, mode="r+")
        self._flows = np.lib.format.open_memmap(flows, mode="r+") if options.keep_flow else None
        self._pending: dict[int, tuple[int, float, float, float]] = {}

    @property
    def finished(self) -> int:
        """Instants measured, from the first on."""
        unfinished = np.flatnonzero(self._steps["previous"] == UNFINISHED)
        return int(unfinished[0]) if len(unfinished) else len(self._steps)

    def skip(self, instant: int) -> None:
        self._add(instant, (NO_STEP, np.nan, np.nan, np.nan))

    def write(self, instant: int, previous: int, step: Step) -> None:
        self._masks[instant] = np.packbits(step.mask, axis=1)
        if self._flows is not None:
            self._flows[instant] = step.flow
        self._add(instant, (previous, step.magnitude, step.noise, float(step.mask.mean())))

    def _add(self, instant: int, record: tuple[int, float, float, float]) -> None:
        self._pending[instant] = record
        if len(self._pending) >= COMMIT_FRAMES:
            self.commit()

    def commit(self) -> None:
        """Pictures reach the disk before the records that vouch for them."""
        if self._flows is not None:
            self._flows.flush()
        self._masks.flush()
        for instant, record in self._pending.items():
            self._steps[instant] = record
        self._steps.flush()
        self._pending.clear()


def _paths(folder: Path, camera: str) -> tuple[Path, Path, Path]:
    return folder / f"{camera}.steps.npy", folder / f"{camera}.masks.npy", folder / f"{camera}.flow.npy"


def _new_array(path: Path, dtype: type, shape: tuple[int, ...]) -> None:
    np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape).flush()


@dataclass(frozen=True)
class MotionCache:
    """A finished measurement, read from disk on demand. A camera is an index into `names`, an instant a row."""

    folder: Path
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    """Width and height of each camera's pictures"""
    options: MotionOptions
    steps: np.ndarray
    """STEP_RECORD [T, C]"""

    @classmethod
    def load(cls, folder: Path) -> MotionCache:
        """Raises FileNotFoundError where nothing was measured, ValueError where the measurement was cut off."""
        path = folder / "motion.json"
        if not path.exists():
            raise FileNotFoundError(f"no motion measurement in {folder}")
        recipe = json.loads(path.read_text())
        names = tuple(camera["name"] for camera in recipe["cameras"])
        if any(not _paths(folder, name)[0].exists() for name in names):
            raise ValueError(f"the motion measurement in {folder} was cut off; run it again to complete it")
        steps = np.stack([np.load(_paths(folder, name)[0]) for name in names], axis=1)  # [T, C]
        if missing := int((steps["previous"] == UNFINISHED).sum()):
            raise ValueError(f"{missing} of {steps.size} pictures in {folder} are not measured; run it again")
        sizes = tuple((camera["width"], camera["height"]) for camera in recipe["cameras"])
        return cls(folder, names, sizes, options_from_json(recipe["options"]), steps)

    def __len__(self) -> int:
        """Number of instants, T."""
        return len(self.steps)

    @property
    def previous(self) -> np.ndarray:
        """int32 [T, C]: the instant that the step to this one starts from, -1 where there is no step."""
        return self.steps["previous"]

    @property
    def magnitude(self) -> np.ndarray:
        """float32 [T, C]: mean flow inside the mask over the whole picture, pixels per instant; NaN without a step.

        A step over dropped frames is divided by its length, so a drop is no peak.
        """
        length = np.arange(len(self))[:, None] - self.previous
        return (self.steps["magnitude"] / length).astype(np.float32)

    def flow(self, camera: int, instant: int) -> np.ndarray | None:
        """Motion from the previous picture to this one on the previous one's grid: float32 [h, w, 2], full pixels.

        None where the camera has no step to this instant.
        """
        if self.previous[instant, camera] < 0:
            return None
        if not self.options.keep_flow:
            raise ValueError(f"{self.folder} was measured without keep_flow; delete it and measure with it")
        return self._arrays[camera][1][instant].astype(np.float32)

    def mask(self, camera: int, instant: int, *, size: tuple[int, int] | None = None) -> np.ndarray | None:
        """What moved since the previous picture, dilated: bool [H, W], or None without a step to this instant.

        It covers where things were as well as where they are. `size` (width, height) is the picture's unless given;
        the dilation is scaled with it.
        """
        if self.previous[instant, camera] < 0:
            return None
        return self._enlarged(camera, self._bits(camera, instant), size)

    def union(self, camera: int, first: int, last: int, *, size: tuple[int, int] | None = None) -> np.ndarray | None:
        """All that moved in the steps to the instants of [first, last), as `mask`; None if there is no step at all."""
        steps = [instant for instant in range(first, last) if self.previous[instant, camera] >= 0]
        if not steps:
            return None
        return self._enlarged(camera, np.logical_or.reduce([self._bits(camera, instant) for instant in steps]), size)

    def _enlarged(self, camera: int, mask: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
        width, height = size or self.sizes[camera]
        radius_px = -(-self.options.dilation_px * width // self.sizes[camera][0])
        return grown(mask, width, height, radius_px)

    def _bits(self, camera: int, instant: int) -> np.ndarray:
        width, _ = fitted_size(*self.sizes[camera], self.options.width)
        return np.unpackbits(self._arrays[camera][0][instant], axis=1, count=width) > 0

    @cached_property
    def _arrays(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Memory maps per camera: masks uint8 [T, hm, ceil(wm / 8)], flow float16 [T, h, w, 2]."""
        empty = np.empty((0, 0, 0, 2), dtype=np.float16)
        paths = [_paths(self.folder, name) for name in self.names]
        return [
            (np.load(masks, mmap_mode="r"), np.load(flows, mmap_mode="r") if self.options.keep_flow else empty)
            for _, masks, flows in paths
        ]


def options_from_json(data: Mapping[str, Any]) -> MotionOptions:
    """Inverse of dataclasses.asdict, through JSON."""
    enums = {"evidence": Evidence, "backend": FlowBackend, "preset": FlowPreset}
    values: dict[str, Any] = {key: enums[key](value) if key in enums else value for key, value in data.items()}
    return MotionOptions(**values)
