"""What moves: optical flow and motion masks between successive pictures of each camera (paper §4.2.2).

The paper's mask is |optical flow| > tau, dilated. That alone bleeds from a moving outline far into a plain wall and
misses slow parts (bench/motion.py measures both), so by default brightness that changes by more than the camera's own
noise is the evidence, at the place that a thing leaves as well as where it arrives, and optical flow decides which
outlines enclose something that moves.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from packuv.camera import PinholeCamera
from packuv.files import load_npy, map_npy, save_json
from packuv.footage import Views
from packuv.motion.raft import Raft, steady
from packuv.motion.step import (
    MotionBackend,
    MotionOptions,
    Step,
    fitted_size,
    grey,
    grown,
    measure_step,
    one_opencv_thread,
    options_from_json,
)
from packuv.progress import Progress, no_progress

FORMAT = 1
"""Version of the cache on disk."""

COMMIT_FRAMES = 16
"""Frames that a kill can cost each camera that is being measured."""

UNFINISHED, NO_STEP = -2, -1
"""`previous` of an instant not measured yet, and of one without a picture or without one before it."""

STEP_RECORD = np.dtype([("previous", "<i4"), ("magnitude", "<f4"), ("noise", "<f4"), ("share", "<f4")])


def measure_motion(
    views: Views,
    folder: Path,
    options: MotionOptions,
    *,
    raft: Raft | None = None,
    workers: int = 2,
    progress: Progress = no_progress,
) -> MotionCache:
    """Measure every step of every camera into `folder`, going on where an earlier call was cut off.

    A step leads from the last instant at which the camera has a picture to this one, so a dropped frame makes a longer
    step. `progress` gets the picture count done and in all. Raises ValueError if the folder holds another measurement,
    or `raft` is not what the backend says.
    """
    if (raft is not None) != (options.backend is MotionBackend.RAFT):
        raise ValueError(f"raft must be given if and only if the backend is raft, but is {raft} with {options.backend}")
    _claim(folder, _recipe(views, options, raft))
    count = len(views.cameras)
    tally = _Tally(len(views) * count, progress)
    with ExitStack() as stack:
        stack.enter_context(one_opencv_thread())
        if raft:
            stack.enter_context(steady())
        pool = stack.enter_context(ThreadPoolExecutor(workers))
        jobs = [pool.submit(_measure_camera, views, index, folder, options, raft, tally) for index in range(count)]
        try:
            for job in as_completed(jobs):
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return MotionCache.load(folder)


class _Tally:
    """A count shared by threads."""

    def __init__(self, total: int, progress: Progress) -> None:
        self._done, self._total, self._progress, self._lock = 0, total, progress, Lock()

    def add(self, count: int) -> None:
        with self._lock:
            self._done += count
            self._progress(self._done, self._total)


def _measure_camera(
    views: Views, camera: int, folder: Path, options: MotionOptions, raft: Raft | None, tally: _Tally
) -> None:
    with closing(_CameraFiles(folder, views.cameras[camera], len(views), options)) as files:
        _measure_steps(views, camera, files, options, raft, tally)


def _measure_steps(
    views: Views, camera: int, files: _CameraFiles, options: MotionOptions, raft: Raft | None, tally: _Tally
) -> None:
    available = np.flatnonzero(views.frames[:, camera] >= 0)
    start = files.finished
    tally.add(start)
    earlier = available[available < start]
    previous = int(earlier[-1]) if len(earlier) else NO_STEP
    before = grey(_pixels(views, camera, previous)) if previous >= 0 and start < len(views) else None
    for instant in range(start, len(views)):
        if views.frames[instant, camera] < 0:
            files.skip(instant)
        else:
            after = grey(_pixels(views, camera, instant))
            if before is None:
                files.skip(instant)
            else:
                files.write(instant, previous, measure_step(before, after, options, raft))
            before, previous = after, instant
        tally.add(1)
    files.commit()


def _pixels(views: Views, camera: int, instant: int) -> np.ndarray:
    """A picture that is there, left out of the views' memory: one pass needs it once."""
    pixels = views.steady(camera, instant, remember=False)
    if pixels is None:
        raise ValueError(f"camera {views.names[camera]!r} has no picture at instant {instant}")
    return pixels


