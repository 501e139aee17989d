"""Pictures that stand otherwise in the calibration than in the video: phones and cinema cameras film on their side.

A video may be stored lying and shown upright, and a calibration is made of the one or the other. Sizes tell that a
picture was turned by a quarter, but not which way: that the pictures tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from calibration.accept import MatchOptions, PairMatches, matches_report
from calibration.rig import Camera, Rig

CLOCKWISE, COUNTERCLOCKWISE = 1, 3
"""Quarter turns clockwise"""


def fitted(rig: Rig, sizes: Mapping[str, tuple[int, int]]) -> tuple[Rig, tuple[str, ...]]:
    """The rig at the pictures' widths and heights, and the cameras that had to be turned clockwise by a quarter for it.

    Raises ValueError for a camera that was calibrated in another shape.
    """
    turned = tuple(camera.name for camera in rig.cameras if _lies(camera, sizes[camera.name]))
    cameras = (camera.turned(CLOCKWISE) if camera.name in turned else camera for camera in rig.cameras)
    return replace(rig, cameras=tuple(cameras)).resized(sizes), turned


def _lies(camera: Camera, size: tuple[int, int]) -> bool:
    return not _fits(camera, size) and _fits(camera.turned(CLOCKWISE), size)


def _fits(camera: Camera, size: tuple[int, int]) -> bool:
    try:
        camera.resized(*size)
    except ValueError:
        return False
    return True


def upright(
    rig: Rig, names: Sequence[str], evidence: Sequence[PairMatches], *, options: MatchOptions
) -> dict[str, int]:
    """By how many quarters to turn each of the named cameras, 0 or 2, so that the poses explain most matches.

    `evidence` was found without the poses. All are turned alike first, as by one way to hold the cameras, then each on
    its own while that explains more.
    """

    def explained(turns: Mapping[str, int]) -> float:
        return matches_report(with_turns(rig, turns), evidence, options=options).explained_share or 0.0

    turns = max((dict.fromkeys(names, turn) for turn in (0, 2)), key=explained)
    best, gained = explained(turns), True
    while gained:
        gained = False
        for name in names:
            other = {**turns, name: 2 - turns[name]}
            if (share := explained(other)) > best:
                turns, best, gained = other, share, True
    return turns


def with_turns(rig: Rig, turns: Mapping[str, int]) -> Rig:
    """The rig with pictures turned by so many quarters, by camera."""
    return replace(rig, cameras=tuple(camera.turned(turns.get(camera.name, 0)) for camera in rig.cameras))
