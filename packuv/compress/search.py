"""The steps that reach a size or a loss, by files that are written and pictures that are drawn."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from packuv.compress.brief import brief
from packuv.compress.filmed import EXACT_DB
from packuv.compress.imagined import IMAGINED
from packuv.compress.judge import Judge
from packuv.compress.rows import Rows
from packuv.compress.sensitivity import sensitivity
from packuv.compress.steps import Steps
from packuv.compress.targets import Targets
from packuv.compress.tune import DRAWN
from packuv.compress.weigh import pictures_of
from packuv.footage import Views as Footage
from packuv.metrics import decibels
from packuv.progress import Progress, Ticks, no_progress
from packuv.scene import EncodeOptions, Scene, open_scene, write_scene
from packuv.scene.header import COMPRESSION

TRIALS = 14
ITERATIONS, FEWEST = 600, 200
"""In which codes of a scene are moved, and those of one of its segments at least"""
AGAIN, CORRECTIONS = 4, 3
"""Further passes from there, each of so many times fewer iterations, until the goal is met"""
FINEST = 1e-10
"""Noise of the finest steps that are tried, mean squared error of each kind of code"""
COARSEST = 0.03
LONGEST = {"psnr_db": -100.123, "psnr_held_out_db": -100.123, "loss_db": -100.1234}
"""Figures that take as many characters as any, in the header of trials"""
RATIO_TOLERANCE, LOSS_TOLERANCE = 0.02, 0.03
"""Shares of the goal by which the result may stay on the safe side of it"""
RATIO_SLOPE, LOSS_SLOPE = 0.35, 1.0
STRIDE = math.log(3)
"""Of the noise from a pass to the next one, at most: codes that move may leave no loss at all"""


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

    def told(self, found: Compressed) -> tuple[float, float, float]:
        """What the goal is about, the goal, and the share of it by which it may be missed on the safe side."""
        if self.ratio is not None:
            return found.ratio, self.ratio, RATIO_TOLERANCE
        assert self.loss_db is not None
        return found.loss_db, self.loss_db, LOSS_TOLERANCE

    def prefers(self, one: Compressed, other: Compressed) -> bool:
        """Of two that keep the goal: as small as asked for and nearer to the lossless one, or as near and smaller."""
        return one.loss_db < other.loss_db if self.ratio is not None else one.bytes < other.bytes

    @property
    def slope(self) -> float:
        """By which power of the noise what the goal is about grows, about."""
        return RATIO_SLOPE if self.ratio is not None else LOSS_SLOPE


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
    """What that costs against footage: what it shows, the larger loss of held-out and of fitted cameras, or by the
    goal's `fitted_db`, of held-out cameras where there are any"""
    noise: float
    """Mean squared error that each kind of code was meant to add to pictures"""
    steps: Steps
    rows: float
    """Share of the rows of all segments that are still there"""
    moved: bool
    """Whether codes were moved; they stay where they were if that makes no better pictures"""
    imagined: bool
    """Whether the pictures are of imagined cameras, as nobody filmed the scene"""
    unfollowed: Mapping[str, str]
    """Fitted cameras towards whose footage, if any is given, no codes moved, and why"""

    @property
    def ratio(self) -> float:
        return self.source_bytes / self.bytes


def compress(
    source: Path,
    target: Path,
    goal: Goal,
    *,
    footage: Footage | None = None,
    iterations: int | None = None,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = no_progress,
) -> Compressed:
    """Write a smaller scene file of a lossless one; the same input gives the same bytes.

    Distortion is that of the scene's own cameras, or of imagined ones where nobody filmed it, the lossless scene being
    the truth. `footage` of these cameras, whose instant i is frame i, tells what is lost, and codes move towards it.
    `iterations` are those of each segment in which they are moved to make up for what is left out (None: the usual
    ones); with 0 they stay where they are. Raises ValueError where the scene is not lossless, shows nothing, or is too
    small to get smaller; where no steps reach the goal, with what can be reached; for footage without a picture to
    judge by.
    """
    if iterations is not None and iterations < 0:
        raise ValueError(f"iterations must be 0 or more, but are {iterations}")
    with open_scene(source, threads=threads) as scene:
        _check_lossless(scene)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".packuv-") as folder:
            work = _Work(scene, goal, footage, Path(folder), iterations, seed, threads, progress)
            return work.write(target, work.search())