def _recipe(views: Views, options: MotionOptions, raft: Raft | None) -> dict[str, Any]:
    """What a cache depends on, as JSON; videos by name and size, so that a capture may be moved."""
    spec = views.to_spec()
    paths = {name: Path(path) for name, path in spec["videos"].items()}
    spec["videos"] = {name: [path.name, path.stat().st_size] for name, path in paths.items()}
    return {
        "format": FORMAT,
        "options": asdict(options),
        "cameras": [{"name": c.name, "width": c.width, "height": c.height} for c in views.cameras],
        "instants": len(views),
        "views": hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest(),
        **({"raft": dict(raft.facts)} if raft else {}),
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
    save_json(path, recipe)


class _CameraFiles:
    """The files of one camera: steps (always), masks as bits, optical flow as float16."""

    def __init__(self, folder: Path, camera: PinholeCamera, instants: int, options: MotionOptions) -> None:
        size = fitted_size(camera.width, camera.height, options.width)
        coarse = fitted_size(camera.width, camera.height, min(options.flow_width, options.width))
        steps, masks, vectors = _paths(folder, camera.name)
        if not steps.exists():
            _new_array(masks, np.uint8, (instants, size[1], -(-size[0] // 8)))
            if options.keep_flow:
                _new_array(vectors, np.float16, (instants, coarse[1], coarse[0], 2))
            # Last, so that its presence says that the others are whole.
            empty = np.full(instants, np.array((UNFINISHED, np.nan, np.nan, np.nan), dtype=STEP_RECORD))
            np.save(steps.with_suffix(".scratch.npy"), empty)
            os.replace(steps.with_suffix(".scratch.npy"), steps)
        unfinished = np.flatnonzero(load_npy(steps)["previous"] == UNFINISHED)
        self.finished = int(unfinished[0]) if len(unfinished) else instants
        """Instants measured when the files were opened, from the first on"""
        self._steps, self._masks = _Rows(steps), _Rows(masks)
        self._vectors = _Rows(vectors) if options.keep_flow else None
        self._pending: dict[int, tuple[int, float, float, float]] = {}

    def skip(self, instant: int) -> None:
        self._add(instant, (NO_STEP, np.nan, np.nan, np.nan))

    def write(self, instant: int, previous: int, step: Step) -> None:
        self._masks.write(instant, np.packbits(step.mask, axis=1))
        if self._vectors is not None:
            self._vectors.write(instant, step.optical_flow)
        self._add(instant, (previous, step.magnitude, step.noise, float(step.mask.mean())))

    def _add(self, instant: int, record: tuple[int, float, float, float]) -> None:
        self._pending[instant] = record
        if len(self._pending) >= COMMIT_FRAMES:
            self.commit()

    def commit(self) -> None:
        """Pictures reach the disk before the records that vouch for them."""
        if self._vectors is not None:
            self._vectors.flush()
        self._masks.flush()
        for instant, record in self._pending.items():
            self._steps.write(instant, np.array(record, STEP_RECORD))
        self._steps.flush()
        self._pending.clear()

    def close(self) -> None:
        """Let go of the files; what is not committed is lost."""
        for rows in (self._steps, self._masks, self._vectors):
            if rows is not None:
                rows.close()


class _Rows:
    """An .npy file that is written row by row. Not by mapping it into memory, where hours of optical flow would pile
    up, and a full disk would end the process without a word."""

    def __init__(self, path: Path) -> None:
        header = map_npy(path)
        self._dtype, self._offset, self._row_bytes = header.dtype, header.offset, header[:1].nbytes
        self._file = path.open("r+b")

    def write(self, row: int, values: np.ndarray) -> None:
        self._file.seek(self._offset + row * self._row_bytes)
        self._file.write(values.astype(self._dtype).tobytes())

    def flush(self) -> None:
        """Have the disk hold what was written."""
        self._file.flush()
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


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
        steps = np.stack([load_npy(_paths(folder, name)[0]) for name in names], axis=1)  # [T, C]
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
        """float32 [T, C]: mean |optical flow| in the mask over the picture, pixels an instant; NaN without a step.

        A step over dropped frames is divided by its length, so a drop is no peak.
        """
        length = np.arange(len(self))[:, None] - self.previous
        speed: np.ndarray = (self.steps["magnitude"] / length).astype(np.float32)
        return speed

    def optical_flow(self, camera: int, instant: int) -> np.ndarray | None:
        """Motion from the previous picture to this one on the previous one's grid: float32 [h, w, 2], full pixels.

        None where the camera has no step to this instant.
        """
        if self.previous[instant, camera] < 0:
            return None
        if not self.options.keep_flow:
            raise ValueError(f"{self.folder} was measured without keep_flow; delete it and measure with it")
        vectors: np.ndarray = self._arrays[camera][1][instant].astype(np.float32)
        return vectors

    def mask(self, camera: int, instant: int, *, size: tuple[int, int] | None = None) -> np.ndarray | None:
        """What moved since the previous picture, dilated: bool [H, W], or None without a step to this instant.

        It covers where things were as well as where they are. `size` (width, height) is the picture's unless given;
        the dilation is scaled with it.
        """
        if self.previous[instant, camera] < 0:
            return None
        return self._enlarged(camera, self._bits(camera, instant), size)

    def measured(self, camera: int, instant: int) -> np.ndarray | None:
        """What moved since the previous picture, as it was measured, not dilated: bool [hm, wm], or None."""
        return None if self.previous[instant, camera] < 0 else self._bits(camera, instant)

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
        """Memory maps per camera: masks uint8 [T, hm, ceil(wm / 8)], optical flow float16 [T, h, w, 2]."""
        empty = np.empty((0, 0, 0, 2), dtype=np.float16)
        paths = [_paths(self.folder, name) for name in self.names]
        return [(map_npy(masks), map_npy(vectors) if self.options.keep_flow else empty) for _, masks, vectors in paths]
