"""Recordings that a camera cut into files: GoPro names them GX010123.MP4, GX020123.MP4, or GOPR0123.MP4, GP010123.MP4
(chapter 01 of recording 0123)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

_CHAPTER = re.compile(r"G[A-Z](?P<chapter>\d{2})(?P<number>\d{4})|GOPR(?P<first>\d{4})", re.IGNORECASE)
SUFFIXES = (".mp4", ".mov")
JOINED = "chapters"
"""Folder of a capture in which chapters lie once they are joined"""


def recordings(files: Iterable[Path]) -> dict[str, dict[int, Path]]:
    """Chapters by their number in the recording, and these by the recording, such as GX0123; other files are missing.

    Raises:
        ValueError: two files are one and the same chapter.
    """
    found: dict[str, dict[int, Path]] = {}
    for path in sorted(files):
        match = _CHAPTER.fullmatch(path.stem)
        if match and path.suffix.lower() in SUFFIXES and path.is_file():
            kind = "GP" if match["first"] else path.stem[:2].upper()
            number = int(match["chapter"] or 0)
            chapters = found.setdefault(f"{kind}{match['first'] or match['number']}", {})
            if number in chapters:
                raise ValueError(
                    f"{path.parent} must hold each chapter once, but {chapters[number].name} and {path.name} are the "
                    "same one; take one of them out"
                )
            chapters[number] = path
    return found


def put_away(inside: Path, camera: str) -> Path:
    """Where the chapters of a camera lie once they are joined."""
    return inside.parent / JOINED / camera


def unjoined(inside: Path) -> Iterator[tuple[str, dict[int, Path]]]:
    """Cameras of which a folder of videos holds chapters, and these: several in the folder, of which some may be put
    away already, or any in one of its own, whose name is then the camera's.

    Raises:
        ValueError: a camera's own folder has chapters of several recordings, or two files are one chapter.
    """
    for recording, chapters in recordings(inside.iterdir()).items():
        if len(chapters) > 1 or put_away(inside, recording).is_dir():
            yield recording, chapters
    for folder in sorted(path for path in inside.iterdir() if path.is_dir() and not path.name.startswith(".")):
        found = recordings(folder.iterdir())
        if len(found) > 1:
            raise ValueError(
                f"{folder} must hold the chapters of one recording, but has those of {', '.join(sorted(found))}; make "
                "a capture folder for each take"
            )
        for chapters in found.values():
            yield folder.name, chapters
