"""What a run leaves for people and programs: run.json, and the input of the report."""

from __future__ import annotations

import contextlib
import json
import platform
import shlex
import socket
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import av
import numpy as np

import packuv
from calibration.accept import RigReport
from calibration.colour import ColourModel
from calibration.rig import Rig
from calibration.triangulate import SparsePoints, reprojections_px
from packuv.files import load_json
from packuv.footage import Light, damage_told
from packuv.scene import open_scene
from packuv.scene.header import VERSION as SCENE_VERSION
from packuv.score import read_table
from pipelines.events import Event, Journal
from pipelines.forecast import Forecast
from pipelines.options import SequenceOptions
from pipelines.request import RunRequest
from pipelines.stages import Made
from sync.align import SyncReport
from sync.content import Content
from tasks.artefacts.jobs import CancelledError
from tasks.artefacts.recipe import plain, restore
from tasks.artefacts.store import Key, Receipt, Store
from tasks.artefacts.workshop import Workshop
from tasks.report.facts import (
    CameraEvidence,
    Choice,
    Compared,
    Comparison,
    FrameScore,
    LastingChange,
    LightCurve,
    MotionCurve,
    ReportInput,
    SceneFigures,
    StageRecord,
    by_camera,
    scene_figures,
)
from tasks.report.record import SCHEMA
from tasks.report.write import JSON_NAME, PAGE_NAME
from tasks.stages.calibrate import CHECK, COLOUR, POINTS
from tasks.stages.content import read_content
from tasks.stages.encode import SCENE
from tasks.stages.evaluate import METRICS, PICTURES, TABLE, fitted_scores, frame_scores
from tasks.stages.fitting import REFUSED
from tasks.stages.footage import LIGHT, RIG
from tasks.stages.light import read_damage, read_steady
from tasks.stages.masks import doubts
from tasks.stages.plan import Plan
from tasks.stages.synchronize import FOOTAGE, UNREAD, read_videos
from tasks.stages.track import read_curve, read_keyframes, repeats_told

WHOLE = (SCENE, PAGE_NAME, JSON_NAME, "run.json")
"""Files of a run that came to its end, in its folder"""


@dataclass(frozen=True)
class Run:
    """One run and what it has made so far."""

    name: str
    """Of the sequence"""
    request: RunRequest
    options: SequenceOptions
    plan: Plan
    workshop: Workshop
    journal: Journal
    started: datetime
    made: Made
    choice: Choice | None = None
    forecast: Forecast | None = None

    def folder(self, stage: str) -> Path | None:
        """Folder of the first artefact of a stage, or None if the run did not come to it."""
        key = self.made.get(stage)
        return self.workshop.path(key) if key else None


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    outcome: str
    """finished, failed, cancelled or stopped"""
    reason: str = ""


def ending_of(error: BaseException) -> Ending:
    """Of a run that raised this."""
    if isinstance(error, CancelledError):
        return Ending("cancelled", str(error))
    if isinstance(error, Exception):
        return Ending("failed", str(error) or type(error).__name__)
    return Ending("stopped", "Ctrl-C" if isinstance(error, KeyboardInterrupt) else "ended by a signal")


def run_json(run: Run, ending: Ending, flow_run: str | None = None) -> dict[str, Any]:
    """Which artefacts with which options, what was skipped and why, and how long it took; also of a failed run.

    `flow_run` is its UUID in the workflow engine.
    """
    events = run.journal.events
    return {
        "sequence": run.name,
        "outcome": ending.outcome,
        "reason": ending.reason,
        "packuv": packuv.__version__,
        "flow_run": flow_run,
        "command": shlex.join(sys.argv),
        "started": run.started.isoformat(timespec="seconds"),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "request": plain(run.request),
        "options": plain(run.options),
        "choice": plain(run.choice),
        "forecast": plain(run.forecast),
        "cameras": {"fitted": run.plan.fitted, "held_out": run.plan.held_out},
        "stages": [event.to_json() for event in events],
        "skipped": [{"what": event.label, "why": event.reason} for event in events if event.outcome == "skipped"],
        "artefacts": [_artefact(run.workshop.store, key) for keys in run.made.keys.values() for key in keys],
    }


def _artefact(store: Store, key: Any) -> dict[str, Any]:
    receipt = store.receipt(key)
    return {
        "artefact": str(key),
        "seconds": receipt.seconds,
        "cpu_seconds": receipt.cpu_seconds,
        "peak_memory_bytes": receipt.peak_memory_bytes,
        "bytes": receipt.size_bytes,
        "finished": receipt.finished,
        "notes": receipt.notes,
    }


