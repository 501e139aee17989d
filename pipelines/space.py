"""Whether the disk can hold what a run is about to write."""

from __future__ import annotations

import errno
from pathlib import Path

from pipelines.disk import free_bytes, size_text, used_bytes
from pipelines.forecast import Size, store_bytes
from pipelines.options import SequenceOptions
from sync.align import FrameGroups
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.plan import Plan
from tasks.stages.synchronize import read_videos, selected

MARGIN = 1.5
"""The forecast is rough, and others write to the disk, too"""


def check_space(workshop: Workshop, plan: Plan, options: SequenceOptions, groups: Key) -> None:
    """Raise OSError (no space) if the disk under the store has less room than the run is likely to need.

    What lies in the store counts as written by this run, so that a run that stopped may go on where it fits.
    """
    root = workshop.store.root
    check_room(root, store_bytes(size_found(workshop.path(groups), plan), options))


def check_room(root: Path, needed: float) -> None:
    """Raise OSError unless the disk has room for so many bytes in this store, and some more."""
    check_free(root, missing_bytes(root, needed))


def check_free(root: Path, needed: float) -> None:
    """Raise OSError unless so many bytes are free on the disk where this folder is, or would be."""
    if (free := free_bytes(root)) < needed:
        raise OSError(
            errno.ENOSPC,
            f"this needs about {size_text(needed)} more under {root}, but {size_text(free)} are free; "
            "free some, or choose another --out, fewer --frames, or motion.keep_flow=false",
        )


def missing_bytes(root: Path, needed: float) -> float:
    """How much room to ask for where a store is to hold so much."""
    return max(0.0, MARGIN * needed - (used_bytes(root) if root.is_dir() else 0))


def size_found(groups: Path, plan: Plan) -> Size:
    """Of a synchronized capture, whose instants are known; raises ValueError where the plan asks for none of them."""
    instants = len(selected(FrameGroups.load(groups), plan.first, plan.stop))
    videos = read_videos(groups)
    fitted, held_out = (
        tuple((videos[name]["width"], videos[name]["height"]) for name in names)
        for names in (plan.fitted, plan.held_out)
    )
    return Size(instants, fitted, held_out)
