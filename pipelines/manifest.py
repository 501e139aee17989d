"""The manifest of a data set: one Parquet file, with a row for each camera of each sequence (docs/datasets.md).

A video is opened once: as long as its size, times and inode stay, its row is taken from the manifest of the last scan.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import groupby
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from packuv.files import whole_file
from packuv.progress import Progress, no_progress
from packuv.tables import column_types, optional_fields
from pipelines.dataset import READERS, Found, Survey, sentence
from sync.capture import Capture, file_timecodes
from sync.probe import VideoInfo, probe_video
from tasks.artefacts.digests import SETTLED_SECONDS, folder_digest, signature

VERSION = "1"
AHEAD = 2 * READERS
"""Captures of which videos wait to be read: enough that no reader is idle, and few in memory"""
CHUNK = 1 << 20
"""Bytes read at once"""


@dataclass(frozen=True)
class Row:
    """One camera of one sequence, or one capture whose cameras are unknown. What is unknown is None."""

    sequence: str
    """Unique in the data set"""
    capture: str
    """Folder, absolute"""
    camera: str | None = None
    path: str | None = None
    """Of the video, or of the folder of pictures, relative to the capture, as are all below"""
    codec: str | None = None
    width: int | None = None
    """Pixels, as shown"""
    height: int | None = None
    frames: int | None = None
    fps: str | None = None
    """Nominal, a number or a fraction as 30000/1001"""
    duration_s: float | None = None
    timecodes: str | None = None
    """Where times come from: 'file', 'label' (the container's, after its SMPTE start label), 'container', or 'number'
    (that of each picture)"""
    timecode_path: str | None = None
    calibration: str | None = None
    """None: the rig is solved"""
    bytes: int | None = None
    mtime_ns: int | None = None
    digest: str | None = None
    """SHA-256 of the video's content, hex"""
    tags: tuple[str, ...] = ()
    held_out: bool = False
    problem: str | None = None
    """Why this camera, or the whole capture, cannot be processed"""
    start_label: str | None = None
    """SMPTE label of the first frame, where the container has one"""
    inode: int | None = None
    """None, as ctime_ns, where the next scan must not rely on this row: the video was just changed, or not read"""
    ctime_ns: int | None = None
    timecode_check: str | None = None
    """What the timecode file was when its lines last fitted the video"""


OPTIONAL = optional_fields(Row)
SCHEMA = pa.schema([pa.field(name, kind, nullable=name in OPTIONAL) for name, kind in column_types(Row).items()])
VIDEO_COLUMNS = (
    *("codec", "width", "height", "frames", "fps", "duration_s", "start_label"),
    *("bytes", "mtime_ns", "digest", "inode", "ctime_ns"),
)
"""What the video alone tells"""


@dataclass(frozen=True)
class Entry:
    """One sequence of a manifest."""

    sequence: str
    capture: Path
    rows: tuple[Row, ...]
    """One per camera, in natural order"""

    @property
    def problem(self) -> str | None:
        """The first; None: the sequence can be processed."""
        return next((row.problem for row in self.rows if row.problem is not None), None)

    @property
    def tags(self) -> tuple[str, ...]:
        return self.rows[0].tags


@dataclass(frozen=True)
class Manifest:
    """The rows of a data set, those of a sequence side by side."""

    dataset: Path
    """Absolute"""
    rows: tuple[Row, ...]

    @property
    def sequences(self) -> tuple[Entry, ...]:
        groups = ((name, tuple(rows)) for name, rows in groupby(self.rows, key=lambda row: row.sequence))
        return tuple(Entry(name, Path(rows[0].capture), rows) for name, rows in groups)


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file of another kind or version.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}; packuv manifest DATASET -o {path} makes it")
    try:
        table = pq.read_table(path, partitioning=None)
    except pa.ArrowInvalid:
        raise ValueError(f"{path} must be a manifest, but is no Parquet file; choose another") from None
    facts = table.schema.metadata or {}
    if facts.get(b"packuv_manifest") != VERSION.encode() or not table.schema.equals(SCHEMA):
        raise ValueError(f"{path} is no manifest of version {VERSION}; remove it, and make it with packuv manifest")
    rows = (Row(**{**row, "tags": tuple(row["tags"])}) for row in table.to_pylist())
    return Manifest(Path(os.fsdecode(facts[b"dataset"])), tuple(rows))


def write(path: Path, manifest: Manifest) -> None:
    """Write a manifest, whole or not at all: the same rows give the same bytes."""
    facts = {"packuv_manifest": VERSION, "dataset": os.fsencode(manifest.dataset)}
    table = pa.Table.from_pylist([vars(row) for row in manifest.rows], schema=SCHEMA.with_metadata(facts))
    with whole_file(path) as partial:
        pq.write_table(table, partial, compression="zstd")


