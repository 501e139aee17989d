"""Data sets as they are published, made capture folders by links: nothing is copied, nothing in the data set changes.

A scene is a folder with a calibration that `calibration.importers` reads and videos, or folders of pictures, of two
cameras or more.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from calibration.importers import Found, find_calibration
from calibration.importers.names import natural_key
from calibration.importers.views import SUFFIXES
from sync.masks import LIKE_MASKS, seems_masks

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".avi", ".webm", ".mxf", ".m4v"})
PICTURE_SUFFIXES = SUFFIXES - VIDEO_SUFFIXES
_CALIBRATIONS = (".", "calib", "calibration", "cameras")
"""Where in a scene its calibration may lie"""
_CAMERAS = (".", "videos", "images", "ims", "rgbs", "images_lr", "frames", "synced")
_RECORDED = re.compile(r"_\d{10,}$")
"""When a recording began, at the end of BRICS's names"""
_ALL_IN_ONE = re.compile(r"_(\d{5})_(\d{2})$")
"""Frame and camera at the end of Technicolor's names"""
_HELD_OUT = {"poses_bounds.npy": "cam00", "models.json": "camera_0001"}
"""Cameras that publications on N3DV and on Google's videos score on"""
_DEPTH = 4


@dataclass(frozen=True)
class Scene:
    """A scene of a data set."""

    name: str
    calibration: Found
    cameras: Mapping[str, Path | tuple[Path, ...]]
    """A video, a folder of pictures, or the pictures themselves"""
    timecodes: Mapping[str, Path] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    """What seems to hold masks, and belongs to none of the cameras"""
    held_out: tuple[str, ...] = ()


def find_scenes(dataset: Path) -> list[Scene]:
    """The scenes in a folder or below it, in natural order.

    Raises FileNotFoundError when there is no such folder, ValueError when it holds no scene.
    """
    if not dataset.is_dir():
        raise FileNotFoundError(f"{dataset} is no folder; adopt makes captures of a data set's folder")
    scenes = list(_scenes(dataset, dataset, _DEPTH))
    if not scenes:
        raise ValueError(
            f"{dataset} holds no scene: a folder with a calibration that docs/calibration.md lists, and with videos or "
            f"folders of pictures of two cameras or more, in it or in {', '.join(_CAMERAS[1:])}"
        )
    return scenes


def adopt(scene: Scene, out: Path) -> Path:
    """Make the capture folder of a scene below `out`; what is there already stays. Returns the folder.

    Raises FileExistsError where something else is in the way.
    """
    folder = out / scene.name
    for camera, source in scene.cameras.items():
        if isinstance(source, tuple):
            for picture in source:
                _link(folder / "videos" / camera / picture.name, picture)
        else:
            _link(folder / "videos" / (camera + (source.suffix if source.is_file() else "")), source)
    for kind, links in (("timecodes", scene.timecodes), ("masks", scene.masks)):
        for camera, path in links.items():
            _link(folder / kind / (camera + (path.suffix if path.is_file() else "")), path)
    for path in scene.calibration.files():
        _link(folder / "calibration" / path.name, path)
    settings = folder / "capture.toml"
    if not settings.exists():
        held = f"held_out = {json.dumps(list(scene.held_out))}\n" if scene.held_out else ""
        settings.write_text(f"name = {json.dumps(scene.name)}\n{held}", encoding="utf-8")
    return folder


def _link(place: Path, source: Path) -> None:
    target = source.absolute()
    if place.is_symlink() and Path(os.readlink(place)) == target:
        return
    if place.is_symlink() or place.exists():
        raise FileExistsError(f"{place} is in the way of a link to {target}; take it out, or adopt into another folder")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(target)


def _scenes(folder: Path, dataset: Path, depth: int) -> Iterator[Scene]:
    """Not below a scene, nor a link, nor a folder that is a capture already."""
    if (folder / "capture.toml").exists():
        return
    if found := _scene(folder, dataset):
        yield found
        return
    inner = sorted((path for path in folder.iterdir() if path.is_dir()), key=lambda path: natural_key(path.name))
    for path in inner:
        if depth and not path.is_symlink() and not path.name.startswith("."):
            yield from _scenes(path, dataset, depth - 1)