def check_whole(folder: Path) -> None:
    """Raise OSError if a file that a whole run leaves is not there, as where somebody removed it meanwhile."""
    for name in WHOLE:
        if not (folder / name).is_file():
            raise OSError(f"the run came to its end, but {folder / name} is not there; run the same command again")


@dataclass(frozen=True)
class Remains:
    """What a report is made of: a run that ends, or what one left in its folder."""

    name: str
    command: str
    options: SequenceOptions
    versions: Mapping[str, str]
    host: str
    finished: str
    """UTC, ISO 8601"""
    seconds: float
    """From start to end"""
    held_out: tuple[str, ...]
    store: Store
    made: Made
    events: Sequence[Event]
    choice: Choice | None
    forecast: Forecast | None

    def folder(self, stage: str) -> Path | None:
        """Folder of the first artefact of a stage, or None if the run did not come to it."""
        key = self.made.get(stage)
        return self.store.path(key) if key else None


def remains(run: Run) -> Remains:
    """Of a run that ends now."""
    now = datetime.now(UTC)
    return Remains(
        name=run.name,
        command=shlex.join(sys.argv),
        options=run.options,
        versions=versions(),
        host=f"{socket.gethostname()}, {run.workshop.jobs.threads} threads a job, {run.plan.device}",
        finished=now.isoformat(timespec="seconds"),
        seconds=(now - run.started).total_seconds(),
        held_out=run.plan.held_out,
        store=run.workshop.store,
        made=run.made,
        events=run.journal.events,
        choice=run.choice,
        forecast=run.forecast,
    )


REPORT = "report"
"""What writing it is called among the stages of a run; a report does not tell of itself"""
PACKAGES = (
    "torch",
    "torchcodec",
    "numpy",
    "numba",
    "av",
    "opencv-contrib-python-headless",
    "pyarrow",
    "pycolmap",
    "prefect",
    "numba-cuda",
    "gsplat",
)
"""Whose versions may change results, or how long they take"""


def versions() -> dict[str, str]:
    """Of what makes results here; packages that are not there are left out."""
    found = {"packuv": packuv.__version__, "python": sys.version.split()[0], "system": platform.platform()}
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    found["ffmpeg in av"] = av.ffmpeg_version_info
    return {**found, "scene file": str(SCENE_VERSION), "report.json": str(SCHEMA)}


