"""Foreground masks beside the videos of a capture: where they lie, and whether they are as many as the frames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sync.capture import Capture, by_camera, camera_of, cameras_in, suggest
from sync.natural import natural_key
from sync.pictures import Pictures, holds_pictures, is_picture, list_pictures
from sync.probe import probe_video

MASKS = "masks"
"""Folder of foreground masks"""
LIKE_MASKS = (MASKS, "mask", "fmask", "fmask_lr", "seg")
"""What data sets call it, in any case: read likewise where it holds some by camera, the first that does"""
WORDS = ("mask", "matte", "matting", "silhouette", "segment", "foreground")
NAMES = frozenset({*LIKE_MASKS, "alpha", "alphas", "pha", "fgr"})
"""A folder with such a word or of such a name seems to hold masks. Mattes are not read by themselves: faint alpha would
count as foreground"""
PACKED = frozenset({".7z", ".gz", ".h5", ".npy", ".npz", ".rar", ".tar", ".tgz", ".zip"})
WANTED = "<camera>/000000.png or <camera>.mp4"


def find_masks(capture: Capture) -> dict[str, Path]:
    """Foreground masks by camera, of those of this capture's cameras that have some; opens none.

    Raises ValueError where masks/ holds none, or some of what is no camera; so for another folder that is read.
    """
    inside = masks_folder(capture)
    if inside is None:
        return {}
    if not inside.is_dir():
        raise ValueError(f"{inside} must be a folder that holds masks as {WANTED}, but is none; rename it")
    if loose := sorted((path.name for path in inside.iterdir() if is_picture(path.name)), key=natural_key):
        raise ValueError(
            f"{inside} must hold masks as {WANTED}, but pictures lie in no camera's folder: {len(loose)}, the first of "
            f"them {loose[0]}; move those of each camera into a folder with its name"
        )
    found, ignored = by_camera(inside, cameras_in(inside)), capture.settings.ignore
    folders = [path for path in inside.iterdir() if path.is_dir() and not path.name.startswith(".")]
    if empty := sorted(path for path in folders if not holds_pictures(path)):
        raise ValueError(f"{empty[0]} must hold numbered masks, as 000000.png, but holds none; add them or take it out")
    if not found:
        raise ValueError(f"{inside} must hold masks as {WANTED}, but holds none; take it out")
    if unknown := [camera for camera in found if camera not in capture.videos and camera not in ignored]:
        raise ValueError(
            f"{found[unknown[0]]} belongs to no video{suggest(unknown[0], capture.videos)}; name it like its video"
        )
    return {camera: found[camera] for camera in capture.cameras if camera in found}


def masks_folder(capture: Capture) -> Path | None:
    """masks/ or, without it, the first of `LIKE_MASKS` that holds some of a camera of this capture."""
    if os.path.lexists(inside := capture.folder / MASKS):
        return inside
    named = sorted(capture.folder.iterdir(), key=lambda path: path.name)
    for name in LIKE_MASKS:
        for path in named:
            if path.name.lower() == name and path.is_dir() and _of_cameras(path, capture):
                return path
    return None


def masks_unread(capture: Capture) -> Iterator[str]:
    """What seems to hold masks and is not read, one sentence each."""
    read = masks_folder(capture)
    for path in sorted(capture.folder.iterdir(), key=lambda path: natural_key(path.name)):
        if path == read or not seems_masks(path):
            continue
        name = path.name + "/" * path.is_dir()
        if read is not None:
            yield f"{name} seems to hold foreground masks and is passed over: those of {read.name}/ are read"
        else:
            yield (
                f"{name} seems to hold foreground masks and is passed over: those are read from {MASKS}/, as {WANTED}, "
                "with all but 0 foreground in PNG; lay them there, or take it out"
            )


def _of_cameras(folder: Path, capture: Capture) -> bool:
    return not {camera_of(path) for path in cameras_in(folder)}.isdisjoint(capture.videos)


def seems_masks(path: Path) -> bool:
    """Whether a folder, or a packed one, is called as if masks lay in it."""
    name = path.name.lower()
    if path.is_dir():
        return not name.startswith(".") and (name in NAMES or any(word in name for word in WORDS))
    stem, _, _ = name.partition(".")
    return path.suffix.lower() in PACKED and (stem in NAMES or any(word in stem for word in WORDS))


def check_masks(capture: Capture, camera: str) -> tuple[int, int]:
    """Width and height of the pictures of a camera with masks; raises ValueError unless it has as many masks as its
    video has frames, with the same numbers."""
    path, video = find_masks(capture)[camera], capture.videos[camera]
    masks, info = list_pictures(path) if path.is_dir() else None, probe_video(video, listen=False)
    if masks and masks.empty:
        name = path / masks.empty[0]
        raise ValueError(f"{name} is an empty file, but must hold a mask; copy it again, or make it anew")
    count = len(masks) if masks else probe_video(path, listen=False).frame_count
    if count != info.frame_count:
        raise ValueError(
            f"{path} must have a mask for each of the {info.frame_count} frames of {camera}, but has {count}"
            f"{_without_number(masks)}; add those that are missing, or take it out"
        )
    if masks and video.is_dir() and not np.array_equal(masks.numbers, wanted := list_pictures(video).numbers):
        odd = int(np.flatnonzero(masks.numbers != wanted)[0])
        raise ValueError(
            f"{path} must have masks with the numbers of the pictures of {camera}, but frame {odd} is picture "
            f"{wanted[odd]} and mask {masks.numbers[odd]}; number them alike"
        )
    return info.width, info.height


def _without_number(masks: Pictures | None) -> str:
    return f", and {masks.others[0]} without a number" if masks and masks.others else ""
