"""A look at a machine and a capture before a run: how long an iteration takes here, and how much moves there.

Seconds, not minutes: iterations on a made-up scene with as many Gaussians and pixels as the fit will have, and a few
pairs of neighbouring pictures. What is found lies in the sequence's folder, so that the same command goes by the same
figures again.
"""

from __future__ import annotations

import json
import socket
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from packuv.fit.pace import FitSize, step_seconds
from packuv.footage.reader import FrameReader
from packuv.motion.step import MotionOptions, fitted_size, grey, grown, measure_step
from packuv.progress import Progress, no_progress
from packuv.raster.view import TILE
from tasks.artefacts.jobs import Jobs
from tasks.artefacts.recipe import plain, write_json

PROBE = "probe.json"
"""In the sequence's folder"""
CAMERAS, INSTANTS = 4, 3
"""Looked at, evenly spread"""


REFERENCE = FitSize(640, 360, 54_000)
"""That of "basketball" with `standard`, on which the forecast's constants were measured"""


@dataclass(frozen=True)
class Probe:
    """What a look found."""

    steps: Mapping[str, float]
    """Seconds of an iteration on whole pictures, by `FitSize`, REFERENCE among them"""
    moving: float | None
    """Share of the tiles that something moves in, median; None where no pair of pictures could be read"""
    picture_seconds: float | None
    """To decode a million pixels in passing and to find motion in them, on one core; None likewise"""

    def step(self, size: FitSize) -> float:
        """Seconds; raises KeyError for a size that was not measured."""
        return self.steps[str(size)]


@dataclass(frozen=True)
class Look:
    """The job of a probe, see `tasks.artefacts.jobs.Job`; what it finds depends on nothing else but the machine."""

    sizes: tuple[FitSize, ...]
    videos: tuple[Path, ...]
    frames: tuple[int, ...]
    """Of each video; the next one is read, too"""
    motion: MotionOptions

    def __str__(self) -> str:
        return "probe"

    def __call__(self, progress: Progress) -> dict[str, Any]:
        sizes = dict.fromkeys([REFERENCE, *self.sizes])
        steps = dict[str, float]()
        for done, size in enumerate(sizes):
            progress(done, len(sizes) + 1, f"iterations on {size} Gaussians")
            steps[str(size)] = step_seconds(size)
        progress(len(sizes), len(sizes) + 1, "what moves")
        return {"steps": steps, **self._seen()}

    def _seen(self) -> dict[str, Any]:
        shares, seconds, pixels = list[float](), 0.0, 0
        reader = FrameReader({str(path): path for path in self.videos})
        for video, frame in ((str(path), frame) for path in self.videos for frame in self.frames):
            with suppress(ValueError, OSError):  # a frame less; the run says what is wrong with the file
                before = grey(reader.read(video, frame))
                begun = time.process_time()
                after = grey(reader.read(video, frame + 1))
                mask = measure_step(before, after, self.motion).mask
                seconds, pixels = seconds + time.process_time() - begun, pixels + after.size
                shares.append(self._tile_share(mask, after))
        found = float(np.median(shares)) if shares else None
        return {"moving": found, "picture_seconds": seconds / pixels * 1e6 if shares else None}

    def _tile_share(self, mask: np.ndarray, picture: np.ndarray) -> float:
        """Of the tiles of a picture that a mask touches, where it is no wider than masks are."""
        width, height = fitted_size(picture.shape[1], picture.shape[0], self.motion.width)
        rows, columns = -(-height // TILE), -(-width // TILE)
        whole = np.zeros((rows * TILE, columns * TILE), bool)
        whole[:height, :width] = grown(mask, width, height, self.motion.dilation_px)
        return float(whole.reshape(rows, TILE, columns, TILE).any(axis=(1, 3)).mean())


def look(question: Look, jobs: Jobs, progress: Progress = no_progress) -> Probe:
    """Ask, in a process with as many threads as the jobs of the run. Raises what `Jobs.run` raises."""
    with tempfile.TemporaryDirectory(prefix="packuv-probe-") as folder:
        return Probe(**jobs.run(question, folder=Path(folder), progress=progress).value)


def remembered(folder: Path, question: Look, jobs: Jobs) -> Probe | None:
    """What was found when as much was asked on this machine for the sequence of this folder."""
    with suppress(OSError, ValueError, TypeError, KeyError):  # not there, or another version's
        known = json.loads((folder / PROBE).read_text())
        found = Probe(**known["found"])
        if known["asked"] == _asked(question, jobs) and {str(size) for size in question.sizes} <= found.steps.keys():
            return found
    return None


def remember(folder: Path, question: Look, jobs: Jobs, found: Probe) -> None:
    """For `remembered`."""
    write_json(folder / PROBE, {"asked": _asked(question, jobs), "found": asdict(found)})


def _asked(question: Look, jobs: Jobs) -> dict[str, Any]:
    """All but the sizes."""
    videos = [str(path) for path in question.videos]
    asked = {"videos": videos, "frames": list(question.frames), "motion": plain(question.motion)}
    return {"host": socket.gethostname(), "threads": jobs.threads, **asked}


def spread(count: int, most: int) -> tuple[int, ...]:
    """Up to `most` of 0 .. count - 1, evenly, in the middle of their shares.

    >>> spread(10, 3), spread(2, 4)
    ((1, 5, 8), (0, 1))
    """
    some = min(count, most)
    return tuple((2 * index + 1) * count // (2 * some) for index in range(some))
