"""Clock: when the cameras filmed, by what they saw and heard, for captures whose times tell nothing of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from calibration.importers import load_rig
from calibration.rig import Rig
from packuv.camera import PinholeCamera
from packuv.files import save_json
from packuv.footage import LensCamera, Transfer, Views
from packuv.motion import MotionBackend, MotionOptions, measure_motion
from sync.capture import Capture, find_capture, load_durations, probe_capture
from sync.content import Activity, Offset, find_offsets
from sync.content.sound import Sound, hear, starts_by_sound
from sync.probe import VideoInfo
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.workshop import Workshop
from tasks.stages.calibrate import calibration_files
from tasks.stages.content import LONGEST_STEP, activity_of
from tasks.stages.footage import lens_camera
from tasks.stages.synchronize import STARTS

Starts = dict[str, tuple[float, float]]
"""When each camera began to film, and the error of that, seconds"""
NEAREST = 0.5
"""Frames up to which the error of a start may be for the nearest frame to be told"""
WINDOW_SECONDS = 20.0
"""Of each video are looked at, from its middle; offsets of up to half of it are found"""


@dataclass(frozen=True, kw_only=True)
class FindStarts(Stage):
    """Find when each camera began to film, by what moves or sounds: starts.json, in seconds by camera."""

    name, version = "clock", 6
    videos: Files
    timecodes: Files
    calibration: Files | None
    """Which need not be right: without one, or with one that the pictures refute, sound and whole pictures tell"""
    fps: Fraction | None = None
    """What capture.toml says"""
    timecode_column: str | None = None
    """Likewise"""
    transfer: Transfer | None = None
    """What the videos' code values mean"""
    options: MotionOptions

    def build(self, work: Work) -> Notes:
        capture = find_capture(work.site.capture)
        said = capture.settings
        if (said.fps, said.timecode_column) != (self.fps, self.timecode_column):
            raise ValueError(f"settings of {capture.folder} changed while they were read; run the command again")
        infos = probe_capture(capture, work.progress, listen=False)
        times = {name: codes.times_ns - codes.times_ns.min() for name, codes in load_durations(capture, infos).items()}
        frames, period_s = _rows(times)
        answers = self._answers(capture, infos, frames, period_s, work)
        unsure, by, found = list(times), "", Starts()
        while unsure and (answer := next(answers, None)):
            left = [name for name in times if name not in answer[1] or answer[1][name][1] > NEAREST * period_s]
            if not by or len(left) < len(unsure):
                unsure, (by, found) = left, answer
        if unsure:
            cure = "give " if self.calibration else "give a calibration, with which pictures tell more, or "
            raise ValueError(
                f"the pictures do not tell when {', '.join(unsure)} began to film: in their middle {WINDOW_SECONDS:g} "
                "s too little moves that several cameras see, or they began further than half of that apart, and they "
                f"have no sound in common{_slow(times)}; {cure}timecodes, cut the videos to about a common start, or "
                "leave these cameras out with 'ignore' in capture.toml"
            )
        first = min(start for start, _ in found.values())
        starts = {name: round(start - first, 6) for name, (start, _) in found.items()}
        errors = {name: round(error, 6) for name, (_, error) in found.items()}
        save_json(work.out / STARTS, {"by": by, "starts_s": starts, "errors_s": errors})
        return {"by": by, "cameras": len(starts), "latest_s": max(starts.values())}

    def _answers(
        self, capture: Capture, infos: Mapping[str, VideoInfo], frames: np.ndarray, period_s: float, work: Work
    ) -> Iterator[tuple[str, Starts]]:
        """What tells it, best first: lines of a calibrated rig, sound, then how much moves in pictures."""
        sizes = {name: (info.width, info.height) for name, info in infos.items()}
        posed = _calibrated(capture, sizes) if self.calibration is not None else None
        if posed:
            seen = self._activity(capture, frames, posed, work, posed=True)
            yield "calibration", _starts(find_offsets(seen, len(frames) // 2, paired=False), period_s)
        heard = {name: sound for name, video in capture.videos.items() if (sound := _heard(video)) is not None}
        yield "sound", starts_by_sound(heard)
        seen = self._activity(capture, frames, _filmed(sizes), work, posed=False)
        yield "whole pictures", _starts(find_offsets(seen, len(frames) // 2, paired=False), period_s)

    def _activity(
        self, capture: Capture, frames: np.ndarray, lenses: list[LensCamera], work: Work, *, posed: bool
    ) -> Mapping[str, Activity]:
        views = Views(dict(capture.videos), frames, lenses, transfer=self.transfer)
        folder = work.scratch / ("posed" if posed else "filmed")
        options, threads = replace(self.options, keep_flow=posed), work.site.threads
        cache = measure_motion(views, folder, options, workers=threads, progress=work.progress)
        whole = range(len(frames))
        return {
            camera.name: activity_of(cache, column, camera, whole, posed=posed)
            for column, camera in enumerate(views.cameras)
        }


def find_starts(workshop: Workshop, options: MotionOptions, transfer: Transfer | None) -> FindStarts:
    """The stage for a capture whose cameras began at times that nobody noted."""
    capture = workshop.capture
    source = None if capture.settings.rig_from else capture.calibration  # which a take with another's rig passes over
    files = None if source is None else workshop.files(calibration_files(source), "reading calibration")
    return FindStarts(
        videos=workshop.files(capture.videos, "reading videos"),
        timecodes=workshop.files(capture.timecodes, "reading timecodes"),
        calibration=files,
        fps=capture.settings.fps,
        timecode_column=capture.settings.timecode_column,
        transfer=transfer,
        options=replace(options, keep_flow=False, backend=MotionBackend.DIS),
    )


def _period_ns(own: np.ndarray) -> float:
    return float(np.median(np.diff(np.sort(own))))


def _slow(times: Mapping[str, np.ndarray]) -> str:
    """Cameras that film too few frames to be compared with most."""
    periods = {name: _period_ns(own) for name, own in times.items()}
    usual = float(np.median(list(periods.values())))
    slow = {name: own for name, own in periods.items() if own > (LONGEST_STEP + 0.5) * usual}
    films = ", ".join(f"{name} films {1e9 / own:.3g}" for name, own in slow.items())
    return f"; {films} frames per second, most cameras {1e9 / usual:.3g}, which is too few to compare" if slow else ""


def _rows(times: Mapping[str, np.ndarray]) -> tuple[np.ndarray, float]:
    """Frames int [T, C] that would be of one moment had all cameras begun at once, and the seconds between rows."""
    alone = [name for name, own in times.items() if len(own) < 2]
    if alone:
        raise ValueError(f"a camera needs two frames or more to tell when it began, but {', '.join(alone)} has one")
    period = float(np.median([_period_ns(own) for own in times.values()]))
    shortest = min(float(own.max()) for own in times.values())
    span = min(shortest, WINDOW_SECONDS * 1e9)
    grid = (shortest - span) / 2 + np.arange(int(span / period) + 1) * period
    columns = []
    for own in times.values():
        order = np.argsort(own, kind="stable")
        after = np.clip(np.searchsorted(own[order], grid), 1, len(own) - 1)
        before = after - 1
        found = order[np.where(grid - own[order][before] <= own[order][after] - grid, before, after)]
        found = np.where(np.abs(own[found] - grid) <= period / 2, found, -1)
        found[1:][found[1:] == found[:-1]] = -1  # one frame is of one moment
        columns.append(found)
    return np.stack(columns, axis=1), period / 1e9


def _calibrated(capture: Capture, sizes: Mapping[str, tuple[int, int]]) -> list[LensCamera] | None:
    """The cameras as they are said to stand; None where that cannot be read, which the stage that imports it tells."""
    if capture.calibration is None:
        return None
    with suppress(ValueError, OSError):
        rig: Rig = load_rig(capture.calibration, tuple(sizes), sizes).resized(sizes)
        return [lens_camera(camera) for camera in rig.cameras]
    return None


def _filmed(sizes: Mapping[str, tuple[int, int]]) -> list[LensCamera]:
    """The cameras as if nothing were known of them: their pictures as they are."""
    return [
        LensCamera(PinholeCamera(name, width, height, width, width, width / 2, height / 2, np.eye(4)))
        for name, (width, height) in sizes.items()
    ]


def _heard(video: Path) -> Sound | None:
    return None if video.is_dir() else hear(video)


def _starts(offsets: Mapping[str, Offset], period_s: float) -> Starts:
    return {
        name: (offset.instants * period_s, offset.error * period_s)
        for name, offset in offsets.items()
        if not offset.by_chance
    }
