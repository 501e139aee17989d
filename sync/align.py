"""Which frames of all cameras belong together: frame groups, one per frame of a reference camera.

Paper, appendix "CAPTURE System and Camera Synchronization", algorithm 3. Every camera gets its AVL index; matching a
whole recording walks the index in order (`merge_nearest`) and gives exactly what a search per frame
(`FrameTree.nearest`) gives. Unlike the paper's, matches are mutual, so no frame serves two instants.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numba import njit

from sync.clock import FEWEST_FRAMES, Clock, ClockMode, ClockState, fit_clock, guess_drift, measure_clock
from sync.probe import CONTAINER_TIMES
from sync.timecode import Timecodes
from sync.tree import FrameTree, in_order, merge_mutual, merge_nearest, whole_file, write_whole

SCHEMA = 1
"""Version of sync.json and groups.arrow."""
JUMP_PERIODS = 10
"""A gap longer than this is a pause or a stall, counted as a jump and not as that many dropped frames."""
RATES_APART = 0.1
"""Share by which a camera's frame period differs from the reference's for it to film at another rate"""
HISTOGRAM_BINS = 20
MOST_FRAMES = 2**14
"""Frames of a camera, evenly spaced, that tell how its clock runs: an error of milliseconds averages out to
microseconds, and all frames of a longer recording would tell no pair otherwise"""


@dataclass(frozen=True)
class AlignOptions:
    """How frames are matched."""

    reference: str | None = None
    """Camera whose frames are the instants; None takes the one with the best coverage"""
    tolerance_ns: int | None = None
    """Largest residual of a match; None is half the reference's frame period"""
    mutual: bool = True
    """A match must be nearest both ways, so that no frame serves two instants"""
    clock: ClockMode = ClockMode.TRUSTED
    """What the rig promises about its clocks"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "clock", ClockMode(self.clock))  # options read from JSON bring text
        if self.tolerance_ns is not None and self.tolerance_ns < 0:
            raise ValueError(f"a tolerance must be 0 ns or more, but is {self.tolerance_ns}")


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """For each of T instants, the frame that each of C cameras took then."""

    cameras: tuple[str, ...]
    reference: str
    times_ns: np.ndarray
    """int64 [T]: the instants on the reference clock, strictly increasing"""
    frames: np.ndarray
    """int32 [T, C]: frame number in that camera's video, -1 where it has none"""
    residuals_ns: np.ndarray
    """int64 [T, C]: the camera's time minus the instant's, after clock correction; 0 where it has no frame"""

    def __post_init__(self) -> None:
        shape = (len(self.times_ns), len(self.cameras))
        if self.frames.shape != shape or self.residuals_ns.shape != shape:
            raise ValueError(
                f"{shape[0]} instants of {shape[1]} cameras, but {self.frames.shape=}, {self.residuals_ns.shape=}"
            )
        if self.reference not in self.cameras:
            raise ValueError(f"the reference {self.reference!r} must be one of the cameras {self.cameras}")

    def __len__(self) -> int:
        """Number of instants."""
        return len(self.times_ns)

    def save(self, folder: Path, report: SyncReport | None = None) -> None:
        """Write `groups.arrow`, then `sync.json` with the report, into `folder` (docs/sync.md)."""
        folder.mkdir(parents=True, exist_ok=True)
        table, options = self._table(), pa.ipc.IpcWriteOptions(compression="zstd")
        with (
            whole_file(folder / "groups.arrow") as file,
            pa.ipc.new_file(file, table.schema, options=options) as writer,
        ):
            writer.write_table(table)
        data = {
            "schema": SCHEMA,
            "cameras": list(self.cameras),
            "reference": self.reference,
            "instants": len(self),
            "first_ns": int(self.times_ns[0]) if len(self) else None,
            "last_ns": int(self.times_ns[-1]) if len(self) else None,
            "table": "groups.arrow",
            "report": None if report is None else report.to_json(),
        }
        write_whole(folder / "sync.json", json.dumps(data, indent=1).encode())

    @classmethod
    def load(cls, folder: Path) -> FrameGroups:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: no sync.json or no table in the folder.
            ValueError: another schema, or a table that does not belong to the JSON.
        """
        data = _read_json(folder)
        path = folder / data["table"]
        if not path.is_file():
            raise FileNotFoundError(f"{path} is missing, though {folder / 'sync.json'} is there; run sync again")
        try:
            with pa.memory_map(str(path)) as source:
                table = pa.ipc.open_file(source).read_all()
        except pa.ArrowInvalid as error:
            raise ValueError(f"{path} is damaged; run sync again ({error})") from None
        cameras = tuple(data["cameras"])
        names = ["time_ns", *(f"{kind}:{name}" for name in cameras for kind in ("frame", "residual_ns"))]
        if len(table) != data["instants"] or set(table.column_names) != set(names):
            raise ValueError(f"{path} does not belong to {folder / 'sync.json'}; run sync again")
        shape = (len(table), len(cameras))
        frames, residuals = np.empty(shape, np.int32), np.empty(shape, np.int64)
        for column, name in enumerate(cameras):
            frames[:, column] = table[f"frame:{name}"].to_numpy()
            residuals[:, column] = table[f"residual_ns:{name}"].to_numpy()
        return cls(cameras, data["reference"], table["time_ns"].to_numpy().copy(), frames, residuals)

    def _table(self) -> pa.Table:
        """Residuals take 32 bits unless one exceeds the two seconds that fit."""
        widest = max(int(self.residuals_ns.max(initial=0)), -int(self.residuals_ns.min(initial=0)))
        kind = np.int32 if widest < 1 << 31 else np.int64
        columns = {"time_ns": self.times_ns}
        for column, name in enumerate(self.cameras):
            columns[f"frame:{name}"] = np.ascontiguousarray(self.frames[:, column])
            columns[f"residual_ns:{name}"] = self.residuals_ns[:, column].astype(kind)
        return pa.table(columns)


@dataclass(frozen=True)
class CameraReport:
    """What the timecodes of one camera look like, and how they fit the reference."""

    camera: str
    lines: int
    """Timecodes in the file"""
    duplicates: int
    """Lines whose time an earlier line had; left out"""
    reversals: int
    """Lines with a time before that of the line ahead of them"""
    jumps: int
    """Gaps of more than ten frame periods: pauses and stalls"""
    drops: int
    """Frames missing inside the shorter gaps"""
    start_ns: int
    """First and last time on the camera's own clock"""
    end_ns: int
    period_ns: int
    """Median time between frames; 0 for a single frame"""
    matched: int
    """Instants at which the camera has a frame"""
    matched_share: float
    """The same as a share of all instants"""
    clock: Clock
    residual_median_ns: float
    """Median and 95th percentile of the absolute residuals"""
    residual_p95_ns: float
    histogram: tuple[int, ...]
    """Matches by residual, in equal bins from minus to plus the tolerance"""
    source: str = ""
    """Where its times come from"""
    read: tuple[str, ...] = ()
    """What had to be assumed or mended to read them"""
    drift: Clock | None = None
    """How its frames run away from the reference's although clocks are trusted; None where they do not"""


