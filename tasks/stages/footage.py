"""The pictures that stages look at: a capture's videos, its frame groups and a rig, as `packuv.footage.views.Views`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.rig import Camera, Rig
from packuv.budget import Budget
from packuv.camera import PinholeCamera
from packuv.files import load_json
from packuv.footage import (
    DamageLog,
    FrameReader,
    LensCamera,
    Light,
    Silhouettes,
    Transfer,
    Views,
    WatchingReader,
    laid_over,
    looks_like_log,
    without,
)
from sync.align import FrameGroups
from sync.capture import find_capture
from sync.masks import find_masks
from tasks.artefacts.stage import Files, Site
from tasks.artefacts.store import Key
from tasks.stages.synchronize import read_videos, selected

RIG = "rig.json"
"""Name of the rig's file in artefacts"""
LIGHT = "light.npz"
"""Name of the file of light and exposures over time in artefacts"""
PACKETS = ".packets"
"""Folder in the store for what the packets of long videos tell"""
LIGHT_FACTS = "light.json"
"""Name of the file beside it, in words and figures"""
DAMAGED = "damaged"
"""Key in these facts of the pictures that are damaged; missing where none is"""
HDR_TAGS = ("arib-std-b67", "smpte2084")
"""Tags of videos that say what their code values mean, HLG and PQ"""


@dataclass(frozen=True)
class PictureOptions:
    """Size of the pictures that are tracked, fitted and scored, and how their code values are read."""

    max_width: int | None = None
    """Wider pictures are scaled down to this, pixels; none keeps them as filmed"""
    transfer: Transfer | None = None
    """What the code values of all videos mean; none: HLG and PQ where a video is tagged so, else a finished picture"""

    def __post_init__(self) -> None:
        if self.max_width is not None and self.max_width < 16:
            raise ValueError(f"max_width must be at least 16 pixels, but is {self.max_width}")

    @property
    def as_filmed(self) -> PictureOptions:
        """The same pictures in their full size."""
        return replace(self, max_width=None)


@dataclass(frozen=True, kw_only=True)
class Take:
    """Which pictures a stage looks at."""

    groups: Key
    rig: Key | None = None
    """Artefact with rig.json; None for who looks at pictures as filmed"""
    light: Key | None = None
    """Artefact with light.npz, measured from the instant `first` on; None: light and exposures are steady"""
    cameras: tuple[str, ...]
    """In this order"""
    first: int = 0
    """First instant of the capture; instants of the views count from here"""
    stop: int | None = None
    """The instant after the last one; None, to the end, for a stage that is told its instants"""
    pictures: PictureOptions = PictureOptions()


@dataclass(frozen=True, kw_only=True)
class MaskedTake(Take):
    """A take of which masks tell the foreground."""

    masks: Files
    """By camera; those of other cameras do not matter"""


