"""Codes in coarser steps, and the quantizer that tells what they mean."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from packuv.bounds import MOST_NUMBER
from packuv.gaussians.codes import OPACITY, REST, Codes, Quantizer
from packuv.gaussians.segment import Segment
from packuv.scene import Tolerance

MIDDLE = 32767.5
"""Position code of the scene's centre, in any steps"""
MOST_POSITION, MOST_ATTRIBUTE, MOST_BAND = 4096.0, 64.0, 512.0
"""Widest steps, in those of the lossless scene: sixteen values along an axis, four of an attribute, 0 alone of a
coefficient of a band above 0"""


@dataclass(frozen=True)
class Steps:
    """By how much wider the steps of a scene's codes are."""

    position: np.ndarray
    """float64 [3], from 1 on: what one code stands for, in codes of the lossless scene"""
    attribute: np.ndarray
    """float64 [A], likewise"""
    multiple: int = 1
    """A power of 2: positions of keys are multiples of it about the centre, beyond what a quantizer's reach can tell"""
    first: np.ndarray | float = 0.0
    """float64 [A]: the code of the lossless scene for which code 0 stands. Of bands above 0 such that 0 has a code, as
    most of their coefficients are nearly that: a third smaller at SH degree 3 than with codes from 0 on"""

    @classmethod
    def of_noise(cls, noise: float, sensitivity: np.ndarray, quantizer: Quantizer) -> Steps:
        """Steps with which every kind of code adds this mean squared error to pictures, or as near as limits allow.

        A step s errs by s^2 / 12 in the mean square. At equal noise a bit more of any kind gains the same, so no
        other steps of that size make better pictures.
        """
        wide = np.sqrt(12 * noise / np.maximum(sensitivity, 1e-300))
        position = np.clip(wide[:3], 1, MOST_POSITION)
        reached = np.log(MOST_NUMBER / 10) - np.log(max(quantizer.unit, 1.0))
        excess = (position * np.log1p(quantizer.reach / quantizer.unit)).max() / reached
        multiple = 2 ** max(0, int(np.ceil(np.log2(excess))))
        band = np.arange(len(quantizer.low)) >= REST
        attribute = np.clip(wide[3:], 1, np.where(band, MOST_BAND, MOST_ATTRIBUTE))
        nought = np.rint(-quantizer.low * 255 / (quantizer.high - quantizer.low))
        first = np.where(band, nought - 128 * attribute, 0.0)
        return cls(np.maximum(position / multiple, 1), attribute, multiple, first)

    @property
    def tolerance(self) -> Tolerance:
        """Of frames after a key, which are seen once, while a key is seen throughout its segment: steps three times
        as wide. Measured on "basketball", 30 frames: at one size 3 dB better than as wide as the key's, 1 dB better
        than five times as wide."""
        return Tolerance((3 * self.multiple - 1) // 2, 1)

    def quantizer(self, quantizer: Quantizer) -> Quantizer:
        """The quantizer whose codes are these steps: the same scales, which reach further than anything lies."""
        reach = quantizer.unit * np.expm1(np.log1p(quantizer.reach / quantizer.unit) * self.position)
        one = (quantizer.high - quantizer.low) / 255
        low = quantizer.low + one * self.first
        return replace(quantizer, reach=reach, low=low, high=low + 255 * one * self.attribute)

    def segment(self, segment: Segment) -> Segment:
        """The same Gaussians in these steps. Equal rows stay equal, so keys share what they shared."""
        key = segment.key
        xyz = self._positions(key.xyz, self.multiple)
        moving = self._positions(segment.xyz, 1)
        return replace(
            segment,
            key=Codes(xyz, self._attributes(key.attributes)),
            xyz=moving,
            attributes=self._attributes(segment.attributes),
        )

    def _positions(self, xyz: np.ndarray, multiple: int) -> np.ndarray:
        """uint16 [..., 3]"""
        away = (xyz - MIDDLE) / (self.position * multiple)
        codes: np.ndarray = np.rint(away * multiple + MIDDLE) if multiple == 1 else np.rint(away) * multiple + 32768
        clipped: np.ndarray = np.clip(codes, 0, 65535).astype(np.uint16)
        return clipped

    def _attributes(self, attributes: np.ndarray) -> np.ndarray:
        """uint8 [..., A]; who is there stays there."""
        there = attributes[..., OPACITY] > 0
        return self.limited(np.rint((attributes - self.first) / self.attribute), there)

    def limited(self, codes: np.ndarray, there: np.ndarray) -> np.ndarray:
        """uint8 [..., A] of codes in these steps, within what the lossless scene can hold; bool [...]: who is there."""
        least, most = np.ceil((0 - self.first) / self.attribute), np.floor((255 - self.first) / self.attribute)
        codes = np.clip(codes, np.clip(least, 0, 255), np.clip(most, 0, 255))
        codes[..., OPACITY] = np.where(there, np.maximum(codes[..., OPACITY], 1), 0)
        limited: np.ndarray = codes.astype(np.uint8)
        return limited
