"""How much view dependence is worth carrying, judged on fitted cameras that were left out so far.

Bands above the constant one fit whatever differs between cameras, be it shine, or an error of calibration: the cameras
that taught them cannot tell. Others can. Each degree is given the same iterations, from the same Gaussians, and is
compared on cameras that took no part; from then on all cameras do. Where too few film to leave any out, no band is
carried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from packuv.camera import PinholeCamera
from packuv.fit.losses import PhotometricOptions, photometric_loss
from packuv.fit.shots import Shot
from packuv.fit.solver import Solver
from packuv.metrics import decibels
from packuv.raster.view import pixels_of_tiles

ONE_OF = 6
"""Cameras, of which one is left out"""
LEAST_LEFT_OUT = 2
LEAST_CAMERAS = 8
"""With fewer, those that are left have too little to tell shine from depth"""
PASSES = 3
"""Over the cameras that take part, in which a degree shows what it can do, at least"""


@dataclass(frozen=True)
class Judgement:
    """What bands are worth."""

    degree: int
    """Chosen: the lowest that is nearly as good as all that were asked for"""
    asked: int
    cameras: tuple[str, ...]
    """Left out and looked at; none: too few cameras"""
    losses: Mapping[int, float]
    """By degree, photometric, of the cameras looked at"""
    psnr_db: Mapping[int, float]
    """Likewise"""

    @property
    def gain(self) -> float:
        """Share of the loss that all bands save."""
        return 1 - self.losses[self.asked] / max(self.losses[0], 1e-12)

    @property
    def gain_db(self) -> float:
        return self.psnr_db[self.asked] - self.psnr_db[0]

    def to_json(self) -> dict[str, Any]:
        return {
            "degree": self.degree,
            "asked": self.asked,
            "left_out": list(self.cameras),
            "losses": {str(degree): value for degree, value in self.losses.items()},
            "gain": self.gain,
            "gain_db": self.gain_db,
        }


def told(judgement: Mapping[str, Any]) -> str:
    """A judgement's `to_json`, in words."""
    cameras = judgement["left_out"]
    carried = f"degree {judgement['degree']} of {judgement['asked']} is carried: "
    if not cameras:
        return (
            carried + f"fewer than {LEAST_CAMERAS} cameras film, so none can be left out to tell what bands are worth"
        )
    return (
        carried + f"all bands save {judgement['gain']:.1%} of the loss of cameras left out ({', '.join(cameras)}), "
        f"{judgement['gain_db']:+.2f} dB"
    )


def left_out(cameras: Sequence[PinholeCamera]) -> list[int]:
    """Which cameras judge, in ascending order: the middle ones of groups that stand together; none of too few."""
    if len(cameras) < LEAST_CAMERAS:
        return []
    places = np.stack([camera.centre for camera in cameras])
    count = max(LEAST_LEFT_OUT, round(len(cameras) / ONE_OF))
    chosen = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())]
    while len(chosen) < count:  # each the farthest from those before it
        distance = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        if not distance.any():  # cameras in fewer places than that
            break
        chosen.append(int(distance.argmax()))
    group = np.linalg.norm(places[:, None] - places[chosen], axis=2).argmin(axis=1)
    middles = (np.flatnonzero(group == number) for number in range(len(chosen)))
    return sorted(int(rows[_middle(places[rows])]) for rows in middles)


def _middle(places: np.ndarray) -> int:
    return int(np.linalg.norm(places[:, None] - places, axis=2).sum(axis=1).argmin())


def judge(
    solver: Solver,
    shots: Sequence[Shot],
    judges: Sequence[int],
    degrees: Sequence[int],
    give: Callable[[Solver, int], None],
    *,
    share: float,
    of: int,
    gain: float,
    options: PhotometricOptions,
) -> tuple[Judgement, Solver]:
    """Which of the degrees, ascending, suffices. Also returns a branch of the solver with that degree, which has gone
    on by this share `of` all iterations.

    `judges` are the shots that took no part; without any the lowest degree suffices, or none but the last if `gain` is
    negative. `give` sets the degree of a solver.
    """
    looked_at = [shots[index] for index in judges] or shots
    part = [shot for index, shot in enumerate(shots) if index not in set(judges)]
    count = max(PASSES * len(part), round(share * of)) if judges else 0
    losses, psnr_db = dict[int, float](), dict[int, float]()

    def tried(degree: int) -> Solver:
        twin = solver.branch()
        give(twin, degree)
        twin.run(part, count, of=of)
        losses[degree], psnr_db[degree] = _error(twin, looked_at, options)
        return twin

    most = degrees[-1]
    chosen, best = most, tried(most)
    for degree in degrees[:-1]:
        twin = tried(degree)
        if losses[degree] <= losses[most] * (1 + gain):
            chosen, best = degree, twin
            break
    names = tuple(shots[index].camera.name for index in judges)
    return Judgement(chosen, most, names, losses, psnr_db), best


def _error(solver: Solver, shots: Sequence[Shot], options: PhotometricOptions) -> tuple[float, float]:
    """Mean photometric loss, and mean PSNR, dB, of what counts in the shots."""
    losses, psnr_db = [], []
    for shot in map(Shot.opened, shots):
        picture = solver.shown(shot)
        wanted = shot.wanted(picture)
        losses.append(photometric_loss(picture, wanted, options=options, tiles=shot.tiles).value)
        square = np.square(picture.clip(0, 1) - wanted)
        psnr_db.append(decibels(max(float(square[:, _counted(shot)].mean()), 1e-10)))
    return float(np.mean(losses)), float(np.mean(psnr_db))


def _counted(shot: Shot) -> np.ndarray:
    """Pixels that count, bool [H, W]."""
    size = shot.camera.height, shot.camera.width
    counted = np.ones(size, bool) if shot.certain is None else shot.certain.copy()
    if shot.tiles is not None:
        counted &= pixels_of_tiles(shot.tiles, shot.camera)
    return counted if counted.any() else np.ones(size, bool)


def still_bands(solver: Solver, degree: int) -> None:
    """For degree 0: rows that may change have no bands, and get none; the table stays as it is."""
    if not degree:
        solver.hold_bands()
