"""A clean plate: the empty stage as the same cameras filmed it, brought to the light of the take.

Who stands still for a whole take is in the temporal median, and hides the wall; a plate shows it. It serves while the
camera stands where it stood and the light differs by no more than a gain; the take's own median tells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from packuv.colour import linear_from_srgb, srgb_from_linear
from packuv.motion.background import BackgroundOptions, Still

COLUMNS, ROWS = 8, 6
"""Blocks of a picture, each of which tells for itself: who stands in the take spoils a few of them"""
LEAST_BLOCKS = 4
"""Fewer blocks with detail tell nothing"""
DETAIL = 0.01
"""Size of the detail that must be the same, as a share of the picture's width"""
LEAST_CONTRAST = 2.0
"""Standard deviation of a block's detail, grey values of 255, below which noise decides"""
LEAST_LIKENESS = 0.5
"""Correlation of detail below which the camera does not show what the plate shows"""
USABLE = (8, 250)
"""Grey values between which a ratio of light can be believed"""


@dataclass(frozen=True)
class Plate:
    """A camera's plate, compared with what stands still in the take."""

    still: Still
    """The plate, in the light of the take"""
    gains: tuple[float, float, float]
    """Factors r g b on linear light that this took; 1 where they do not help"""
    agreement: float | None
    """Share of the places known in both whose colours agree; None where nothing is known in both"""
    likeness: float | None
    """Median correlation of detail over the blocks of the picture; None where too few have any"""

    @property
    def fits(self) -> bool:
        """False if the camera shows another place than its plate."""
        return self.likeness is None or self.likeness >= LEAST_LIKENESS


def compare_plate(plate: Still, own: Still | None, options: BackgroundOptions) -> Plate:
    """Bring a plate to the light of the take, whose temporal median is `own`, where that helps."""
    if own is None or not (both := plate.known & own.known).any():
        return Plate(plate, (1.0, 1.0, 1.0), None, None)
    gains = _gains(plate.pixels[both], own.pixels[both])
    lit = _lit(plate.pixels, gains)
    before, after = (_agreement(pixels[both], own.pixels[both], options.tolerance) for pixels in (plate.pixels, lit))
    likeness = _likeness(plate.pixels, own.pixels, both)
    if after <= before:
        return Plate(plate, (1.0, 1.0, 1.0), before, likeness)
    return Plate(replace(plate, pixels=lit), gains, after, likeness)


def _gains(plate: np.ndarray, own: np.ndarray) -> tuple[float, float, float]:
    """Median ratio of linear light per channel of uint8 [n, 3]; 1 for a channel that is dark or clipped throughout."""
    found = []
    for channel in range(3):
        a, b = plate[:, channel], own[:, channel]
        usable = (np.minimum(a, b) >= USABLE[0]) & (np.maximum(a, b) <= USABLE[1])
        ratio = _LIGHT[b[usable]] / _LIGHT[a[usable]]
        found.append(float(np.median(ratio)) if len(ratio) else 1.0)
    red, green, blue = found
    return red, green, blue


_LIGHT = linear_from_srgb(np.arange(256) / 255)
"""Linear light of 8-bit values"""


def _lit(pixels: np.ndarray, gains: tuple[float, float, float]) -> np.ndarray:
    tables = srgb_from_linear(_LIGHT[:, None] * np.array(gains))  # [256, 3]
    lit: np.ndarray = cv2.LUT(pixels, np.rint(255 * tables).astype(np.uint8)[None])
    return lit


def _agreement(first: np.ndarray, second: np.ndarray, tolerance: int) -> float:
    apart = np.maximum(first, second) - np.minimum(first, second)
    return float((apart <= tolerance).all(axis=1).mean())


def _likeness(first: np.ndarray, second: np.ndarray, both: np.ndarray) -> float | None:
    """Median over blocks of the correlation of detail, where both pictures, uint8 [H, W, 3], are known."""
    details = [_detail(pixels) for pixels in (first, second)]
    found = []
    for rows in np.array_split(np.arange(both.shape[0]), ROWS):
        for columns in np.array_split(np.arange(both.shape[1]), COLUMNS):
            block = np.ix_(rows, columns)
            known = both[block]
            a, b = (detail[block][known] for detail in details)
            if known.mean() >= 0.5 and min(a.std(), b.std()) >= LEAST_CONTRAST:
                found.append(float(np.corrcoef(a, b)[0, 1]))
    return float(np.median(found)) if len(found) >= LEAST_BLOCKS else None


def _detail(pixels: np.ndarray) -> np.ndarray:
    """What a picture holds beside its smooth part: float32 [H, W], grey values of 255."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    detail: np.ndarray = grey - cv2.GaussianBlur(grey, (0, 0), max(1.0, DETAIL * pixels.shape[1]))
    return detail
