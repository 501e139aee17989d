"""What changes for good: a thing put down, a door that stays open; when, and where each camera saw it.

A place counts if it stands still at one colour before an instant and at another one after it, for long on both sides; a
change counts if several cameras show connected places that change at the same time. Few, small pictures tell; the date
between two of them is found by halving.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from packuv.files import open_npz, save_npz
from packuv.footage import Views
from packuv.motion.background import apart, median_of
from packuv.motion.step import fitted_size
from packuv.progress import Progress, no_progress

TELLING = 8
"""Cameras that are asked for the date, at most"""
LEAST_PIXELS = 6
"""Of a change in a small picture, below which noise decides"""
Places = dict[int, np.ndarray]
"""Changed places by index of the camera: bool [h, w], a small picture"""


@dataclass(frozen=True)
class PatchOptions:
    """What counts as a change for good."""

    enabled: bool = True
    instants: int = 48
    """Evenly over the sequence, of which small pictures are compared; the date is then sought between them"""
    width: int = 160
    """Of these pictures, pixels"""
    lasting: int = 60
    """Instants for which both states must last, at least: what stays for less is as well fitted by keyframes"""
    lasting_share: float = 0.1
    """And the share of the sequence"""
    tolerance: int = 12
    """Grey values of 255 from the state that noise and shadows explain"""
    contrast: int = 30
    """Grey values, in some channel, by which the states must differ"""
    agreement: float = 0.8
    """Share of the pictures on either side that must show the state, or the place is unknown: people pass by"""
    least_area: float = 0.001
    """Share of the picture that a connected change must fill"""
    still_share: float = 0.6
    """Share of it that must stand still on either side: of a thing nearly all, of a person who waits the middle"""
    cameras: int = 3
    """That must see a change, at least"""
    most_area: float = 0.4
    """If more than this share of the pictures changes at once, the scene was cut, which no patch mends"""

    def __post_init__(self) -> None:
        for name in ("lasting_share", "agreement", "least_area", "still_share", "most_area"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} must be a share above 0, at most 1, but is {getattr(self, name)}")
        if self.instants < 2 or self.lasting < 1 or self.cameras < 1 or self.width < 16:
            raise ValueError(
                "instants must be 2 or more, lasting and cameras 1, width 16, but they are "
                f"{self.instants}, {self.lasting}, {self.cameras} and {self.width}"
            )
        if not 0 <= self.tolerance < self.contrast:
            raise ValueError(
                f"contrast must exceed tolerance, or noise is a change, but they are {self.contrast}, {self.tolerance}"
            )


@dataclass(frozen=True)
class Patch:
    """One change for good."""

    date: int
    """The first instant at which more of its places show what comes than what was"""
    masks: Mapping[int, np.ndarray]
    """Where, by index of the camera, of those that saw it: bool [h, w], a small picture"""


@dataclass(frozen=True)
class Patches:
    """All changes for good of a sequence."""

    found: tuple[Patch, ...]
    """By date, ascending"""
    cuts: tuple[int, ...] = ()
    """Instants at which so much changes that the scene must have been cut; they are no patches"""

    @property
    def dates(self) -> tuple[int, ...]:
        return tuple(patch.date for patch in self.found)

    def save(self, path: Path) -> None:
        masks = {f"mask_{number}_{camera}": mask for number, patch in enumerate(self.found)
                 for camera, mask in patch.masks.items()}  # fmt: skip
        save_npz(path, {"dates": np.array(self.dates, np.int64), "cuts": np.array(self.cuts, np.int64), **masks})

    @classmethod
    def load(cls, path: Path) -> Patches:
        with open_npz(path) as data:
            found = [Patch(int(date), dict(_masks(data, number))) for number, date in enumerate(data["dates"])]
            return cls(tuple(found), tuple(int(cut) for cut in data["cuts"]))


def _masks(data: Mapping[str, np.ndarray], number: int) -> Iterator[tuple[int, np.ndarray]]:
    for name in data:
        if name.startswith(f"mask_{number}_"):
            yield int(name.rsplit("_", 1)[1]), data[name]


def epochs(dates: Sequence[int], count: int) -> list[range]:
    """Instants between dates, half-open; together they are range(count)."""
    return [range(first, last) for first, last in zip([0, *dates], [*dates, count], strict=True)]


def find_patches(views: Views, options: PatchOptions, *, workers: int = 1, progress: Progress = no_progress) -> Patches:
    """Changes for good of the views' cameras; none in a sequence that is too short for two lasting states."""
    lasting = max(options.lasting, round(options.lasting_share * len(views)))
    if len(views) < 2 * lasting or len(views.cameras) < options.cameras:
        return Patches(())
    instants = np.unique(np.linspace(0, len(views) - 1, min(options.instants, len(views))).round().astype(int))
    window = max(3, int(np.searchsorted(instants, lasting, side="right")) - 1)
    seen = []
    with ThreadPoolExecutor(workers) as pool:
        work = [pool.submit(_camera_changes, views, c, instants, window, options) for c in range(len(views.cameras))]
        for done, part in enumerate(work, start=1):
            seen.append(part.result())
            progress(done, len(work))
    dated, cuts = _clustered(seen, window, options)
    found: dict[int, Places] = {}
    for split, own, places in dated:
        found.setdefault(_date(views, instants, seen, split, own, options, window), places)
    patches = tuple(Patch(date, found[date]) for date in sorted(found))
    return Patches(patches, tuple(int(instants[cut]) for cut in cuts))


