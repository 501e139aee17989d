"""Cameras that look at a scene as its own do, and from between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from packuv.camera import PinholeCamera

NEIGHBOURS = 3
"""Of a camera, towards which others are imagined"""
OWN = 0.3
"""Share of the scene's own cameras among those drawn"""
LEAST, MOST = -0.3, 0.6
"""Of the way from a camera to its neighbour: a little beyond the rig's end, and past the middle"""


class Views:
    """Cameras of a scene, and more between and beside them: who never looks from elsewhere fits what he sees alone."""

    def __init__(self, cameras: Sequence[PinholeCamera], *, filmed: bool = True) -> None:
        self._cameras = tuple(cameras)
        self.filmed = filmed
        """Whether they filmed the scene, so that what lies beside all their pictures was never meant to be seen"""
        self._centres = np.array([camera.centre for camera in cameras])

    def __len__(self) -> int:
        """Number of the scene's own."""
        return len(self._cameras)

    def draw(self, rng: np.random.Generator) -> PinholeCamera:
        """One of them, by chance."""
        return self._beside(int(rng.integers(len(self))), rng)

    def sweep(self, count: int, rng: np.random.Generator) -> Iterator[PinholeCamera]:
        """So many, by chance, but of each of the scene's own or beside it as many as of any other, or one more."""
        for number in range(count):
            if number % len(self) == 0:
                order = rng.permutation(len(self))
            yield self._beside(int(order[number % len(self)]), rng)

    def _beside(self, index: int, rng: np.random.Generator) -> PinholeCamera:
        own = rng.random() < OWN
        camera, apart = self._cameras[index], np.linalg.norm(self._centres - self._centres[index], axis=1)
        near = np.argsort(apart, kind="stable")[1 : 1 + NEIGHBOURS]
        if own or not len(near):
            return camera
        return _between(camera, self._cameras[near[rng.integers(len(near))]], rng.uniform(LEAST, MOST))


def _between(a: PinholeCamera, b: PinholeCamera, share: float) -> PinholeCamera:
    """Optics of the first, standing and turned a share of the way towards the second."""
    turns = [camera.camera_from_world[:3, :3] for camera in (a, b)]
    left, _, right = np.linalg.svd((1 - share) * turns[0] + share * turns[1])
    pose = np.eye(4)
    pose[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    pose[:3, 3] = -pose[:3, :3] @ ((1 - share) * a.centre + share * b.centre)
    return replace(a, camera_from_world=pose)
