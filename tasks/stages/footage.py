"""The pictures that stages look at: a capture's videos, its frame groups and a rig, as `packuv.footage.views.Views`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.rig import Camera, Rig
from packuv.camera import PinholeCamera
from packuv.footage import LensCamera, Views
from sync.align import FrameGroups
from sync.capture import find_capture
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.plan import Plan
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


@dataclass(frozen=True)
class Footage:
    """Where pictures come from; plain values, so that a job can be told."""

    capture: Path
    """Capture folder"""
    groups: Path
    """Folder of the sync artefact"""
    rig: Path
    """Folder with rig.json"""
    cameras: tuple[str, ...]
    """Cameras to show, in this order"""
    first: int
    """First instant of the capture; instants of the views count from here"""
    stop: int | None
    max_width: int | None = None

    def load_groups(self) -> FrameGroups:
        """The selected instants of all cameras."""
        groups = FrameGroups.load(self.groups)
        chosen = selected(groups, self.first, self.stop)
        rows = slice(chosen.start, chosen.stop)
        return FrameGroups(
            groups.cameras, groups.reference, groups.times_ns[rows], groups.frames[rows], groups.residuals_ns[rows]
        )

    def load_rig(self) -> Rig:
        """The rig of `cameras`."""
        return Rig.load(self.rig / RIG).select(self.cameras)

    def open_views(self, cameras: Sequence[str] | None = None) -> Views:
        """Undistorted, colour-balanced pictures of `cameras`, by default all of this footage."""
        names = self.cameras if cameras is None else tuple(cameras)
        groups, rig = self.load_groups(), self.load_rig()
        columns = [groups.cameras.index(name) for name in names]
        videos = find_capture(self.capture).videos
        lenses = [lens_camera(rig[name]) for name in names]
        return Views(videos, np.ascontiguousarray(groups.frames[:, columns]), lenses, max_width=self.max_width)


def footage_of(
    workshop: Workshop,
    plan: Plan,
    groups: Key,
    rig: Key,
    *,
    cameras: Sequence[str],
    pictures: PictureOptions | None = None,
) -> Footage:
    """Pictures of these cameras in a plan's instants, with the rig of an artefact; without options as filmed."""
    max_width = pictures.max_width if pictures else None
    folders = workshop.path(groups), workshop.path(rig)
    return Footage(plan.capture, *folders, tuple(cameras), plan.first, plan.stop, max_width)


def lens_camera(camera: Camera) -> LensCamera:
    """A calibrated camera in the terms of `packuv`."""
    pinhole = PinholeCamera(
        camera.name, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.camera_from_world
    )
    return LensCamera(pinhole, camera.distortion, camera.gains)