def update(path: Path, found: Survey, *, progress: Progress = no_progress) -> Manifest:
    """Bring the manifest at `path` up to date, or make it.

    Whatever ends a scan early, what it has read is kept, and what it did not come to stays as it was.

    Raises:
        ValueError: the file is there, but is no manifest.
    """
    known = read_manifest(path) if path.exists() else None
    remembered = _by_place(known)
    rows, done = list[Row](), 0
    try:
        for read in scan(found, known, progress=progress):
            rows += read
            done += 1
    finally:
        for one in found.captures[done:]:
            known_rows = remembered.get(one.place, [])
            rows += [replace(row, sequence=one.name, capture=str(one.folder)) for row in known_rows]
        manifest = Manifest(found.dataset, tuple(rows))
        write(path, manifest)
    return manifest


def scan(found: Survey, known: Manifest | None = None, *, progress: Progress = no_progress) -> Iterator[list[Row]]:
    """The rows of each capture, in the order of the survey; several videos are read at a time.

    Args:
        known: the manifest of an earlier scan; videos that have not changed since are not opened.
        progress: hears of bytes of the videos that are read.
    """
    remembered = _by_place(known)
    stop = threading.Event()
    pool = ThreadPoolExecutor(READERS)
    try:
        plans = list(pool.map(lambda one: _plan(one, remembered.get(one.place, [])), found.captures))
        meter = _Meter(progress, sum(plan.unread_bytes for plan in plans))
        waiting = deque[tuple[_Plan, dict[str, Future[dict[str, Any]]]]]()
        for plan in plans:
            meter.note = plan.found.name
            waiting.append((plan, {name: pool.submit(_read, path, meter, stop) for name, path in plan.unread.items()}))
            if len(waiting) > AHEAD:
                yield _rows(*waiting.popleft())
        while waiting:
            yield _rows(*waiting.popleft())
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class _Plan:
    """What is to do for one capture."""

    found: Found
    known: Mapping[str, Row]
    """Rows by camera whose videos have not changed"""
    unread: Mapping[str, Path]
    """Other videos by camera"""
    unread_bytes: int


class _Meter:
    """Counts bytes that threads have read."""

    def __init__(self, progress: Progress, total: int) -> None:
        self.note = ""
        self._progress, self._total, self._done = progress, total, 0
        self._lock = threading.Lock()

    def __call__(self, count: int) -> None:
        with self._lock:
            self._done += count
            self._progress(self._done, self._total, self.note)


def _by_place(manifest: Manifest | None) -> dict[str, list[Row]]:
    """Rows by the place of their capture in the data set, so that one that was moved as a whole is known."""
    found = defaultdict[str, list[Row]](list)
    if manifest is not None:
        for row in manifest.rows:
            found[Path(os.path.relpath(row.capture, manifest.dataset)).as_posix()].append(row)
    return found


def _plan(found: Found, remembered: Sequence[Row]) -> _Plan:
    rows = {row.path: row for row in remembered}
    known, unread, size = dict[str, Row](), dict[str, Path](), 0
    for camera, path in found.capture.videos.items() if found.capture else ():
        row = rows.get(_inside(found.folder, path))
        try:
            seen = signature(path)
        except OSError:  # gone since it was found, which reading it will say
            unread[camera] = path
            continue
        if row is not None and seen == [row.bytes, row.mtime_ns, row.ctime_ns, row.inode]:
            known[camera] = row
        else:
            unread[camera] = path
            size += seen[0]
    return _Plan(found, known, unread, size)


def _read(path: Path, tell: Callable[[int], None], stop: threading.Event) -> dict[str, Any]:
    """The columns that a video tells, and its problem."""
    facts: dict[str, Any] = {}
    began_ns = time.time_ns()
    try:
        seen = signature(path)
        facts |= {"bytes": seen[0], "mtime_ns": seen[1]}
        try:
            facts |= _probe_columns(probe_video(path), timed=not path.is_dir())
        except ValueError as error:
            tell(seen[0])
            facts["problem"] = sentence(error)
        else:
            facts["digest"] = _digest(path, tell, stop)
        if signature(path) != seen:
            return facts | {"problem": f"{path} changed while it was read; scan again when it is whole"}
    except OSError as error:  # may be another the next time
        return facts | {"problem": sentence(error)}
    if began_ns - seen[2] > SETTLED_SECONDS * 1e9:
        facts |= {"ctime_ns": seen[2], "inode": seen[3]}
    return facts


