"""Masks: foreground masks that come with a capture are read, and compared with what moves."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from packuv.files import save_json
from packuv.motion import MotionCache
from packuv.motion.foreground import compare_masks
from sync.capture import check_masks, find_capture, find_masks
from tasks.artefacts.stage import Files, Notes, Stage, Work
from tasks.artefacts.store import Key
from tasks.stages.footage import Footage, Take
from tasks.stages.synchronize import read_videos
from tasks.stages.track import MOTION

AGREEMENT = "masks.json"
MOST_OUTSIDE = 0.5
"""Share of what moves that may lie outside the masks: shadows and things that nobody masked move, too"""
EMPTY, FULL = 1e-4, 0.98
"""Shares of a picture below and above which masks tell nothing"""


@dataclass(frozen=True, kw_only=True)
class CheckMasks(Stage):
    """Read the foreground masks of the fitted cameras and compare them with what moves: masks.json."""

    name, version = "masks", 1
    take: Take
    motion: Key
    masks: Files
    """By camera"""

    def build(self, work: Work) -> Notes:
        capture = find_capture(work.site.capture)
        masks = {name: path for name, path in find_masks(capture).items() if name in self.masks.sha256}
        videos = read_videos(work.path(self.take.groups))
        check_masks(capture, masks, {name: videos[name]["frames"] for name in masks})
        facts = self._compare(work, masks)
        save_json(work.out / AGREEMENT, facts)
        return {"cameras": facts, "without": [name for name in self.take.cameras if name not in masks]}

    def _compare(self, work: Work, masks: dict[str, Path]) -> dict[str, Any]:
        views, cache = (
            Footage(self.take, work.site).open_masks(masks),
            MotionCache.load(work.path(self.motion) / MOTION),
        )
        facts = dict[str, Any]()
        with ThreadPoolExecutor(work.site.threads) as pool:
            for found in pool.map(lambda camera: compare_masks(views, cache, camera), range(len(masks))):
                facts[views.names[len(facts)]] = asdict(found)
                work.progress(len(facts), len(masks))
        return facts

    def spared(self, folder: Path, notes: Notes) -> Iterator[tuple[str, str]]:
        if notes["without"]:
            yield "masks", f"no masks of {', '.join(notes['without'])}"
        for name, facts in notes["cameras"].items():
            if why := _doubt(facts):
                yield f"masks of {name}", why


def _doubt(facts: dict[str, Any]) -> str | None:
    """Why a camera's masks are not to be believed."""
    share, outside = facts["foreground_share"], facts["outside_share"]
    if share < EMPTY or share > FULL:
        return f"{share:.2%} of its pictures is foreground, which tells nothing; is white the foreground?"
    if outside is not None and outside > MOST_OUTSIDE:
        return f"{outside:.0%} of what moves lies outside; are they of this camera and numbered like its pictures?"
    return None
