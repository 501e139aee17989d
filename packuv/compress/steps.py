"""Codes in coarser steps, and the quantizer that tells what they mean."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from packuv.bounds import MOST_NUMBER
from packuv.gaussians.codes import OPACITY, Codes, Quantizer
from packuv.gaussians.segment import Segment
from packuv.scene import Tolerance

MIDDLE = 32767.5
"""Position code of the scene's centre, in any steps"""
MOST_POSITION, MOST_ATTRIBUTE = 4096.0, 64.0
"""Widest steps, in those of the lossless scene: sixteen values along an axis, four of an attribute"""


@dataclass(frozen=True)
class Steps:
    """By how much wider the steps of a scene's codes are."""

    position: np.ndarray
    """float64 [3], from 1 on: what one code stands for, in codes of the lossless scene"""
    attribute: np.ndarray
    """float64 [A], likewise"""
    multiple: int = 1
    """A power of 2: positions of keys are multiples of it about the centre, beyond what a quantizer's reach can tell"""

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
        return cls(np.maximum(position / multiple, 1), np.clip(wide[3:], 1, MOST_ATTRIBUTE), multiple)

    @property
    def tolerance(self) -> Tolerance:
        """Of frames after a key, which are seen once, while a key is seen throughout its segment: steps three times
        as wide. Measured on "basketball", 30 frames: at one size 3 dB better than as wide as the key's, 1 dB better
        than five times as wide."""
        return Tolerance((3 * self.multiple - 1) // 2, 1)

    def quantizer(self, quantizer: Quantizer) -> Quantizer:
        """The quantizer whose codes are these steps: the same scales, which reach further than anything lies."""
        reach = quantizer.unit * np.expm1(np.log1p(quantizer.reach / quantizer.unit) * self.position)
        return replace(quantizer, reach=reach, high=quantizer.low + (quantizer.high - quantizer.low) * self.attribute)

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
        codes: np.ndarray = np.rint(attributes / self.attribute)
        there = attributes[..., OPACITY] > 0
        codes[..., OPACITY] = np.where(there, np.maximum(codes[..., OPACITY], 1), 0)
        rounded: np.ndarray = codes.astype(np.uint8)
        return rounded