@dataclass(frozen=True)
class SyncReport:
    """How well a capture is synchronized."""

    reference: str
    reference_named: bool
    """Whether the options named the reference; otherwise coverage chose it"""
    period_ns: int
    """Median time between frames of the reference"""
    tolerance_ns: int
    mutual: bool
    clock: ClockMode
    instants: int
    complete: int
    """Instants at which every camera has a frame"""
    cameras: tuple[CameraReport, ...]

    @property
    def clocks(self) -> dict[str, Clock]:
        """Clock of each camera, as `build_index` takes them."""
        return {report.camera: report.clock for report in self.cameras}

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should look at, one sentence each."""
        return (*_common_notes(self), *(note for report in self.cameras for note in _notes(report, self)))

    def to_json(self) -> dict[str, Any]:
        data = asdict(self)
        data["clock"] = str(self.clock)
        data["cameras"] = [
            {
                **asdict(report),
                "clock": report.clock.to_json(),
                "histogram": list(report.histogram),
                "read": list(report.read),
                "drift": report.drift and report.drift.to_json(),
            }
            for report in self.cameras
        ]
        return {**data, "notes": list(self.notes)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SyncReport:
        cameras = tuple(_camera_from_json(item) for item in data["cameras"])
        fields = {name: value for name, value in data.items() if name != "notes"}
        return cls(**{**fields, "clock": ClockMode(data["clock"]), "cameras": cameras})

    @classmethod
    def load(cls, folder: Path) -> SyncReport:
        """Read the report from `sync.json`.

        Raises:
            FileNotFoundError: no sync.json.
            ValueError: another schema, or it was saved without a report.
        """
        report = _read_json(folder)["report"]
        if report is None:
            raise ValueError(f"{folder / 'sync.json'} was saved without a report; run sync again")
        return cls.from_json(report)


def _camera_from_json(item: Mapping[str, Any]) -> CameraReport:
    drift = item.get("drift")
    parsed = {
        "clock": Clock.from_json(item["clock"]),
        "histogram": tuple(item["histogram"]),
        "read": tuple(item.get("read", ())),
        "drift": None if drift is None else Clock.from_json(drift),
    }
    return CameraReport(**{**item, **parsed})


def align(timecodes: Mapping[str, Timecodes], options: AlignOptions | None = None) -> tuple[FrameGroups, SyncReport]:
    """Match the frames of all cameras to the frames of a reference camera.

    Duplicate, reversed and missing timecodes are counted in the report and are no error.

    Args:
        timecodes: by camera; the columns of the result have the same order. `indices` must be frame numbers of the
            videos (`frame_numbers`).
        options: None means the defaults.

    Raises:
        ValueError: no cameras, a clock that stood still, an unknown reference, no frame period to derive a tolerance
            from, frames of no other camera within the tolerance of the reference's, or no instant at which every camera
            has a frame.
    """
    options = options or AlignOptions()
    if not timecodes:
        raise ValueError("alignment needs the timecodes of at least one camera, but got none")
    times = {camera: _in_order(camera, codes)[0] for camera, codes in timecodes.items()}
    if stopped := [
        camera for camera, codes in timecodes.items() if len(codes) >= FEWEST_FRAMES and len(times[camera]) == 1
    ]:
        raise ValueError(
            f"{', '.join(stopped)} must have a timecode for each frame, but all lines of a camera say the same time, "
            f"{times[stopped[0]][0]} ns: its clock stood still; re-export the times, or list the camera under 'ignore' "
            "in capture.toml"
        )
    reference = _named_reference(times, options.reference) or choose_reference(times)
    tolerance = _tolerance(times, reference, options)
    fitted = _fit_clocks(times, reference) if options.clock is ClockMode.TRIGGERED else None
    groups = _match(timecodes, fitted, reference, tolerance, mutual=options.mutual)
    if len(times) > 1 and (np.delete(_counts(groups), groups.cameras.index(reference)) == 0).all():
        raise ValueError(
            f"no frame of any camera lies within {tolerance} ns of a frame of {reference!r}; "
            f"the cameras' times span {_spans(times)}: do they share a clock, an epoch and a unit?"
            f"{_read_told(timecodes)}"
        )
    if not (groups.frames >= 0).all(axis=1).any():
        raise ValueError(_never_complete(groups, times, tolerance))
    clocks = fitted or _measure_clocks(groups)
    drifts = {} if fitted else _find_drifts(times, reference)
    cameras = tuple(
        replace(
            _camera_report(camera, timecodes[camera], times[camera], groups, clocks[camera], tolerance),
            drift=drifts.get(camera),
        )
        for camera in times
    )
    return groups, _report(groups, cameras, tolerance, options)


def build_index(timecodes: Mapping[str, Timecodes], clocks: Mapping[str, Clock] | None = None) -> dict[str, FrameTree]:
    """AVL index of each camera (algorithm 1), by time on the reference clock where `clocks` are given."""
    return {camera: FrameTree(*_in_order(camera, codes, clocks)) for camera, codes in timecodes.items()}


def save_index(timecodes: Mapping[str, Timecodes], clocks: Mapping[str, Clock] | None, folder: Path) -> None:
    """Write `<folder>/index/<camera>.avl` for each camera: `build_index`, of which one tree is in memory at a time."""
    (folder / "index").mkdir(parents=True, exist_ok=True)
    for camera, codes in timecodes.items():
        FrameTree(*_in_order(camera, codes, clocks)).save(folder / "index" / f"{camera}.avl")


def load_index(folder: Path) -> dict[str, FrameTree]:
    """Map what `save_index` wrote into memory, by camera in the order of the names.

    Raises:
        FileNotFoundError: no index in the folder.
        ValueError: a file is damaged.
    """
    paths = sorted((folder / "index").glob("*.avl"))
    if not paths:
        raise FileNotFoundError(f"{folder / 'index'} holds no frame index; run sync first")
    return {path.stem: FrameTree.load(path) for path in paths}


def choose_reference(times: Mapping[str, np.ndarray]) -> str:
    """Camera with the best coverage: most frames at which at least half the cameras have one, too.

    Of equals the one with fewer frames of its own wins (a faster camera would add instants that few see), then the
    first. A camera has a frame if it has one within half of the candidate's frame period.

    Args:
        times: by camera, int64 [n], strictly increasing.
    """
    best, chosen = (-1, 0), ""
    for camera in sorted(times, key=lambda name: -len(times[name])):
        own = times[camera]
        if len(own) < best[0]:
            break  # it covers no more than it has, nor do those that follow
        reach = (frame_period(own) or 1) // 2
        counts = np.zeros(len(own), np.int64)
        for other in times.values():
            counts += _frames_within(other, own, reach)
        covered = int((counts * 2 >= len(times)).sum())
        if (covered, -len(own)) > best:
            best, chosen = (covered, -len(own)), camera
    return chosen


def frame_period(times: np.ndarray) -> int:
    """Median gap of int64 [n] increasing times, ns; 0 if there is none."""
    return int(np.median(np.diff(times))) if len(times) > 1 else 0


@njit(cache=True, error_model="numpy")
def _frames_within(other: np.ndarray, times: np.ndarray, reach: int) -> np.ndarray:
    """How many of the sorted `other` lie in [time - reach, time + reach) for each sorted time, int64."""
    counts = np.empty(times.size, np.int64)
    first = last = 0
    for i in range(times.size):
        while first < other.size and other[first] < times[i] - reach:
            first += 1
        while last < other.size and other[last] < times[i] + reach:
            last += 1
        counts[i] = last - first
    return counts


def _named_reference(times: Mapping[str, np.ndarray], name: str | None) -> str | None:
    if name is not None and name not in times:
        raise ValueError(f"the reference camera {name!r} must be one of {list(times)}")
    return name


def _tolerance(times: Mapping[str, np.ndarray], reference: str, options: AlignOptions) -> int:
    if options.tolerance_ns is not None:
        return options.tolerance_ns
    # a reference with one frame borrows the period of the others
    period = frame_period(times[reference]) or max(frame_period(own) for own in times.values())
    if period == 0 and len(times) > 1:
        raise ValueError("cameras with one frame each have no frame period; give the tolerance in nanoseconds")
    return period // 2


def _some_frames(values: np.ndarray) -> np.ndarray:
    """At most about MOST_FRAMES of them, evenly spaced."""
    return values[:: 1 + len(values) // MOST_FRAMES]


def _fit_clocks(times: Mapping[str, np.ndarray], reference: str) -> dict[str, Clock]:
    own = times[reference]
    some, period = _some_frames(own), frame_period(own)
    clocks = {camera: fit_clock(some, other, period) for camera, other in times.items() if camera != reference}
    return {**clocks, reference: Clock(ClockState.REFERENCE, int(own[0]))}


def _find_drifts(times: Mapping[str, np.ndarray], reference: str) -> dict[str, Clock]:
    """Of cameras whose frames run away from the reference's, in step with it, by more than a quarter of a frame.

    Trusted clocks have no drift. Where frames follow the reference's all the same, and more or less of them every
    second, either a clock runs wrong, and pairs of nearest frames are wrong after half a frame, or cameras run free.
    """
    own, found = times[reference], dict[str, Clock]()
    period = frame_period(own)
    some = _some_frames(own)
    for camera, other in times.items():
        span = float(other[-1] - other[0])
        if camera == reference or not period or abs(guess_drift(some, other, period)) * span < period / 8:
            continue
        clock = fit_clock(some, other, period)
        if clock.state is ClockState.CORRECTED and abs(clock.drift_ppm) * 1e-6 * span > period / 4:
            found[camera] = clock
    return found


def _never_complete(groups: FrameGroups, times: Mapping[str, np.ndarray], tolerance: int) -> str:
    """Why no instant is complete, as far as can be told."""
    fewest = sorted(zip(_counts(groups).tolist(), groups.cameras, strict=True))[:4]
    counts = ", ".join(f"{camera} has one at {count} of {len(groups)}" for count, camera in fewest)
    return (
        f"no instant has a frame of every camera within {tolerance} ns: {counts}; the cameras' times span "
        f"{_spans(times)}; list cameras that filmed at another time under 'ignore' in capture.toml"
    )


def _measure_clocks(groups: FrameGroups) -> dict[str, Clock]:
    clocks = {}
    for column, camera in enumerate(groups.cameras):
        there = _some_frames(np.flatnonzero(groups.frames[:, column] >= 0))
        clocks[camera] = measure_clock(groups.times_ns[there], groups.residuals_ns[there, column])
    return {**clocks, groups.reference: Clock(ClockState.REFERENCE, int(groups.times_ns[0]))}


def _in_order(
    camera: str, codes: Timecodes, clocks: Mapping[str, Clock] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Distinct times of a camera, int64 [n], and their frames, as its index has them; on the reference clock where
    `clocks` are given. Not copied where they are that already."""
    try:
        return in_order(
            codes.times_ns if clocks is None else clocks[camera].to_reference(codes.times_ns), codes.indices
        )
    except ValueError as error:
        raise ValueError(f"camera {camera!r}: {error}; number its lines with frame_numbers first") from None


