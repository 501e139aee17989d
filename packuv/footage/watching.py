"""A reader that goes on where pictures are damaged, and keeps a log of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from packuv.footage.damage import DamagedPictureError, DamageLog, neighbours
from packuv.footage.reader import FrameReader
from packuv.footage.transfer import Transfer


class WatchingReader(FrameReader):
    """Gives the nearest picture in place of a lost one; who reads all of a video learns all of its damage."""

    def __init__(
        self,
        videos: Mapping[str, Path],
        log: DamageLog,
        *,
        transfer: Transfer | None = None,
        kept: Path | None = None,
    ) -> None:
        super().__init__(videos, transfer=transfer, kept=kept, careful=True)
        self.log = log

    def read(self, camera: str, frame: int) -> np.ndarray:
        """Raises FileNotFoundError and ValueError as FrameReader does, but for pictures that are damaged."""
        try:
            return self._nearest(camera, frame)
        finally:
            if damage := self.damage(camera):
                self.log.note(camera, damage)

    def _nearest(self, camera: str, frame: int) -> np.ndarray:
        try:
            return super().read(camera, frame)
        except DamagedPictureError as error:
            lost = error
        for other in neighbours(frame, self.frame_count(camera)):
            try:
                return super().read(camera, other)
            except DamagedPictureError:
                continue
        raise lost
