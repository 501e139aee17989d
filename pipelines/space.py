"""Whether the disk can hold what a run is about to write."""

from __future__ import annotations

import errno

from packuv.motion.step import fitted_size
from pipelines.disk import free_bytes, size_text, used_bytes
from pipelines.options import SequenceOptions
from sync.align import FrameGroups
from tasks.artefacts.store import Key
from tasks.artefacts.workshop import Workshop
from tasks.stages.footage import PictureOptions
from tasks.stages.plan import Plan
from tasks.stages.synchronize import read_videos, selected

MARGIN = 1.5
"""The forecast is rough, and others write to the disk, too"""
CODE_BYTES = 14
"""Of one Gaussian without view dependence: three 16-bit positions, eight of ten 8-bit columns after removing repeats"""
COPIES = 3
"""A fit's codes lie in its checkpoints, its segment and, less than that, in the scene file"""


def check_space(workshop: Workshop, plan: Plan, options: SequenceOptions, groups: Key) -> None:
    """Raise OSError (no space) if the disk under the store has less room than the run is likely to need.

    What lies in the store counts as written by this run, so that a run that stopped may go on where it fits.
    """
    root = workshop.store.root
    needed, free = MARGIN * forecast_bytes(workshop, plan, options, groups) - used_bytes(root), free_bytes(root)
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"this run needs about {size_text(needed)} more under {root}, but {size_text(free)} are free; "
            "free some, or choose another --out, fewer --frames, or motion.keep_flow=false",
        )


def forecast_bytes(workshop: Workshop, plan: Plan, options: SequenceOptions, groups: Key) -> int:
    """Bytes that the flow cache and the fit of a synchronized capture take, roughly."""
    instants = len(selected(FrameGroups.load(workshop.path(groups)), plan.first, plan.stop))
    videos = read_videos(workshop.path(groups))
    pictures = sum(_motion_bytes(videos[name]["width"], videos[name]["height"], options) for name in plan.fitted)
    columns = CODE_BYTES + 3 * ((options.fit.sh_degree + 1) ** 2 - 1)
    return instants * (pictures + COPIES * columns * options.fit.density.cap)


def _motion_bytes(width: int, height: int, options: SequenceOptions) -> int:
    """Of one picture: flow as two float16 per pixel, the mask as bits."""
    width, height = _fitted(width, height, options.pictures)
    flow = fitted_size(width, height, min(options.motion.flow_width, options.motion.width))
    mask = fitted_size(width, height, options.motion.width)
    return (4 * flow[0] * flow[1] if options.motion.keep_flow else 0) + mask[0] * mask[1] // 8


def _fitted(width: int, height: int, options: PictureOptions) -> tuple[int, int]:
    if options.max_width is None or width <= options.max_width:
        return width, height
    return options.max_width, round(height * options.max_width / width)
