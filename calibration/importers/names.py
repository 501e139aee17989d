"""Which posed pictures of a file belong to which video."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from calibration.rig import Camera

_NAMES_SHOWN = 8


class Named(Protocol):
    """A posed picture with the names that its camera may have."""

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def camera(self) -> Camera: ...


def cameras_by_name(views: Sequence[Named], names: Sequence[str] | None, file: Path) -> Iterator[Camera]:
    """One camera for each name: the first way to name the pictures that knows all videos, or whose poses agree."""
    schemes = [_grouped(views, index) for index in range(max(len(view.names) for view in views))]
    size = _extent(views)
    if names is None:
        names, scheme = _agreeing(schemes, size, file)
    else:
        scheme = _covering(schemes, names, file)
    for name in names:
        group = scheme[name]
        if not _agree(group, size):
            raise ValueError(
                f"{file}: the {len(group)} pictures of camera {name!r} must share one pose and lens, but differ"
            )
        yield replace(group[0], name=name)


def same_name(first: str, second: str) -> bool:
    """Whether two names mean one camera: Unicode knows several ways to write a letter."""
    return _plain(first) == _plain(second)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that reads digits as numbers, and upper case as lower case, as `sync.natural` sorts cameras.

    >>> sorted(["cam10", "CAM2", "cam1b"], key=natural_key)
    ['cam1b', 'CAM2', 'cam10']
    """
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), part) if part[0].isdecimal() else (1, 0, part.casefold()) for part in parts)


def some(names: Iterable[str]) -> str:
    """The first names in order, and how many more there are."""
    ordered = sorted(names, key=natural_key)
    more = len(ordered) - _NAMES_SHOWN
    return ", ".join(ordered[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name)


_ALIKE: tuple[Callable[[str], str], ...] = (str, _plain, lambda name: _plain(name).casefold())
"""When names count as one: as they are written, as Unicode composes their letters, in any case"""


def _grouped(views: Sequence[Named], index: int) -> dict[str, list[Camera]]:
    groups: dict[str, list[Camera]] = {}
    for view in views:
        groups.setdefault(view.names[min(index, len(view.names) - 1)], []).append(view.camera)
    return groups


def _covering(schemes: Sequence[dict[str, list[Camera]]], names: Sequence[str], file: Path) -> dict[str, list[Camera]]:
    """The cameras of all names, by the first scheme that knows all; the best one is named where none does."""
    best, known = schemes[0], dict[str, list[Camera]]()
    for scheme in schemes:
        found = max((_matched(scheme, names, alike) for alike in _ALIKE), key=len)
        if len(found) == len(names):
            return found
        if len(found) > len(known):
            best, known = scheme, found
    raise ValueError(
        f"every video needs a camera of its name in {file}; videos without one: {some(set(names) - set(known))}; "
        f"the file's cameras: {some(best)}"
    )


def _matched(
    scheme: Mapping[str, list[Camera]], names: Sequence[str], alike: Callable[[str], str]
) -> dict[str, list[Camera]]:
    """Of the names that are alike to one of the scheme's, and to no other of `names`."""
    wanted = {alike(name): name for name in names}
    found: dict[str, list[Camera]] = {}
    for name, group in scheme.items():
        if len(wanted) == len(names) and alike(name) in wanted:
            found.setdefault(wanted[alike(name)], []).extend(group)
    return found


def _agreeing(
    schemes: Sequence[dict[str, list[Camera]]], size: float, file: Path
) -> tuple[list[str], dict[str, list[Camera]]]:
    for scheme in schemes:
        if "" not in scheme and all(_agree(group, size) for group in scheme.values()):
            return list(scheme), scheme
    raise ValueError(
        f"{file}: pictures of one camera must share one pose and lens, but neither their file names nor their folders "
        "group them so; keep one picture of each camera, named after it"
    )


def _extent(views: Sequence[Named]) -> float:
    """Size of the rig, to judge by what a distance between two poses of one camera means."""
    centres = np.stack([view.camera.centre for view in views])
    return float(np.linalg.norm(centres.max(axis=0) - centres.min(axis=0)))


def _agree(group: Sequence[Camera], size: float) -> bool:
    """Whether all are one camera: within 0.1 degrees, 0.1 % of the rig, and 0.1 % in focal length."""
    first = group[0]
    for other in group[1:]:
        turn = first.camera_from_world[:3, :3] @ other.camera_from_world[:3, :3].T
        angle_deg = math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(turn)) - 1) / 2))))
        shift = float(np.linalg.norm(first.centre - other.centre))
        same_lens = (first.width, first.height) == (other.width, other.height) and abs(other.fx / first.fx - 1) < 1e-3
        if angle_deg > 0.1 or shift > 1e-3 * size or not same_lens:
            return False
    return True