class _Work:
    """One scene, whose steps are looked for."""

    def __init__(
        self,
        scene: Scene,
        goal: Goal,
        footage: Footage | None,
        folder: Path,
        iterations: int | None,
        seed: int,
        threads: int,
        progress: Progress,
    ) -> None:
        self._scene, self._goal, self._folder, self._threads = scene, goal, folder, threads
        self._judge = Judge(scene)
        learned, segments = self._judge.learned, scene.index.segments
        iterations = usual_iterations(len(segments)) if iterations is None else iterations
        self._passes = [iterations] + [-(-iterations // AGAIN)] * CORRECTIONS if iterations else []
        first, trial = self._judge.pictures(footage)
        first += len(learned) * len(self._judge.frames)
        first += sum(pictures_of(entry.frames, len(self._judge.views)) for entry in segments)
        trials = trial * (TRIALS + len(self._passes))
        tuned = DRAWN * len(segments) * sum(self._passes)
        self._ticks = Ticks(progress, first + trials + tuned + 1)
        self._judge.look(scene, footage, self._ticks)
        near, ticks = self._judge.near, self._ticks
        self._sensitivity = sensitivity(scene, learned, self._judge.frames, near=near, seed=seed, ticks=ticks)
        if not self._sensitivity.any():
            raise ValueError(f"{scene.path} must show something to be compressed, but its cameras see nothing")
        targets = Targets(self._judge.views, self._judge.filmed, near=near)
        self._rows = Rows(scene, targets, folder, near=near, seed=seed, ticks=ticks)
        self._source, self._source_bytes = _digest(scene), scene.path.stat().st_size
        self._sound = scene.sound()

    def search(self) -> Compressed:
        """What is nearest to the goal on its safe side, its segments kept: no larger than asked for, no worse than
        allowed. Codes as they are tell about where that is, moved ones where exactly."""
        found = self._tune(self._bisect())
        self._check_smaller(found)
        return found

    def _bisect(self) -> Compressed:
        """What is nearest to the goal on its safe side, codes being as they are."""
        unsafe, safe = (FINEST, COARSEST) if self._goal.ratio is not None else (COARSEST, FINEST)
        ends = {noise: self._trial(noise) for noise in (unsafe, safe)}
        self._rows.keep()
        self._check_reach(ends[FINEST], ends[COARSEST])
        best = ends[safe]
        low, high = math.log(FINEST), math.log(COARSEST)
        for _ in range(TRIALS - 2):
            middle = math.exp((low + high) / 2)
            trial = self._trial(middle)
            found, wanted, tolerance = self._goal.told(trial)
            if found > wanted:
                high = math.log(middle)
            else:
                low = math.log(middle)
            if (found >= wanted) == (self._goal.ratio is not None):
                best = trial
                self._rows.keep()
                if abs(found - wanted) <= tolerance * wanted:
                    break
        return best

    def _tune(self, best: Compressed) -> Compressed:
        """The best of it and some trials with codes moved, each from where the last one left them."""
        noise, tried = best.noise, list[tuple[float, float]]()
        for iterations in self._passes:
            trial = self._trial(noise, iterations)
            found, wanted, tolerance = self._goal.told(trial)
            if (found >= wanted) == (self._goal.ratio is not None):
                if self._goal.prefers(trial, best):
                    best = trial
                    self._rows.keep()
                if abs(found - wanted) <= tolerance * wanted:
                    break
            tried.append((math.log(noise), math.log(max(found, 1e-9))))
            aim = wanted * (1 + tolerance / 2 if self._goal.ratio is not None else 1 - tolerance / 2)
            noise = math.exp(_ahead(tried, math.log(aim), self._goal.slope))
            noise = min(max(noise, FINEST), COARSEST)
        return best

    def _check_reach(self, fine: Compressed, coarse: Compressed) -> None:
        self._check_smaller(fine if fine.bytes < coarse.bytes else coarse)
        (least, wanted, _), (most, _, _) = (self._goal.told(trial) for trial in (fine, coarse))
        if least < wanted <= most:
            return
        what = "{:.2f} to {:.2f} times smaller" if self._goal.ratio is not None else "worse by {:.3f} to {:.2f} dB"
        asked = f"{wanted:g} times" if self._goal.ratio is not None else f"{wanted:g} dB"
        raise ValueError(
            f"{self._scene.path} can be made {what.format(least, most)}, but {asked} is asked for; ask for what lies "
            "between"
        )

    def _check_smaller(self, found: Compressed) -> None:
        if found.bytes >= self._source_bytes:
            raise ValueError(
                f"{self._scene.path} has {self._source_bytes} bytes and must get smaller by compression, but gets no "
                "smaller: its header says more then; keep it as it is, or allow more loss"
            )

    def write(self, target: Path, found: Compressed) -> Compressed:
        """The file itself, of the segments that were kept, whose header says what was done to them."""
        unseen = found.psnr_held_out_db and round(found.psnr_held_out_db, 3)
        figures = {
            "psnr_db": round(found.psnr_db, 3),
            "psnr_held_out_db": unseen,
            "loss_db": round(found.loss_db, 4),
        }
        size = self._encode(target, self._rows.best, found.steps, found.rows, figures)
        self._ticks.advance()
        return replace(found, bytes=size)

    def _trial(self, noise: float, iterations: int = 0) -> Compressed:
        """Write and look at a file of this noise, as long as the one that says what was found."""
        steps = Steps.of_noise(noise, self._sensitivity, self._scene.header.quantizer)
        path, segments = self._folder / "trial.mkv", self._rows.coarse(noise, steps, iterations)
        rows = self._rows.kept / self._rows.count
        size = self._encode(path, segments, steps, rows, LONGEST)
        errors = self._judge.errors(path)
        psnr_db = min(decibels(errors.mean), EXACT_DB)
        unseen_db = None if errors.unseen is None else min(decibels(errors.unseen), EXACT_DB)
        loss_db = self._goal.loss(psnr_db if unseen_db is None else unseen_db)
        if errors.lost_db is not None:
            loss_db = errors.lost_db
        imagined = self._judge.imagined is not None
        return Compressed(
            self._source_bytes, size, psnr_db, unseen_db, loss_db, noise, steps, rows, iterations > 0, imagined,
            self._judge.filmed.unfollowed if self._judge.filmed else {},
        )  # fmt: skip

    def _encode(
        self, path: Path, segments: Sequence[Path], steps: Steps, rows: float, figures: Mapping[str, Any]
    ) -> int:
        """Write segments in these steps, with these figures in the header; the file's size in bytes."""
        header = self._scene.header
        extra = {**header.extra, COMPRESSION: {**self._said(steps), "rows": round(rows, 4), **figures}}
        stated = brief(replace(header, quantizer=steps.quantizer(header.quantizer), extra=extra))
        options = EncodeOptions(steps.tolerance)
        return write_scene(path, segments, stated, sound=self._sound, options=options, threads=self._threads).bytes

    def _said(self, steps: Steps) -> dict[str, Any]:
        """What the header says of how it was compressed, but for what was found."""
        return {
            "source": self._source,
            "source_bytes": self._source_bytes,
            "position_steps": steps.position.tolist(),
            "position_multiple": steps.multiple,
            "attribute_steps": steps.attribute.tolist(),
            "fitted_db": self._goal.fitted_db,
            "filmed": self._judge.filmed is not None,
            "cameras": [camera.name for camera in self._judge.cameras],
            "frames": list(self._judge.frames),
            **({IMAGINED: self._judge.imagined} if self._judge.imagined else {}),
        }


def usual_iterations(segments: int) -> int:
    """In which the codes of each of so many segments are moved."""
    return max(FEWEST, ITERATIONS // segments)


def _ahead(tried: Sequence[tuple[float, float]], aim: float, slope: float) -> float:
    """Where a straight line through the last two points meets the aim, or one of this slope through the last; no
    further from there than STRIDE."""
    (x, y), before = tried[-1], tried[-2:-1]
    if before and x != before[0][0]:
        steep = (y - before[0][1]) / (x - before[0][0])
        slope = min(max(steep, slope / 3), 3 * slope)
    return x + min(max((aim - y) / slope, -STRIDE), STRIDE)


def _check_lossless(scene: Scene) -> None:
    if not scene.lossless:
        raise ValueError(
            f"{scene.path} must be lossless to be compressed, but is lossy already; take the file that it was made from"
        )


def _digest(scene: Scene) -> str:
    """Of all codes of a scene, SHA-256 of its frames' digests in hex."""
    return hashlib.sha256("".join(scene.index.digests).encode()).hexdigest()