def remains_in(folder: Path) -> Remains:
    """Of the run that last ended in the folder of a sequence.

    Raises FileNotFoundError where there is none, or what it made is gone, ValueError for files of another version.
    """
    told, reported = (_told(folder / name) for name in ("run.json", JSON_NAME))
    store, made = Store(folder / "store"), Made()
    try:
        for item in told["artefacts"]:
            stage, _, digest = item["artefact"].partition("/")
            made.add(Key(stage, digest, reused=True))
        record = Remains(
            name=told["sequence"],
            command=reported["run"]["command"],
            options=restore(SequenceOptions, told["options"]),
            versions=reported["run"]["versions"],
            host=reported["run"]["host"],
            finished=reported["run"]["finished"],
            seconds=reported["run"]["seconds"],
            held_out=tuple(told["cameras"]["held_out"]),
            store=store,
            made=made,
            events=[event_of(stage) for stage in told["stages"] if stage["stage"] != REPORT],
            choice=restore(Choice | None, told["choice"]),
            forecast=restore(Forecast | None, told["forecast"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{folder} was written by another version of packuv ({error}); run it again") from None
    for stage in SHOWN:
        if (key := made.get(stage)) and not store.holds(key):
            raise FileNotFoundError(f"the report needs {key}, which is gone from {store.root}; run the same again")
    return record


SHOWN = ("sync", "rig", "light", "points", "content", "masks", "patches", "keyframes", "encode", "verify", "evaluate")
"""Stages whose artefacts a report reads"""


def _told(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"{path.parent} must be the folder of a run that ended, but has no {path.name}")
    try:
        told: dict[str, Any] = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} must hold JSON as packuv writes it: {error}") from None
    return told


def event_of(stage: Mapping[str, Any]) -> Event:
    """Of a stage in run.json."""
    kind, _, digest = stage.get("artefact", "").partition("/")
    key = Key(kind, digest, reused=stage["outcome"] == "reused") if digest else None
    return Event(stage["stage"], stage["outcome"], stage["seconds"], key, stage.get("reason", ""))


def collect(run: Remains) -> ReportInput:
    """What the stages left, for the report; parts that the run did not come to are missing."""
    scores, receipts = _scores(run.folder("evaluate")), _receipts(run)
    rig_folder, sync_folder = run.folder("points") or run.folder("rig"), run.folder("sync")
    return ReportInput(
        name=run.name,
        command=run.command,
        options=run.options,
        versions=run.versions,
        stage_versions={receipt.recipe["stage"]: receipt.recipe["version"] for receipt in receipts},
        otherwise=_otherwise(run, receipts),
        host=run.host,
        finished=run.finished,
        seconds=run.seconds,
        sync=SyncReport.load(sync_folder) if sync_folder else None,
        rig=Rig.load(rig_folder / RIG) if rig_folder else None,
        held_out=run.held_out,
        check=_check(run),
        evidence=_evidence(run.folder("points")),
        content=_content(run.folder("content")),
        masks=_mask_doubts(run),
        unread=tuple(event.reason for event in run.events if event.label == UNREAD),
        footage=tuple(_footage_notes(run)),
        colours={name: video["colour"] for name, video in read_videos(sync_folder).items()} if sync_folder else {},
        unlike=_points_notes(run).get("unlike", {}),
        log_like=tuple(_points_notes(run).get("log_like", ())),
        light=_light(run.folder("light")),
        motion=_curve(run),
        scores=scores,
        fitted=_fitted(run.folder("evaluate")),
        scene=_scene(run),
        pictures=tuple(_pictures(run.folder("evaluate"))),
        stages=tuple(_stage(run.store, event) for event in run.events),
        forecast=tuple(_compared(run, receipts)),
        choice=run.choice and replace(run.choice, minutes=run.seconds / 60, psnr_db=_level(scores)),
    )


def _receipts(run: Remains) -> list[Receipt]:
    """Of all that the run is made of, whoever made it, in order of making."""
    return [
        run.store.receipt(key)
        for keys in run.made.keys.values()
        for key in keys
        if run.store.holds(key)  # what another take lends lies in a store of its own
    ]


def _otherwise(run: Remains, receipts: Sequence[Receipt]) -> dict[str, tuple[str, ...]]:
    """What was made by other software than this run's, or by another processor than the last artefact, by how."""
    found: dict[str, dict[str, None]] = {}
    for receipt in receipts:
        for name, used in receipt.versions.items():
            if (now := run.versions.get(name, used)) != used:
                found.setdefault(f"{name} {used}, not {now}", {})[receipt.recipe["stage"]] = None
        if receipt.cpu and receipts[-1].cpu not in ("", receipt.cpu):
            found.setdefault(f"another processor, {receipt.cpu}", {})[receipt.recipe["stage"]] = None
    return {how: tuple(stages) for how, stages in found.items()}


GROUPS = {
    **dict.fromkeys(("clock", "sync", "mask_files"), "sync"),
    **dict.fromkeys(("rig", "light", "points"), "calibrate"),
    **dict.fromkeys(("motion", "content", "masks", "patches", "keyframes"), "flow"),
    **dict.fromkeys(("background", "backdrop", "key", "segment", "preview"), "fit"),
    **{name: name for name in ("encode", "verify", "evaluate")},
}
"""Stage that each kind of artefact belongs to"""


def _compared(run: Remains, made: Sequence[Receipt]) -> Iterator[Compared]:
    """What was forecast beside what came. Times of stages are work: sums over what the run is made of, whoever made it.
    The total is that of the run from start to end, and what a run that reused nothing would have done beside."""
    if run.forecast is None:
        return
    receipts = [(receipt.recipe["stage"], receipt) for receipt in made]
    for stage, seconds in run.forecast.seconds.items():
        took = [receipt.seconds for name, receipt in receipts if GROUPS[name] == stage]
        yield Compared(stage, "min", seconds / 60, sum(took) / 60 if took else None)
    there = {event.key for event in run.events if event.key and event.outcome == "reused"}
    before = sum(run.store.receipt(key).seconds for key in there if run.store.holds(key))
    name = "total time" if not before else "total time, with what was there before"
    yield Compared(name, "min", run.forecast.minutes, (run.seconds + before) / 60)
    peak = max((receipt.peak_memory_bytes for _, receipt in receipts), default=0)
    yield Compared("memory of the largest job", "GB", run.forecast.memory_bytes / 1e9, peak / 1e9)
    kept = sum(receipt.size_bytes for _, receipt in receipts)
    yield Compared("on disk", "GB", run.forecast.disk_bytes / 1e9, kept / 1e9)
    folder = run.folder("encode")
    scene = (folder / SCENE).stat().st_size / 1e6 if folder else None
    yield Compared("scene file", "MB", run.forecast.scene_bytes / 1e6, scene)


def _level(scores: Sequence[FrameScore]) -> float | None:
    """Mean PSNR over cameras first, then over frames, calibrated, dB."""
    cameras = by_camera(scores).values()
    return float(np.mean([np.mean([score.level_db for score in own]) for own in cameras])) if cameras else None


def _check(run: Remains) -> RigReport | None:
    folder, background = run.folder("rig"), run.made.get("background")
    if folder is None:
        return None
    report = RigReport(**json.loads((folder / CHECK).read_text()))
    refused = run.store.receipt(background).notes.get(REFUSED, {}) if background else {}
    return replace(report, suspicious={**report.suspicious, **refused})


def _evidence(folder: Path | None) -> dict[str, CameraEvidence]:
    if folder is None or not (folder / COLOUR).is_file():
        return {}
    rig, points = Rig.load(folder / RIG), SparsePoints.load(folder / POINTS)
    colour = json.loads((folder / COLOUR).read_text())
    errors = reprojections_px(rig.select(points.cameras), points)
    found = {}
    for name in rig.names:
        seen = errors[points.camera == points.cameras.index(name)] if name in points.cameras else None
        found[name] = CameraEvidence(
            points=colour["observations"].get(name),
            error_px=float(np.median(seen)) if seen is not None and len(seen) else None,
            gain=_gain_told(name, colour),
        )
    return found


def _gain_told(name: str, colour: Mapping[str, Any]) -> str:
    """Whether a camera's gain was measured, for people."""
    held = colour["held_out"].get(name)
    if held is None:
        if name in colour["weak_cameras"]:
            return f"not measured: only {colour['observations'].get(name, 0)} points"
        return "measured with the others" if colour["model"] != str(ColourModel.NONE) else "none: it does not pay"
    if held["spread_before"] is None:
        return f"not measured: only {held['observations']} points"
    told = f"{held['spread_after']:.1%} off instead of {held['spread_before']:.1%}"
    return f"measured after the fit: {told}" if held["kept"] else f"not measured: it would be {told}"


def _footage_notes(run: Remains) -> Iterator[str]:
    sync, light = run.made.get("sync"), run.folder("light")
    if sync:
        yield from run.store.receipt(sync).notes.get(FOOTAGE, ())
    if light:
        yield from (damage_told(name, facts) for name, facts in read_damage(light).items())
    elif run.folder("points"):
        yield "damaged pictures were not looked for, since light.enabled is false"
    if motion := run.made.get("motion"):
        yield from repeats_told(run.store.receipt(motion).notes)


def _content(folder: Path | None) -> Content | None:
    return read_content(folder) if folder else None


def _mask_doubts(run: Remains) -> dict[str, str]:
    notes = [run.store.receipt(key).notes for key in run.made.keys.get("masks", ())]
    return {name: why for part in notes for name, why in doubts(part).items()}


def _points_notes(run: Remains) -> Mapping[str, Any]:
    points = run.made.get("points")
    return run.store.receipt(points).notes if points else {}


def _light(folder: Path | None) -> LightCurve | None:
    if folder is None:
        return None
    light = Light.load(folder / LIGHT)
    return LightCurve(light.light, light.exposures, read_steady(folder))


def _curve(run: Remains) -> MotionCurve | None:
    folder, patches = run.folder("keyframes"), run.made.get("patches")
    if folder is None:
        return None
    notes = run.store.receipt(patches).notes if patches else {"patches": (), "cuts": ()}
    changes = tuple(LastingChange(patch["instant"], tuple(patch["cameras"])) for patch in notes["patches"])
    return MotionCurve(np.array(read_curve(folder)), tuple(read_keyframes(folder)), changes, tuple(notes["cuts"]))


def _scores(folder: Path | None) -> tuple[FrameScore, ...]:
    return frame_scores(read_table(folder / TABLE)) if folder else ()


def _fitted(folder: Path | None) -> tuple[FrameScore, ...]:
    return fitted_scores(load_json(folder / METRICS)) if folder else ()


def _scene(run: Remains) -> SceneFigures | None:
    folder = run.folder("encode")
    if folder is None:
        return None
    with open_scene(folder / SCENE) as scene:
        return scene_figures(scene, verified=True if run.folder("verify") else None)


def _pictures(folder: Path | None) -> Iterator[Comparison]:
    if folder is None:
        return
    inside = folder / PICTURES
    for item in json.loads((inside / "index.json").read_text())["pictures"]:
        yield Comparison(item["camera"], item["frame"], inside / item["truth"], inside / item["render"], item["choice"])


def _stage(store: Store, event: Event) -> StageRecord:
    there = event.key is not None and store.holds(event.key)  # what another take lends lies in a store of its own
    memory = store.receipt(event.key).peak_memory_bytes if event.key and there else None
    return StageRecord(event.label, event.outcome, round(event.seconds, 3), memory, event.reason)  # type: ignore[arg-type]  # StageRecord checks the outcome
