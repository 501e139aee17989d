"""The pictures that stages look at: a capture's videos, its frame groups and a rig, as `packuv.footage.views.Views`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.rig import Camera, Rig
from packuv.camera import PinholeCamera
from packuv.footage import FrameReader, LensCamera, Views
from sync.align import FrameGroups
from sync.capture import find_capture
from tasks.artefacts.stage import Site
from tasks.artefacts.store import Key
from tasks.stages.synchronize import selected

RIG = "rig.json"
"""Name of the rig's file in artefacts"""


@dataclass(frozen=True)
class PictureOptions:
    """Size of the pictures that are tracked, fitted and scored."""

    max_width: int | None = None
    """Wider pictures are scaled down to this, pixels; none keeps them as filmed"""

    def __post_init__(self) -> None:
        if self.max_width is not None and self.max_width < 16:
            raise ValueError(f"max_width must be at least 16 pixels, but is {self.max_width}")


@dataclass(frozen=True, kw_only=True)
class Take:
    """Which pictures a stage looks at."""

    groups: Key
    rig: Key | None = None
    """Artefact with rig.json; None for who looks at pictures as filmed"""
    cameras: tuple[str, ...]
    """In this order"""
    first: int = 0
    """First instant of the capture; instants of the views count from here"""
    stop: int | None = None
    """The instant after the last one; None, to the end, for a stage that is told its instants"""
    pictures: PictureOptions = PictureOptions()


@dataclass(frozen=True)
class Footage:
    """A take where a job finds it."""

    take: Take
    site: Site

    def load_groups(self) -> FrameGroups:
        """The selected instants of all cameras."""
        groups = FrameGroups.load(self.site.path(self.take.groups))
        chosen = selected(groups, self.take.first, self.take.stop)
        rows = slice(chosen.start, chosen.stop)
        return FrameGroups(
            groups.cameras, groups.reference, groups.times_ns[rows], groups.frames[rows], groups.residuals_ns[rows]
        )

    def load_rig(self) -> Rig:
        """The rig of the cameras."""
        assert self.take.rig is not None, "this take is looked at as filmed"
        return Rig.load(self.site.path(self.take.rig) / RIG).select(self.take.cameras)

    def open_views(self, cameras: Sequence[str] | None = None) -> Views:
        """Undistorted, colour-balanced pictures of `cameras`, by default all of this take."""
        names = self.take.cameras if cameras is None else tuple(cameras)
        groups, rig = self.load_groups(), self.load_rig()
        columns = [groups.cameras.index(name) for name in names]
        videos = find_capture(self.site.capture).videos
        lenses = [lens_camera(rig[name]) for name in names]
        frames = np.ascontiguousarray(groups.frames[:, columns])
        return Views(videos, frames, lenses, max_width=self.take.pictures.max_width)

    def open_plate(self, videos: Mapping[str, Path], pictures: int) -> Views:
        """Up to `pictures` frames, spread over each video of the empty stage, as this take's cameras would show them.

        Raises ValueError for a video of another size than the take's.
        """
        rig, reader = self.load_rig(), FrameReader(videos)
        frames = np.full((pictures, len(videos)), -1, np.int32)
        for column, (name, video) in enumerate(videos.items()):
            height, width = reader.read(name, 0).shape[:2]
            if (width, height) != (rig[name].width, rig[name].height):
                raise ValueError(
                    f"{video} must have the size of the take's video of {name}, {rig[name].width}x{rig[name].height}, "
                    f"but has {width}x{height}; film the empty stage as the take, or leave this camera's plate out"
                )
            count = reader.frame_count(name)
            chosen = np.unique(np.linspace(0, count - 1, min(pictures, count)).round().astype(int))
            frames[: len(chosen), column] = chosen
        lenses = [lens_camera(rig[name]) for name in videos]
        return Views(videos, frames, lenses, max_width=self.take.pictures.max_width, reader=reader)

    def filmed(self, instant: int) -> dict[str, np.ndarray]:
        """Pictures as filmed, uint8 [H, W, 3] RGB, of the cameras that have one at this instant of the take."""
        groups, videos = self.load_groups(), find_capture(self.site.capture).videos
        names = self.take.cameras
        reader = FrameReader({name: videos[name] for name in names})
        numbers = {name: int(groups.frames[instant, groups.cameras.index(name)]) for name in names}
        return {name: reader.read(name, number) for name, number in numbers.items() if number >= 0}


def lens_camera(camera: Camera) -> LensCamera:
    """A calibrated camera in the terms of `packuv`."""
    pinhole = PinholeCamera(
        camera.name, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.camera_from_world
    )
    return LensCamera(pinhole, camera.distortion, camera.gains)