@dataclass(frozen=True)
class Footage:
    """A take where a job finds it."""

    take: Take
    site: Site

    def load_groups(self) -> FrameGroups:
        """The selected instants of all cameras; of a take with light, damaged pictures count as missing."""
        groups = FrameGroups.load(self.site.path(self.take.groups))
        chosen = selected(groups, self.take.first, self.take.stop)
        rows = slice(chosen.start, chosen.stop)
        frames = groups.frames[rows]
        if damaged := self._load_damaged():
            frames = frames.copy()
            for column, name in enumerate(groups.cameras):
                if name in damaged:
                    frames[:, column] = without(frames[:, column], damaged[name])
        return FrameGroups(groups.cameras, groups.reference, groups.times_ns[rows], frames, groups.residuals_ns[rows])

    def _load_damaged(self) -> dict[str, Any]:
        """What the stage that saw all pictures says of damaged ones, by camera, see `DamageLog.facts`."""
        if self.take.light is None:
            return {}
        facts: dict[str, Any] = load_json(self.site.path(self.take.light) / LIGHT_FACTS)
        found: dict[str, Any] = facts.get(DAMAGED, {})
        return found

    def load_rig(self) -> Rig:
        """The rig of the cameras."""
        assert self.take.rig is not None, "this take is looked at as filmed"
        return Rig.load(self.site.path(self.take.rig) / RIG).select(self.take.cameras)

    def open_views(self, cameras: Sequence[str] | None = None, *, spill: Path | None = None) -> Views:
        """Undistorted pictures as filmed, and the responses, of `cameras`, by default all of this take.

        What is read again and does not fit into memory goes to the folder `spill`, if given.
        """
        names = self.take.cameras if cameras is None else tuple(cameras)
        groups, rig = self.load_groups(), self.load_rig()
        columns = [groups.cameras.index(name) for name in names]
        videos = find_capture(self.site.capture).videos
        lenses = [lens_camera(rig[name]) for name in names]
        frames = np.ascontiguousarray(groups.frames[:, columns])
        pictures, light = self.take.pictures, self.load_light()
        return Views(
            videos,
            frames,
            lenses,
            max_width=pictures.max_width,
            transfer=pictures.transfer,
            light=light.of(names, len(frames)) if light else None,
            budget=Budget(self.site.memory_bytes),
            spill=spill,
            reader=self._reader({name: videos[name] for name in names}),
        )

    def load_light(self) -> Light | None:
        """Light of the instants and exposures of the cameras; None where they are steady."""
        return Light.load(self.site.path(self.take.light) / LIGHT) if self.take.light else None

    def open_plate(self, videos: Mapping[str, Path], count: int) -> Views:
        """Up to `count` frames, spread over each video of the empty stage, as this take's cameras would show them
        in steady light: a plate has a clock of its own.

        Raises ValueError for a video of another size than the take's.
        """
        rig, reader = self.load_rig(), FrameReader(videos, transfer=self.take.pictures.transfer)
        frames = np.full((count, len(videos)), -1, np.int32)
        for column, (name, video) in enumerate(videos.items()):
            height, width = reader.read(name, 0).shape[:2]
            if (width, height) != (rig[name].width, rig[name].height):
                raise ValueError(
                    f"{video} must have the size of the take's video of {name}, {rig[name].width}x{rig[name].height}, "
                    f"but has {width}x{height}; film the empty stage as the take, or leave this camera's plate out"
                )
            total = reader.frame_count(name)
            chosen = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
            frames[: len(chosen), column] = chosen
        lenses = [lens_camera(rig[name]) for name in videos]
        pictures = self.take.pictures
        return Views(videos, frames, lenses, max_width=pictures.max_width, transfer=pictures.transfer, reader=reader)

    def open_silhouettes(self) -> Silhouettes | None:
        """The foreground of the take, if masks tell it."""
        return Silhouettes(self.open_masks(self.take.masks)) if isinstance(self.take, MaskedTake) else None

    def open_masks(self, files: Files) -> Views:
        """Foreground masks of those of this take's cameras that have some among the files, laid over the pictures that
        `open_views` gives; see `packuv.footage.foreground`."""
        rig, groups, found = self.load_rig(), self.load_groups(), find_masks(find_capture(self.site.capture))
        masks = {name: found[name] for name in self.take.cameras if name in files.sha256}
        frames = groups.frames[:, [groups.cameras.index(name) for name in masks]]
        lenses = [lens_camera(rig[name]) for name in masks]
        return laid_over(masks, frames, lenses, max_width=self.take.pictures.max_width)

    def filmed(self, instant: int) -> dict[str, np.ndarray]:
        """Pictures as filmed, uint8 [H, W, 3] RGB, of the cameras that have one at this instant of the take."""
        reader = self.open_reader()
        frames = {name: int(numbers[instant]) for name, numbers in self.load_frames().items() if numbers[instant] >= 0}
        with ThreadPoolExecutor(self.site.threads) as pool:
            return dict(zip(frames, pool.map(reader.read, frames, frames.values()), strict=True))

    def open_reader(self) -> FrameReader:
        """Pictures as filmed, by camera and number of the frame."""
        videos = find_capture(self.site.capture).videos
        return self._reader({name: videos[name] for name in self.take.cameras})

    def _reader(self, videos: Mapping[str, Path]) -> FrameReader:
        return FrameReader(videos, transfer=self.take.pictures.transfer, kept=self.site.store / PACKETS)

    def open_watching_reader(self, log: DamageLog) -> WatchingReader:
        """The same pictures, damaged ones noted in the log."""
        videos = find_capture(self.site.capture).videos
        own = {name: videos[name] for name in self.take.cameras}
        return WatchingReader(own, log, transfer=self.take.pictures.transfer, kept=self.site.store / PACKETS)

    def load_frames(self) -> dict[str, np.ndarray]:
        """By camera the number of its frame at each instant of the take, int [T], -1 where it has none."""
        groups = self.load_groups()
        return {name: groups.frames[:, groups.cameras.index(name)] for name in self.take.cameras}

    def watch_for_log(self) -> LogWatch:
        """Watches cameras that may have filmed log without saying so: more than 8 bits, no word on what they mean."""
        videos = {} if self.take.pictures.transfer else read_videos(self.site.path(self.take.groups))
        tags = {name: video["colour"] for name, video in videos.items()}
        deep = (name for name, tag in tags.items() if (tag["bit_depth"] or 0) > 8 and tag["transfer"] not in HDR_TAGS)
        return LogWatch(dict.fromkeys(deep, False))


@dataclass
class LogWatch:
    """Looks at pictures on their way."""

    flat: dict[str, bool]
    """By watched camera: whether all of its pictures so far look like log footage"""
    seen: set[str] = field(default_factory=set)

    def passing(self, pictures: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The same pictures, as decoded."""
        for name in self.flat.keys() & pictures.keys():
            self.flat[name] = looks_like_log(pictures[name]) and (self.flat[name] or name not in self.seen)
        self.seen.update(pictures)
        return pictures

    @property
    def suspects(self) -> list[str]:
        return [name for name, flat in self.flat.items() if flat]


def lens_camera(camera: Camera) -> LensCamera:
    """A calibrated camera in the terms of `packuv`."""
    pinhole = PinholeCamera(
        camera.name, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.camera_from_world
    )
    return LensCamera(pinhole, camera.distortion, camera.gains, camera.shading, camera.fisheye)
