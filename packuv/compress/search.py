"""The steps that reach a size or a loss, by files that are written and pictures that are drawn."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from packuv.colour import lit
from packuv.compress.sensitivity import sensitivity
from packuv.compress.steps import Steps
from packuv.gaussians.segment import Segment
from packuv.metrics import decibels
from packuv.progress import Progress, Ticks, no_progress
from packuv.raster import Arena, RasterOptions, render
from packuv.scene import EncodeOptions, Scene, open_scene, write_scene
from packuv.scene.header import COMPRESSION

FRAMES, CAMERAS = 3, 12
"""Of which pictures tell distortion, at most, spread evenly: 36 of them differ from all by some tenths of a decibel"""
TRIALS = 14
FINEST = 1e-10
"""Noise of the finest steps that are tried, mean squared error of each kind of code"""
COARSEST = 0.03
LONGEST = {"psnr_db": -100.123, "psnr_held_out_db": -100.123, "loss_db": -100.1234}
"""Figures that take as many characters as any, in the header of trials"""
RATIO_TOLERANCE, LOSS_TOLERANCE = 0.02, 0.03
"""Shares of the goal by which the result may stay on the safe side of it"""


@dataclass(frozen=True)
class Goal:
    """What a compressed scene shall be: so much smaller, or so little worse. One of the two."""

    ratio: float | None = None
    """Size of the lossless file over that of the compressed one, at least"""
    loss_db: float | None = None
    """Decibels that PSNR against footage may fall, at most"""
    fitted_db: float = 30.0
    """PSNR of the lossless scene against footage, from which a loss follows"""

    def __post_init__(self) -> None:
        if (self.ratio is None) == (self.loss_db is None):
            raise ValueError("compression needs a ratio or a loss in dB as its goal, one of the two")
        for name, value, least in (("ratio", self.ratio, 1.0), ("loss in dB", self.loss_db, 0.0)):
            if value is not None and not (math.isfinite(value) and value > least):
                raise ValueError(f"the {name} to compress to must be above {least:g}, but is {value:g}")
        if not 1 <= self.fitted_db <= 100:
            raise ValueError(f"the PSNR of the lossless scene must be 1 to 100 dB, but is {self.fitted_db:g}")

    def loss(self, psnr_db: float) -> float:
        """Decibels that PSNR against footage falls where compressed and lossless pictures are so near to each other.

        The errors of fit and of compression are independent, so their squares add up.
        """
        return 10 * math.log10(1 + 10 ** ((self.fitted_db - psnr_db) / 10))

    def told(self, ratio: float, loss_db: float) -> tuple[float, float, float]:
        """What the goal is about, the goal, and the share of it by which it may be missed on the safe side."""
        if self.ratio is not None:
            return ratio, self.ratio, RATIO_TOLERANCE
        assert self.loss_db is not None
        return loss_db, self.loss_db, LOSS_TOLERANCE


@dataclass(frozen=True)
class Compressed:
    """A compressed scene."""

    source_bytes: int
    bytes: int
    psnr_db: float
    """Of its pictures against those of the lossless scene"""
    psnr_held_out_db: float | None
    """Of cameras from which no step was learned; None where no camera is held out"""
    loss_db: float
    """What that costs against footage, by the goal's `fitted_db`; of held-out cameras where there are any"""
    noise: float
    """Mean squared error that each kind of code was meant to add to pictures"""
    steps: Steps

    @property
    def ratio(self) -> float:
        return self.source_bytes / self.bytes


def compress(
    source: Path,
    target: Path,
    goal: Goal,
    *,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = no_progress,
) -> Compressed:
    """Write a smaller scene file of a lossless one; the same input gives the same bytes.

    Distortion is that of the scene's own cameras, the lossless scene being the truth. Raises ValueError where the
    scene is not lossless, or has no cameras; where no steps reach the goal, with what can be reached.
    """
    with open_scene(source, threads=threads) as scene:
        work = _Work(scene, goal, seed, threads, progress)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".packuv-") as folder:
            work.unpack(Path(folder))
            noise = work.search()
            return work.write(target, noise)