def _scene(folder: Path, dataset: Path) -> Scene | None:
    calibration = next((found for place in _CALIBRATIONS if (found := _calibration(folder / place))), None)
    cameras = _cameras(folder) if calibration else {}
    if calibration is None or len(cameras) < 2:
        return None
    name = "-".join(folder.relative_to(dataset).parts) or folder.resolve().name
    read, masks = _masks(folder, cameras)
    times = {
        camera: path.with_suffix(".txt")
        for camera, path in cameras.items()
        if isinstance(path, Path) and path.is_file() and path.with_suffix(".txt").is_file()
    }
    return Scene(
        re.sub(r"[^\w .+()-]", "-", name).strip(" .") or "scene",
        calibration,
        cameras,
        times if len(times) == len(cameras) else {},
        masks,
        tuple(path.name for path in _sorted(folder) if path != read and seems_masks(path)),
        _held_out(calibration, cameras),
    )


def _masks(folder: Path, cameras: Mapping[str, object]) -> tuple[Path | None, dict[str, Path]]:
    """The first folder that holds some of these cameras, and masks by camera."""
    for name in LIKE_MASKS:
        for place in _sorted(folder):
            if place.name.lower() == name and place.is_dir():
                videos = {path.stem: path for path in _sorted(place) if path.suffix.lower() in VIDEO_SUFFIXES}
                found = {**videos, **_picture_folders(place)}
                if own := {camera: found[camera] for camera in cameras if camera in found}:
                    return place, own
    return None, {}


def _calibration(folder: Path) -> Found | None:
    try:
        return find_calibration(folder) if folder.is_dir() else None
    except ValueError:
        return None


def _cameras(folder: Path) -> dict[str, Path | tuple[Path, ...]]:
    for place in (folder / name for name in _CAMERAS):
        files = _sorted(place)
        videos = [path for path in files if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES]
        named = {_RECORDED.sub("", path.stem): path for path in videos}
        if len(videos) > 1:
            return dict(named if len(named) == len(videos) else {path.stem: path for path in videos})
        if len(folders := _picture_folders(place)) > 1:
            return dict(folders)
        mixed: dict[str, list[Path]] = {}
        for path in files:
            if path.suffix.lower() in PICTURE_SUFFIXES and (match := _ALL_IN_ONE.search(path.stem)):
                mixed.setdefault(f"cam{match[2]}", []).append(path)
        if len(mixed) > 1:
            return {camera: tuple(pictures) for camera, pictures in sorted(mixed.items())}
    return {}


def _picture_folders(place: Path) -> dict[str, Path]:
    """Folders in which pictures lie, by name."""
    return {path.name: path for path in _sorted(place) if path.is_dir() and _shows_pictures(path)}


def _sorted(place: Path) -> list[Path]:
    """What is in a folder, in natural order; nothing where there is none."""
    return sorted(place.iterdir(), key=lambda path: natural_key(path.name)) if place.is_dir() else []


def _shows_pictures(folder: Path) -> bool:
    return any(path.suffix.lower() in PICTURE_SUFFIXES for path in folder.iterdir())


def _held_out(calibration: Found, cameras: Mapping[str, object]) -> tuple[str, ...]:
    """Those that others score on, so that figures can be compared."""
    names: tuple[str, ...] = (_HELD_OUT.get(calibration.file.name, ""),)
    test = calibration.file.with_name("test_meta.json")
    if calibration.file.name.endswith("_meta.json") and test.is_file():
        listed = json.loads(test.read_text(encoding="utf-8")).get("cam_id") or [[]]
        names = tuple(str(camera) for camera in listed[0])
    held = tuple(name for name in names if name in cameras)
    return held if len(held) < len(cameras) else ()
