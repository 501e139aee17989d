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
    """Chapters by their number in the recording, and these by the number of the recording; other files are missing."""
    found: dict[str, dict[int, Path]] = {}
    for path in sorted(files):
        match = _CHAPTER.fullmatch(path.stem)
        if match and path.suffix.lower() in SUFFIXES and path.is_file():
            number, chapter = match["first"] or match["number"], int(match["chapter"] or 0)
            found.setdefault(number, {})[chapter] = path
    return found


def unjoined(inside: Path) -> Iterator[tuple[str, dict[int, Path]]]:
    """Cameras of which a folder of videos holds chapters, and these: several in the folder, or any in one of its own,
    whose name is then the camera's.

    Raises:
        ValueError: a camera's own folder has chapters of several recordings.
    """
    for number, chapters in recordings(inside.iterdir()).items():
        if len(chapters) > 1:
            yield f"{chapters[max(chapters)].stem[:2]}{number}", chapters
    for folder in sorted(path for path in inside.iterdir() if path.is_dir() and not path.name.startswith(".")):
        found = recordings(folder.iterdir())
        if len(found) > 1:
            raise ValueError(
                f"{folder} must hold the chapters of one recording, but has those of {', '.join(sorted(found))}; make "
                "a capture folder for each take"
            )
        for chapters in found.values():
            yield folder.name, chapters
