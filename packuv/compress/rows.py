"""The rows of a lossless scene, fewer and in coarser steps: segment files for every trial."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from packuv.compress.steps import Steps
from packuv.compress.targets import Targets
from packuv.compress.tune import moved_segment, tune
from packuv.compress.weigh import weigh, worth
from packuv.gaussians.segment import Segment
from packuv.progress import Ticks
from packuv.scene import Scene
from packuv.scene.sharing import match_rows


@dataclass(frozen=True)
class _Part:
    """Files of one segment."""

    lossless: Path
    weights: Path
    """float32 [N]: the largest of it and of those before it with the same codes, which cost nothing to keep"""
    kin: Path
    """int64 [N]: row of the segment before with the same codes at its key, -1 without"""
    offsets: Path
    """float32 [N, 3 + A], lossless codes: where `tune` left each row"""
    coarse: Path
    best: Path


class Rows:
    """Segments of a scene, one in memory at a time."""

    def __init__(self, scene: Scene, targets: Targets, folder: Path, *, near: float, seed: int, ticks: Ticks) -> None:
        self._targets, self._seed, self._ticks = targets, seed, ticks
        self._quantizer, self._near = scene.header.quantizer, near
        self._parts: list[_Part] = []
        self.count = self.kept = 0
        """Rows of all segments, and of the last trial"""
        self._passes = 0
        before = None
        for number in range(len(scene.index.segments)):
            before = self._unpack(scene.segment(number), number, before, folder)

    def keep(self) -> None:
        """The segment files of the last trial stay, as those of the best one, which `best` lists."""
        for part in self._parts:
            part.coarse.replace(part.best)

    @property
    def best(self) -> list[Path]:
        return [part.best for part in self._parts]

    def _unpack(self, segment: Segment, number: int, before: Segment | None, folder: Path) -> Segment:
        names = ("lossless.npz", "weights.npy", "kin.npy", "offsets.npy", "coarse.npz", "best.npz")
        part = _Part(*(folder / f"{number}{name}" for name in names))
        segment.save(part.lossless)
        rng = np.random.default_rng([self._seed, number])
        found = weigh(segment, self._quantizer, self._targets.views, near=self._near, rng=rng, ticks=self._ticks)
        kin = np.full(len(segment.key), -1)
        if before is not None:
            there, here = match_rows(before.key, segment.key)
            kin[here] = there
            found[here] = np.maximum(found[here], np.load(self._parts[-1].weights)[there])
        np.save(part.weights, found)
        np.save(part.kin, kin)
        np.save(part.offsets, np.zeros((len(segment.key), 3 + segment.key.attributes.shape[1]), np.float32))
        self._parts.append(part)
        self.count += len(segment.key)
        return segment

    def coarse(self, noise: float, steps: Steps, iterations: int) -> list[Path]:
        """Segment files in these steps, without rows that are not worth their bits where kinds of codes add so much
        noise; tuned from where the last trial left them, so many iterations each, or as coarse as they are if none.

        A row that the segment before has already keeps what it has there, so that keys share it.
        """
        self.kept, before = 0, None
        self._passes += iterations > 0
        for number, part in enumerate(self._parts):
            before = self._coarse(part, number, noise, steps, iterations, before)
        return [part.coarse for part in self._parts]

    def _coarse(
        self,
        part: _Part,
        number: int,
        noise: float,
        steps: Steps,
        iterations: int,
        before: tuple[np.ndarray, np.ndarray] | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        segment, kin, offsets = Segment.load(part.lossless), np.load(part.kin), np.load(part.offsets)
        stays = worth(np.load(part.weights), noise / self.count * len(self._parts))
        free = np.ones(len(kin), bool)
        if before is not None:
            free = (kin < 0) | ~before[0][kin]
            offsets[~free] = before[1][kin[~free]]
        wide = np.concatenate([steps.position * steps.multiple, steps.attribute])
        coarse = steps.segment(segment.only(stays))
        if iterations:
            found = tune(
                coarse,
                steps,
                steps.quantizer(self._quantizer),
                lambda frame: self._quantizer.decode(segment.frame(frame)),
                self._targets,
                offsets[stays] / wide,
                free=free[stays],
                iterations=iterations,
                near=self._near,
                rng=np.random.default_rng([self._seed, number, self._passes]),
                ticks=self._ticks,
            )
            coarse = moved_segment(coarse, found, steps)
            offsets[stays] = found * wide
            np.save(part.offsets, offsets)
        coarse.save(part.coarse)
        self.kept += len(coarse.key)
        return stays, offsets