class _Work:
    """One scene, whose steps are looked for."""

    def __init__(self, scene: Scene, goal: Goal, seed: int, threads: int, progress: Progress) -> None:
        _check_lossless(scene)
        self._scene, self._goal, self._threads = scene, goal, threads
        self._judge = Judge(scene)
        learned = self._judge.learned
        self._ticks = Ticks(progress, len(learned) * len(self._judge.frames) + TRIALS + 1)
        self._sensitivity = sensitivity(scene, learned, self._judge.frames, seed=seed, ticks=self._ticks)
        self._source, self._source_bytes = _digest(scene), scene.path.stat().st_size
        self._sound = scene.sound()
        self._folder = Path()
        self._segments: list[Path] = []

    def unpack(self, folder: Path) -> None:
        """Segment files of the lossless scene, for all trials."""
        self._folder = folder
        for number in range(len(self._scene.index.segments)):
            self._segments.append(folder / f"lossless{number}.npz")
            self._scene.segment(number).save(self._segments[-1])

    def search(self) -> float:
        """The noise that is nearest to the goal on its safe side: no larger than asked for, no worse than allowed."""
        coarse, fine = self._trial(COARSEST), self._trial(FINEST)
        self._check_reach(fine, coarse)
        low, high = math.log(FINEST), math.log(COARSEST)
        safe = COARSEST if self._goal.ratio is not None else FINEST
        for _ in range(TRIALS - 2):
            middle = math.exp((low + high) / 2)
            found, wanted, tolerance = self._goal.told(*_figures(self._trial(middle)))
            if found > wanted:
                high = math.log(middle)
            else:
                low = math.log(middle)
            if (found >= wanted) == (self._goal.ratio is not None):
                safe = middle
                if abs(found - wanted) <= tolerance * wanted:
                    break
        return safe

    def _check_reach(self, fine: Compressed, coarse: Compressed) -> None:
        (least, wanted, _), (most, _, _) = (self._goal.told(*_figures(trial)) for trial in (fine, coarse))
        if least < wanted <= most:
            return
        what = "{:.2f} to {:.2f} times smaller" if self._goal.ratio is not None else "worse by {:.3f} to {:.2f} dB"
        asked = f"{wanted:g} times" if self._goal.ratio is not None else f"{wanted:g} dB"
        raise ValueError(
            f"{self._scene.path} can be made {what.format(least, most)}, but {asked} is asked for; ask for what lies "
            "between"
        )

    def write(self, target: Path, noise: float) -> Compressed:
        """The file itself, whose header says what was done to it."""
        found = self._trial(noise)
        unseen = found.psnr_held_out_db and round(found.psnr_held_out_db, 3)
        figures = {
            "psnr_db": round(found.psnr_db, 3),
            "psnr_held_out_db": unseen,
            "loss_db": round(found.loss_db, 4),
        }
        size = self._encode(target, found.steps, figures)
        self._ticks.advance()
        return replace(found, bytes=size)

    def _trial(self, noise: float) -> Compressed:
        """Write and look at a file of this noise, as long as the one that says what was found."""
        steps = Steps.of_noise(noise, self._sensitivity, self._scene.header.quantizer)
        path = self._folder / "trial.mkv"
        size = self._encode(path, steps, LONGEST)
        error, unseen = self._judge.errors(path)
        self._ticks.advance()
        psnr_db = decibels(error)
        unseen_db = None if unseen is None else decibels(unseen)
        loss_db = self._goal.loss(psnr_db if unseen_db is None else unseen_db)
        return Compressed(self._source_bytes, size, psnr_db, unseen_db, loss_db, noise, steps)

    def _encode(self, path: Path, steps: Steps, figures: Mapping[str, Any]) -> int:
        """Write the scene in these steps, with these figures in its header; its size in bytes."""
        coarse = [self._folder / f"coarse{number}.npz" for number in range(len(self._segments))]
        for number, place in enumerate(coarse):
            steps.segment(Segment.load(self._segments[number])).save(place)
        options = EncodeOptions(steps.tolerance)
        header = self._scene.header
        said = {**self._said(steps), **figures}
        extra = {**header.extra, COMPRESSION: said}
        stated = replace(header, quantizer=steps.quantizer(header.quantizer), extra=extra)
        return write_scene(path, coarse, stated, sound=self._sound, options=options, threads=self._threads).bytes

    def _said(self, steps: Steps) -> dict[str, Any]:
        """What the header says of how it was compressed, but for what was found."""
        return {
            "source": self._source,
            "source_bytes": self._source_bytes,
            "position_steps": steps.position.tolist(),
            "position_multiple": steps.multiple,
            "attribute_steps": steps.attribute.tolist(),
            "fitted_db": self._goal.fitted_db,
            "cameras": [camera.name for camera in self._judge.cameras],
            "frames": list(self._judge.frames),
        }


