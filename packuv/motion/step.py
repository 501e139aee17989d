"""What moves between two pictures: optical flow, and the mask of what changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np

from packuv.footage import Views
from packuv.motion.masks import beyond, change, connected, filled


class MotionBackend(StrEnum):
    """Who estimates optical flow."""

    DIS = "dis"
    """OpenCV's dense inverse search, on the CPU"""
    RAFT = "raft"
    """A network with weights of the user's, see `packuv.motion.raft`; a hundred times slower on the CPU. It estimates
    what the cache keeps; where two pictures are only compared, DIS says which outlines are filled"""


class DisPreset(StrEnum):
    """Effort of DIS."""

    ULTRAFAST = "ultrafast"
    FAST = "fast"
    MEDIUM = "medium"


class Evidence(StrEnum):
    """What makes a pixel part of a motion mask."""

    CHANGE = "change"
    """Brightness changes above the noise; optical flow fills what the changed outlines enclose"""
    FLOW = "flow"
    """The paper's |optical flow| > tau alone"""


@dataclass(frozen=True)
class MotionOptions:
    """How motion is measured. Lengths named _px are pixels of the views' pictures unless said otherwise."""

    evidence: Evidence = Evidence.CHANGE
    width: int = 640
    """Pictures are compared at most this wide, pixels; noise averages out in wider ones at no loss to a mask"""
    backend: MotionBackend = MotionBackend.DIS
    flow_width: int = 320
    """Width at which optical flow is estimated and stored, pixels; never more than `width`"""
    preset: DisPreset = DisPreset.MEDIUM
    """Medium at a width of 320 is as quick as fast at 640, as exact, and a quarter of the size"""
    tau_px: float = 0.5
    """Optical flow from one picture to the next that counts as motion"""
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
    """Largest hole in an outline, share of the picture, that motion may fill: on plain walls and floors it is chance"""
    dilation_px: int = 3
    """Growth of a mask when it is read: the blur of its edges, plus a pixel of pose error"""
    keep_flow: bool = True
    """Store optical flow: 0.23 MB a frame at 320x180. Off, 88 cameras for half an hour at 30 fps save a terabyte"""

    def __post_init__(self) -> None:
        if self.width < 16 or self.flow_width < 16:
            raise ValueError(f"pictures narrower than 16 px show no motion: {self.width=}, {self.flow_width=}")
        if not 0 < self.low_sigmas <= self.high_sigmas or not self.noise_floor > 0 or not self.tau_px > 0:
            raise ValueError(
                f"thresholds must satisfy 0 < low <= high and be positive: {self.low_sigmas=}, {self.high_sigmas=}, "
                f"{self.noise_floor=}, {self.tau_px=}"
            )
        if min(self.closing_px, self.dilation_px, self.least_area_px) < 0 or not self.blur_px > 0:
            raise ValueError("closing_px, dilation_px and least_area_px must not be negative, blur_px positive")


Estimator = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Optical flow, float32 [h, w, 2], pixels, of two grey pictures, uint8 [h, w] each"""


@dataclass(frozen=True)
class Step:
    """Motion from one picture of a camera to a later one."""

    optical_flow: np.ndarray
    """float32 [h, w, 2]: x and y motion of the earlier picture's content, in pixels of the full picture"""
    mask: np.ndarray
    """bool [hm, wm]: what moved, where it was and where it is; not dilated"""
    magnitude: float
    """Mean over the picture of |optical flow| inside the mask, pixels of the full picture"""
    noise: float
    """Standard deviation of the blurred difference where nothing moves, grey values"""