@dataclass(frozen=True)
class _Changes:
    """Where and between which of its pictures a camera changes for good."""

    splits: np.ndarray
    """bool [n, h, w]: at each split, by the first picture after it, the places that change there"""
    states: np.ndarray
    """uint8 [n, h, w, 3]: at each place of the first axis the state of the `window` pictures from there on"""


def _camera_changes(views: Views, camera: int, instants: np.ndarray, window: int, options: PatchOptions) -> _Changes:
    pictures = [_small(views, camera, int(instant), options.width) for instant in instants]
    size = fitted_size(views.cameras[camera].width, views.cameras[camera].height, options.width)
    splits, states = (
        np.zeros((len(pictures), size[1], size[0]), bool),
        np.zeros((len(pictures), *size[::-1], 3), np.uint8),
    )
    there = np.array([picture is not None for picture in pictures])
    if there.sum() < window:
        return _Changes(splits, states)
    found = np.stack([picture for picture in pictures if picture is not None])
    usual = median_of(found)
    away = options.contrast - 2 * options.tolerance
    other = sum((apart(picture, usual) >= away).astype(np.int16) for picture in found)
    open_places = np.asarray(other >= window // 2)  # the rest has one state throughout
    states[:] = usual
    places = np.zeros((len(pictures), int(open_places.sum()), 3), np.uint8)
    places[there] = found[:, open_places]
    splits[:, open_places], states[:, open_places] = _dated_places(places, there, window, options)
    return _Changes(splits, states)


def _dated_places(
    shown: np.ndarray,  # uint8 [n, P, 3]
    there: np.ndarray,  # bool [n], the pictures that there are
    window: int,
    options: PatchOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Splits, bool [n, P], and states, uint8 [n, P, 3], as `_Changes` has them."""
    count, enough = len(shown), options.agreement * window
    states, steady = np.zeros_like(shown), np.zeros(shown.shape[:2], np.int16)
    for first in range(count - window + 1):
        part = shown[first : first + window][there[first : first + window]]
        if len(part) >= enough:
            states[first] = median_of(part)
            steady[first] = sum((apart(picture, states[first]) <= options.tolerance) for picture in part)
    score = np.zeros(shown.shape[:2], np.int16)
    for split in range(window, count - window + 1):
        before, after = steady[split - window], steady[split]
        real = (before >= enough) & (after >= enough)
        real &= apart(states[split - window], states[split]) >= options.contrast
        score[split] = np.where(real, before + after, 0)
    return _peaks(score, window), states


def _small(views: Views, camera: int, instant: int, width: int) -> np.ndarray | None:
    """Steady picture, uint8 [h, w, 3]."""
    pixels = views.steady(camera, instant, remember=False)
    if pixels is None:
        return None
    size = fitted_size(pixels.shape[1], pixels.shape[0], width)
    return pixels if size == pixels.shape[1::-1] else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _peaks(score: np.ndarray, reach: int) -> np.ndarray:
    """Where a score, int16 [n, P], is positive and the first of the highest among those nearer than `reach`: bool."""
    peaks = score > 0
    for step in range(1, reach):
        peaks[step:] &= score[step:] > score[:-step]
        peaks[:-step] &= score[:-step] >= score[step:]
    return peaks


def _clustered(
    seen: Sequence[_Changes], window: int, options: PatchOptions
) -> tuple[list[tuple[int, Places, Places]], list[int]]:
    """Splits at which enough cameras change, with the places of each camera there, and those of all splits nearer than
    `window`, for which the one with most places stands; and the splits at which the scene is cut."""
    possible = range(window, len(seen[0].splits) - window + 1)
    masks: dict[int, Places] = {
        split: {c: mask for c, part in enumerate(seen) if (mask := _region(part, split, window, options)).any()}
        for split in possible
    }
    share = {split: sum(float(mask.mean()) for mask in part.values()) for split, part in masks.items()}
    exact = {split: sum(int(part.splits[split].sum()) for part in seen) for split in possible}
    left = {split for split in possible if len(masks[split]) >= options.cameras}
    dated, cuts = [], []
    while left:
        best = max(left, key=lambda split: (exact[split], -split))
        near = sorted(split for split in left if abs(split - best) < window)
        left -= set(near)
        if share[best] > options.most_area * len(seen):
            cuts.append(best)
            continue
        together: Places = {}
        for split in near:
            for camera, mask in masks[split].items():
                together[camera] = together.get(camera, np.zeros_like(mask)) | mask
        dated.append((best, masks[best], together))
    return dated, sorted(cuts)


def _region(part: _Changes, split: int, window: int, options: PatchOptions) -> np.ndarray:
    """Connected places that differ from before to after a split, bool [h, w], if most of each are as still on either
    side as a thing is: the outline of a person who stands is not."""
    still = np.asarray(part.splits[max(0, split - 1) : split + 2].any(axis=0))
    if not still.any():
        return still
    other = apart(part.states[split - window], part.states[split]) >= options.contrast
    count, labels, stats, _ = cv2.connectedComponentsWithStats((other | still).astype(np.uint8), connectivity=8)
    own, area = np.bincount(labels[still], minlength=count), stats[:, cv2.CC_STAT_AREA]
    whole = (own >= max(LEAST_PIXELS, options.least_area * still.size)) & (own >= options.still_share * area)
    whole[0] = False
    region: np.ndarray = whole[labels]
    return region


def _date(
    views: Views,
    instants: np.ndarray,
    seen: Sequence[_Changes],
    split: int,
    masks: Mapping[int, np.ndarray],
    options: PatchOptions,
    window: int,
) -> int:
    """The instant, by halving, from which on most of the places show the later state rather than the earlier one; the
    cameras that see most of them tell."""
    telling = sorted(masks, key=lambda camera: (-int(masks[camera].sum()), camera))[:TELLING]

    def changed(instant: int) -> bool:
        later = total = 0
        for camera in telling:
            picture, mask = _small(views, camera, instant, options.width), masks[camera]
            if picture is not None:
                before, after = (seen[camera].states[first][mask] for first in (split - window, split))
                here = picture[mask].astype(np.int16)
                later += int((np.abs(here - after).sum(axis=1) < np.abs(here - before).sum(axis=1)).sum())
                total += int(mask.sum())
        return 2 * later > total

    low, high = int(instants[max(split - 2, 0)]), int(instants[min(split + 1, len(instants) - 1)])
    if changed(low) or not changed(high):
        return int(instants[split])
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if changed(middle) else (middle, high)
    return high
