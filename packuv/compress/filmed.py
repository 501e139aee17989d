"""What cameras filmed, beside the scene that was fitted to it: who is believed, and what a compressed scene loses."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from packuv.footage import Views as Footage
from packuv.metrics import psnr
from packuv.progress import Ticks
from packuv.raster import Arena, RasterOptions, render
from packuv.scene import Scene

EXACT_DB = 120.0
"""PSNR of equal pictures, which have none"""
UNLIKE_DB = 6.0
"""By how much less than the middle one a camera that films something else is like the lossless scene"""


class Filmed:
    """Pictures of a scene's cameras, compared with the scene as they would film it."""

    def __init__(
        self,
        scene: Scene,
        footage: Footage,
        *,
        fitted: Sequence[str],
        judged: Collection[str],
        frames: Sequence[int],
        near: float,
        ticks: Ticks,
    ) -> None:
        """Instant i of `footage` is frame i of the lossless scene. Of the cameras that are `judged` some may be
        `fitted`, by which others are followed, too. Ticks count pictures. Raises ValueError where there is none to
        judge by."""
        self.footage, self._frames, self._ticks = footage, frames, ticks
        self._options, self._arena = RasterOptions(near=near), Arena()
        self.unfollowed = self._unlike(scene, fitted)
        """Fitted cameras whose pictures do not show what the scene does, and why that is thought of them"""
        self.followed = tuple(name for name in fitted if name not in self.unfollowed)
        self._held_out = {*judged} - {*fitted}
        self._judged = self._held_out | ({*judged} & {*self.followed})
        self._lossless = self._levels(scene)
        if not self._lossless or (self._held_out and True not in self._lossless):
            names = ", ".join(sorted(self._held_out or judged))
            raise ValueError(
                f"{scene.path} must be compared with what {names} filmed, but the capture has no picture of theirs "
                f"{self._at} that shows the scene; leave the capture out"
            )

    def lost_db(self, scene: Scene) -> float:
        """By how much the PSNR of a compressed scene is below that of the lossless one: of cameras that are held out,
        or of fitted ones if that is more."""
        now = self._levels(scene)
        return max(level - now[group] for group, level in self._lossless.items())

    def _levels(self, scene: Scene) -> dict[bool, float]:
        """PSNR, mean over pictures, of judged cameras that are held out (True), and of others."""
        found = dict[bool, list[float]]()
        for name, level in self._measured(scene, self._judged):
            found.setdefault(name in self._held_out, []).append(level)
        return {group: float(np.mean(levels)) for group, levels in found.items()}

    def _unlike(self, scene: Scene, fitted: Sequence[str]) -> dict[str, str]:
        """Cameras of these that have no picture at any of the frames, or are much further from the scene in the first
        one than others are, and why."""
        levels, unknown = dict[str, float](), {*fitted}
        for name, level in self._measured(scene, unknown):
            levels[name] = level
            unknown.discard(name)
        middle = float(np.median([*levels.values()])) if levels else 0.0
        unlike = {name: f"{level:.1f} dB to the scene, others {middle:.1f}" for name, level in levels.items()
                  if level < middle - UNLIKE_DB}  # fmt: skip
        lacking = {name: f"no picture {self._at}" for name in fitted if name not in levels}
        return {**unlike, **lacking}

    @property
    def _at(self) -> str:
        return f"at frame{'s' if len(self._frames) > 1 else ''} {', '.join(map(str, self._frames))}"

    def _measured(self, scene: Scene, wanted: Collection[str]) -> Iterator[tuple[str, float]]:
        """Camera and PSNR, dB, of each picture of those that are still wanted when its turn comes."""
        for frame in self._frames:
            gaussians = scene.gaussians(frame)
            for number, camera in enumerate(self.footage.cameras):
                if camera.name in wanted and (filmed := self.footage.filmed(number, frame)) is not None:
                    drawn = render(gaussians, camera, options=self._options, arena=self._arena).colour
                    shown = self.footage.response(number, frame).shown(drawn)
                    yield camera.name, min(psnr(shown, filmed), EXACT_DB)
                    self._ticks.advance()