class Judge:
    """Pictures of a scene, to which those of others are compared."""

    def __init__(self, scene: Scene) -> None:
        header = scene.header
        held_out = [camera for camera in header.cameras if camera.name in header.held_out]
        fitted = [camera for camera in header.cameras if camera.name not in header.held_out]
        unseen = _spread(held_out, CAMERAS // 3 if fitted else CAMERAS)
        self.learned = _spread(fitted, CAMERAS - len(unseen)) or unseen
        """Cameras from which sensitivity is learned"""
        self.cameras = tuple(self.learned) + tuple(camera for camera in unseen if camera not in self.learned)
        self.frames = tuple(_spread(range(len(scene)), FRAMES))
        self._unseen = {camera.name for camera in self.cameras} - {camera.name for camera in self.learned}
        self._options, self._arena = RasterOptions(near=header.near), Arena()
        self._truth = {(frame, name): picture for frame, name, picture in self._pictures(scene)}

    def errors(self, path: Path) -> tuple[float, float | None]:
        """Mean squared error of a scene file's pictures, and of those of cameras from which nothing was learned."""
        wrong = [
            (unseen, float(np.square(picture - truth, dtype=np.float64).mean()))
            for unseen, picture, truth in self.pairs(path)
        ]
        others = [error for unseen, error in wrong if unseen]
        return float(np.mean([error for _, error in wrong])), float(np.mean(others)) if others else None

    def pairs(self, path: Path) -> Iterator[tuple[bool, np.ndarray, np.ndarray]]:
        """Whether nothing was learned from the camera, a scene file's picture and the true one, float32 [3, H, W]."""
        with open_scene(path) as scene:
            for frame, name, picture in self._pictures(scene):
                yield name in self._unseen, picture, self._truth[frame, name]

    def _pictures(self, scene: Scene) -> Iterator[tuple[int, str, np.ndarray]]:
        """Frame, camera, and float32 [3, H, W] as a display shows it in the light of the instant."""
        for frame in self.frames:
            gaussians = scene.gaussians(frame)
            for camera in self.cameras:
                drawn = render(gaussians, camera, options=self._options, arena=self._arena).colour
                yield frame, camera.name, np.clip(lit(drawn, scene.light(frame)), 0, 1).astype(np.float32)


def _figures(found: Compressed) -> tuple[float, float]:
    return found.ratio, found.loss_db


def _spread(items: Sequence[Any], count: int) -> list[Any]:
    """`count` of the items at equal distances; all of them if there are fewer."""
    if count >= len(items):
        return list(items)
    return [items[(2 * place + 1) * len(items) // (2 * count)] for place in range(count)]


def _check_lossless(scene: Scene) -> None:
    if not scene.lossless:
        raise ValueError(
            f"{scene.path} must be lossless to be compressed, but is lossy already; take the file that it was made from"
        )
    if not scene.header.cameras:
        raise ValueError(f"{scene.path} must hold the cameras whose pictures tell the loss, but holds none")


def _digest(scene: Scene) -> str:
    """Of all codes of a scene, SHA-256 of its frames' digests in hex."""
    return hashlib.sha256("".join(scene.index.digests).encode()).hexdigest()
