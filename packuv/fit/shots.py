"""The pictures that a fit explains, and which Gaussians may change for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.depth import SparseDepth
from packuv.fit.labels import dynamic_labels
from packuv.fit.options import ChangeOptions
from packuv.fit.start.bounds import Bounds
from packuv.footage import Response, Views, as_planes
from packuv.footage.response import PLAIN
from packuv.gaussians.codes import Quantizer
from packuv.gaussians.floats import Gaussians

VOID = 16 / 255
"""A pixel whose channels are all at most so bright may show nothing: decoded black is not quite black"""

Later = Callable[[], np.ndarray]
"""Reads an array when it is needed: of many cameras one at a time is whole in memory"""
Sent = Callable[[], Any]
"""Gives an array as it has come to a GPU"""


@dataclass(frozen=True)
class Shot:
    """One picture to explain."""

    camera: PinholeCamera
    source: np.ndarray | Later
    """As filmed, uint8 [H, W, 3], or float32 [3, H, W] in [0, 1]"""
    response: Response = PLAIN
    """What the camera makes of the rig's colours"""
    tiles: np.ndarray | None = None
    """bool [tiles_y, tiles_x] where the picture counts; None: everywhere"""
    known: np.ndarray | Later | None = None
    """bool [H, W] where the picture counts within these tiles; None: everywhere"""
    depths: SparseDepth | None = None
    """Where the surface is known to be"""
    sent: Sent | None = None
    """The source, already on its way to the GPU; None: whoever needs it there sends it"""

    @property
    def filmed(self) -> np.ndarray:
        """The picture as its source has it."""
        return self.source() if callable(self.source) else self.source

    @property
    def target(self) -> np.ndarray:
        """float32 [3, H, W] in [0, 1], as filmed."""
        filmed = self.filmed
        return as_planes(filmed) if filmed.dtype == np.uint8 else filmed

    @property
    def certain(self) -> np.ndarray | None:
        """What is `known`, bool [H, W]."""
        return self.known() if callable(self.known) else self.known

    @property
    def void(self) -> np.ndarray:
        """Where the picture may show nothing, bool [H, W]."""
        return np.asarray(self.target.max(axis=0) <= VOID)

    def opened(self) -> Shot:
        """The same with its arrays in memory."""
        return replace(self, source=self.target, known=self.certain)

    def wanted(self, picture: np.ndarray) -> np.ndarray:
        """The target, float32 [3, H, W]; what is not known is taken for right as `picture` shows it."""
        known = self.certain
        return self.target if known is None else np.where(known, self.target, picture)


def halved(shot: Shot) -> Shot:
    """The same picture at half its size, made when it is needed."""
    camera = shot.camera.scaled(max(16, shot.camera.width // 2), max(16, shot.camera.height // 2))
    size = camera.width, camera.height

    def target() -> np.ndarray:
        small = cv2.resize(shot.target.transpose(1, 2, 0), size, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(small.transpose(2, 0, 1))

    def known() -> np.ndarray:
        mask = shot.certain
        assert mask is not None
        return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)

    response = shot.response.scaled(camera.width / shot.camera.width, camera.height / shot.camera.height)
    return Shot(camera, target, response, known=None if shot.known is None else known)


def find_shots(
    views: Views,
    instant: int,
    masks: Sequence[np.ndarray | None] | None = None,
    sent: Sequence[Sent | None] | None = None,
) -> list[Shot]:
    """Pictures of the cameras that have one, and whose mask, if given, is not empty; some may be on their way."""
    shots = []
    for index, camera in enumerate(views.cameras):
        if masks is not None and (mask := masks[index]) is not None and not mask.any():
            continue
        if views.has(index, instant):
            source, response = partial(_filmed, views, index, instant), views.response(index, instant)
            shots.append(Shot(camera, source, response, sent=sent[index] if sent else None))
    if masks is None and len(shots) < 2:
        raise ValueError(f"instant {instant} has pictures of {len(shots)} cameras to fit, but needs two or more; "
                         "choose another range with --frames")  # fmt: skip
    return shots


def _filmed(views: Views, camera: int, instant: int) -> np.ndarray:
    pixels = views.pixels(camera, instant)
    assert pixels is not None, "who lacks the picture has no shot"
    return pixels


def moving_rows(
    gaussians: Gaussians,
    quantizer: Quantizer,
    views: Views,
    masks: Sequence[np.ndarray | None],
    bounds: Bounds,
    options: ChangeOptions,
) -> np.ndarray:  # bool [N]
    """Gaussians that a motion mask touches in some camera (paper, algorithm 4)."""
    drawn = quantizer.decode(quantizer.encode(gaussians))
    return dynamic_labels(drawn, views.cameras, masks, near=bounds.near, options=options.labels,
                          device=options.device)  # fmt: skip
