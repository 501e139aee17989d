"""CPU time by stage of making one camera's picture ready for a GPU, and what a rig of them takes for an instant.

    packuv simulate runs/large --cameras 2 --frames 10 --size 1920x1200 --seed 3
    NUMBA_NUM_THREADS=1 packuv bench reading runs/large/videos --out bench/results/reading.json

Videos are read in order by one thread, as by each of those that prepare the next instant while a GPU fits this one
(`packuv.fit.prepare`). Each is undistorted as if its lens were bent, so that this is measured, too; a rig whose videos
are undistorted spares it. Beside that, what the fit itself does with each mask before it iterates. Times are CPU time
(of one thread: NUMBA_NUM_THREADS=1), medians over all pictures but the first of each video; of decoding it is the mean,
for frames differ.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch

from bench.command import parser
from packuv.camera import PinholeCamera
from packuv.each import packed
from packuv.fit.labels import active_tiles
from packuv.footage import FrameReader, LensCamera, Views, develop, exact
from packuv.gaussians.floats import Gaussians
from packuv.kernels.simd import cpu_description
from packuv.motion import MotionOptions, one_opencv_thread
from packuv.motion.step import fitted_size, grown

LENS = (-0.1, 0.02, 0.0, 0.0)
"""Made up, radial"""
CAMERAS, FRAME_SECONDS = 88, 1.5
"""Of the rig, and what its GPU takes for an instant"""
MOVING_SHARE, MOVING = 0.1, 8_000
"""Of a picture, in the made-up mask, and Gaussians that may change"""
LOOKS = 3
"""Times that a fit unpacks a mask before it iterates"""


def measure(videos: Sequence[Path], frames: int) -> dict[str, Any]:
    """Milliseconds by stage, and what follows for a rig."""
    with one_opencv_thread():
        found = [_measure_video(path, frames) for path in videos]
    stages = {name: 1000 * float(np.mean([part[name] for part in found])) for name in found[0]}
    own = stages.pop("fit")
    straight = sum(ms for name, ms in stages.items() if name != "undistort")
    per_instant = {"as filmed": CAMERAS * sum(stages.values()) / 1000, "undistorted before": CAMERAS * straight / 1000}
    return {
        "cpu": cpu_description(),
        "size": "x".join(map(str, _size(videos[0]))),
        "pictures": (frames - 1) * len(videos),
        "ms": stages,
        "cameras": CAMERAS,
        "cpu_seconds_an_instant": per_instant,
        "cores_in_time": {name: seconds / FRAME_SECONDS for name, seconds in per_instant.items()},
        "ms_of_the_fit_itself": own,
    }


def _size(path: Path) -> tuple[int, int]:
    height, width = FrameReader({"a": path}).read("a", 0).shape[:2]
    return width, height


def _measure_video(path: Path, frames: int) -> dict[str, float]:
    """Seconds of CPU time by stage."""
    width, height = _size(path)
    camera = PinholeCamera("a", width, height, 0.8 * width, 0.8 * width, width / 2, height / 2, np.eye(4))
    times: dict[str, list[float]] = {name: [] for name in ("convert", "undistort", "whole", "mask", "copy", "fit")}
    mask, moving = _made_up_mask(width, height), _made_up_gaussians()

    def look(mask: Callable[[], np.ndarray]) -> None:
        for _ in range(LOOKS):
            known = mask()
        active_tiles(known, moving, camera)

    with ExitStack() as stack:
        for name, place, function in (("convert", exact, "converted"), ("convert", develop.Developer, "picture"),
                                      ("undistort", cv2, "remap")):  # fmt: skip
            stack.enter_context(patch.object(place, function, _timed(getattr(place, function), times[name])))
        source = Views({"a": path}, np.arange(frames)[:, None], [LensCamera(camera, LENS)])
        source.pixels(0, 0)  # which opens the video, and makes maps of the lens
        look(packed(np.ones((height, width), bool)))  # which compiles
        for part in times.values():
            part.clear()
        read, copy = _timed(source.pixels, times["whole"]), _timed(torch.tensor, times["copy"])
        enlarge = _timed(lambda: packed(grown(mask, width, height, MotionOptions().dilation_px)), times["mask"])
        prepare = _timed(look, times["fit"])
        for frame in range(1, frames):
            copy(read(0, frame, remember=False))
            prepare(enlarge())
    median = {name: float(np.median(part)) for name, part in times.items() if name != "whole"}
    rest = np.mean(times["whole"]) - np.mean(times["convert"]) - np.mean(times["undistort"])
    return {"decode": float(rest), **median}


def _made_up_mask(width: int, height: int) -> np.ndarray:
    """Of what moves, at the size at which motion is measured, bool."""
    width, height = fitted_size(width, height, MotionOptions().width)
    mask = np.zeros((height, width), bool)
    mask[: round(height * MOVING_SHARE**0.5), : round(width * MOVING_SHARE**0.5)] = True
    return mask


def _made_up_gaussians() -> Gaussians:
    """A cloud before the camera."""
    rng = np.random.default_rng(0)
    arrays = (rng.normal([0, 0, 4], 1, (MOVING, 3)), np.full((MOVING, 3), -4.0), rng.normal(size=(MOVING, 4)),
              np.zeros(MOVING), np.zeros((MOVING, 1, 3)))  # fmt: skip
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def _timed(function: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    def run(*given: Any, **named: Any) -> Any:
        begun = time.thread_time()
        found = function(*given, **named)
        seconds.append(time.thread_time() - begun)
        return found

    return run


def main(arguments: Sequence[str] | None = None) -> None:
    command = parser("reading", __doc__)
    command.add_argument("videos", type=Path, help="folder with videos of one size")
    command.add_argument("--out", type=Path, required=True, help="JSON file to write")
    command.add_argument("--frames", type=int, default=10, help="of each video, from its first on (10)")
    command.add_argument("--count", type=int, default=2, help="of the videos, in order of their names (2)")
    given = command.parse_args(arguments)
    result = measure(sorted(given.videos.iterdir())[: given.count], given.frames)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
