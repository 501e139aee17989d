"""One fitted segment of a sequence, as the integers the scene file will hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from packuv.files import open_npz
from packuv.gaussians.codes import Codes


@dataclass(frozen=True)
class Segment:
    """A keyframe and the frames after it, up to the next keyframe.

    A row is one Gaussian for the whole segment. A Gaussian that is born later or dies earlier has opacity
    code 0 in the frames where it is absent.
    """

    first: int
    """Instant of the keyframe in the sequence, counted from 0"""
    key: Codes
    """All N Gaussians at the keyframe"""
    dynamic: np.ndarray
    """bool [N]: the D rows that may change inside the segment; the others repeat the keyframe exactly"""
    xyz: np.ndarray
    """uint16 [T - 1, D, 3]: positions of the dynamic rows in the frames after the keyframe"""
    attributes: np.ndarray
    """uint8 [T - 1, D, A]"""

    def __post_init__(self) -> None:
        count = int(self.dynamic.sum())
        if self.dynamic.shape != (len(self.key),) or self.xyz.shape[1:] != (count, 3):
            raise ValueError(
                f"{len(self.key)} Gaussians, {count} dynamic, but {self.dynamic.shape=}, {self.xyz.shape=}"
            )
        if self.attributes.shape != (*self.xyz.shape[:2], self.key.attributes.shape[1]):
            raise ValueError(
                f"{self.attributes.shape=} does not match {self.xyz.shape=} and {self.key.attributes.shape=}"
            )

    def __len__(self) -> int:
        """Number of frames, the keyframe included."""
        return 1 + len(self.xyz)

    def frame(self, index: int) -> Codes:
        """All N Gaussians at frame `index` of this segment, 0 <= index < len(self)."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of a segment with {len(self)} frames")
        if index == 0:
            return self.key
        xyz, attributes = self.key.xyz.copy(), self.key.attributes.copy()
        xyz[self.dynamic] = self.xyz[index - 1]
        attributes[self.dynamic] = self.attributes[index - 1]
        return Codes(xyz, attributes)

    def only(self, rows: np.ndarray) -> Segment:
        """The same frames of these rows, bool [N]."""
        moving = rows[self.dynamic]
        return Segment(self.first, self.key[rows], self.dynamic[rows], self.xyz[:, moving], self.attributes[:, moving])

    def save(self, path: Path) -> None:
        np.savez(
            path,
            first=self.first,
            key_xyz=self.key.xyz,
            key_attributes=self.key.attributes,
            dynamic=self.dynamic,
            xyz=self.xyz,
            attributes=self.attributes,
        )

    @classmethod
    def load(cls, path: Path) -> Segment:
        with open_npz(path) as data:
            return cls(
                int(data["first"]),
                Codes(data["key_xyz"], data["key_attributes"]),
                data["dynamic"],
                data["xyz"],
                data["attributes"],
            )
