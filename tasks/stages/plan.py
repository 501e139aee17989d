"""What every stage of a run needs to know beside its own options."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True)
class Plan:
    """One sequence, which of its instants and cameras, and how to compute."""

    capture: Path
    """Capture folder"""
    videos: Mapping[str, Path]
    """Camera -> video file"""
    held_out: tuple[str, ...]
    """Cameras that are never fitted; scores are taken on them"""
    first: int
    """First instant of the capture that is processed; from then on instants count from 0"""
    stop: int | None
    """The instant after the last one; None: to the end"""
    device: str
    """cpu or cuda"""
    side_by_side: bool
    """Fit segments at the same time, none knowing how the one before it ends; otherwise each goes on from there"""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.held_out if name not in self.videos]:
            raise ValueError(f"cannot hold out {', '.join(unknown)}: the capture has {', '.join(self.videos)}")
        if len(self.fitted) < 2:
            raise ValueError(
                f"at least two cameras must be fitted, but of {len(self.videos)} only {len(self.fitted)} may be"
            )

    def only(self, names: Collection[str]) -> Plan:
        """With these cameras alone; raises ValueError where too few are left to fit."""
        videos = {name: path for name, path in self.videos.items() if name in names}
        return replace(self, videos=videos, held_out=tuple(name for name in self.held_out if name in videos))

    @property
    def fitted(self) -> tuple[str, ...]:
        """Cameras that the fit sees, in the capture's order."""
        return tuple(name for name in self.videos if name not in self.held_out)
