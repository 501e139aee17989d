"""Sync: which frames of all cameras belong to which instant."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

from sync.align import AlignOptions, FrameGroups, SyncReport, align, save_index
from sync.capture import (
    SETTINGS,
    Capture,
    find_capture,
    load_durations,
    load_timecodes,
    offsets_of,
    picture_notes,
    probe_capture,
    timing_notes,
    with_offsets,
)
from sync.clock import ClockMode
from sync.probe import VideoInfo
from sync.timecode import Timecodes
from tasks.artefacts.recipe import write_json
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop

HEARD = ".heard"
"""Folder in the store for the LTC of long sound tracks"""
STARTS = "starts.json"
STARTS_NS = "starts_ns"
"""Key of the same in the header of a scene"""
BY_CONTENT = "what the cameras saw or heard"
UNREAD = "not read"
"""As what a run says what beside the videos seems to belong to them"""
FOOTAGE = "footage"
"""Name of the notes on what was read of the videos, and what was not; missing where there are none"""


@dataclass(frozen=True, kw_only=True)
class Synchronize(Stage):
    """Match the frames of all cameras: sync.json, groups.arrow, videos.json and the AVL index of each camera."""

    name, version = "sync", 6
    small = True
    videos: Files
    timecodes: Files
    fps: Fraction | None
    """What capture.toml says"""
    timecode_column: str | None
    """Likewise"""
    time_offset_s: Mapping[str, str] = field(default_factory=dict)
    """Likewise, and what t_offsets.json adds, as text"""
    starts: Key | None = None
    """When the cameras began to film; None where times tell it"""
    options: AlignOptions

    def build(self, work: Work) -> Notes:
        found = find_capture(work.site.capture)
        self._check(found)
        infos = probe_capture(found, work.progress, listen=self.starts is None, kept=work.site.store / HEARD)
        if self.starts is None:
            timecodes = load_timecodes(found, infos, self.options.clock)
        else:
            starts = read_starts(work.path(self.starts))
            timecodes = with_offsets(found, begun(load_durations(found, infos), starts), self.options.clock)
        groups, report = align(timecodes, self.options)
        groups.save(work.out, report)
        save_index(timecodes, report.clocks, work.out)
        videos = {camera: _info_to_json(info) for camera, info in infos.items()}
        rate = found.settings.fps or _nominal_rate(infos, report)
        write_json(work.out / "videos.json", {"rate": rate, "videos": videos})
        facts = {"instants": len(groups), "cameras": len(groups.cameras), "reference": groups.reference}
        timing = timing_notes(found, infos, self.options.clock)
        notes = [
            *found.notes,
            *_copies(self.videos.sha256),
            *picture_notes(found, infos),
            *timing,
            *(note for info in infos.values() for note in info.notes),
        ]
        return {**facts, FOOTAGE: notes} if notes else facts

    def _check(self, found: Capture) -> None:
        """A file that comes and goes while the job runs is seen by nobody else."""
        videos, timecodes, settings = list(found.videos), list(found.timecodes), found.settings
        if (videos, timecodes) != (list(self.videos.sha256), list(self.timecodes.sha256)) or (
            settings.fps,
            settings.timecode_column,
            _offsets(found, self.options.clock),
        ) != (self.fps, self.timecode_column, self.time_offset_s):
            raise ValueError(f"files or settings of {found.folder} changed while they were read; run the command again")


def _copies(sha256: Mapping[str, str]) -> Iterator[str]:
    """Videos that are other cameras', too, by their content."""
    first = dict[str, str]()
    for camera, content in sha256.items():
        if (other := first.setdefault(content, camera)) != camera:
            yield (
                f"the videos of {other} and {camera} are the same to the byte, so one camera's recording is missing "
                f"and its place is wrong: copy it again, or list one of them under 'ignore' in {SETTINGS}"
            )


def synchronize(workshop: Workshop, options: AlignOptions, starts: Key | None) -> Synchronize:
    """The stage for a workshop's capture; cost: reading the files that changed since the last time."""
    capture = workshop.capture
    return Synchronize(
        videos=workshop.files(capture.videos, "reading videos"),
        timecodes=workshop.files(capture.timecodes, "reading timecodes"),
        fps=capture.settings.fps,
        timecode_column=capture.settings.timecode_column,
        time_offset_s=_offsets(capture, options.clock),
        starts=starts,
        options=options,
    )


def _offsets(capture: Capture, clock: ClockMode) -> dict[str, str]:
    return {camera: str(seconds) for camera, seconds in offsets_of(capture, clock).items()}


def read_starts(folder: Path) -> dict[str, int]:
    """When each camera began to film, ns."""
    data = json.loads((folder / STARTS).read_text())
    return {name: round(start * 1e9) for name, start in data["starts_s"].items()}


def starts_of(report: SyncReport) -> dict[str, int]:
    """The same, as a report of them tells it."""
    return {camera.camera: camera.start_ns for camera in report.cameras}


def begun(timecodes: Mapping[str, Timecodes], starts_ns: Mapping[str, int]) -> dict[str, Timecodes]:
    """Times counted from where each camera began, by its pictures."""
    return {name: codes.begun(starts_ns[name], BY_CONTENT) for name, codes in timecodes.items()}


def selected(groups: FrameGroups, first: int, stop: int | None) -> range:
    """The instants of the groups that a plan asks for; raises ValueError if there are none."""
    chosen = range(len(groups))[first:stop]
    if not chosen:
        raise ValueError(f"the capture has instants 0 to {len(groups) - 1}, none of them in {first}:{stop or ''}")
    if stop is not None and stop > len(groups):
        raise ValueError(f"the capture has {len(groups)} instants, but {first}:{stop} are asked for")
    return chosen


def read_videos(groups: Path) -> dict[str, dict[str, Any]]:
    """What a sync artefact says about the video of each camera: width, height, codec, rate, frames, colour, ..."""
    videos: dict[str, dict[str, Any]] = json.loads((groups / "videos.json").read_text())["videos"]
    return videos


def _nominal_rate(infos: Mapping[str, VideoInfo], report: SyncReport) -> Fraction:
    """The container's rate of the reference, unless its timecodes run at another one."""
    rate = infos[report.reference].rate
    if report.period_ns and abs(rate * report.period_ns / 1_000_000_000 - 1) > Fraction(1, 10):
        return Fraction(1_000_000_000, report.period_ns).limit_denominator(1001)
    return rate


def _info_to_json(info: VideoInfo) -> dict[str, Any]:
    facts = {
        "width": info.width,
        "height": info.height,
        "codec": info.codec,
        "rate": info.rate,
        "frames": info.frame_count,
        "duration_ns": info.duration_ns,
        "bytes": info.size_bytes,
        "colour": asdict(info.colour),
    }
    return {**facts, "rotation_deg": info.rotation_deg} if info.rotation_deg else facts
