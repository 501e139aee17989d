"""Encode: the scene file; verify: that it gives back every integer that was fitted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from packuv.files import save_json
from packuv.fit.keyframe import KeyState
from packuv.footage import Light
from packuv.footage.lens import abridged, undistorted_camera
from packuv.footage.light import packed
from packuv.gaussians.codes import OPACITY, Codes
from packuv.gaussians.segment import Segment
from packuv.scene import EncodeOptions, SceneHeader, Sound, Tolerance, open_scene, write_scene
from packuv.scene.header import LENSES
from packuv.scene.sharing import stored_segments
from packuv.scene.sound import RATE
from sync.align import SyncReport
from sync.capture import find_capture
from sync.clock import ClockMode
from sync.content.sound import listen_to_one
from tasks.artefacts.stage import Notes, Site, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.fitting import SEGMENT
from tasks.stages.footage import Footage, Take, lens_camera
from tasks.stages.synchronize import STARTS_NS, starts_of

SCENE = "scene.mkv"


@dataclass(frozen=True, kw_only=True)
class Encode(Stage):
    """Write the scene file from the segments, in order; by default lossless."""

    name, version = "encode", 7
    take: Take
    """All cameras"""
    held_out: tuple[str, ...]
    key: Key
    """First keyframe, whose quantizer is that of all"""
    segments: tuple[Key, ...]
    options: EncodeOptions

    def build(self, work: Work) -> Notes:
        header = self._header(work.site)
        segments = [work.path(key) / SEGMENT for key in self.segments]
        path = work.out / SCENE
        sound = self._sound(work.site, header)
        summary = write_scene(path, segments, header, sound=sound, options=self.options, progress=work.progress)
        notes = {"frames": summary.frames, "bytes": summary.bytes, "track_bytes": dict(summary.track_bytes)}
        save_json(work.out / "encode.json", notes)
        return notes

    def write_finished(self, path: Path, site: Site) -> int:
        """Write the segments as a scene file that ends after them; returns its number of frames.

        For a run that stops early, or to watch one that goes on: the segments are those that are fitted, without a gap
        from the first on. The file is whole or absent at any time, and takes the place of one that is there. Nothing
        goes to the store, for the stage makes the same file of all segments.
        """
        header = self._header(site)
        segments = [site.path(key) / SEGMENT for key in self.segments]
        header = header.first(sum(len(Segment.load(part)) for part in segments))
        return write_scene(path, segments, header, sound=self._sound(site, header), options=self.options).frames

    def _header(self, site: Site) -> SceneHeader:
        footage = Footage(self.take, site)
        return scene_header(footage, self.held_out, KeyState.load(site.path(self.key)), footage.load_light())

    def _sound(self, site: Site, header: SceneHeader) -> Sound | None:
        """What the reference camera, or else another one, heard from the first frame of the scene to its end."""
        if not self.options.sound:
            return None
        frames = {name: int(own[0]) for name, own in Footage(self.take, site).load_frames().items()}
        heard = listen_to_one(find_capture(site.capture).videos, in_turn(frames, header), header.seconds, RATE)
        return heard and Sound.of(*heard)


@dataclass(frozen=True, kw_only=True)
class Verify(Stage):
    """Decode the scene file and compare every frame with the fitted segments.

    Fails on a difference beyond the tolerance that the scene states.
    """

    name, version = "verify", 4
    scene: Key
    segments: tuple[Key, ...]

    def build(self, work: Work) -> Notes:
        scene, segments = work.path(self.scene) / SCENE, [work.path(key) / SEGMENT for key in self.segments]
        frame, worst = 0, Tolerance()
        with open_scene(scene) as opened:
            fitted = (Segment.load(path) for path in segments)
            references = [entry.reference for entry in opened.index.segments]
            if len(references) != len(segments):
                raise RuntimeError(f"{scene} has {len(references)} segments, but {len(segments)} were fitted")
            for path, stored in zip(segments, stored_segments(fitted, references=references), strict=True):
                for index in range(len(stored)):
                    allowed = opened.index.tolerance if index else Tolerance()
                    worst = _worse(worst, opened.codes(frame), stored.frame(index), allowed, f"frame {frame} ({path})")
                    frame += 1
                    work.progress(frame, len(opened))
            if frame != len(opened):
                raise RuntimeError(f"{scene} has {len(opened)} frames, but {frame} were fitted")
        notes = {"frames": frame, "exact": worst.exact, "largest_error": vars(worst)}
        save_json(work.out / "verify.json", notes)
        return notes


def in_turn(frames: Mapping[str, int], header: SceneHeader) -> dict[str, int]:
    """Cameras in the order in which they are asked for the sound of a scene, with their frames: the reference first."""
    return dict(sorted(frames.items(), key=lambda item: item[0] != header.sync.get("reference")))


def scene_header(footage: Footage, held_out: tuple[str, ...], key: KeyState, light: Light | None = None) -> SceneHeader:
    """What the scene says about its capture. No path and no clock time goes in: same input, same bytes.

    `light` is that of the footage's instants, with the cameras' own exposures; None: all is steady.
    """
    groups = footage.site.path(footage.take.groups)
    rig, report, transfer = footage.load_rig(), SyncReport.load(groups), footage.take.pictures.transfer
    lenses = [lens_camera(camera) for camera in rig.cameras]
    cameras = tuple(map(undistorted_camera, lenses))
    return SceneHeader(
        quantizer=key.quantizer,
        times_ns=np.ascontiguousarray(footage.load_groups().times_ns),
        rate=_rate(groups),
        cameras=cameras,
        held_out=held_out,
        sync={
            "reference": report.reference,
            "period_ns": report.period_ns,
            "tolerance_ns": report.tolerance_ns,
            "clock": str(report.clock),
            "instants": report.instants,
            "complete": report.complete,
            # Elsewhere times of the capture itself tell it.
            **({STARTS_NS: starts_of(report)} if report.clock is ClockMode.CONTENT else {}),
        },
        extra={
            "near": key.bounds.near,
            "scene_radius": key.bounds.radius,
            "metric": rig.metric,
            # Absent where nobody knows it, likewise below, so that scenes keep their bytes.
            **({"up": list(rig.up)} if rig.up else {}),
            "max_width": footage.take.pictures.max_width,
            LENSES: abridged(lenses, cameras),
            # Absent where tags decide, so that scenes of such captures keep their bytes.
            **({"transfer": str(transfer)} if transfer else {}),
            **({"exposure": {name: packed(own) for name, own in light.exposures.items()}} if light else {}),
        },
        **({"light": light.light} if light else {}),
    )


def _worse(worst: Tolerance, found: Codes, fitted: Codes, allowed: Tolerance, what: str) -> Tolerance:
    """The largest errors so far; raises RuntimeError beyond what is allowed."""
    if found.xyz.shape != fitted.xyz.shape or found.attributes.shape != fitted.attributes.shape:
        raise RuntimeError(f"{what} does not decode to what was fitted: {len(found)} rows, not {len(fitted)}")
    position = _largest_error(found.xyz, fitted.xyz)
    attribute = _largest_error(found.attributes, fitted.attributes)
    same_rows = np.array_equal(found.attributes[:, OPACITY] > 0, fitted.attributes[:, OPACITY] > 0)
    if position > allowed.position or attribute > allowed.attribute or not same_rows:
        raise RuntimeError(
            f"{what} does not decode to what was fitted: codes differ by up to {position} and {attribute} steps, "
            f"but {allowed.position} and {allowed.attribute} are allowed"
        )
    return Tolerance(max(worst.position, position), max(worst.attribute, attribute))


def _largest_error(found: np.ndarray, fitted: np.ndarray) -> int:
    return int(np.abs(found.astype(np.int32) - fitted.astype(np.int32)).max(initial=0))


def _rate(groups: Path) -> Fraction:
    return Fraction(json.loads((groups / "videos.json").read_text())["rate"])
