"""Artefacts without the stages that make them, and stages without processes of their own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from packuv.progress import Progress, no_progress
from tasks.artefacts.stage import Notes, Site, Stage, Work
from tasks.artefacts.store import Key, Store


def put(site: Site, stage: str, fill: Callable[[Path], Any], **options: Any) -> Key:
    """An artefact of a stage whose folder `fill` fills; other options make another one."""

    def build(building: Any) -> None:
        fill(building.out)

    return Store(site.store).make(stage, 1, options, {}, build)


def build_here(stage: Stage, site: Site, folder: Path, progress: Progress = no_progress) -> tuple[Notes, Path]:
    """Do a stage's job in this process; its notes, and the folder `out` in `folder` that it filled."""
    for name in ("out", "scratch"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    return stage.build(Work(site, folder / "out", folder / "scratch", progress)), folder / "out"