def _counts(groups: FrameGroups) -> np.ndarray:
    """Instants at which each camera has a frame, int64 [C]."""
    return np.array([np.count_nonzero(column >= 0) for column in groups.frames.T])


def _match(
    timecodes: Mapping[str, Timecodes],
    clocks: Mapping[str, Clock] | None,
    reference: str,
    tolerance: int,
    *,
    mutual: bool,
) -> FrameGroups:
    cameras, instants = tuple(timecodes), _in_order(reference, timecodes[reference], clocks)[0]
    frames = np.empty((len(instants), len(cameras)), np.int32, order="F")  # they are filled by camera
    residuals = np.empty((len(instants), len(cameras)), np.int64, order="F")
    merge = merge_mutual if mutual else merge_nearest
    for column, camera in enumerate(cameras):
        times, numbers = _in_order(camera, timecodes[camera], clocks)
        positions, residuals[:, column] = merge(times, instants, tolerance)
        frames[:, column] = np.where(positions >= 0, numbers[positions], -1)
    return FrameGroups(cameras, reference, instants, frames, residuals)


def _report(
    groups: FrameGroups, cameras: tuple[CameraReport, ...], tolerance: int, options: AlignOptions
) -> SyncReport:
    return SyncReport(
        reference=groups.reference,
        reference_named=options.reference is not None,
        period_ns=frame_period(groups.times_ns),
        tolerance_ns=tolerance,
        mutual=options.mutual,
        clock=options.clock,
        instants=len(groups),
        complete=int((groups.frames >= 0).all(axis=1).sum()),
        cameras=cameras,
    )


