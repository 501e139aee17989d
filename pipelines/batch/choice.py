"""Which sequences of a manifest a request means."""

from __future__ import annotations

from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path

from pipelines.batch.request import BatchRequest
from pipelines.manifest import Entry, Row, read_manifest
from sync.capture import check_name

MOST_NAMES = 8
"""Of what there is, in a message"""


def read_sequences(path: Path) -> tuple[Entry, ...]:
    """Every sequence of a manifest, in its order.

    Raises FileNotFoundError without the file, ValueError for one that is no manifest, or whose names are not those of
    folders, each for one capture.
    """
    found = read_manifest(path).sequences
    counts = Counter(check_name(entry.sequence) for entry in found)
    for name, count in counts.items():
        if count > 1 or len({row.capture for entry in found if entry.sequence == name for row in entry.rows}) > 1:
            raise ValueError(f"{path} has the name {name} for two captures; packuv manifest gives each its own")
    return found


def choose(found: tuple[Entry, ...], request: BatchRequest) -> tuple[Entry, ...]:
    """Sequences with one of the names and all of the tags that are asked for; raises ValueError for none."""
    chosen = tuple(entry for entry in found if _fits(entry, request))
    if not chosen:
        names, tags = [entry.sequence for entry in found], sorted({tag for entry in found for tag in entry.tags})
        asked = f"names {', '.join(request.names) or 'any'} and tags {', '.join(request.tags) or 'any'}"
        raise ValueError(
            f"no sequence of {request.manifest} has {asked}; it holds {_some(names)}, with tags {_some(tags)}"
        )
    return chosen


def problem_of(entry: Entry) -> str | None:
    """Why the sequence cannot be processed: the first fault of a camera, by name."""
    return next((_sentence(row) for row in entry.rows if row.problem is not None), None)


def frames_of(entry: Entry, instants: tuple[int, int | None]) -> int:
    """Of its longest video, within the instants that are asked for."""
    first, stop = instants
    longest = max((row.frames or 0 for row in entry.rows), default=0)
    return max(0, min(longest, longest if stop is None else stop) - first)


def _fits(entry: Entry, request: BatchRequest) -> bool:
    named = not request.names or any(fnmatchcase(entry.sequence, pattern) for pattern in request.names)
    return named and set(entry.tags) >= set(request.tags)


def _some(names: list[str]) -> str:
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return (", ".join(names[:MOST_NAMES]) or "none") + more


def _sentence(row: Row) -> str:
    problem = str(row.problem)
    return problem if not row.camera or row.camera in problem else f"{row.camera}: {problem}"
