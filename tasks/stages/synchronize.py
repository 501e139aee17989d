"""Sync: which frames of all cameras belong to which instant."""

from __future__ import annotations

import json
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from packuv.progress import Progress
from sync.align import AlignOptions, FrameGroups, SyncReport, align, build_index, save_index
from sync.capture import Capture, find_capture, load_timecodes
from sync.probe import VideoInfo, probe_video
from tasks.artefacts.recipe import write_json
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.plan import Plan

VERSION = 1


def synchronize(workshop: Workshop, plan: Plan, options: AlignOptions) -> Key:
    """Match the frames of all cameras: sync.json, groups.arrow, videos.json and the AVL index of each camera."""
    capture = find_capture(plan.capture)
    settings = capture.settings
    reads = {"align": options, "fps": settings.fps, "timecode_column": settings.timecode_column}
    inputs = {
        "videos": workshop.digests(capture.videos, "reading videos"),
        "timecodes": workshop.digests(capture.timecodes, "reading timecodes"),
    }
    arguments = {"capture": plan.capture, "options": options}
    return workshop.make("sync", VERSION, reads, inputs, "tasks.stages.synchronize:build", arguments)


def build(capture: Path, options: AlignOptions, out: Path, progress: Progress) -> dict[str, Any]:
    """Match the frames of a capture folder; the job behind `synchronize`."""
    found = find_capture(capture)
    infos = _probe_all(found, progress)
    timecodes = load_timecodes(found, infos)
    groups, report = align(timecodes, options)
    groups.save(out, report)
    save_index(build_index(timecodes, report.clocks), out)
    videos = {camera: _info_to_json(info) for camera, info in infos.items()}
    write_json(out / "videos.json", {"rate": found.settings.fps or _nominal_rate(infos, report), "videos": videos})
    return {"instants": len(groups), "cameras": len(groups.cameras), "reference": groups.reference}


def selected(groups: FrameGroups, first: int, stop: int | None) -> range:
    """The instants of the groups that a plan asks for; raises ValueError if there are none."""
    chosen = range(len(groups))[first:stop]
    if not chosen:
        raise ValueError(f"the capture has instants 0 to {len(groups) - 1}, none of them in {first}:{stop or ''}")
    if stop is not None and stop > len(groups):
        raise ValueError(f"the capture has {len(groups)} instants, but {first}:{stop} are asked for")
    return chosen


def read_videos(groups: Path) -> dict[str, dict[str, Any]]:
    """What a sync artefact says about the video of each camera: width, height, codec, rate, frames, ..."""
    return json.loads((groups / "videos.json").read_text())["videos"]


def _probe_all(capture: Capture, progress: Progress) -> dict[str, VideoInfo]:
    infos = {}
    for done, (camera, path) in enumerate(capture.videos.items()):
        progress(done, len(capture.videos), camera)
        infos[camera] = probe_video(path)
    return infos


def _nominal_rate(infos: Mapping[str, VideoInfo], report: SyncReport) -> Fraction:
    """The container's rate of the reference, unless its timecodes run at another one."""
    rate = infos[report.reference].rate
    if report.period_ns and abs(rate * report.period_ns / 1_000_000_000 - 1) > Fraction(1, 10):
        return Fraction(1_000_000_000, report.period_ns).limit_denominator(1001)
    return rate


def _info_to_json(info: VideoInfo) -> dict[str, Any]:
    return {
        "width": info.width,
        "height": info.height,
        "codec": info.codec,
        "rate": info.rate,
        "frames": info.frame_count,
        "duration_ns": info.duration_ns,
        "bytes": info.size_bytes,
    }
