"""t_offsets.json of EasyVolcap: by how much the frames of each camera are late, to parts of a frame.

A camera's name and seconds each. EasyVolcap's own script writes them as frames / fps + sub-frame offset
(`scripts/selfcap/collect_sync.py`); readers of data sets that come with such a file take frame n of a camera for the
instant n / fps - offset. So an offset is taken off the times.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Any

T_OFFSETS = "t_offsets.json"
MOST_OFFSET_S = 10**6
"""By which a camera's times may be moved: eleven days"""


def find_offsets(folder: Path) -> Path | None:
    """The file of a capture folder, there or in calibration/; raises ValueError where both have one."""
    found = [path for path in (folder / T_OFFSETS, folder / "calibration" / T_OFFSETS) if path.is_file()]
    if len(found) > 1:
        raise ValueError(f"{folder} has {T_OFFSETS} twice, there and in calibration/; take one of them out")
    return found[0] if found else None


def read_offsets(path: Path, cameras: Iterable[str]) -> dict[str, Decimal]:
    """Seconds to add to the times of these cameras, of those that the file names.

    Raises ValueError for what is no such file, or names none of them.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"), parse_float=Decimal, parse_int=Decimal)
    except (ValueError, RecursionError) as problem:
        raise ValueError(f"{path} is no JSON: {problem}") from None
    if not isinstance(data, dict) or not data:
        raise ValueError(f'{path} must give seconds by camera, as {{"00": 0.0021}}, but holds {str(data)[:80]}')
    late = {name: _seconds(path, name, value) for name, value in data.items()}
    named = {camera: name for camera in cameras if (name := _named(camera, late)) is not None}
    if not named:
        raise ValueError(f"{path} names {', '.join(sorted(late)[:8])}, none of which is a camera of this capture")
    return {camera: -late[name] for camera, name in named.items()}


def offset_notes(path: Path, moves: Mapping[str, Decimal], cameras: Iterable[str], period_ns: int) -> Iterator[str]:
    """How the file was understood, and what speaks against that; `period_ns` is that of the frames, 0 if unknown."""
    least, most = (float(pick(moves.values())) * 1e3 for pick in (min, max))
    yield (
        f"{path.name} moves the times of {len(moves)} cameras by {least:+.3g} to {most:+.3g} ms: it is read as seconds "
        "that frames are late, as EasyVolcap's are, which nothing in it says"
    )
    if lacking := [camera for camera in cameras if camera not in moves]:
        yield f"{path.name} has no offset for {', '.join(lacking)}: taken for 0"
    if 0 < period_ns < max(abs(least), abs(most)) * 1e6:
        frames = max(abs(least), abs(most)) * 1e6 / period_ns
        yield (
            f"{path.name} moves times by up to {frames:.1f} frames: if it counts frames instead of seconds, take it "
            "out and say time_offset_s in capture.toml"
        )


def _seconds(path: Path, name: str, value: Any) -> Decimal:
    if not isinstance(value, Decimal) or not value.is_finite() or not -MOST_OFFSET_S <= value <= MOST_OFFSET_S:
        raise ValueError(
            f"{path}: the offset of {name!r} must be a number of seconds, at most {MOST_OFFSET_S} either way, but is "
            f"{str(value)[:80]}"
        )
    return value


def _named(camera: str, known: Iterable[str]) -> str | None:
    """The name that means the camera; numbers may have zeros before them."""
    names = list(known)
    if camera in names or not camera.isdecimal():
        return camera if camera in names else None
    same = [name for name in names if name.isdecimal() and int(name) == int(camera)]
    return same[0] if len(same) == 1 else None