def _probe_columns(info: VideoInfo, *, timed: bool) -> dict[str, Any]:
    """`timed`: pictures in a folder have no rate of their own."""
    return {
        "codec": info.codec,
        "width": info.width,
        "height": info.height,
        "frames": info.frame_count,
        "fps": str(info.rate) if timed else None,
        "duration_s": info.duration_ns / 1e9 if timed else None,
        "start_label": info.start_label,
    }


def _digest(path: Path, tell: Callable[[int], None], stop: threading.Event) -> str:
    """`file_digest` of what may be large: others hear how far it is, and can end it."""
    if path.is_dir():
        return folder_digest(path, lambda file: _digest(file, tell, stop))
    sha256, buffer = hashlib.sha256(), memoryview(bytearray(CHUNK))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(buffer):
            if stop.is_set():
                raise CancelledError
            sha256.update(buffer[:count])
            tell(count)
    return sha256.hexdigest()


def _rows(plan: _Plan, reading: Mapping[str, Future[dict[str, Any]]]) -> list[Row]:
    found, capture = plan.found, plan.found.capture
    if capture is None:
        return [_row(sequence=found.name, capture=str(found.folder), problem=found.problem)]
    videos = {name: _known_columns(row) for name, row in plan.known.items()}
    videos |= {name: future.result() for name, future in reading.items()}
    checks = _check_timecodes(
        capture,
        {name: videos[name]["frames"] for name in capture.cameras if "frames" in videos[name]},
        {name: row.timecode_check for name, row in plan.known.items()},
        {name: Fraction(rate) for name in capture.cameras if (rate := videos[name].get("fps"))},
    )
    return [
        _row(
            sequence=found.name,
            capture=str(found.folder),
            camera=name,
            path=_inside(found.folder, path),
            timecodes=_time_source(capture, name, videos[name]),
            timecode_path=_inside(found.folder, capture.timecodes.get(name)),
            calibration=_inside(found.folder, capture.calibration),
            tags=capture.settings.tags,
            held_out=name in capture.settings.held_out,
            **{**checks.get(name, {}), **videos[name]},
        )
        for name, path in capture.videos.items()
    ]


def _row(**columns: Any) -> Row:
    """A row that can be stored: names of files may be anything, text may not."""
    for name, value in columns.items():
        if isinstance(value, str):
            columns[name] = value.encode("utf-8", "backslashreplace").decode()
    return Row(**columns)


def _known_columns(row: Row) -> dict[str, Any]:
    """As `_read` gave them."""
    columns = {name: value for name in VIDEO_COLUMNS if (value := getattr(row, name)) is not None}
    return columns if row.codec is not None else columns | {"problem": row.problem}


def _time_source(capture: Capture, camera: str, video: Mapping[str, Any]) -> str | None:
    if capture.timecodes:
        return "file" if camera in capture.timecodes else None
    if "codec" not in video:
        return None
    if capture.videos[camera].is_dir():
        return "number"
    return "label" if video.get("start_label") else "container"


def _check_timecodes(
    capture: Capture, frames: Mapping[str, int], known: Mapping[str, str | None], rates: Mapping[str, Fraction]
) -> dict[str, dict[str, str]]:
    """`timecode_check` or `problem` of these cameras; a file that fitted before is not read again."""
    if not capture.timecodes:
        return {}
    checks = {camera: _timecode_check(capture, camera, count) for camera, count in frames.items()}
    unsure = {camera: frames[camera] for camera, check in checks.items() if check is None or known.get(camera) != check}
    found = {camera: {"problem": problem} for camera, problem in _timecode_problems(capture, unsure, rates).items()}
    return {camera: {"timecode_check": check} for camera, check in checks.items() if check is not None} | found


def _timecode_check(capture: Capture, camera: str, frames: int) -> str | None:
    """All that decides whether timecodes fit a video; None where it could change without being seen."""
    try:
        seen = signature(capture.timecodes[camera])
    except (KeyError, OSError):
        return None
    if time.time_ns() - seen[2] <= SETTLED_SECONDS * 1e9:
        return None
    return " ".join(map(str, (*seen, frames, capture.settings.fps, capture.settings.timecode_column)))


def _timecode_problems(capture: Capture, frames: Mapping[str, int], rates: Mapping[str, Fraction]) -> dict[str, str]:
    """By camera. They are read together, and one by one if that fails, to find whose fault it is."""
    if not frames:
        return {}
    try:
        file_timecodes(capture, frames, rates)
        return {}
    except (ValueError, OSError) as error:
        if len(frames) == 1:
            return dict.fromkeys(frames, sentence(error))
    alone = (_timecode_problems(capture, {camera: count}, rates) for camera, count in frames.items())
    return {camera: problem for problems in alone for camera, problem in problems.items()}


def _inside(folder: Path, path: Path | None) -> str | None:
    return None if path is None else Path(os.path.relpath(path, folder)).as_posix()
