"""What stands still: the temporal median of each camera's pictures.

What moves hides other parts of the scene at every instant; over a sequence most of the rest is seen. A fit that knows
it first paints no head onto the wall behind it, and has the wall that a step aside uncovers.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import cv2
import numpy as np

from packuv.budget import Budget
from packuv.files import open_npz, save_npz
from packuv.footage import Silhouettes, Views
from packuv.progress import Progress, no_progress

BORDER_PX = 2
"""Width of the border around masks in which pixels are mixed with the foreground"""


@dataclass(frozen=True)
class BackgroundOptions:
    instants: int = 15
    """Evenly over the sequence, of which the median is taken; fewer than three leave no background, and 0 none of an
    empty stage either"""
    tolerance: int = 12
    """Grey values of 255 from the median that noise and shadows explain"""
    agreement: float = 0.6
    """Share of the instants that must lie within the tolerance, or the place is unknown: somebody stood there"""

    def __post_init__(self) -> None:
        if self.instants < 0 or self.tolerance < 0 or not 0 < self.agreement <= 1:
            raise ValueError(
                "instants and tolerance must not be negative and agreement must lie in (0, 1], "
                f"but they are {self.instants}, {self.tolerance} and {self.agreement}"
            )


@dataclass(frozen=True)
class Still:
    """The background of one camera."""

    camera: int
    """Index into the views' cameras"""
    pixels: np.ndarray
    """uint8 [H, W, 3], in the camera's own colours and steady light"""
    known: np.ndarray
    """bool [H, W]: most instants agree on it"""


def find_background(
    views: Views,
    options: BackgroundOptions,
    progress: Progress = no_progress,
    *,
    silhouettes: Silhouettes | None = None,
    least: int = 3,
    among: range | None = None,
    workers: int = 2,
) -> list[Still]:
    """Backgrounds of the cameras that filmed at least `least` of the instants chosen `among` some, by default all; an
    empty stage needs one. What `silhouettes` cover, with a border, is no background, and what they leave in fewer than
    `least` pictures is not known.

    `workers` cameras at a time, each with the pictures of all instants in memory.
    """
    among = range(len(views)) if among is None else among
    count = min(options.instants, len(among))
    instants = np.unique(np.linspace(among.start, among.stop - 1, count).round().astype(int))

    def look(camera: int) -> Still | None:
        pictures = {int(instant): views.steady(camera, int(instant), remember=False) for instant in instants}
        found = {instant: picture for instant, picture in pictures.items() if picture is not None}
        if len(found) < least:
            return None
        masks = [silhouettes.of(views.names[camera], instant) for instant in found] if silhouettes else []
        ahead = [bordered(mask) for mask in masks if mask is not None]
        stack = np.stack(list(found.values()))
        if ahead:
            return _behind(camera, stack, np.stack(ahead), options, least)
        return _still(camera, stack, options)

    stills = []
    with ThreadPoolExecutor(workers) as pool:
        for camera, still in enumerate(pool.map(look, range(len(views.cameras)))):
            stills += [still] if still else []
            progress(camera + 1, len(views.cameras))
    return stills


def patched(usual: Still, own: Still, places: np.ndarray) -> Still:
    """A background with another one, of the same camera, in some places, bool [H, W]."""
    pixels = np.where(places[:, :, None], own.pixels, usual.pixels)
    return replace(usual, pixels=pixels, known=np.where(places, own.known, usual.known))


def save_stills(path: Path, stills: Sequence[Still]) -> None:
    """Write one .npz with all backgrounds."""
    arrays = {f"{name}_{still.camera}": getattr(still, name) for still in stills for name in ("pixels", "known")}
    save_npz(path, {"cameras": np.array([still.camera for still in stills], np.int64), **arrays})


def load_stills(path: Path, budget: Budget | None = None) -> Stills:
    """What `save_stills` wrote. Those that the budget has no room for are read when they are asked for; None: all are
    kept."""
    return Stills(path, budget)


class Stills(Sequence[Still]):
    """Backgrounds in a file."""

    def __init__(self, path: Path, budget: Budget | None) -> None:
        self._path, self._budget = path, budget
        with open_npz(path) as arrays:
            self._cameras = [int(camera) for camera in arrays["cameras"]]
        self._kept: dict[int, Still] = {}

    def __len__(self) -> int:
        return len(self._cameras)

    @overload
    def __getitem__(self, index: int) -> Still: ...
    @overload
    def __getitem__(self, index: slice) -> list[Still]: ...
    def __getitem__(self, index: int | slice) -> Still | list[Still]:
        if isinstance(index, slice):
            return [self[place] for place in range(len(self))[index]]
        camera = self._cameras[index]
        if camera in self._kept:
            return self._kept[camera]
        with open_npz(self._path) as arrays:
            still = Still(camera, arrays[f"pixels_{camera}"], arrays[f"known_{camera}"])
        if self._budget is None or self._budget.take(still.pixels.nbytes + still.known.nbytes):
            self._kept[camera] = still
        return still


def _still(camera: int, pictures: np.ndarray, options: BackgroundOptions) -> Still:
    """`pictures` is uint8 [n, H, W, 3]."""
    median = median_of(pictures)
    needed = options.agreement * len(pictures)
    near = np.zeros(median.shape[:2], np.int32)
    for picture in pictures:
        near += apart(picture, median) <= options.tolerance
    return Still(camera, median, near >= needed)


def _behind(camera: int, pictures: np.ndarray, ahead: np.ndarray, options: BackgroundOptions, least: int) -> Still:
    """`_still` of those pictures of each pixel in which nothing stands before it; `ahead` is bool [n, H, W]."""
    free = len(pictures) - ahead.sum(axis=0)  # [H, W]
    ordered = np.where(ahead[..., None], np.uint16(256), pictures)
    ordered.sort(axis=0)
    middle = np.minimum(free // 2, len(pictures) - 1)
    found = np.take_along_axis(ordered, middle[None, :, :, None], axis=0)[0]
    median = np.where(free[:, :, None] > 0, found, pictures[0]).astype(np.uint8)
    near = np.zeros(free.shape, np.int32)
    for picture, hidden in zip(pictures, ahead, strict=True):
        near += ~hidden & (apart(picture, median) <= options.tolerance)
    return Still(camera, median, (free >= least) & (near >= options.agreement * free))


def bordered(mask: np.ndarray) -> np.ndarray:
    """A mask, bool [H, W], with the border of mixed pixels around it."""
    side = 2 * BORDER_PX + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def median_of(pictures: np.ndarray) -> np.ndarray:
    """The upper median along the first axis, uint8 [...] of [n, ...]."""
    middle = len(pictures) // 2
    return np.asarray(np.partition(pictures, middle, axis=0)[middle])


def apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Largest difference of a channel, uint8 [...] of [..., 3]."""
    difference = np.maximum(first, second) - np.minimum(first, second)
    largest: np.ndarray = np.maximum(np.maximum(difference[..., 0], difference[..., 1]), difference[..., 2])
    return largest