def _camera_report(
    camera: str, codes: Timecodes, times: np.ndarray, groups: FrameGroups, clock: Clock, tolerance: int
) -> CameraReport:
    """Report on the lines of one camera; `times` are the distinct ones in order."""
    gaps, period = np.diff(times), frame_period(times)
    jumps = gaps > JUMP_PERIODS * period
    missing = np.rint(gaps[~jumps] / max(period, 1)).astype(np.int64) - 1
    column = groups.cameras.index(camera)
    there = groups.frames[:, column] >= 0
    residuals = groups.residuals_ns[there, column]
    matched = len(residuals)
    median, high = np.percentile(np.abs(residuals), (50, 95)) if matched else (0.0, 0.0)
    # a tolerance of 0 still needs bins of some width
    counts, _ = np.histogram(residuals, HISTOGRAM_BINS, (-max(tolerance, 1), max(tolerance, 1)))
    return CameraReport(
        camera=camera,
        lines=len(codes),
        duplicates=len(codes) - len(times),
        reversals=int((np.diff(codes.times_ns) < 0).sum()),
        jumps=int(jumps.sum()),
        drops=int(np.maximum(missing, 0).sum()),
        start_ns=int(times[0]),
        end_ns=int(times[-1]),
        period_ns=period,
        matched=matched,
        matched_share=matched / max(len(groups), 1),
        clock=clock,
        residual_median_ns=float(median),
        residual_p95_ns=float(high),
        histogram=tuple(int(count) for count in counts),
        source=codes.source,
        read=codes.notes,
    )