def measure_step(
    before: np.ndarray, after: np.ndarray, options: MotionOptions, estimator: Estimator | None = None
) -> Step:
    """Motion between two grey pictures of one camera, uint8 [H, W] each; by DIS where no other estimator is given."""
    if before.shape != after.shape or before.ndim != 2 or before.dtype != np.uint8 or after.dtype != np.uint8:
        raise ValueError(
            f"motion needs two grey uint8 pictures of one size, but has {before.dtype} {before.shape} "
            f"and {after.dtype} {after.shape}"
        )
    vectors = optical_flow(before, after, options, estimator)
    size = fitted_size(before.shape[1], before.shape[0], options.width)
    speed = cv2.resize(np.hypot(vectors[..., 0], vectors[..., 1]), size)  # [hm, wm]
    mask, noise = changed(_shrunk(before, size), _shrunk(after, size), options)
    if options.evidence is Evidence.CHANGE:
        mask = filled(_closed(mask, options.closing_px), speed > options.tau_px, options.hole_share)
    else:
        mask = speed > options.tau_px
    return Step(vectors, mask, float((speed * mask).mean()), noise)


def optical_flow(
    before: np.ndarray, after: np.ndarray, options: MotionOptions, estimator: Estimator | None = None
) -> np.ndarray:
    """Optical flow from `before` to `after`, uint8 [H, W] each: float32 [h, w, 2], in pixels of the given pictures."""
    height, width = before.shape
    size = fitted_size(width, height, min(options.flow_width, options.width))
    estimate = estimator or dis(options.preset)
    vectors = estimate(_shrunk(before, size), _shrunk(after, size))
    return vectors * np.array([width / size[0], height / size[1]], dtype=np.float32)


def dis(preset: DisPreset) -> Estimator:
    """OpenCV's dense inverse search."""
    presets = {
        DisPreset.ULTRAFAST: cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
        DisPreset.FAST: cv2.DISOPTICAL_FLOW_PRESET_FAST,
        DisPreset.MEDIUM: cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
    }
    engine = cv2.DISOpticalFlow.create(presets[preset])
    return lambda before, after: np.asarray(engine.calc(before, after, np.zeros((*before.shape, 2), np.float32)))


def changed(before: np.ndarray, after: np.ndarray, options: MotionOptions) -> tuple[np.ndarray, float]:
    """Pixels whose brightness changes by more than the noise, bool [h, w], and that noise in grey values.

    A pixel needs `low_sigmas`, and a connection to one with `high_sigmas`. A change of the whole picture by the same
    amount (mains flicker) does not count.
    """
    size = np.abs(cv2.GaussianBlur(change(before, after), (0, 0), options.blur_px))
    noise = max(_still_deviation(size), options.noise_floor)
    smooth = cv2.GaussianBlur(before, (0, 0), 1.0)
    slopes = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    low, high = beyond(size, *slopes, noise=noise, low=options.low_sigmas, high=options.high_sigmas)
    return connected(low, high, options.least_area_px), noise


def fitted_size(width: int, height: int, limit: int) -> tuple[int, int]:
    """Width and height of a picture shrunk to at most `limit` wide; at least 16 each, or no motion is found."""
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
    before, after = views.steady(camera, first), views.steady(camera, last)
    return None if before is None or after is None else difference(before, after, options)


def difference(before: np.ndarray, after: np.ndarray, options: MotionOptions) -> np.ndarray:
    """What differs between two pictures of a camera, uint8 [H, W, 3] each: bool [H, W], dilated."""
    step = measure_step(grey(before), grey(after), options)
    return grown(step.mask, before.shape[1], before.shape[0], options.dilation_px)


def _shrunk(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return picture if picture.shape[::-1] == size else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def grey(pixels: np.ndarray) -> np.ndarray:
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


def _closed(mask: np.ndarray, radius_px: int) -> np.ndarray:
    """Closing by a disc, as if the mask went on beyond the border by nothing, bool [h, w]."""
    if not radius_px:
        return mask
    padded = np.pad(mask.astype(np.uint8), radius_px)
    inner = slice(radius_px, -radius_px)
    return cv2.morphologyEx(padded, cv2.MORPH_CLOSE, _disc(radius_px))[inner, inner] > 0


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Cameras run in parallel, so OpenCV need not split each picture as well."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def options_from_json(data: Mapping[str, Any]) -> MotionOptions:
    """Inverse of dataclasses.asdict, through JSON."""
    enums = {"evidence": Evidence, "backend": MotionBackend, "preset": DisPreset}
    values: dict[str, Any] = {key: enums[key](value) if key in enums else value for key, value in data.items()}
    return MotionOptions(**values)
