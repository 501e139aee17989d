"""What lies in a capture folder as if it belonged to the capture, under names that are not read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sync.capture import SETTINGS, SOLVE, Capture
from sync.masks import masks_unread
from sync.natural import natural_key
from sync.timecode import SUFFIXES

TIMES = frozenset({"sync", "time", "timecode", "timecodes", "times", "timestamp", "timestamps"})
"""What a folder or file of times may be called"""
CALIBRATIONS = frozenset({"calib", "calibs", "calibration", "calibrations", "cameras", "colmap", "sparse"})
"""What a folder of a calibration may be called"""
CALIBRATION_FILES = frozenset(
    {"cameras.bin", "cameras.txt", "extri.yml", "intri.yml", "models.json", "params.txt", "poses_bounds.npy"}
    | {"rig.json", "transforms.json"}
)


def unread(capture: Capture) -> Iterator[str]:
    """What seems to be masks, times or a calibration of this capture and is not read, one sentence each."""
    yield from masks_unread(capture)
    there = sorted(capture.folder.iterdir(), key=lambda path: natural_key(path.name))
    seen = [path for path in there if not path.name.startswith(".") and path.name != SETTINGS]
    if not capture.timecodes:
        yield from (_times_told(_named(path)) for path in seen if path.name != "timecodes" and _seems_times(path))
        if beside := _beside_videos(capture):
            more = f" and {len(beside) - 1} more" if len(beside) > 1 else ""
            yield _times_told(f"{beside[0].parent.name}/{beside[0].name}{more}")
    if capture.calibration is None and capture.settings.calibration != SOLVE and capture.settings.rig_from is None:
        for path in seen:
            if path.name != "calibration" and _seems_calibration(path):
                yield (
                    f"{_named(path)} seems to hold a calibration and is passed over: one is read from calibration/; "
                    f'move it there, or write calibration = "{path.name}" into {SETTINGS}'
                )


def _named(path: Path) -> str:
    return path.name + "/" * path.is_dir()


def _times_told(name: str) -> str:
    return (
        f"{name} seems to hold times and is passed over: they are read from timecodes/; move what tells times there, "
        "named as the videos"
    )


def _seems_times(path: Path) -> bool:
    if path.is_dir():
        return path.name.lower() in TIMES and any(inner.suffix.lower() in SUFFIXES for inner in path.iterdir())
    return path.stem.lower() in TIMES and path.suffix.lower() in SUFFIXES


def _beside_videos(capture: Capture) -> list[Path]:
    """Files named as videos that lie beside them."""
    files = (video.with_suffix(suffix) for video in capture.videos.values() for suffix in SUFFIXES)
    return [path for path in files if path.is_file() and path not in capture.videos.values()]


def _seems_calibration(path: Path) -> bool:
    name = path.name.lower()
    if path.is_dir():
        return name in CALIBRATIONS and any(inner.is_file() for inner in path.rglob("*"))
    return name in CALIBRATION_FILES or "calib" in path.stem.lower()