def _common_notes(sync: SyncReport) -> list[str]:
    """Of all cameras together."""
    blind = [report.camera for report in sync.cameras if report.source == CONTAINER_TIMES]
    if not blind:
        return []
    return [
        f"times of {_some(blind)} are those of the containers, which begin at 0 wherever a recording began: right "
        "only if all cameras started at once or the files were cut to a common start; --clock content finds by "
        "pictures and sound when each began"
    ]


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} and {len(names) - 3} more"


def _notes(report: CameraReport, sync: SyncReport) -> list[str]:
    name, clock = report.camera, report.clock
    counts = {"duplicate": report.duplicates, "reversed": report.reversals}
    notes = [f"{name}: {note}" for note in report.read]
    if report.drift is not None:
        over = report.drift.drift_ppm * 1e-6 * (report.end_ns - report.start_ns)
        notes.append(
            f"{name}: its frames drift by {report.drift.drift_ppm:+.1f} ppm from those of {sync.reference}, "
            f"{over / 1e6:+.1f} ms or {over / max(sync.period_ns, 1):+.1f} frames over the recording; if one trigger "
            "fires all cameras, its clock runs wrong and so do the pairs: set clock = 'triggered' in capture.toml"
        )
    notes += [f"{name}: {count} {kind} timecodes" for kind, count in counts.items() if count]
    if report.period_ns and abs(report.period_ns / max(sync.period_ns, 1) - 1) > RATES_APART:
        notes.append(
            f"{name}: it films a frame each {report.period_ns / 1e6:.3g} ms, {sync.reference}, whose frames are the "
            f"instants, each {sync.period_ns / 1e6:.3g} ms, so it has one at {100 * report.matched_share:.0f} % of them"
        )
    if report.jumps:
        notes.append(f"{name}: {report.jumps} pauses of more than {JUMP_PERIODS} frame periods")
    if report.matched == 0:
        notes.append(f"{name}: no frame matches any instant")
    if clock.state is ClockState.FREE_RUNNING:
        notes.append(f"{name}: its frames do not follow the trigger of {sync.reference}; its clock is left alone")
    if clock.state is ClockState.TRUSTED and abs(clock.offset_ns) > sync.period_ns / 4:
        notes.append(f"{name}: frames lie {clock.offset_ns / 1e6:+.1f} ms from the reference's on average")
    return notes


def _spans(times: Mapping[str, np.ndarray]) -> str:
    return ", ".join(f"{camera} {own[0]} to {own[-1]}" for camera, own in list(times.items())[:4])


def _read_told(timecodes: Mapping[str, Timecodes]) -> str:
    """What had to be assumed to read them, which may be why they lie apart."""
    notes = [f"{camera}: {note}" for camera, codes in timecodes.items() for note in codes.notes]
    return "".join(f" {note}" for note in notes[:4])


def _read_json(folder: Path) -> dict[str, Any]:
    path = folder / "sync.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; run sync first")
    try:
        data = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged; run sync again ({error})") from None
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise ValueError(f"{path} must be of schema {SCHEMA}, but is of another; run sync again")
    return data
