"""A data set: a folder with captures somewhere below it, each of which gets a name that no other has."""

from __future__ import annotations

import os
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from packuv.progress import Progress, no_progress
from pipelines.folder import IDENTITY
from sync.capture import (
    LONGEST_NAME,
    SETTINGS,
    Capture,
    CaptureSettings,
    check_name,
    find_capture,
    holds_pictures_of_cameras,
)
from sync.natural import natural_key

READERS = 4
"""Threads that read: a disk or a network serves some requests at once, and one core hashes what a fast disk gives"""


@dataclass(frozen=True)
class Found:
    """One capture folder of a data set."""

    place: str
    """Relative to the data set, '.' for the data set itself"""
    folder: Path
    """Absolute"""
    name: str
    """Of the sequence; no other of the data set has it, on file systems that ignore case neither"""
    capture: Capture | None
    """None where `problem` says why"""
    problem: str | None = None


@dataclass(frozen=True)
class Survey:
    """The captures of a data set, in natural order of their places, before any video is opened."""

    dataset: Path
    """Absolute"""
    captures: tuple[Found, ...]
    unreadable: tuple[Path, ...] = ()
    """Folders that could not be looked into"""


def survey(dataset: Path, *, progress: Progress = no_progress) -> Survey:
    """Find the capture folders: those that hold `videos/` or capture.toml, or pictures of cameras as published.

    Hidden folders, captures within captures and what `packuv run` wrote are passed over; a folder that several links
    lead to counts once. A capture with a fault is one of them, and says so.

    Raises:
        FileNotFoundError: no such folder.
        ValueError: no capture in it.
    """
    if not dataset.is_dir():
        raise FileNotFoundError(f"no folder {dataset}; a data set is a folder with capture folders in it")
    dataset, unreadable = dataset.absolute(), list[Path]()
    folders = sorted(_capture_folders(dataset, unreadable), key=lambda path: _order(_place(dataset, path)))
    if not folders:
        unread = f", of which {unreadable[0]} cannot be read" if unreadable else ""
        raise ValueError(f"{dataset} must hold capture folders, with videos/<camera>.mp4 in each, but has none{unread}")
    own, captures = dict[str, str | None](), list[tuple[str, Path, Capture | None, str | None]]()
    with ThreadPoolExecutor(READERS) as pool:
        for folder, (name, capture, problem) in zip(folders, pool.map(_examine, folders), strict=True):
            place = _place(dataset, folder)
            own[place] = name
            captures.append((place, folder, capture, problem))
            progress(len(captures), len(folders), place)
    names = unique_names(own, root=dataset.name)
    found = (Found(place, folder, names[place], capture, problem) for place, folder, capture, problem in captures)
    return Survey(dataset, tuple(found), tuple(sorted(unreadable)))


def unique_names(own: Mapping[str, str | None], *, root: str = "") -> dict[str, str]:
    """A name for each place of a data set: its own if it has one that no other has, else what its path makes.

    >>> unique_names({"day1/dance": "dance", "day2/dance": "dance", "hall": "Hall"})
    {'hall': 'Hall', 'day1/dance': 'day1-dance', 'day2/dance': 'day2-dance'}

    Args:
        own: by place, relative to the data set; None where the capture has no name that could be used.
        root: the folder's name of a data set that is a capture itself.
    """
    count = Counter(_alike(name) for name in own.values() if name is not None)
    names = {place: name for place, name in own.items() if name is not None and count[_alike(name)] == 1}
    taken = {_alike(name) for name in names.values()}
    for place in own:
        if place not in names:
            names[place] = _free(_valid(root if place == "." else place.replace("/", "-")), taken)
            taken.add(_alike(names[place]))
    return names


def sentence(error: ValueError | OSError) -> str:
    """What an error says, as one line; the system's with the file that it is about."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror and error.filename:
        text = f"{error.filename}: {error.strerror}"
    return " ".join(text.split())


def holds_capture(folder: Path) -> bool:
    """Whether a folder is taken for one capture, be it a whole one or not."""
    return (folder / "videos").is_dir() or (folder / SETTINGS).is_file() or holds_pictures_of_cameras(folder)


def _capture_folders(dataset: Path, unreadable: list[Path]) -> Iterator[Path]:
    """Real folders first, so that a link to one of them adds nothing."""
    real, links, seen = [dataset], list[Path](), set[tuple[int, int]]()
    while real or links:
        folder = real.pop() if real else links.pop()
        try:
            stat = folder.stat()
            inside = _folders_within(folder)
        except OSError:
            unreadable.append(folder)
            continue
        if (stat.st_dev, stat.st_ino) in seen:
            continue
        seen.add((stat.st_dev, stat.st_ino))
        if holds_capture(folder):
            yield folder
        elif not _is_output(folder):
            for path in reversed(inside):
                (links if path.is_symlink() else real).append(path)


def _folders_within(folder: Path) -> list[Path]:
    """Sorted; a link counts as what it leads to."""
    with os.scandir(folder) as entries:
        shown = [entry for entry in entries if not entry.name.startswith(".")]
    # Path.is_dir takes a link that leads round to itself for no folder, where DirEntry.is_dir raises
    found = (entry for entry in shown if (Path(entry).is_dir() if entry.is_symlink() else entry.is_dir()))
    return sorted(Path(entry) for entry in found)


def _is_output(folder: Path) -> bool:
    """Whether `packuv run` wrote it."""
    return (folder / "store").is_dir() and any((folder / name).is_file() for name in ("run.json", IDENTITY))


def _examine(folder: Path) -> tuple[str | None, Capture | None, str | None]:
    """Own name, capture and problem, as far as there are any."""
    try:
        _check_text(folder)
        capture = find_capture(folder)
        return capture.name, capture, None
    except (ValueError, OSError) as error:
        return _own_name(folder), None, sentence(error)


def _check_text(folder: Path) -> None:
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise ValueError(f"{str(folder)!r} must be a name in UTF-8, but is none; rename it") from None


def _own_name(folder: Path) -> str | None:
    path = folder / SETTINGS
    try:
        return check_name((CaptureSettings.read(path).name if path.is_file() else None) or folder.name)
    except (ValueError, OSError):
        return None


def _place(dataset: Path, folder: Path) -> str:
    return folder.relative_to(dataset).as_posix()


def _order(place: str) -> list[tuple[object, str]]:
    """By folder, so that "a/b" comes before "a b"."""
    return [(natural_key(part), part) for part in place.split("/")]


def _alike(name: str) -> str:
    """Equal for names that a file system may take for one."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _free(wanted: str, taken: set[str]) -> str:
    """The name, numbered if it is taken."""
    number, name = 1, wanted
    while _alike(name) in taken:
        number += 1
        name = _valid(wanted, ending=f"-{number}")
    return name


def _valid(text: str, *, ending: str = "") -> str:
    """The name most like a text: what names may not have becomes '_', or goes at its ends."""
    text = "".join(character if _fits(f"a{character}a") else "_" for character in text[:LONGEST_NAME])
    while text and not _fits(text + ending):
        text = text[1:] if not _fits(f"{text[0]}a") else text[:-1]
    return text + ending if text else f"capture{ending}"


def _fits(name: str) -> bool:
    try:
        return bool(check_name(name))
    except ValueError:
        return False
